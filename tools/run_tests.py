"""Run stages of tests, print what each took, and fail when one fails.

    .venv/bin/python -m tools.run_tests [STAGE ...]     those of `make test`, unless named
    .venv/bin/python -m tools.run_tests --rest          those that `make test-all` adds to them

No test runs twice with the same versions. Later stages run also when an earlier one failed. JUnit files land in
out/test/.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from xml.etree import ElementTree

from tools.make_venv import WHEEL_VARIABLES, sourced_prefixes

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "out" / "test"
PYTHON = ROOT / ".venv" / "bin" / "python"
EXECUTABLES = ("sensor_tracker", "fusion_centre", "replay", "evaluator", "track-fusion")
# Not .venv/bin/colcon: with a sourced ROS, colcon may be the system's, whose tests would not see the environment.
COLCON = "import sys; from colcon_core.command import main; sys.exit(main())"
EXTRAS = ("click", "jsonschema", "rich", "rosbags", "matplotlib")
FLOOR = ("numpy==1.26.*", "scipy==1.11.*")
FLOOR_PYTHONS = ((3, 11), (3, 12))  # NumPy 1.26 has no wheel for later ones
# Two tests at a time on two cores; a file's tests stay together, for they share processes.
PARALLEL = ("-n", "auto", "--dist", "loadfile")
# Threads of BLAS only fight for the cores: with SciPy 1.11's, tests of small matrices take five times as long.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
# Hundreds of processes start: compiled modules are kept, whatever the shell says.
DROPPED = ("PYTHONDONTWRITEBYTECODE",)
COMMAND_LIMIT_S = 1200  # far above what any one command takes; a hang must not outlive it


class StageFailure(Exception):
    """A stage failed; the message is its line in the summary."""


class StageSkipped(Exception):
    """A stage cannot run here; the message says why."""


@dataclasses.dataclass
class Counts:
    """Tests of one or more pytest runs."""

    passed: int = 0
    failed: int = 0
    skipped: int = 0

    def __add__(self, other: Counts) -> Counts:
        """Return the sums."""
        return Counts(self.passed + other.passed, self.failed + other.failed, self.skipped + other.skipped)

    def __str__(self) -> str:
        """Say it in the words CI systems read."""
        return f"{self.passed} passed, {self.failed} failed, {self.skipped} skipped"


#: Commands at work, to be ended with this one.
running: set[subprocess.Popen[str]] = set()


def run(
    command: Sequence[object], *, cwd: Path = ROOT, env: dict[str, str] | None = None, capture: bool = False
) -> str:
    """Run a command in a process group of its own; raise StageFailure unless it exits with 0."""
    words = [str(word) for word in command]
    shown = " ".join(words).replace(f"{PYTHON} -c {COLCON}", "colcon").replace(f"{ROOT}/", "")
    print("$", shown, flush=True)
    dropped = DROPPED if sourced_prefixes() else (*DROPPED, *WHEEL_VARIABLES)
    clean = {k: v for k, v in (env or os.environ).items() if k not in dropped}
    process = subprocess.Popen(
        words, cwd=cwd, env=clean, text=True, stdout=subprocess.PIPE if capture else None, start_new_session=True
    )
    running.add(process)
    try:
        output, _ = process.communicate(timeout=COMMAND_LIMIT_S)
    except subprocess.TimeoutExpired:
        raise StageFailure(f"took longer than {COMMAND_LIMIT_S} s: {shown}") from None
    finally:
        stop_group(process)
        running.discard(process)
    if process.returncode != 0:
        print(output or "", end="")
        raise StageFailure(f"exit code {process.returncode} from: {shown}")
    return output or ""


def stop_group(process: subprocess.Popen[str]) -> None:
    """End whatever a command left running in its process group."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return
    process.wait()


def end_commands() -> None:
    """End all commands at work and what they left running."""
    for process in list(running):
        stop_group(process)


def junit_counts(path: Path) -> Counts:
    """Read the counts of a JUnit file."""
    suites = list(ElementTree.parse(path).getroot().iter("testsuite"))
    total, bad, skipped = (
        sum(int(suite.get(name, 0)) for suite in suites for name in names)
        for names in (("tests",), ("failures", "errors"), ("skipped",))
    )
    return Counts(total - bad - skipped, bad, skipped)


def pytest(name: str, counts: list[Counts], *arguments: object, python: Path = PYTHON, **extra_env: str) -> None:
    """Run pytest, adding its counts also when it fails."""
    report = RESULTS / f"{name}.xml"
    report.unlink(missing_ok=True)
    command = [python, "-m", "pytest", "-q", "--durations=5", f"--junit-xml={report}", *arguments]
    try:
        run(command, env={**os.environ, **ONE_THREAD, **extra_env})
    finally:
        if report.exists():
            counts.append(junit_counts(report))


def make_venv(folder: str, extras: str, *pins: str) -> Path:
    """Make or update another environment with this Python; return its interpreter."""
    command = [PYTHON, "tools/make_venv.py", folder, "--extras", extras]
    for pin in pins:
        command += ["--pin", pin]
    run(command)
    return ROOT / folder / "bin" / "python"


def lint(counts: list[Counts]) -> None:
    """Run ruff, and mypy --strict over the library and the adapters."""
    failures = []
    for arguments in (
        ["ruff", "check", "--output-format", "concise", "."],
        ["ruff", "format", "--check", "--quiet", "."],
        ["mypy", "--strict"],
    ):
        try:
            run([PYTHON, "-m", *arguments])
        except StageFailure:
            failures.append(" ".join(arguments[:2]))
    if failures:
        raise StageFailure(f"{' and '.join(failures)} found something")


def suite(counts: list[Counts]) -> None:
    """Run every test that is not slow."""
    pytest("suite", counts, *PARALLEL, "-m", "not slow")


def slow(counts: list[Counts]) -> None:
    """Run the slow tests."""
    pytest("slow", counts, *PARALLEL, "-m", "slow")


def colcon(counts: list[Counts]) -> None:
    """Build and test the package as a robot does, in a scratch workspace."""
    with tempfile.TemporaryDirectory(prefix="track_fusion_ws_") as folder:
        workspace = Path(folder)
        source = workspace / "src" / "track_fusion"
        copy_sources(source)
        command = [PYTHON, "-c", COLCON, "--log-level", "error"]
        env = {**os.environ, "AMENT_PREFIX_PATH": os.environ.get("AMENT_PREFIX_PATH") or str(ROOT / ".venv")}
        listed = run([*command, "list"], cwd=workspace, env=env, capture=True).split()
        if listed != ["track_fusion", "src/track_fusion", "(ros.ament_python)"]:
            raise StageFailure(f"`colcon list` says {' '.join(listed)!r}, not (ros.ament_python)")
        run([*command, "build", "--event-handlers", "console_cohesion+"], cwd=workspace, env=env)
        check_installed(workspace, source)
        check_installed_command(workspace, env)
        test_workspace(command, workspace, env, counts)


def test_workspace(command: Sequence[object], workspace: Path, env: dict[str, str], counts: list[Counts]) -> None:
    """Run `colcon test` on the marked tests, and check that it ran them: without any it would be green, too."""
    expected = marked_tests(workspace / "src" / "track_fusion")
    # A "-m" of its own would be taken for colcon's: hence the leading space, which colcon strips.
    run([*command, "test", "--pytest-args", " -m", "colcon"], cwd=workspace, env=env)
    results = workspace / "build" / "track_fusion" / "pytest.xml"
    shutil.copy(results, RESULTS / "colcon.xml")
    counts.append(junit_counts(results))
    run([*command, "test-result", "--all", "--verbose"], cwd=workspace, env=env)
    ran = dataclasses.astuple(counts[-1])
    if sum(ran) != expected or counts[-1].passed == 0:
        raise StageFailure(f"colcon test ran {sum(ran)} tests ({counts[-1]}), but {expected} carry the marker")


def copy_sources(target: Path) -> None:
    """Copy what git tracks, and new files it does not ignore, so that work not yet committed is tested too."""
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listing, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():  # a file deleted but not yet committed is still listed
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target / name)


def check_installed(workspace: Path, source: Path) -> None:
    """Check that executables, marker, manifest, parameter files and launch files are where ROS looks for them."""
    prefix = workspace / "install" / "track_fusion"
    share = prefix / "share" / "track_fusion"
    wanted = [prefix / "lib" / "track_fusion" / name for name in EXECUTABLES]
    wanted += [prefix / "share" / "ament_index" / "resource_index" / "packages" / "track_fusion", share / "package.xml"]
    wanted += [share / path.relative_to(source) for path in source.glob("config/*")]
    wanted += [share / path.relative_to(source) for path in source.glob("launch/*.launch.py")]
    missing = [str(path.relative_to(prefix)) for path in wanted if not path.exists()]
    if missing:
        raise StageFailure("colcon build did not install " + ", ".join(missing))


def check_installed_command(workspace: Path, env: dict[str, str]) -> None:
    """Run the installed command in a shell with the workspace sourced: it must load the installed copy."""
    script = (
        ". install/local_setup.sh && cd / && python3 -c 'import track_fusion; print(track_fusion.__file__)' && "
        '"$OLDPWD"/install/track_fusion/lib/track_fusion/track-fusion rules --json > /dev/null'
    )
    path = f"{PYTHON.parent}{os.pathsep}{os.environ['PATH']}"
    loaded = run(["sh", "-c", script], cwd=workspace, env={**env, "PATH": path}, capture=True).strip()
    if not loaded.startswith(str(workspace / "install")):
        raise StageFailure(f"the built workspace loads track_fusion from {loaded}")


def marked_tests(source: Path) -> int:
    """Count the tests that carry the marker, as pytest collects them."""
    command = [PYTHON, "-m", "pytest", "--collect-only", "-qq", "-m", "colcon"]
    lines = run(command, cwd=source, capture=True).splitlines()
    return sum(int(line.rsplit(": ", 1)[1]) for line in lines if ": " in line)


def floor(counts: list[Counts]) -> None:
    """Run what is neither slow nor the same with all versions, with the oldest NumPy and SciPy: Ubuntu 24.04's."""
    pytest("floor", counts, *PARALLEL, "-m", "not slow and not once", python=floor_python())


def floor_rest(counts: list[Counts]) -> None:
    """Run all other tests with the oldest NumPy and SciPy."""
    pytest("floor-rest", counts, *PARALLEL, "-m", "slow or once", python=floor_python())


def floor_python() -> Path:
    """Make or update the environment of the oldest versions; return its interpreter."""
    if sys.version_info[:2] not in FLOOR_PYTHONS:
        raise StageSkipped("NumPy 1.26 has no wheel for Python {}.{}".format(*sys.version_info[:2]))
    with making:
        return make_venv(".venv-floor", "all,test", *FLOOR)


#: One at a time makes the environment of the oldest versions; for the next it is there.
making = threading.Lock()


def make_ahead() -> None:
    """Make the environment of the oldest versions; when that fails, the stage that needs it tries again and tells."""
    with contextlib.suppress(StageFailure, StageSkipped):
        floor_python()


def bare(counts: list[Counts]) -> None:
    """Start the four nodes in an environment with rclpy, the messages, NumPy and SciPy, and nothing else."""
    if sourced_prefixes():
        raise StageSkipped("with a sourced ROS the system's Python packages are seen, so no environment is bare")
    python = make_venv(".venv-bare", "")
    extras = run([python, "-c", f"import importlib.util as u; print(*filter(u.find_spec, {EXTRAS}))"], capture=True)
    if extras.strip():
        raise StageFailure(f"the bare environment is not bare: it has {extras.strip()}")
    pytest("bare", counts, "test/package/test_nodes_start.py", TRACK_FUSION_NODE_PYTHON=str(python))


Stage = Callable[[list[Counts]], None]
#: `make test`: what a change breaks first.
TEST: dict[str, Stage] = {"lint": lint, "suite": suite, "floor": floor}
#: What `make test-all` adds: what is slow or needs more.
REST: dict[str, Stage] = {"slow": slow, "floor-rest": floor_rest, "colcon": colcon, "bare": bare}
STAGES = TEST | REST


def run_stage(name: str, counts: list[Counts]) -> tuple[str, float]:
    """Run one stage; return its outcome in words and its wall time in seconds."""
    print(f"\n=== {name}: {(STAGES[name].__doc__ or '').splitlines()[0]}", flush=True)
    start = time.monotonic()
    try:
        STAGES[name](counts)
        outcome = "ok"
    except StageSkipped as reason:
        outcome = f"skipped: {reason}"
    except StageFailure as reason:
        outcome = f"FAILED: {reason}"
    took_s = time.monotonic() - start
    print(f"=== {name}: {outcome} ({took_s:.1f} s)", flush=True)
    return outcome, took_s


def chosen() -> tuple[list[str], bool]:
    """Read from the command line which stages are to run, and whether they are the second half of `make test-all`."""
    parser = argparse.ArgumentParser(description="Run stages of tests.")
    parser.add_argument("stages", nargs="*", metavar="STAGE", help=f"{', '.join(STAGES)}; none: {', '.join(TEST)}")
    parser.add_argument("--rest", action="store_true", help=f"the second half of `make test-all`: {', '.join(REST)}")
    options = parser.parse_args()
    unknown = [name for name in options.stages if name not in STAGES]
    if unknown:
        parser.error(f"no stage {', '.join(unknown)}; there are {', '.join(STAGES)}")
    return options.stages or list(REST if options.rest else TEST), options.rest


def main() -> int:
    """Run stages; print the summary; return the exit code."""
    names, rest = chosen()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what runs is ended, as on Ctrl-C
    atexit.register(end_commands)
    RESULTS.mkdir(parents=True, exist_ok=True)
    # The last line of `make test-all` counts what its first half, `make test`, has run just before.
    before = [RESULTS / f"{name}.xml" for name in TEST if rest]
    counts = [junit_counts(path) for path in before if path.exists()]
    if "floor" in names[1:]:  # meanwhile earlier stages run: it waits for the network more than it computes
        threading.Thread(target=make_ahead, daemon=True).start()
    results = {name: run_stage(name, counts) for name in names}
    print("\n=== Summary")
    for name, (outcome, took_s) in results.items():
        print(f"{name:12}{took_s:7.1f} s  {outcome}")
    failed = [name for name, (outcome, _) in results.items() if outcome.startswith("FAILED")]
    print(f"{'all':12}{sum(took_s for _, took_s in results.values()):7.1f} s")
    if counts:
        print(f"tests: {sum(counts, Counts())}")
    if failed:
        print(f"FAILED: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
