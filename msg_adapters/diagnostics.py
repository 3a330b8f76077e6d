"""diagnostic_msgs/DiagnosticArray, what /diagnostics carries."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from msg_adapters.header import make_header

OK, WARN, ERROR, STALE = range(4)


def diagnostic_array(
    stamp_ns: int, node_name: str, level: int | bytes, summary: str, values: Mapping[str, object]
) -> DiagnosticArray:
    """Make a message of one status.

    Parameters
    ----------
    stamp_ns : int          nanoseconds
    node_name : str         name of the status and its hardware_id
    level : int or bytes    OK, WARN, ERROR or STALE
    summary : str           one line for people
    values : mapping        key to value; floats are given with 6 digits

    Raises
    ------
    ValueError    no such level
    """
    number = level[0] if isinstance(level, bytes) and len(level) == 1 else level
    if number not in (OK, WARN, ERROR, STALE):
        raise ValueError(f"The 'level' must be 0 (OK), 1 (WARN), 2 (ERROR) or 3 (STALE). Got {level!r}.")
    status = DiagnosticStatus(
        level=bytes([int(number)]),  # a ROS byte is a bytes object in Python
        name=node_name, message=summary, hardware_id=node_name,
        values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
    )  # fmt: skip
    return DiagnosticArray(header=make_header(stamp_ns, ""), status=[status])


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
