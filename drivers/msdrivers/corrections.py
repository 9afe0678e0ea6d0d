"""Corrections for a receiver from an NTRIP caster: a thread that receives them while the driver runs.

The driver takes the frames in each pass and sends them to the receiver. Without an answer, or after the connection was
lost, the thread connects again, later each time.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from modelserver.messages import FixType, GpsSample, Sample
from msdrivers.line_settings import NtripSettings, split_address
from msdrivers.protocol.ntrip import NtripError, NtripRequest, NtripSession, make_gga
from msdrivers.runner import Runner

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S: Final = 5.0
POLL_S: Final = 0.2
"""Longest wait for bytes: so long does the thread take to end."""
SILENCE_S: Final = 30.0
"""After this time without a byte the connection is given up."""
FIRST_DELAY_S, LONGEST_DELAY_S = 1.0, 60.0
"""Delays before another attempt, doubled each time."""
MAX_WAITING: Final = 256
"""Frames that wait for the driver; of more the oldest are lost: old corrections are of no use."""
DAY_US: Final = 86_400_000_000


class CorrectionsClient:
    """Receives corrections in a thread, from `start` until `stop`."""

    def __init__(self, settings: NtripSettings, name: str, monotonic: Callable[[], float] = time.monotonic):
        self._settings, self._name, self._monotonic = settings, name, monotonic
        self._frames: deque[bytes] = deque()
        self._lock = threading.Lock()
        self._is_stopping = threading.Event()
        self._counts: Counter[str] = Counter()
        self._received_s: float | None = None
        self._station = -1
        self._place: GpsSample | None = None
        self._reported = ""
        self._thread = threading.Thread(target=self._run, name=f"corrections of {name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._is_stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    def wrap_publish(self, publish: Callable[[Sample], object]) -> Callable[[Sample], object]:
        """Return a function that publishes a sample, and notes the position of a fix for the caster."""

        def publish_and_note(sample: Sample) -> None:
            if isinstance(sample, GpsSample) and sample.fix_type is not FixType.NONE:
                self._place = sample
            publish(sample)

        return publish_and_note

    def feed_runner(self, runner: Runner[bytes]) -> Callable[[], object]:
        """Return the function that sends the received frames to a runner's device, and counts for its health."""

        def feed() -> None:
            for frame in self.pop_frames():
                runner.send_unit(frame)
            for name, number in self.counts.items():
                runner.counts[name] = number

        return feed

    def pop_frames(self) -> list[bytes]:
        """Return the frames that were received since the last call."""
        with self._lock:
            frames = list(self._frames)
            self._frames.clear()
        return frames

    @property
    def counts(self) -> dict[str, int]:
        """Counters for the health report: `corrections.frames`, `.connects`, `.lost`, `.station`, and `.age_s`, whole
        seconds since the last frame; -1 for none."""
        age = -1 if self._received_s is None else round(self._monotonic() - self._received_s)
        return {
            **{f"corrections.{name}": number for name, number in self._counts.items()},
            "corrections.station": self._station,
            "corrections.age_s": age,
        }

    def _run(self) -> None:
        delay = FIRST_DELAY_S
        while not self._is_stopping.is_set():
            before = self._counts["frames"]
            try:
                self._receive()
            except (OSError, NtripError) as error:
                self._report(
                    f"no corrections from {self._settings.caster}: {getattr(error, 'strerror', None) or error}"
                )
            delay = FIRST_DELAY_S if self._counts["frames"] > before else min(2.0 * delay, LONGEST_DELAY_S)
            self._is_stopping.wait(delay)

    def _receive(self) -> None:
        """Receive until the connection ends. Raises OSError, NtripError."""
        settings = self._settings
        host, port = split_address(settings.caster)
        request = NtripRequest(host, settings.mountpoint, settings.user, settings.password)
        session = NtripSession(request)
        with contextlib.closing(socket.create_connection((host, port), CONNECT_TIMEOUT_S)) as connection:
            self._counts["connects"] += 1
            connection.sendall(request.encode())
            connection.settimeout(POLL_S)
            last_s, gga_s = self._monotonic(), -1e9
            while not self._is_stopping.is_set():
                now = self._monotonic()
                if session.is_answered and settings.gga_period and now - gga_s >= settings.gga_period and self._place:
                    gga_s = now
                    connection.sendall(_make_position(self._place))
                try:
                    data = connection.recv(4096)
                except TimeoutError:
                    if now - last_s > SILENCE_S:
                        raise NtripError(f"nothing received for {SILENCE_S:g} s") from None
                    continue
                if not data:
                    raise NtripError("the caster has closed the connection")
                last_s = now
                for frame in session.feed(data):
                    self._add(frame.data, frame.station)

    def _add(self, data: bytes, station: int) -> None:
        if not self._counts["frames"]:
            log.info("%s: corrections from %s arrive", self._name, self._settings.caster)
        self._reported = ""
        self._received_s = self._monotonic()
        self._station = station if station >= 0 else self._station
        with self._lock:
            self._counts["frames"] += 1
            if len(self._frames) == MAX_WAITING:
                self._frames.popleft()
                self._counts["lost"] += 1
            self._frames.append(data)

    def _report(self, text: str) -> None:
        if text != self._reported:
            self._reported = text
            log.warning("%s: %s", self._name, text)


def _make_position(sample: GpsSample) -> bytes:
    height = sample.height_msl if sample.height_msl == sample.height_msl else sample.height_ellipsoidal
    height = height if height == height else 0.0
    return make_gga(
        sample.latitude_deg, sample.longitude_deg, height, sample.satellites, (time.time_ns() // 1000) % DAY_US
    )
