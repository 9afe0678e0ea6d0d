"""The real daemon among faults: told of a simulated drive in real time, listened to, asked, ended, started again."""

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
from support_lcm import MODELSERVER, PATIENCE_S, started
from support_ride import CHANNELS, LONGEST_LIE_S, RAPTOR, Judged, Ride, judged, longest_lie

from modelserver.client.remote import Platform
from modelserver.errors import ModelServerError
from modelserver.messages import Health, PoseAnswer
from modelserver.simulation import Event
from modelserver.wire.codec import decode, encode
from modelserver.wire.restamp import restamped

PAST_S = 8.0
"""So much of a drive is over when it is first told: the pose is valid at once."""

START_S = 90.0
"""How long processes may take to start: on a machine that is busy with other tests, long."""

RESTART_SEC = 0.5
"""What systemd waits before it starts a unit again."""

STEPPED = """
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
"""The `modelserver` command with a time of day that is stepped by a file's nanoseconds at SIGUSR1: the kernel's own
belongs to all of the machine, and is no test's to set."""

BRISK = {"  rate_hz: 50 ": "  rate_hz: 100 ", "  health_hz: 1": "  health_hz: 10"}


def write_raptor(folder: Path, more: str = "", changes: Mapping[str, str] = MappingProxyType({})) -> Path:
    """Write the Raptor's vehicle file into a folder, its state beside it; `more` goes to its end."""
    text, _, _ = (RAPTOR / "vehicle.yaml").read_text().partition("\ndrivers:")
    text = text.replace("geometry: geometry.yaml", f"geometry: {RAPTOR / 'geometry.yaml'}\nstate_directory: state")
    for old, new in (BRISK | dict(changes)).items():
        assert old in text, old
        text = text.replace(old, new)
    path = folder / "vehicle.yaml"
    path.write_text(f"{text}\n{more}")
    return path


@dataclass
class Heard:
    """What was heard on a channel, each with the second of the monotonic clock."""

    poses: list[tuple[float, PoseAnswer]] = field(default_factory=list)
    health: list[tuple[float, Health]] = field(default_factory=list)


@dataclass
class Trial:
    """A daemon that a drive is told to, and what is heard of it meanwhile. Make it with `trial`.

    Answers are asked for every 20 ms; `answers` has when each came, `errors` what was said in their place.
    """

    url: str
    folder: Path
    ride: Ride
    vehicle: Path
    command: Sequence[str] = MODELSERVER
    heard: Heard = field(default_factory=Heard)
    answers: list[float] = field(default_factory=list)
    errors: list[tuple[float, Exception]] = field(default_factory=list)
    step_us: int = 0
    """By how much the host's clock has been stepped: what the feeder stamps with."""
    process: subprocess.Popen[str] = field(init=False)
    started_at: float = 0.0
    _running: ExitStack = field(default_factory=ExitStack)
    _ending: threading.Event = field(default_factory=threading.Event)
    _threads: list[threading.Thread] = field(default_factory=list)
    _starts: int = 0
    _told: int = 0

    # --- the daemon ---

    def start(self, *before: str) -> float:
        """Start the daemon; `before` is put before its command. Return when, seconds of the monotonic clock."""
        self._starts += 1
        begun = self.started_at = time.monotonic()
        log = self._running.enter_context((self.folder / f"daemon{self._starts}.log").open("w"))
        command = [*before, *self.command, "run", "-c", str(self.vehicle)]
        self.process = self._running.enter_context(started(command, self.url, stderr=log))
        return begun

    @property
    def log(self) -> str:
        return "".join(
            (self.folder / f"daemon{number}.log").read_text(errors="replace") for number in range(1, self._starts + 1)
        )

    def kill(self, number: signal.Signals = signal.SIGKILL) -> float:
        """End the daemon by a signal; return when it was sent."""
        sent = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(PATIENCE_S)
        return sent

    def start_again(self) -> None:
        """Start the daemon as systemd does when it has ended."""
        time.sleep(RESTART_SEC)
        self.start()

    # --- what is said and heard ---

    def publish(self, channel: str, data: bytes) -> None:
        with suppress(OSError):  # a network that is down: what is said is lost
            self._bus.publish(channel, data)

    def feed(self, events: Iterable[Event] | None = None) -> None:
        """Publish the drive in real time from now on: what is past already at once."""
        stream = iter(self.ride.stream() if events is None else events)
        for event in stream:
            if event.header.host_utime >= time.time_ns() // 1000:
                self.spawn(self._feed, itertools.chain([event], stream))
                return
            self.tell(event)

    def tell_all(self, events: Sequence[Event], portion: int = 1000) -> None:
        """Tell of a whole drive as fast as the daemon takes it, and return when it has taken it all."""
        for first in range(0, len(events), portion):
            for event in events[first : first + portion]:
                self.tell(event)
            self._told += len(events[first : first + portion])
            self.until(lambda: self._taken >= self._told, f"that {self._told} samples were taken")

    @property
    def _taken(self) -> int:
        if not self.heard.health:
            return 0
        ignored = sum(count for _, reason, count in self.health.rejected if reason == "second_writer")
        return sum(each.count for each in self.health.channels) + ignored

    def tell(self, event: Event) -> None:
        self.publish(CHANNELS[type(event)], restamped(encode(event), self.step_us))

    def until(self, arrived: Callable[[], bool], what: str, seconds: float = PATIENCE_S) -> float:
        """Wait until something has come about; return when, seconds of the monotonic clock."""
        deadline = time.monotonic() + seconds
        while not arrived():
            assert time.monotonic() < deadline, f"{what} did not come in {seconds:g} s:\n{self.log}\n{self.errors[-3:]}"
            time.sleep(0.01)
        return time.monotonic()

    def elapse(self, seconds: float) -> None:
        time.sleep(seconds)

    def answered_since(self, since: float) -> bool:
        return bool(self.answers) and self.answers[-1] > since

    def valid_since(self, since: float) -> bool:
        return bool(self.heard.poses) and self.heard.poses[-1][0] > since and self.last.transformation.valid

    @property
    def last(self) -> PoseAnswer:
        return self.heard.poses[-1][1]

    @property
    def health(self) -> Health:
        return self.heard.health[-1][1]

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        return {(channel, reason): count for channel, reason, count in self.health.rejected}

    def until_health(self, enough: Callable[[Health], bool], what: str) -> Health:
        """Wait for a health report from now on that is as wanted."""
        since = time.monotonic()

        def arrived() -> bool:
            at, health = self.heard.health[-1] if self.heard.health else (0.0, None)
            return at > since and health is not None and enough(health)

        self.until(arrived, what)
        return self.health

    # --- the verdict ---

    def judged(self, since: float = 0.0) -> list[Judged]:
        """Every pose that was heard, beside the truth."""
        return [
            judged(pose, self.ride.truth(self.true_utime(pose.transformation.utime)))
            for at, pose in list(self.heard.poses)
            if at >= since
        ]

    def true_utime(self, utime: int) -> int:
        """When it was, on the clock before it was stepped, that the host's clock showed `utime`.

        A step is many times longer than a trial: each instant has one reading before it or after.
        """
        shifted = utime - self.step_us
        return shifted if abs(shifted - self.ride.start_utime) < abs(utime - self.ride.start_utime) else utime

    def longest_silence(self, since: float, until: float | None = None) -> float:
        """For how many seconds on end no question was answered."""
        end = time.monotonic() if until is None else until
        times = [since, *(at for at in list(self.answers) if since <= at <= end), end]
        return max(after - before for before, after in itertools.pairwise(times))

    def assert_right(self) -> list[Judged]:
        """Check that no pose lied for long, and return them all."""
        found = self.judged()
        assert any(each.valid for each in found)
        assert longest_lie(found) <= LONGEST_LIE_S, [each for each in found if each.lies][:5]
        return found

    # --- threads ---

    def open(self) -> None:
        self._bus = lcm.LCM(self.url)
        self.spawn(self._listen)
        self.spawn(self._ask)

    def close(self) -> None:
        self._ending.set()
        for thread in self._threads:
            thread.join(PATIENCE_S)
        with suppress(AttributeError, ProcessLookupError):
            self.process.send_signal(signal.SIGCONT)
        self._running.close()

    @property
    def ended(self) -> bool:
        return self._ending.is_set()

    def spawn(self, work: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _feed(self, stream: Iterable[Event]) -> None:
        # the pace is the monotonic clock's: the time of day may be stepped
        ahead = time.time_ns() // 1000 - time.monotonic_ns() // 1000
        for event in stream:
            left = event.header.host_utime - ahead - time.monotonic_ns() // 1000
            if left > 0 and self._ending.wait(left * 1e-6):
                return
            self.tell(event)

    def _listen(self) -> None:
        bus = lcm.LCM(self.url)
        heard = self.heard

        def hear(kind: str, into: list[tuple[float, Any]]) -> Callable[[str, bytes], None]:
            return lambda _, data: into.append((time.monotonic(), decode(kind, data)))

        bus.subscribe(re.escape("POSE"), hear("pose_transform_t", heard.poses)).set_queue_capacity(0)
        bus.subscribe("MODELSERVER_HEALTH", hear("health_t", heard.health)).set_queue_capacity(0)
        while not self._ending.is_set():
            bus.handle_timeout(100)

    def _ask(self) -> None:
        with Platform(self.url, name="asker", timeout=0.25, retries=0) as platform:
            while not self._ending.wait(0.02):
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
    seconds: float = PAST_S + 4.0 * PATIENCE_S,
    past: float = PAST_S,
    feeding: bool = True,
    command: Sequence[str] = MODELSERVER,
    more: str = "",
    before: Sequence[str] = (),
    changes: Mapping[str, str] = MappingProxyType({}),
    **models: Any,
) -> Iterator[Trial]:
    """Run the daemon beside a drive whose first seconds are `past`; the block begins when its pose is valid.

    Without `feeding` it begins when the daemon answers. `more` and `changes` are of the vehicle file, `before` of the
    command, `models` of the sensors.
    """
    vehicle = write_raptor(folder, more, changes)
    found = Trial(url, folder, Ride.at(0, 1.0), vehicle, command)
    found.open()
    try:
        begun = found.start(*before)
        found.until(lambda: found.answered_since(begun), "an answer", START_S)
        found.ride = Ride.at(time.time_ns() // 1000 - round(past * 1e6), seconds, **models)
        if feeding:
            found.feed()
            found.until(lambda: found.valid_since(begun), "a valid pose")
        yield found
    finally:
        found.close()
