"""What the tests of nodes share: node processes that cannot outlive a test, and waiting with a deadline.

with NodeProcess("fusion_centre", params={"rule": "naive"}) as centre, Probe(ros_context) as probe:
    tracks = probe.listen("/fusion_centre/tracks", PointCloud2)
    probe.wait_for(lambda: tracks, 5.0, "a fused message")
    assert centre.stop() == 0
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from track_fusion.demo.bringup import ros_arguments

STOP_DEADLINE_S = 5.0  # from a signal to the end of the process; a node takes well under one second
POLL_S = 0.02  # how often a condition is looked at while nothing arrives

_pause = threading.Event().wait

# Run as `python -S -c LAUNCHER program ...`: the process dies with its parent, whatever ends that (PR_SET_PDEATHSIG).
LAUNCHER = "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); os.execv(sys.argv[1], sys.argv[1:])"
# Set by the ROS wheels' start-up hook; another environment's Python must find its own libraries.
WHEEL_VARIABLES = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH")


_next_domain = os.getpid() * 7  # suites that start one after the other begin in different places


@contextmanager
def own_domain(domains: Sequence[int]) -> Iterator[int]:
    """Claim a ROS domain that no other test on this machine uses meanwhile."""
    global _next_domain
    for _ in domains:
        domain = domains[_next_domain % len(domains)]
        _next_domain += 1
        # A lock on an open file ends with the process, however it ends.
        path = Path(tempfile.gettempdir()) / f"track_fusion_{os.getuid()}_domain_{domain}.lock"
        lock = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            continue
        try:
            yield domain
        finally:
            os.close(lock)
        return
    raise RuntimeError("Every ROS domain is in use by other tests on this machine.")


class NodeProcess:
    """A node of track_fusion in a process of its own, started on construction, killed at the latest on exit.

    Parameters
    ----------
    executable : module in track_fusion.nodes, such as "sensor_tracker"
    node : name of the node when it differs from the executable's (`__node:=`)
    params, params_file, remaps : what ROS 2 takes on the command line
    python : interpreter to use, this one by default
    env : variables to add to this process's environment
    command : the whole command instead of a node's module, such as ["-m", "track_fusion.cli", "demo"]
    """

    def __init__(
        self,
        executable: str,
        *,
        node: str | None = None,
        params: Mapping[str, Any] | None = None,
        params_file: str | Path | None = None,
        remaps: Mapping[str, str] | None = None,
        python: str | Path = sys.executable,
        env: Mapping[str, str] | None = None,
        command: Sequence[str] | None = None,
    ) -> None:
        self.name = node or executable
        if command is None:
            command = ["-m", f"track_fusion.nodes.{executable}"]
            command += ros_arguments(self.name, params_file and Path(params_file), params or {}, remaps or {})
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(env or {})}
        if str(python) != sys.executable:
            for variable in WHEEL_VARIABLES:
                environment.pop(variable, None)
        self._log = tempfile.TemporaryFile("w+", prefix=f"{self.name}_", suffix=".log")
        self.process = subprocess.Popen(
            [sys.executable, "-S", "-c", LAUNCHER, str(python), *command],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        try:
            self.stop()
        except TimeoutError:
            if error_type is None:
                raise
        finally:
            self.kill()
            if error_type is not None:  # pytest shows it beside the failure
                print(f"--- output of {self.name} (exit code {self.process.returncode})\n{self.output()}")
            self._log.close()

    @property
    def pid(self) -> int:
        """The node's process id: no wrapper stays between."""
        return self.process.pid

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self.process.poll() is None

    def output(self) -> str:
        """Return what the process has printed so far, both streams together."""
        log = self._log.fileno()
        return os.pread(log, os.fstat(log).st_size, 0).decode(errors="replace")  # leaves the writer's offset alone

    def send(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        if self.running:
            self.process.send_signal(number)

    def wait(self, deadline_s: float) -> int:
        """Wait for the process to end by itself; return its exit code."""
        try:
            return self.process.wait(deadline_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"{self.name} still runs after {deadline_s} s. It printed:\n{self.output()}") from None

    def stop(self, number: int = signal.SIGINT, deadline_s: float = STOP_DEADLINE_S) -> int:
        """Send SIGINT (or another signal) and wait for the end; return the exit code."""
        self.send(number)
        return self.wait(deadline_s)

    def kill(self) -> None:
        """End the process and whatever it started, at once."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            return
        finally:
            self.process.wait()

    def wait_for_output(self, text: str, deadline_s: float) -> str:
        """Wait until the process has printed a text; return all its output."""
        wait_until(
            lambda: text in self.output() or not self.running, deadline_s, f"{text!r} from {self.name}", self.output
        )
        if text not in self.output():
            raise AssertionError(f"{self.name} ended without printing {text!r}. It printed:\n{self.output()}")
        return self.output()

    def memory_bytes(self) -> int:
        """Return the resident memory of the process."""
        resident_pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
        return resident_pages * os.sysconf("SC_PAGE_SIZE")


def wait_until(
    condition: Callable[[], object],
    deadline_s: float,
    what: str,
    detail: Callable[[], str] = str,
    step: Callable[[float], object] = _pause,
) -> None:
    """Wait until a condition holds; raise TimeoutError, saying what was waited for, when it does not in time."""
    end = time.monotonic() + deadline_s
    while not condition():
        remaining_s = end - time.monotonic()
        if remaining_s <= 0:
            raise TimeoutError(f"Waited {deadline_s} s in vain for {what}. {detail()}".rstrip())
        step(min(POLL_S, remaining_s))


class Probe:
    """A node of the test's own, with its executor: listens, publishes, calls services, waits with a deadline."""

    def __init__(self, context: Any, name: str = "test_probe", **node_options: Any) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self.node = Node(name, context=context, **node_options)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)

    def __enter__(self) -> Probe:
        return self

    def __exit__(self, *_: object) -> None:
        self.executor.shutdown()
        self.node.destroy_node()

    def wait_for(self, condition: Callable[[], object], deadline_s: float, what: str = "the condition") -> None:
        """Spin until a condition holds; raise TimeoutError when it does not in time."""
        wait_until(condition, deadline_s, what, step=lambda s: self.executor.spin_once(timeout_sec=s))

    def listen(self, topic: str, message_type: type, qos: Any = 100) -> list[Any]:
        """Subscribe; return the list that grows by each message while the probe spins."""
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, qos)
        return received

    def publisher(
        self, topic: str, message_type: type, qos: Any = 100, readers: int = 1, deadline_s: float = 10.0
    ) -> Any:
        """Make a publisher and wait until it is matched with that many subscriptions."""
        publisher = self.node.create_publisher(message_type, topic, qos)
        self.wait_for(lambda: publisher.get_subscription_count() >= readers, deadline_s, f"{readers} reader of {topic}")
        return publisher

    def wait_for_publisher(self, topic: str, count: int = 1, deadline_s: float = 10.0) -> None:
        """Wait until that many publishers of a topic are seen."""
        self.wait_for(lambda: self.node.count_publishers(topic) >= count, deadline_s, f"{count} publisher of {topic}")

    def _asked_again(self, client: Any, request: Any, future: Any, deadline_s: float) -> Any:
        """Ask a question that changes nothing every fifth of the deadline until it is answered; the future that is."""
        for _ in range(4):
            try:
                self.wait_for(future.done, deadline_s / 5, "an answer")
            except TimeoutError:
                future = client.call_async(request)
        return future

    def call(self, service: str, service_type: type, request: Any, deadline_s: float = 10.0) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(service_type, service)
        try:
            self.wait_for(client.service_is_ready, deadline_s, f"service {service}")
            future = client.call_async(request)
            if service_type.__name__.startswith("Get"):  # a server that does not know its client yet drops the answer
                future = self._asked_again(client, request, future, deadline_s)
            self.wait_for(future.done, deadline_s, f"an answer from {service}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def state(self, node: str, deadline_s: float = 10.0) -> str:
        """Return the lifecycle state of a node: "unconfigured", "inactive", "active", "finalized"."""
        from lifecycle_msgs.srv import GetState

        return str(self.call(f"{node}/get_state", GetState, GetState.Request(), deadline_s).current_state.label)

    def wait_for_state(self, node: str, state: str, deadline_s: float = 10.0) -> None:
        """Wait until a lifecycle node is in a state."""
        end = time.monotonic() + deadline_s
        while (now := self.state(node, max(end - time.monotonic(), 0.0))) != state:
            if time.monotonic() > end:
                raise TimeoutError(f"{node} is {now} after {deadline_s} s, not {state}.")
