"""NTRIP: the session of a client with a caster, both versions (RTCM 10410.0 and 10410.1).

The client asks for a mountpoint by HTTP. A caster of version 1 answers `ICY 200 OK` and sends corrections at once; one
of version 2 answers as HTTP does, usually in chunks. For an unknown mountpoint it sends its source table.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Final

from modelserver.version import __version__
from msdrivers.protocol.nmea import fields as nmea
from msdrivers.protocol.rtcm import RtcmFrame, RtcmStream

MAX_HEADER: Final = 8192
MAX_CHUNK: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class NtripRequest:
    """What is asked of a caster. `host` has no port."""

    host: str
    mountpoint: str
    user: str = ""
    password: str = ""

    def encode(self) -> bytes:
        """Return the bytes of the request."""
        lines = [
            f"GET /{self.mountpoint} HTTP/1.1",
            f"Host: {self.host}",
            "Ntrip-Version: Ntrip/2.0",
            f"User-Agent: NTRIP ModelServer/{__version__}",
            "Connection: close",
        ]
        if self.user:
            lines.append(f"Authorization: Basic {b64encode(f'{self.user}:{self.password}'.encode()).decode()}")
        return ("\r\n".join(lines) + "\r\n\r\n").encode("utf-8")


class NtripError(Exception):
    """The caster does not send corrections; the message has the reason and what to do."""


class NtripSession:
    """Bytes of a caster in, frames out. `stream.counts` has the frames by kind and what was rejected."""

    def __init__(self, request: NtripRequest) -> None:
        self._request = request
        self._buffer = b""
        self._is_answered = self._is_chunked = False
        self._chunk_left = 0
        self.stream = RtcmStream()

    @property
    def is_answered(self) -> bool:
        """Whether the caster has accepted the request."""
        return self._is_answered

    def feed(self, data: bytes) -> list[RtcmFrame]:
        """Return the frames that `data` completes. Raises NtripError."""
        if not self._is_answered:
            self._buffer += data
            body = self._read_header()
            if body is None:
                return []
            data = body
        return self.stream.feed(self._read_chunks(data) if self._is_chunked else data)

    def _read_header(self) -> bytes | None:
        """Return what follows the header; None while it is incomplete."""
        line, end, rest = self._buffer.partition(b"\r\n")
        if not end:
            if len(self._buffer) > MAX_HEADER:
                raise NtripError("the server's answer is not that of an NTRIP caster: check caster")
            return None
        status = line.decode("latin-1")
        if status.startswith("ICY 200"):
            self._is_answered, self._buffer = True, b""
            return rest
        if status.startswith("SOURCETABLE"):
            raise NtripError(f"the caster has no mountpoint {self._request.mountpoint!r}: check mountpoint")
        words = status.split(" ", 2)
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
            raise NtripError(f"the caster has no mountpoint {self._request.mountpoint!r}: check mountpoint")
        self._is_answered, self._buffer = True, b""
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
                raise NtripError("the caster's chunks are damaged") from None
            if size == 0:
                raise NtripError("the caster has ended the stream")
            if not 0 < size <= MAX_CHUNK:
                raise NtripError("the caster's chunks are damaged")
            self._chunk_left = size
        return content


def make_gga(
    latitude_deg: float, longitude_deg: float, height_msl: float, satellites: int, time_of_day_us: int
) -> bytes:
    """Return the sentence by which a network of stations computes corrections for this place."""
    place = (*nmea.format_angle(latitude_deg, "NS", 2), *nmea.format_angle(longitude_deg, "EW", 3))
    height = (nmea.format_number(height_msl, 2), "M", "0.0", "M")
    count = str(max(satellites, 4))
    return nmea.encode(
        "GP", "GGA", (nmea.format_time_of_day(time_of_day_us), *place, "1", count, "1.0", *height, "", "")
    )
