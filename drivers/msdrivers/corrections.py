"""Corrections for a receiver from an NTRIP caster: the NTRIP session, and the thread that receives them.

NTRIP, both versions (RTCM 10410.0 and 10410.1): the client asks for a mountpoint by HTTP. A caster of version 1 answers
`ICY 200 OK` and sends corrections at once, some after further lines of a header; one of version 2 answers as HTTP does,
usually in chunks. For an unknown mountpoint it sends its source table, or 404. A session reads a table, and the text of
a rejection, to its end or until nothing more comes (`finish`), since both have what is wrong.

Position: a network of stations (VRS, or the nearest station) computes corrections for the place of the rover, and sends
nothing until it has a GGA sentence. Its line of the source table has `nmea` = 1. A stream that sends nothing is looked
up there, and gets the position of the last fix if the table asks for it: in the request (version 2) and after the
answer (version 1).

The driver takes what was received in each pass and sends it to the receiver, which checks the RTCM messages by their
checksums. Without an answer, or after the connection was lost, the thread connects again, later each time.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import socket
import ssl
import threading
import time
from base64 import b64encode
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from modelserver.errors import find_nearest_names, quote
from modelserver.messages import NAN, FixType, GpsSample, Sample
from modelserver.version import __version__
from msdrivers.devices.gps import DAY, nmea
from msdrivers.registry import NtripSettings, split_address
from msdrivers.runner import Runner

MAX_HEADER: Final = 8192
MAX_CHUNK: Final = 1 << 20
MAX_ICY_LINE: Final = 256
"""A longer line after `ICY 200 OK` is no line of a header."""
MAX_BODY: Final = 4 << 20
"""Of a source table: 20 000 streams of 200 bytes."""

_ICY_HEADER = re.compile(rb"[A-Za-z][A-Za-z-]*(:[ -~]*)?\r?")
"""A line of a header, or the beginning of one; no RTCM message begins so."""


def encode_request(settings: NtripSettings, mountpoint: str | None = None, gga: bytes = b"") -> bytes:
    """Return the request for a mountpoint; empty for the source table. `gga`: the position of the rover."""
    lines = [
        f"GET /{settings.mountpoint if mountpoint is None else mountpoint} HTTP/1.1",
        f"Host: {split_address(settings.caster)[0]}",
        "Ntrip-Version: Ntrip/2.0",
        f"User-Agent: NTRIP ModelServer/{__version__}",
        "Connection: close",
    ]
    if gga:
        lines.append(f"Ntrip-GGA: {gga.decode('ascii').strip()}")
    if settings.user:
        lines.append(f"Authorization: Basic {b64encode(f'{settings.user}:{settings.password}'.encode()).decode()}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode("utf-8")


class NtripStream(NamedTuple):
    """A stream of the source table; `needs_place`: it needs the position of the rover. Degrees, nan if not there."""

    name: str
    latitude_deg: float
    longitude_deg: float
    needs_place: bool


def parse_source_table(text: str) -> tuple[NtripStream, ...]:
    """Return the streams of a source table (RTCM 10410.0, 5.4.1)."""
    streams = []
    for line in text.splitlines():
        # a semicolon in a field is written in quotes
        fields = line.replace('";"', ",").split(";")
        if fields[0].strip() == "STR" and len(fields) > 1:
            fields += [""] * (12 - len(fields))
            latitude, longitude = (_to_number(each) for each in fields[9:11])
            streams.append(NtripStream(fields[1].strip(), latitude, longitude, fields[11].strip() == "1"))
    return tuple(streams)


def _to_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return NAN


class NtripError(Exception):
    """The caster does not send corrections; the message has the reason and what to do."""


class MissingMountpointError(NtripError):
    """The caster answers with its source table (`streams`), or with 404 and none."""

    def __init__(self, mountpoint: str, streams: tuple[NtripStream, ...], place: GpsSample | None = None):
        self.streams = streams
        names = [each.name for each in streams]
        if mountpoint in names:
            what = f"the caster lists mountpoint {quote(mountpoint)} and does not send it: its station is off the air, "
            super().__init__(f"{what}or the user may not read it; try again later, or check user and password")
            return
        near = find_nearest_names(mountpoint, names)
        hints = [", ".join(map(quote, near))]
        if place is not None and (around := sorted((_find_distance_km(each, place), each.name) for each in streams)):
            listed = ", ".join(f"{quote(name)} ({km:.0f} km)" for km, name in around[:3] if km < math.inf)
            hints.append(listed and f"nearest to the rover: {listed}")
        elif not near:
            hints.append(", ".join(quote(name) for name in names[:10]) + (", ..." if len(names) > 10 else ""))
        hint = "; ".join(filter(None, hints))
        head = f"the caster has no mountpoint {quote(mountpoint)}: check mountpoint"
        super().__init__(f"{head}; it has {hint}" if hint else head)


def _find_distance_km(stream: NtripStream, place: GpsSample) -> float:
    """Return the distance on a sphere of 6371 km, flat about the place; infinite for a stream without one."""
    north = stream.latitude_deg - place.latitude_deg
    east = (stream.longitude_deg - place.longitude_deg + 180.0) % 360.0 - 180.0
    km = 6371.0 * math.radians(math.hypot(north, east * math.cos(math.radians(place.latitude_deg))))
    return km if math.isfinite(km) else math.inf


class NtripSession:
    """Bytes of a caster in, corrections out."""

    def __init__(self, mountpoint: str) -> None:
        self._mountpoint = mountpoint
        self._buffer = b""
        self.is_answered = False
        """Corrections follow."""
        self.is_rejected = False
        """No corrections follow, but the reason."""
        self._status = ""
        """Of a rejection; empty for a source table."""
        self._body = b""
        self._body_length = MAX_BODY
        self._is_icy_header = self._is_chunked = False
        self._chunk_left = 0

    def feed(self, data: bytes) -> bytes:
        """Return the corrections in `data`. Raises NtripError."""
        if not (self.is_answered or self.is_rejected):
            self._buffer += data
            body = self._read_header()
            if body is None:
                return b""
            data = body
        if self.is_rejected:
            self._read_body(data)
            return b""
        if self._is_icy_header:
            data = self._skip_icy_header(data)
        return self._read_chunks(data) if self._is_chunked else data

    def finish(self) -> None:
        """Process the end of the connection, or of what comes. Raises NtripError unless there were corrections."""
        if self.is_rejected:
            raise self._make_rejection()
        if not self.is_answered:
            raise NtripError("the caster closes the connection without an answer: check caster, user and password")

    def _read_header(self) -> bytes | None:
        """Return what follows the header; None while it is incomplete."""
        line, end, rest = self._buffer.partition(b"\n")
        if self._buffer.startswith(b"\x15\x03"):  # a TLS alert
            raise NtripError("the caster wants TLS at this port: set tls: true")
        if not end:
            if len(self._buffer) > MAX_HEADER:
                raise NtripError("the server's answer is not that of an NTRIP caster: check caster")
            return None
        status = line.decode("latin-1").strip()
        words = status.split(" ", 2)
        kind, code = words[0].upper(), words[1] if len(words) > 1 else ""
        if kind == "ICY" and code == "200":
            self.is_answered, self._is_icy_header, self._buffer = True, True, b""
            return rest
        if kind == "SOURCETABLE":
            self.is_rejected, self._buffer = True, b""
            return rest
        if kind in ("ERROR", "ICY"):
            raise NtripError(f"the caster answers {quote(status, 100)}: check mountpoint, user and password")
        if not kind.startswith("HTTP/") or not code:
            raise NtripError(f"the server's answer {status[:60]!r} is not that of an NTRIP caster: check caster")
        found = re.search(rb"\r?\n\r?\n", self._buffer)
        if found is None:
            if len(self._buffer) > MAX_HEADER:
                raise NtripError("the caster's header is too long")
            return None
        lines = self._buffer[: found.start()].decode("latin-1").splitlines()[1:]
        header = {key.strip().lower(): value.strip() for key, _, value in (each.partition(":") for each in lines)}
        body, self._buffer = self._buffer[found.end() :], b""
        self._is_chunked = "chunked" in header.get("transfer-encoding", "").lower()
        content = header.get("content-type", "").lower()
        if code in ("301", "302", "303", "307", "308"):
            target = quote(header.get("location", ""), 100)
            raise NtripError(f"the caster redirects to {target}: set caster and mountpoint to that")
        if code == "200" and content.startswith("text/html"):
            raise NtripError("the server answers with a web page, not as an NTRIP caster does: check caster")
        if code == "200" and "gnss/sourcetable" not in content:
            self.is_answered = True
            return body
        self.is_rejected = True
        self._status = "" if code == "200" else " ".join(words[1:])[:60]
        if (length := header.get("content-length", "")).isdecimal() and not self._is_chunked:
            self._body_length = min(int(length), MAX_BODY)
        return body

    def _skip_icy_header(self, data: bytes) -> bytes:
        """Return what follows the lines that some casters send after `ICY 200 OK`, up to an empty one."""
        self._buffer += data
        while True:
            line, end, rest = self._buffer.partition(b"\n")
            is_empty = line in (b"", b"\r")
            is_header = is_empty or bool(_ICY_HEADER.fullmatch(line) and (not end or b":" in line))
            if is_header and not end and len(line) <= MAX_ICY_LINE:
                return b""
            if is_header and end:
                self._buffer = rest
            if is_empty or not is_header or not end:
                self._is_icy_header = False
                data, self._buffer = self._buffer, b""
                return data

    def _read_body(self, data: bytes) -> None:
        """Collect a source table, or the text of a rejection. Raises NtripError at its end."""
        try:
            self._body += self._read_chunks(data) if self._is_chunked else data
        except NtripError:
            raise self._make_rejection() from None
        is_table_end = not self._status and b"ENDSOURCETABLE" in self._body[-len(data) - 16 :]
        if is_table_end or len(self._body) >= self._body_length:
            raise self._make_rejection()

    def _make_rejection(self) -> NtripError:
        text = self._body.decode("utf-8", "replace")
        code = self._status[:3]
        if not self._status or code == "404":
            return MissingMountpointError(self._mountpoint, parse_source_table(text))
        fixes = {"401": "check user and password", "403": "check user and password"}
        message = f"the caster answers {self._status}: {fixes.get(code, 'try again later')}"
        reason = " ".join(re.sub(r"<[^>]*>", " ", text).split())
        return NtripError(f"{message} (its text: {quote(reason, 120)})" if reason else message)

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
                self._body += content if self.is_rejected else b""
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


def _open_line(settings: NtripSettings) -> socket.socket:
    """Return a connection to a caster, with TLS once it has proved who it is. Raises OSError, NtripError."""
    host, _ = address = split_address(settings.caster)
    context = ssl.create_default_context() if settings.tls else None
    connection = socket.create_connection(address, CONNECT_TIMEOUT_S)
    if context is None:
        return connection
    try:
        return context.wrap_socket(connection, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        fix = "check caster and the clock; the certificates of an authority of your own: SSL_CERT_FILE"
        raise NtripError(
            f"the certificate of {host} is not valid ({error.verify_message.rstrip('.')}): {fix}"
        ) from None
    except ssl.SSLError as error:
        why = error.reason or error.strerror
        raise NtripError(f"the caster does not speak TLS ({why}): leave tls out, or give its port with TLS") from None


log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S: Final = 5.0
POLL_S: Final = 0.2
"""Longest wait for bytes: so long does the thread take to end."""
SILENCE_S: Final = 30.0
"""After this time without a byte the connection is given up."""
QUIET_S: Final = 5.0
"""After this time without corrections a stream is looked up in the source table: most send every second."""
GGA_PERIOD_S: Final = 10.0
"""Between positions for a stream that needs them; casters expect them every 5 to 60 s (SNIP, "NMEA GGA strings in NTRIP
clients")."""
REJECTION_S: Final = 2.0
"""After this time without a byte a source table, or the text of a rejection, is complete."""
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
        self._streams: tuple[NtripStream, ...] = ()
        """The source table, once it was needed."""
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
        settings, has_data, is_looked_up = self._settings, False, False
        with self._connect(settings.mountpoint, self._make_gga()) as connection:
            session = NtripSession(settings.mountpoint)
            self._counts["connects"] += 1
            last_s, gga_s = self._monotonic(), -math.inf
            while not self._is_stopping.is_set():
                now = self._monotonic()
                is_quiet = session.is_answered and not has_data and now - last_s >= QUIET_S
                if is_quiet and not is_looked_up:
                    is_looked_up = True
                    self._look_up()
                if session.is_answered and now - gga_s >= self._gga_period and (gga := self._make_gga()):
                    gga_s = now
                    connection.sendall(gga)
                try:
                    data = connection.recv(4096)
                except TimeoutError:
                    if session.is_rejected and now - last_s > REJECTION_S:
                        self._finish(session)
                    if now - last_s > SILENCE_S:
                        raise NtripError(f"nothing received for {SILENCE_S:g} s{self._explain(has_data)}") from None
                    continue
                except ConnectionResetError:
                    data = b""
                if not data:
                    self._finish(session)
                    if not has_data:
                        self._look_up()
                    raise NtripError(f"the caster has closed the connection{self._explain(has_data)}")
                last_s = now
                try:
                    corrections = session.feed(data)
                except MissingMountpointError as error:
                    raise self._complete(error) from None
                if corrections:
                    has_data = True
                    self._add(corrections)

    @contextlib.contextmanager
    def _connect(self, mountpoint: str, gga: bytes = b"") -> Iterator[socket.socket]:
        with contextlib.closing(_open_line(self._settings)) as line:
            line.sendall(encode_request(self._settings, mountpoint, gga))
            line.settimeout(POLL_S)
            yield line

    def _finish(self, session: NtripSession) -> None:
        try:
            session.finish()
        except MissingMountpointError as error:
            raise self._complete(error) from None

    def _complete(self, error: MissingMountpointError) -> NtripError:
        """Return the error with the streams near the mountpoint in name and place."""
        self._streams = error.streams or self._streams
        self._look_up()
        return MissingMountpointError(self._settings.mountpoint, self._streams, self._place)

    @property
    def _stream(self) -> NtripStream | None:
        """The stream in the source table; None while that is not known, or if it is not there."""
        return next((each for each in self._streams if each.name == self._settings.mountpoint), None)

    @property
    def _gga_period(self) -> float:
        """Seconds between positions that are sent; infinite for none."""
        if self._settings.gga_period is not None:
            return self._settings.gga_period or math.inf
        return GGA_PERIOD_S if self._stream is not None and self._stream.needs_place else math.inf

    def _make_gga(self) -> bytes:
        """Return the position for the caster; empty without a fix, or if it needs none."""
        if self._place is None or self._gga_period == math.inf:
            return b""
        return make_gga(self._place, (time.time_ns() // 1000) % DAY)

    def _look_up(self) -> None:
        """Get the source table, unless it is known; it stays unknown if the caster does not send it."""
        if self._streams:
            return
        session, begin_s = NtripSession(""), self._monotonic()
        try:
            with self._connect("") as connection:
                last_s = begin_s
                while not self._is_stopping.is_set() and self._monotonic() - begin_s < SILENCE_S:
                    try:
                        data = connection.recv(65536)
                    except TimeoutError:
                        if self._monotonic() - last_s > (REJECTION_S if session.is_rejected else CONNECT_TIMEOUT_S):
                            session.finish()
                        continue
                    last_s = self._monotonic()
                    if not data:
                        session.finish()
                        return
                    session.feed(data)
        except MissingMountpointError as error:
            self._streams = error.streams
        except (OSError, NtripError) as error:
            log.debug("%s: no source table of %s: %s", self._name, self._settings.caster, error)
        if self._stream is not None and self._stream.needs_place:
            what = (
                f"mountpoint {quote(self._settings.mountpoint)} of {self._settings.caster} needs the rover's position"
            )
            if self._gga_period == math.inf:
                log.warning(
                    "%s: %s, which gga_period: 0 does not send: set it to 10, or leave it out", self._name, what
                )
            else:
                after = "" if self._place else ", from the first fix on"
                log.info(
                    "%s: %s, by its source table: it is sent every %g s%s", self._name, what, self._gga_period, after
                )

    def _explain(self, has_data: bool) -> str:
        """Return why a caster that has answered sends no corrections."""
        if has_data:
            return ""
        if self._gga_period < math.inf:
            if self._place is None:
                return ": it needs the rover's position, and the receiver has no fix yet"
            return (
                ", although the rover's position is sent: is the rover in its area, and may the user read the stream?"
            )
        if self._stream is not None and not self._stream.needs_place:
            return ": its source table asks for no position; if it is a network (VRS) all the same, set gga_period: 10"
        return ": a network of stations (VRS) needs the rover's position: set gga_period: 10"

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
