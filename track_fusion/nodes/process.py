"""A node as a process: its exit code, its last words, its clean end."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress

import rclpy
import rclpy.utilities
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

from track_fusion.nodes.managed import ManagedNode
from track_fusion.params import Fault, ParameterError

#: A signal takes effect on the context within this time.
SIGNAL_LAG_S = 0.5
RCLError: type[Exception] = rclpy_implementation.RCLError


def run(make: Callable[[], ManagedNode]) -> int:
    """Run a node until SIGINT, SIGTERM or its own end; return the exit code.

    0: ended as asked; 1: a fault; 2: a parameter was wrong.
    """
    node = None
    try:  # from here on a signal may come, also while rclpy is being initialised
        try:
            rclpy.init()
        except RCLError as error:  # a parameter file that cannot be read, a malformed argument
            return _failed(str(error), 2)
        executor = SingleThreadedExecutor()
        node = make()
        executor.add_node(node)
        while rclpy.utilities.ok() and not getattr(node, "finished", False):
            executor.spin_once()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterError as error:
        return _failed(str(error), 2)
    except Exception as error:
        # When a signal comes while the node is being built or waits, what it builds upon is gone; that is no fault.
        if not _ending():
            if not isinstance(error, Fault):
                raise
            return _failed(str(error), 1)
    finally:
        _close(node)
    return 0


def _ending() -> bool:
    """Tell whether a signal is ending this process: its errors may be seen a little before the context says so."""
    deadline = time.monotonic() + SIGNAL_LAG_S
    try:
        while rclpy.utilities.ok() and time.monotonic() < deadline:
            time.sleep(0.01)
    except KeyboardInterrupt:  # Python's own handler may run after that of rclpy
        return True
    return not rclpy.utilities.ok()


def _failed(text: str, code: int) -> int:
    print(text, file=sys.stderr)
    return code


def _close(node: ManagedNode | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ending already; a second Ctrl-C shall not lose the result
    try:
        if node is not None:
            node.close()
    finally:
        with suppress(RCLError):  # a signal may have shut the context down between the look and the call
            rclpy.utilities.try_shutdown()


def end(code: int) -> None:
    """End the process with this code.

    Destroying a node entity by entity while its context goes down can crash inside DDS; by now all is published and
    written, so the process leaves without.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
