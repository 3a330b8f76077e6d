"""What all nodes share: lifecycle with autostart, input held back, counted rejections, diagnostics."""

from __future__ import annotations

import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import rclpy.utilities
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from msg_adapters.arrays import MessageError
from msg_adapters.classes import message_class
from msg_adapters.diagnostics import diagnostic_array
from track_fusion.clock import ClockParams
from track_fusion.messages.counts import Counts
from track_fusion.messages.parameters import ManagedParams
from track_fusion.nodes.ros_params import declare, refuse_unknown_of, unfit_files
from track_fusion.params import Fault, ParameterError

DIAGNOSTICS_PERIOD_S = 1.0
#: How often a held-back message looks whether the clock and the subscribers are there.
LOOK_PERIOD_S = 0.02
#: So many messages are held back at most; later ones are rejected.
MAX_HELD = 10_000


def qos(depth: int, *, latched: bool = False) -> QoSProfile:
    """Reliable, keep the last `depth`: the default of every topic of this package; latched: also for late readers."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=depth, durability=durability
    )


def class_of(kind: str) -> type:
    """Return the class of a type such as sensor_msgs/msg/PointCloud2.

    Raises
    ------
    Fault    its package is not installed
    """
    try:
        return message_class(kind)
    except ImportError as error:
        raise Fault(
            f"The type {kind} cannot be had. {error} Or leave its topics out (of a bag: by bag_topics)."
        ) from None


class ManagedNode(LifecycleNode):
    """A lifecycle node whose subclasses declare parameters, connect topics and handle messages.

    Subclasses define `declare_parameters_` (all of them), `connect` (on configure) and may define
    `on_start`, `on_stop`, `on_clock_jump`, `diagnose` and `close`.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.log: Any = LifecycleNode.get_logger(self)
        self.counts = Counts(lambda text: self.log.warning(text))
        self.counted, self.rejected = self.counts.counted, self.counts.rejected
        self.active = False
        self.released = False
        self._error: Exception | None = None
        self.outputs: list[tuple[Any, int]] = []
        self._held: deque[tuple[Callable[[Any], None], Any]] = deque()
        self._look: Any = None
        self._wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.managed, self.clock = declare(self, ManagedParams), declare(self, ClockParams)
        self.declare_parameters_()
        refuse_unknown_of(self)
        self._warn_of_unfit_files(kwargs)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos(10))
        self.every(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics)
        backward = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        self._jump = self.get_clock().create_jump_callback(backward, post_callback=self._on_jump)
        if self.managed.autostart:
            self._autostart()

    def _warn_of_unfit_files(self, options: Mapping[str, Any]) -> None:
        """Say which parameter files of the command line are for other nodes: a misspelt section goes unnoticed."""
        arguments = [*(options.get("cli_args") or ()), *(sys.argv if options.get("use_global_arguments", True) else ())]
        name = self.get_fully_qualified_name()
        for path, names in unfit_files(arguments, name).items():
            self.log.warning(f"The file {path} has no parameters for {name}. It has some for {', '.join(names)}.")

    # What subclasses fill in.

    def declare_parameters_(self) -> None:
        """Declare parameters; a ParameterError ends the start-up."""

    def connect(self) -> None:
        """Create publishers and subscriptions."""

    def on_start(self) -> None:
        """Begin, after activation."""

    def on_clock_jump(self) -> None:
        """Forget what belongs to another time: the clock has jumped back."""

    def on_stop(self) -> None:
        """Drop what waits, at deactivation."""

    def diagnose(self) -> tuple[list[str], dict[str, Any]]:
        """Return warnings and values to report."""
        return [], {}

    def close(self) -> None:
        """Do last things when the process ends."""

    # Lifecycle.

    def _autostart(self) -> None:
        """Configure and activate; rclpy has no such thing. Raise what made it fail; the log has an unforeseen error."""
        transitions: list[Callable[[], Any]] = [self.trigger_configure, self.trigger_activate]
        for transition in transitions:
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise self._error or Fault(f"{self.get_name()} could not start.")

    def on_configure(self, state: Any) -> Any:
        """Connect topics."""
        return self._guarded(self.connect) if not self.outputs else TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: Any) -> Any:
        """Begin to process."""
        result = super().on_activate(state)
        if result == TransitionCallbackReturn.SUCCESS:
            self.active = True
            result = self._guarded(self._start)
        self.active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: Any) -> Any:
        """Stop processing; what arrives from now on is ignored."""
        self._stop()
        return super().on_deactivate(state)

    def on_shutdown(self, state: Any) -> Any:
        """Stop processing for good."""
        self._stop()
        return super().on_shutdown(state)

    def _stop(self) -> None:
        self.active = self.released = False
        self._held.clear()
        if self._look is not None:
            self._look.cancel()
        self.on_stop()

    def _guarded(self, action: Callable[[], None]) -> Any:
        """Run a transition's work; rclpy would swallow its error, so log it and fail."""
        try:
            action()
        except (Fault, ParameterError) as error:
            self._error = error
            if not self.managed.autostart:  # else the process ends with it
                self.log.error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            if rclpy.utilities.ok():  # else a signal has come meanwhile
                self.log.error(f"{error}\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _start(self) -> None:
        self._began = time.monotonic()
        self.released = not self._awaited()
        if not self.released:
            self._look = self.every(LOOK_PERIOD_S, self._release)
        self.on_start()

    # Topics.

    def publisher(self, kind: type, topic: str, depth: int = 10, expected: int = 0) -> Any:
        """Create a lifecycle publisher, its QoS overridable; input is held back until `expected` subscribe."""
        pub = LifecycleNode.create_lifecycle_publisher(
            self, kind, topic, qos(depth), qos_overriding_options=QoSOverridingOptions.with_default_policies()
        )
        self.outputs.append((pub, expected))
        return pub

    def subscribe(self, kind: type, topic: str, handle: Callable[[Any], None], depth: int = 10, **kwargs: Any) -> Any:
        """Subscribe; `handle` is called while active, and a message that cannot be read is counted, never fatal."""

        def guarded(msg: Any) -> None:
            if not self.active:
                return
            if self.released:
                self._handle(handle, msg)
            elif len(self._held) < MAX_HELD:
                self._held.append((handle, msg))
            else:
                self.reject({"held_too_long": 1}, f"{MAX_HELD} messages wait for {self._awaited()}")

        return self.create_subscription(
            kind, topic, guarded, qos(depth),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(), **kwargs,
        )  # fmt: skip

    def drained(self, subscription: Any, limit: int) -> Iterator[Any]:
        """Take the messages that wait in a subscription, at most so many; none while older ones are held back."""
        for _ in range(0 if self._held else limit):
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            yield taken[0]

    def _handle(self, handle: Callable[[Any], None], msg: Any) -> None:
        try:
            handle(msg)
        except MessageError as error:
            self.reject({error.reason: 1}, str(error))
        except (Fault, ParameterError):
            raise
        except Exception as error:  # a fault of ours must not stop the robot: tell it loudly and go on
            self.reject({"internal_error": 1}, f"{error}\n{traceback.format_exc()}")

    def _awaited(self) -> str:
        """Say what input is held back for; empty: nothing.

        Before simulated time has begun no stamp can be judged: the first messages may overtake the first /clock.
        """
        if self.now_ns() == 0:
            return "/clock"
        return ", ".join(f"subscribers of {pub.topic_name}" for pub, count in self.outputs if self._missing(pub, count))

    def _missing(self, pub: Any, expected: int) -> bool:
        if expected == 0 or pub.get_subscription_count() >= expected:
            return False
        return time.monotonic() - self._began < self.managed.subscribers_deadline_s

    def _release(self) -> None:
        """Hand on what was held back, once the clock runs and all subscribers are there or too late."""
        if self._awaited():
            return
        self._look.cancel()
        for pub, count in self.outputs:
            have = pub.get_subscription_count()
            if have < count:
                self.log.warning(f"{pub.topic_name} has {have} of {count} expected subscribers; going on.")
        # No message is lost silently, however many waited here.
        self.outputs = [(pub, 0) for pub, _ in self.outputs]
        self.released = True
        while self._held:
            self._handle(*self._held.popleft())

    # Time.

    def every(self, period_s: float, call: Callable[[], None]) -> Any:
        """Call again and again, in wall time; return the timer."""
        return self.create_timer(period_s, call, clock=self._wall)

    def _on_jump(self, jump: Any) -> None:
        back_ns = -int(jump.delta.nanoseconds)
        if back_ns <= self.clock.tolerance_ns:
            self.counted["clock_steps"] += 1
            return
        self.log.warning(f"The clock has jumped back by {back_ns / 1e9:.3f} s: starting anew.")
        self.counted["clock_jumps"] += 1
        self._held.clear()
        self.on_clock_jump()

    # Rejections and diagnostics.

    def reject(self, reasons: Mapping[str, int], text: str = "") -> None:
        """Count rejected messages or tracks by reason, and log the first of each kind."""
        self.counts.reject(reasons, text or "see /diagnostics for the count")

    def now_ns(self) -> int:
        """ROS time; 0 until simulated time has begun."""
        return int(self.get_clock().now().nanoseconds)

    def _publish_diagnostics(self) -> None:
        warnings, values = self.diagnose()
        if self.active and not self.released:
            warnings.append(f"{len(self._held)} messages wait for {self._awaited()}")
        warnings += [f"{sum(self.rejected.values())} rejected"] if self.rejected else []
        level = DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        shown = {"active": self.active, **values, **self.counted}
        shown |= {f"rejected/{reason}": count for reason, count in sorted(self.rejected.items())}
        self._diagnostics.publish(
            diagnostic_array(self.now_ns(), self.get_name(), level, "; ".join(warnings) or "ok", shown)
        )
