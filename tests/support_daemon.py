"""The real daemon under faults: fed with a simulated drive in real time, observed, queried, killed, restarted."""

from __future__ import annotations

import itertools
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import lcm
from support_command import run_command
from support_drive import (
    CHANNELS,
    MAX_MISLEADING_S,
    RAPTOR,
    ComparedPose,
    SimulatedDrive,
    compare_pose,
    longest_misleading,
)
from support_lcm import MODELSERVER, TIMEOUT_S, run_process

from modelserver.client.remote import Platform
from modelserver.errors import ModelServerError
from modelserver.messages import Health, PoseAnswer
from modelserver.simulation import Event
from modelserver.wire.codec import decode, encode, restamp

ELAPSED_S = 8.0
"""The real daemon under faults: fed with a simulated drive in real time, observed, queried, killed, restarted."""

START_TIMEOUT_S = 90.0
"""The real daemon under faults: fed with a simulated drive in real time, observed, queried, killed, restarted."""

RESTART_SEC = 0.5
"""The real daemon under faults: fed with a simulated drive in real time, observed, queried, killed, restarted."""

CLOCK_STEP_PROGRAM = """
import os, signal, time
real, step = time.time_ns, 0
def stepped(number, frame):
    global step
    step = int(open(os.environ["CLOCK_STEP"]).read())
signal.signal(signal.SIGUSR1, stepped)
time.time_ns = lambda: real() + step
from mstools.cli import main
main()
"""
"""The `modelserver` command with a clock that a file's nanoseconds step at SIGUSR1: the kernel's own clock belongs to
the whole machine, and no test may set it."""

FAST_RATES = {"  rate_hz: 50 ": "  rate_hz: 100 ", "  health_hz: 1": "  health_hz: 10"}


def write_raptor(folder: Path, more: str = "", changes: Mapping[str, str] = MappingProxyType({})) -> Path:
    """Write the Raptor's vehicle file into a folder, its state beside it; `more` goes to its end."""
    text, _, _ = (RAPTOR / "vehicle.yaml").read_text().partition("\ndrivers:")
    text = text.replace("geometry: geometry.yaml", f"geometry: {RAPTOR / 'geometry.yaml'}\nstate_directory: state")
    for old, new in (FAST_RATES | dict(changes)).items():
        assert old in text, old
        text = text.replace(old, new)
    path = folder / "vehicle.yaml"
    path.write_text(f"{text}\n{more}")
    return path


@dataclass
class ReceivedMessages:
    """Received messages, each with its receive time in seconds of the monotonic clock."""

    poses: list[tuple[float, PoseAnswer]] = field(default_factory=list)
    health: list[tuple[float, Health]] = field(default_factory=list)


@dataclass
class Trial:
    """A daemon that is fed with a drive, and what it publishes meanwhile. Create it with `trial`.

    It is queried every 20 ms: `answers` are the times of the replies, `errors` the failures.
    """

    url: str
    folder: Path
    ride: SimulatedDrive
    vehicle: Path
    program: Sequence[str] = ()
    """What runs the daemon, if not the `modelserver` command."""
    received: ReceivedMessages = field(default_factory=ReceivedMessages)
    answers: list[float] = field(default_factory=list)
    errors: list[tuple[float, Exception]] = field(default_factory=list)
    step_us: int = 0
    """By how much the host's clock has been stepped: what the feeder stamps with."""
    process: subprocess.Popen[str] = field(init=False)
    started_at: float = 0.0
    _running: ExitStack = field(default_factory=ExitStack)
    _stop: threading.Event = field(default_factory=threading.Event)
    _threads: list[threading.Thread] = field(default_factory=list)
    _starts: int = 0
    _published: int = 0

    # --- the daemon ---

    def start(self, *before: str) -> float:
        """Start the daemon, with `before` in front of its program; return the time, seconds of the monotonic clock."""
        self._starts += 1
        started = self.started_at = time.monotonic()
        log = self._running.enter_context((self.folder / f"daemon{self._starts}.log").open("w"))
        words = ["run", "-c", str(self.vehicle)]
        if self.program or before:
            program = [*before, *(self.program or MODELSERVER), *words]
            self.process = self._running.enter_context(run_process(program, self.url, stderr=log))
        else:
            self.process = self._running.enter_context(run_command(words, self.url, stderr=log))
        return started

    @property
    def log(self) -> str:
        return "".join(
            (self.folder / f"daemon{number}.log").read_text(errors="replace") for number in range(1, self._starts + 1)
        )

    def kill(self, number: signal.Signals = signal.SIGKILL) -> float:
        """Send a signal to the daemon and wait for its end; return the time of sending."""
        sent = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(TIMEOUT_S)
        return sent

    def restart(self) -> None:
        """Restart the daemon as systemd does after its end."""
        time.sleep(RESTART_SEC)
        self.start()

    # --- messages ---

    def publish(self, channel: str, data: bytes) -> None:
        with suppress(OSError):  # a network that is down loses the message
            self._bus.publish(channel, data)

    def feed(self, events: Iterable[Event] | None = None) -> None:
        """Publish the drive in real time from now on; its past part at once."""
        stream = iter(self.ride.stream() if events is None else events)
        for event in stream:
            if event.header.host_utime >= time.time_ns() // 1000:
                self.spawn(self._feed, itertools.chain([event], stream))
                return
            self.publish_event(event)

    def publish_all(self, events: Sequence[Event], portion: int = 1000) -> None:
        """Publish a whole drive as fast as the daemon accepts it, and return when it has accepted all."""
        for first in range(0, len(events), portion):
            for event in events[first : first + portion]:
                self.publish_event(event)
            self._published += len(events[first : first + portion])
            self.wait_until(lambda: self._accepted >= self._published, f"that {self._published} samples were taken")

    @property
    def _accepted(self) -> int:
        if not self.received.health:
            return 0
        ignored = sum(count for _, reason, count in self.health.rejected if reason == "publisher_conflict")
        return sum(each.count for each in self.health.channels) + ignored

    def publish_event(self, event: Event) -> None:
        self.publish(CHANNELS[type(event)], restamp(encode(event), self.step_us))

    def wait_until(self, is_arrived: Callable[[], bool], what: str, seconds: float = TIMEOUT_S) -> float:
        """Wait until a condition holds; return the time, seconds of the monotonic clock."""
        deadline = time.monotonic() + seconds
        while not is_arrived():
            assert time.monotonic() < deadline, (
                f"{what} did not happen in {seconds:g} s:\n{self.log}\n{self.errors[-3:]}"
            )
            time.sleep(0.01)
        return time.monotonic()

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)

    def is_answered_since(self, since: float) -> bool:
        return bool(self.answers) and self.answers[-1] > since

    def is_valid_since(self, since: float) -> bool:
        return bool(self.received.poses) and self.received.poses[-1][0] > since and self.last.transformation.is_valid

    @property
    def last(self) -> PoseAnswer:
        return self.received.poses[-1][1]

    @property
    def health(self) -> Health:
        return self.received.health[-1][1]

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        return {(channel, reason): count for channel, reason, count in self.health.rejected}

    def wait_for_health(self, enough: Callable[[Health], bool], what: str) -> Health:
        """Wait for a health report from now on that is as wanted."""
        since = time.monotonic()

        def is_arrived() -> bool:
            at, health = self.received.health[-1] if self.received.health else (0.0, None)
            return at > since and health is not None and enough(health)

        self.wait_until(is_arrived, what)
        return self.health

    # --- the verdict ---

    def evaluate_poses(self, since: float = 0.0) -> list[ComparedPose]:
        """Return every received pose beside the truth."""
        return [
            compare_pose(pose, self.ride.truth(self.true_utime(pose.transformation.utime)))
            for at, pose in list(self.received.poses)
            if at >= since
        ]

    def true_utime(self, utime: int) -> int:
        """Return the time on the clock before the step at which the host's clock showed `utime`.

        A step is many times longer than a trial: each instant has one reading before it or after.
        """
        shifted = utime - self.step_us
        return shifted if abs(shifted - self.ride.start_utime) < abs(utime - self.ride.start_utime) else utime

    def longest_gap(self, since: float, until: float | None = None) -> float:
        """Return the longest time without an answered query, seconds."""
        end = time.monotonic() if until is None else until
        times = [since, *(at for at in list(self.answers) if since <= at <= end), end]
        return max(after - before for before, after in itertools.pairwise(times))

    def assert_consistent(self) -> list[ComparedPose]:
        """Check that no pose was misleading for long, and return them all."""
        found = self.evaluate_poses()
        assert any(each.is_valid for each in found)
        assert longest_misleading(found) <= MAX_MISLEADING_S, [each for each in found if each.is_misleading][:5]
        return found

    # --- threads ---

    def open(self) -> None:
        self._bus = lcm.LCM(self.url)
        self.spawn(self._listen)
        self.spawn(self._ask)

    def close(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(TIMEOUT_S)
        with suppress(AttributeError, ProcessLookupError):
            self.process.send_signal(signal.SIGCONT)
        self._running.close()

    @property
    def is_stopped(self) -> bool:
        return self._stop.is_set()

    def spawn(self, work: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _feed(self, stream: Iterable[Event]) -> None:
        # the pace is the monotonic clock's: the time of day may be stepped
        ahead = time.time_ns() // 1000 - time.monotonic_ns() // 1000
        for event in stream:
            left = event.header.host_utime - ahead - time.monotonic_ns() // 1000
            if left > 0 and self._stop.wait(left * 1e-6):
                return
            self.publish_event(event)

    def _listen(self) -> None:
        bus = lcm.LCM(self.url)
        received = self.received

        def append_to(kind: str, into: list[tuple[float, Any]]) -> Callable[[str, bytes], None]:
            return lambda _, data: into.append((time.monotonic(), decode(kind, data)))

        bus.subscribe(re.escape("POSE"), append_to("pose_transform_t", received.poses)).set_queue_capacity(0)
        bus.subscribe("MODELSERVER_HEALTH", append_to("health_t", received.health)).set_queue_capacity(0)
        while not self._stop.is_set():
            bus.handle_timeout(100)

    def _ask(self) -> None:
        with Platform(self.url, name="asker", timeout=0.25, retries=0) as platform:
            while not self._stop.wait(0.02):
                try:
                    platform.get_transformation("Digiclops:ImagePlane", "Raptor:CG")
                except (ModelServerError, OSError) as error:
                    self.errors.append((time.monotonic(), error))
                else:
                    self.answers.append(time.monotonic())


@contextmanager
def trial(
    url: str,
    folder: Path,
    seconds: float = ELAPSED_S + 4.0 * TIMEOUT_S,
    past: float = ELAPSED_S,
    feeding: bool = True,
    program: Sequence[str] = (),
    more: str = "",
    before: Sequence[str] = (),
    changes: Mapping[str, str] = MappingProxyType({}),
    **models: Any,
) -> Iterator[Trial]:
    """Run the daemon beside a drive whose first seconds are `past`; the block begins when its pose is valid.

    Without `feeding` it begins when the daemon answers. `more` and `changes` are of the vehicle file, `before` of the
    program, `models` of the sensors.
    """
    vehicle = write_raptor(folder, more, changes)
    found = Trial(url, folder, SimulatedDrive.create(0, 1.0), vehicle, program)
    found.open()
    try:
        started = found.start(*before)
        found.wait_until(lambda: found.is_answered_since(started), "an answer", START_TIMEOUT_S)
        found.ride = SimulatedDrive.create(time.time_ns() // 1000 - round(past * 1e6), seconds, **models)
        if feeding:
            found.feed()
            found.wait_until(lambda: found.is_valid_since(started), "a valid pose")
        yield found
    finally:
        found.close()
