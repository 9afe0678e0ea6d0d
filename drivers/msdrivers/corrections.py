"""Corrections for a receiver from an NTRIP caster: the NTRIP session, and the thread that receives them.

NTRIP, both versions (RTCM 10410.0 and 10410.1): the client asks for a mountpoint by HTTP. A caster of version 1 answers
`ICY 200 OK` and sends corrections at once; one of version 2 answers as HTTP does, usually in chunks. For an unknown
mountpoint it sends its source table.

The driver takes what was received in each pass and sends it to the receiver, which checks the RTCM messages by their
checksums. Without an answer, or after the connection was lost, the thread connects again, later each time.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from base64 import b64encode
from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from modelserver.messages import FixType, GpsSample, Sample
from modelserver.version import __version__
from msdrivers.devices.gps import DAY, nmea
from msdrivers.registry import NtripSettings, split_address
from msdrivers.runner import Runner

MAX_HEADER: Final = 8192
MAX_CHUNK: Final = 1 << 20


def encode_request(settings: NtripSettings) -> bytes:
    """Return the request for a mountpoint."""
    lines = [
        f"GET /{settings.mountpoint} HTTP/1.1",
        f"Host: {split_address(settings.caster)[0]}",
        "Ntrip-Version: Ntrip/2.0",
        f"User-Agent: NTRIP ModelServer/{__version__}",
        "Connection: close",
    ]
    if settings.user:
        lines.append(f"Authorization: Basic {b64encode(f'{settings.user}:{settings.password}'.encode()).decode()}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode("utf-8")


class NtripError(Exception):
    """The caster does not send corrections; the message has the reason and what to do."""


class NtripSession:
    """Bytes of a caster in, corrections out."""

    def __init__(self, mountpoint: str) -> None:
        self._mountpoint = mountpoint
        self._buffer = b""
        self.is_answered = self._is_chunked = False
        self._chunk_left = 0

    def feed(self, data: bytes) -> bytes:
        """Return the corrections in `data`. Raises NtripError."""
        if not self.is_answered:
            self._buffer += data
            body = self._read_header()
            if body is None:
                return b""
            data = body
        return self._read_chunks(data) if self._is_chunked else data

    def _read_header(self) -> bytes | None:
        """Return what follows the header; None while it is incomplete."""
        line, end, rest = self._buffer.partition(b"\r\n")
        if not end:
            if len(self._buffer) > MAX_HEADER:
                raise NtripError("the server's answer is not that of an NTRIP caster: check caster")
            return None
        status = line.decode("latin-1")
        if status.startswith("ICY 200"):
            self.is_answered, self._buffer = True, b""
            return rest
        words = status.split(" ", 2)
        no_mountpoint = NtripError(f"the caster has no mountpoint {self._mountpoint!r}: check mountpoint")
        if words[0] == "SOURCETABLE":
            raise no_mountpoint
        if not words[0].startswith("HTTP/") or len(words) < 2:
            raise NtripError(f"the server's answer {status[:60]!r} is not that of an NTRIP caster: check caster")
        if words[1] != "200":
            fix = {"401": "check user and password", "404": "check mountpoint"}.get(words[1], "try again later")
            raise NtripError(f"the caster answers {' '.join(words[1:])[:60]}: {fix}")
        header, end, body = self._buffer.partition(b"\r\n\r\n")
        if not end:
            if len(self._buffer) > MAX_HEADER:
                raise NtripError("the caster's header is too long")
            return None
        text = header.decode("latin-1").lower()
        if "gnss/sourcetable" in text:
            raise no_mountpoint
        self.is_answered, self._buffer = True, b""
        self._is_chunked = "transfer-encoding: chunked" in text
        return body

    def _read_chunks(self, data: bytes) -> bytes:
        content = b""
        self._buffer += data
        while self._buffer:
            if self._chunk_left:
                part = self._buffer[: self._chunk_left]
                content += part
                self._buffer = self._buffer[len(part) :]
                self._chunk_left -= len(part)
                continue
            line, end, rest = self._buffer.partition(b"\r\n")
            if not end:
                if len(self._buffer) > 64:
                    raise NtripError("the caster's chunks are damaged")
                break
            self._buffer = rest
            if not line:  # the end of the chunk before
                continue
            try:
                size = int(line.split(b";")[0], 16)
            except ValueError:
                size = -1
            if size == 0:
                raise NtripError("the caster has ended the stream")
            if not 0 < size <= MAX_CHUNK:
                raise NtripError("the caster's chunks are damaged")
            self._chunk_left = size
        return content


def make_gga(sample: GpsSample, time_of_day_us: int) -> bytes:
    """Return the sentence by which a network of stations computes corrections for the place of a fix."""
    height = sample.height_msl if sample.height_msl == sample.height_msl else sample.height_ellipsoidal
    place = (*nmea.format_angle(sample.latitude_deg, "NS", 2), *nmea.format_angle(sample.longitude_deg, "EW", 3))
    heights = (nmea.format_number(height if height == height else 0.0, 2), "M", "0.0", "M")
    quality = ("1", str(max(sample.satellites, 4)), "1.0")
    return nmea.encode("GP", "GGA", (nmea.format_time_of_day(time_of_day_us), *place, *quality, *heights, "", ""))


log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S: Final = 5.0
POLL_S: Final = 0.2
"""Longest wait for bytes: so long does the thread take to end."""
SILENCE_S: Final = 30.0
"""After this time without a byte the connection is given up."""
FIRST_DELAY_S, LONGEST_DELAY_S = 1.0, 60.0
"""Delays before another attempt, doubled each time."""
MAX_WAITING: Final = 256
"""Readings that wait for the driver; of more the oldest are lost: old corrections are of no use."""


class CorrectionsClient:
    """Receives corrections in a thread, from `start` until `stop`."""

    def __init__(self, settings: NtripSettings, name: str, monotonic: Callable[[], float] = time.monotonic):
        self._settings, self._name, self._monotonic = settings, name, monotonic
        self._waiting: deque[bytes] = deque()
        self._lock = threading.Lock()
        self._is_stopping = threading.Event()
        self._counts: Counter[str] = Counter()
        self._received_s: float | None = None
        self._place: GpsSample | None = None
        self._reported = ""
        self._thread = threading.Thread(target=self._run, name=f"corrections of {name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._is_stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    def note_place(self, sample: Sample) -> None:
        """Note the position of a fix for the caster."""
        if isinstance(sample, GpsSample) and sample.fix_type is not FixType.NONE:
            self._place = sample

    def feed_runner(self, runner: Runner[bytes]) -> Callable[[], object]:
        """Return the function that sends what was received to a runner's device, and counts for its health."""

        def feed() -> None:
            for data in self.pop_received():
                runner.send_unit(data)
            for name, number in self.counts.items():
                runner.counts[name] = number

        return feed

    def pop_received(self) -> list[bytes]:
        """Return what was received since the last call."""
        with self._lock:
            received = list(self._waiting)
            self._waiting.clear()
        return received

    @property
    def counts(self) -> dict[str, int]:
        """Counters for the health report: `corrections.bytes`, `.connects`, `.lost`, and `.age_s`, whole seconds since
        the last ones; -1 for none."""
        age = -1 if self._received_s is None else round(self._monotonic() - self._received_s)
        return {
            **{f"corrections.{name}": number for name, number in self._counts.items()},
            "corrections.age_s": age,
        }

    def _run(self) -> None:
        delay = FIRST_DELAY_S
        while not self._is_stopping.is_set():
            before = self._counts["bytes"]
            try:
                self._receive()
            except (OSError, NtripError) as error:
                self._report(
                    f"no corrections from {self._settings.caster}: {getattr(error, 'strerror', None) or error}"
                )
            delay = FIRST_DELAY_S if self._counts["bytes"] > before else min(2.0 * delay, LONGEST_DELAY_S)
            self._is_stopping.wait(delay)

    def _receive(self) -> None:
        """Receive until the connection ends. Raises OSError, NtripError."""
        settings = self._settings
        session, address = NtripSession(settings.mountpoint), split_address(settings.caster)
        with contextlib.closing(socket.create_connection(address, CONNECT_TIMEOUT_S)) as connection:
            self._counts["connects"] += 1
            connection.sendall(encode_request(settings))
            connection.settimeout(POLL_S)
            last_s, gga_s = self._monotonic(), -1e9
            while not self._is_stopping.is_set():
                now = self._monotonic()
                if session.is_answered and settings.gga_period and now - gga_s >= settings.gga_period and self._place:
                    gga_s = now
                    connection.sendall(make_gga(self._place, (time.time_ns() // 1000) % DAY))
                try:
                    data = connection.recv(4096)
                except TimeoutError:
                    if now - last_s > SILENCE_S:
                        raise NtripError(f"nothing received for {SILENCE_S:g} s") from None
                    continue
                if not data:
                    raise NtripError("the caster has closed the connection")
                last_s = now
                if corrections := session.feed(data):
                    self._add(corrections)

    def _add(self, data: bytes) -> None:
        if not self._counts["bytes"]:
            log.info("%s: corrections from %s arrive", self._name, self._settings.caster)
        self._reported = ""
        self._received_s = self._monotonic()
        with self._lock:
            self._counts["bytes"] += len(data)
            if len(self._waiting) == MAX_WAITING:
                self._waiting.popleft()
                self._counts["lost"] += 1
            self._waiting.append(data)

    def _report(self, text: str) -> None:
        if text != self._reported:
            self._reported = text
            log.warning("%s: %s", self._name, text)
