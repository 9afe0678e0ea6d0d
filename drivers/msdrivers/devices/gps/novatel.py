"""NovAtel OEM4 and successors: logs in binary and ASCII, command responses and prompts.

Contents have the names of the manuals. Numbers that are not in these tables, of newer receivers, stay plain numbers.

Bodies are little-endian and packed in binary; ASCII has comma-separated fields, names for enumerations and quoted
strings: one table of columns for both. Logs are asked for in binary; ASCII is only read.

Frames of logs end with CRC-32: the reflected polynomial 0xEDB88320, starting from 0, without final inversion. Responses
and prompts have no checksum.
"""

from __future__ import annotations

import csv
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from math import isfinite
from operator import itemgetter
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

from msdrivers.devices.stream import NO_FRAME, ParsedFrame, RejectedFrame


class TimeStatus(IntEnum):
    """Quality of the receiver's GPS time."""

    UNKNOWN = 20
    APPROXIMATE = 60
    COARSEADJUSTING = 80
    COARSE = 100
    COARSESTEERING = 120
    FREEWHEELING = 130
    FINEADJUSTING = 140
    FINE = 160
    FINEBACKUPSTEERING = 170
    FINESTEERING = 180
    SATTIME = 200


class SolutionStatus(IntEnum):
    """Whether a solution was computed. The other reasons why not are plain numbers."""

    SOL_COMPUTED = 0
    INSUFFICIENT_OBS = 1


class PositionType(IntEnum):
    """Type of a position or velocity solution."""

    NONE = 0
    FIXEDPOS = 1
    FIXEDHEIGHT = 2
    FLOATCONV = 4
    WIDELANE = 5
    NARROWLANE = 6
    DOPPLER_VELOCITY = 8
    SINGLE = 16
    PSRDIFF = 17
    WAAS = 18
    PROPAGATED = 19
    OMNISTAR = 20
    L1_FLOAT = 32
    IONOFREE_FLOAT = 33
    NARROW_FLOAT = 34
    L1_INT = 48
    WIDE_INT = 49
    NARROW_INT = 50
    RTK_DIRECT_INS = 51
    INS_SBAS = 52
    INS_PSRSP = 53
    INS_PSRDIFF = 54
    INS_RTKFLOAT = 55
    INS_RTKFIXED = 56
    OMNISTAR_HP = 64
    OMNISTAR_XP = 65
    CDGPS = 66
    PPP_CONVERGING = 68
    PPP = 69
    INS_PPP_CONVERGING = 73
    INS_PPP = 74
    PPP_BASIC_CONVERGING = 77
    PPP_BASIC = 78
    INS_PPP_BASIC_CONVERGING = 79
    INS_PPP_BASIC = 80


class LogHeader(NamedTuple):
    """Header of a log.

    name: e.g. "BESTPOS", or "id 1234" for an unknown binary log. week may be rolled over, see `gps_time`.
    milliseconds: of the week. time_status: a `TimeStatus`; UNKNOWN for a short header.
    port: as ASCII names it, or the binary address's number. antenna: the measurement source; 1 is the secondary
    antenna, which ASCII writes as a suffix of the name (`BESTPOSA_1`). Older boards send others, which mean none.
    """

    name: str
    week: int
    milliseconds: int
    time_status: int
    port: str
    sequence: int
    receiver_status: int
    is_binary: bool
    antenna: int = 0

    @property
    def label(self) -> str:
        """The name as receivers write it: `BESTPOSB`, `BESTPOSA_1`."""
        return f"{self.name}{'B' if self.is_binary else 'A'}{'_1' if self.is_secondary else ''}"

    @property
    def is_secondary(self) -> bool:
        return self.antenna == 1


class Position(NamedTuple):
    """Body of BESTPOS, PSRPOS and RTKPOS. Degrees; meters; ages in seconds; sigmas along north, east and up.

    height is above mean sea level; above the ellipsoid it is `height + undulation`.
    """

    status: int
    type: int
    latitude: float
    longitude: float
    height: float
    undulation: float
    datum: int
    sigma_latitude: float
    sigma_longitude: float
    sigma_height: float
    station: str
    differential_age: float
    solution_age: float
    tracked: int
    used: int


class Velocity(NamedTuple):
    """Body of BESTVEL. latency: seconds to take off the header's time. m/s, up positive; track: degrees clockwise from
    true north."""

    status: int
    type: int
    latency: float
    age: float
    horizontal: float
    track: float
    vertical: float


class HeadingLog(NamedTuple):
    """Body of HEADING and HEADING2: from the antenna whose position is given to the other one.

    length: meters, -1 if unknown. Degrees; heading clockwise from true north.
    """

    status: int
    type: int
    length: float
    heading: float
    pitch: float
    sigma_heading: float
    sigma_pitch: float
    station: str
    tracked: int
    used: int


Body: TypeAlias = Position | Velocity | HeadingLog


class NovatelLog(NamedTuple):
    """A log whose checksum is right. body: None for a log that is not read here. start: bytes from the beginning of
    the stream to its first byte."""

    header: LogHeader
    body: Body | None
    start: int = 0


MESSAGE_IDS = {
    37: "VERSION",
    42: "BESTPOS",
    47: "PSRPOS",
    93: "RXSTATUS",
    99: "BESTVEL",
    101: "TIME",
    141: "RTKPOS",
    174: "PSRDOP",
    241: "BESTXYZ",
    264: "INSCOV",
    508: "INSPVAS",
    726: "BESTUTM",
    812: "CORRIMUDATA",
    971: "HEADING",
    1163: "PSRDOP2",
    1335: "HEADING2",
    1465: "INSPVAX",
}

MAX_ANTENNA = 31
"""The largest measurement source: five bits of a binary log's message type."""

WGS84_DATUM = 61
"""The only datum that the driver takes: the names of others in ASCII logs become 0."""


@dataclass(frozen=True, slots=True)
class CommandResponse:
    """Response to a command. error: its text, empty for `<OK`."""

    start: int
    error: str = ""


@dataclass(frozen=True, slots=True)
class Prompt:
    """`[COM1]`: follows every answer, and greets after the receiver has started."""

    start: int
    port: str


UNKNOWN_VALUE = 255
"""Status or type whose word is not in the tables; no receiver uses this number."""


class _Column(NamedTuple):
    """A value of a body: its struct code, how its ASCII field is parsed, and its conversion from and to what is packed.

    Without `parse` it is reserved.
    """

    code: str
    parse: Callable[[str], object] | None = None
    unpack: Callable[[Any], object] | None = None
    pack: Callable[[Any], object] | None = None


def parse_integer(text: str, most: int, base: int = 10) -> int:
    """Read a number that the binary log has without a sign, `most` being the largest."""
    value = int(text, base)
    if not 0 <= value <= most:
        raise ValueError(f"{value} is not within 0 to {most}")
    return value


_FLOAT, _DOUBLE = _Column("f", float), _Column("d", float)


def _enumeration(kind: type[IntEnum]) -> _Column:
    members = kind.__members__
    return _Column("I", lambda word: int(members[word]) if word in members else UNKNOWN_VALUE)


_SOLUTION = (_enumeration(SolutionStatus), _enumeration(PositionType))
_COUNTS = (_Column("B", partial(parse_integer, most=0xFF)),) * 2
_STATION = _Column(
    "4s",
    str,
    lambda raw: raw.partition(b"\0")[0].decode("ascii", "replace"),
    lambda text: text.encode("ascii"),
)
_DATUM = _Column("I", lambda word: WGS84_DATUM if word == "WGS84" else 0)
_RESERVED = _Column("4x")
_TAIL = (_Column("x"),) * 6
"""Counts of observations and masks that end several logs."""
_BASELINE = (*_SOLUTION, *(_FLOAT,) * 3, _RESERVED, *(_FLOAT,) * 2, _STATION)


class BodyLayout:
    """The columns of a kind of body; `is_possible` checks values that are finite."""

    def __init__(self, make: type[Body], is_possible: Callable[[Any], bool], *columns: _Column):
        self._make, self._is_possible, self._columns = make, is_possible, columns
        self._struct = Struct("<" + "".join(each.code for each in columns))
        values = [each for each in columns if each.parse is not None]
        self._converted = [(n, each.unpack, each.pack) for n, each in enumerate(values) if each.unpack and each.pack]
        self._floats = itemgetter(*(n for n, each in enumerate(values) if each.parse is float))
        self.size = self._struct.size
        """Bytes of a binary body."""

    def unpack(self, buffer: bytes | bytearray, at: int) -> Body:
        """Decode a binary body of `size` bytes at `at`."""
        values = self._struct.unpack_from(buffer, at)
        for n, unpack, _ in self._converted:
            values = (*values[:n], unpack(values[n]), *values[n + 1 :])
        return self._check(values)

    def pack(self, body: Body) -> bytes:
        values: list[Any] = list(body)
        for n, _, pack in self._converted:
            values[n] = pack(values[n])
        return self._struct.pack(*values)

    def parse(self, fields: Sequence[str]) -> Body:
        """Decode the ASCII fields of a body, without quotes."""
        columns = zip(self._columns, fields, strict=True)
        return self._check([each.parse(text) for each, text in columns if each.parse is not None])

    def _check(self, values: Sequence[object]) -> Body:
        body = self._make._make(values)
        # an infinity makes the sum infinite, a nan makes it nan
        if not (isfinite(sum(self._floats(values))) and self._is_possible(body)):
            raise ValueError(f"{body} cannot be")
        return body


_POSITION = BodyLayout(
    Position,
    lambda body: abs(body.latitude) <= 90.0 and -180.0 <= body.longitude <= 360.0,
    *_SOLUTION,
    *(_DOUBLE,) * 3,
    _FLOAT,
    _DATUM,
    *(_FLOAT,) * 3,
    _STATION,
    *(_FLOAT,) * 2,
    *_COUNTS,
    *_TAIL,
)

BODIES = {
    "BESTPOS": _POSITION,
    "PSRPOS": _POSITION,
    "RTKPOS": _POSITION,
    "BESTVEL": BodyLayout(
        Velocity, lambda body: body.horizontal >= 0.0, *_SOLUTION, *(_FLOAT,) * 2, *(_DOUBLE,) * 3, _RESERVED
    ),
    "HEADING": BodyLayout(HeadingLog, lambda body: 0.0 <= body.heading <= 360.0, *_BASELINE, *_COUNTS, *_TAIL),
    "HEADING2": BodyLayout(
        HeadingLog, lambda body: 0.0 <= body.heading <= 360.0, *_BASELINE, _RESERVED, *_COUNTS, *_TAIL
    ),
}
"""Name of a log -> the layout of its body. PSRPOS and RTKPOS are written as BESTPOS; HEADING2 names two stations."""

MAX_LOG_BYTES = 1024
"""Bytes of a log. Longer ones (raw observations) are not read here; a broken length must not swallow good logs."""
_MAX_NAME_BYTES = 40
_WEEK_MS = 604_800_000

_LONG_HEADER = Struct("<HBBHHxBHII4x")
"""After sync (AA 44 12) and header length: id, type, port, body length, sequence, time status, week, ms, receiver
status."""
_LONG_BYTES = 4 + _LONG_HEADER.size
_SHORT_HEADER = Struct("<HHI")
"""After sync (AA 44 13) and body length: id, week, ms."""
_SHORT_BYTES = 4 + _SHORT_HEADER.size

_IDS = {name: ident for ident, name in MESSAGE_IDS.items()}
_PORTS = {"COM1": 32, "COM2": 64, "COM3": 96}


def crc32(data: bytes | bytearray) -> int:
    """Return the checksum of a log: from its sync bytes to the end of its body, or between '#' and '*'."""
    # zlib inverts before and after; both are undone
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def encode(log: NovatelLog) -> bytes:
    """Encode a log with a body in binary, with a long header, as the receiver does."""
    header, body = log.header, log.body
    assert body is not None
    layout = BODIES[header.name]
    head = _LONG_HEADER.pack(
        _IDS[header.name],
        header.antenna,
        _PORTS.get(header.port, 0),
        layout.size,
        header.sequence,
        header.time_status,
        header.week,
        header.milliseconds,
        header.receiver_status,
    )
    frame = b"\xaa\x44\x12\x1c" + head + layout.pack(body)
    return frame + crc32(frame).to_bytes(4, "little")


class BinaryFormat:
    """Long headers (AA 44 12) and short ones (AA 44 13)."""

    start_bytes = b"\xaa"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[NovatelLog] | RejectedFrame | None:
        available = len(buffer) - at
        if available < 4:
            return None if b"\xaa\x44".startswith(buffer[at : at + 2]) else NO_FRAME
        sort, size = buffer[at + 2], buffer[at + 3]
        if buffer[at + 1] != 0x44 or sort not in (0x12, 0x13):
            return NO_FRAME
        if sort == 0x12:
            if size < _LONG_BYTES:
                return RejectedFrame("novatel_header")
            if available < _LONG_BYTES:
                return None
            ident, kind, port, length, sequence, status, week, ms, receiver = _LONG_HEADER.unpack_from(buffer, at + 4)
            begin, end = at + size, at + size + length
        else:
            if available < _SHORT_BYTES:
                return None
            ident, week, ms = _SHORT_HEADER.unpack_from(buffer, at + 4)
            begin, end = at + _SHORT_BYTES, at + _SHORT_BYTES + size
            kind, port, sequence, status, receiver = 0, "", 0, TimeStatus.UNKNOWN, 0
        name = MESSAGE_IDS.get(ident) or f"id {ident}"
        layout = BODIES.get(name) if sort == 0x12 else None
        if ms >= _WEEK_MS or kind & 0x60 or (layout is not None and end - begin != layout.size):
            return RejectedFrame("novatel_header")
        if end + 4 - at > MAX_LOG_BYTES:
            return RejectedFrame("novatel_length")
        if len(buffer) < end + 4:
            return None
        if crc32(buffer[at:end]) != int.from_bytes(buffer[end : end + 4], "little"):
            return RejectedFrame("novatel_checksum")
        try:
            # an answer to a binary command has the id of the command, and another body
            body = layout.unpack(buffer, begin) if layout is not None and not kind & 0x80 else None
        except ValueError:
            return RejectedFrame("novatel_value")
        header = LogHeader(name, week, ms, status, str(port), sequence, receiver, True, kind & MAX_ANTENNA)
        label = header.label if sort == 0x12 else f"{name}SB"
        return ParsedFrame(end + 4, f"novatel.{label}", NovatelLog(header, body, start))


class AsciiFormat:
    """`#NAMEA,header;body*crc32` and `%NAMESA,header;body*crc32`; `NAMEA_1` is of the secondary antenna."""

    start_bytes = b"#%"
    _begin = re.compile(rb"[#%][A-Z][A-Z0-9_]*(,?)")
    _body = re.compile(rb"[ -)+-~]*")
    _sum = re.compile(rb"[0-9A-Fa-f]{8}")

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[NovatelLog] | RejectedFrame | None:
        if len(buffer) == at + 1:
            return None
        begin = self._begin.match(buffer, at, at + _MAX_NAME_BYTES)
        if begin is None or not begin[1]:
            return None if begin is not None and begin.end() == len(buffer) else NO_FRAME
        body = self._body.match(buffer, begin.end(), at + MAX_LOG_BYTES)
        assert body is not None
        end = body.end()
        if end - at >= MAX_LOG_BYTES:
            return RejectedFrame("novatel_length")
        if end == len(buffer):
            return None
        if buffer[end] != 0x2A:
            return RejectedFrame("novatel_incomplete")
        if len(buffer) < end + 9:
            return None
        stated = buffer[end + 1 : end + 9]
        content = bytes(buffer[at + 1 : end])
        if not self._sum.fullmatch(stated) or int(stated, 16) != crc32(content):
            return RejectedFrame("novatel_checksum")
        try:
            log = _parse_text(content.decode("ascii"), buffer[at] == 0x23, start)
        except ValueError:
            return RejectedFrame("novatel_value")
        return ParsedFrame(end + 9, f"novatel.{log.header.label}", log)


_NAME = re.compile(r"(\w+)A(?:_([0-9]{1,2}))?", re.ASCII)


def _parse_text(content: str, is_long: bool, start: int) -> NovatelLog:
    """Parse a log between its sync and '*': ten fields of header, three of a short one, and fields of the body."""
    head, separator, rest = content.partition(";")
    fields = head.split(",")
    if not separator or len(fields) != (10 if is_long else 3):
        raise ValueError("no header")
    port, sequence, status, receiver = (fields[1], *fields[2:5:2], fields[7]) if is_long else ("", "0", "", "0")
    week, seconds = fields[5:7] if is_long else fields[1:]
    parts = _NAME.fullmatch(fields[0])
    milliseconds = float(seconds) * 1000.0
    # not a number and infinities are not within it either
    if parts is None or not 0.0 <= milliseconds < _WEEK_MS - 0.5:
        raise ValueError(f"{fields[0]} at {seconds} s is no log of a week")
    header = LogHeader(
        parts[1],
        parse_integer(week, 0xFFFF),
        round(milliseconds),
        TimeStatus.__members__.get(status, TimeStatus.UNKNOWN),
        port,
        parse_integer(sequence, 0xFFFF),
        parse_integer(receiver, 0xFFFF_FFFF, 16),
        False,
        parse_integer(parts[2] or "0", MAX_ANTENNA),
    )
    layout = BODIES.get(header.name) if is_long else None
    if layout is None:
        return NovatelLog(header, None, start)
    return NovatelLog(header, layout.parse(next(csv.reader([rest])) if '"' in rest else rest.split(",")), start)


class TextFormat:
    """`<OK`, `<ERROR:...`, and abbreviated ASCII, whose lines begin with '<' and carry no checksum: not used."""

    start_bytes = b"<"
    # not over the beginning of a log or a sentence: then the '<' was noise
    _line = re.compile(rb"<[ -\"&-Z\\-~]*")
    _longest = 256

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[CommandResponse] | RejectedFrame | None:
        line = self._line.match(buffer, at, at + self._longest)
        assert line is not None
        end = line.end()
        if end - at >= self._longest:
            return NO_FRAME
        if end == len(buffer):
            return None
        if buffer[end] not in b"\r\n":
            return NO_FRAME
        text = line[0].decode("ascii").rstrip()
        if text == "<OK":
            return ParsedFrame(end, "novatel.OK", CommandResponse(start))
        if text.startswith("<ERROR"):
            return ParsedFrame(end, "novatel.ERROR", CommandResponse(start, text[6:].lstrip(": ") or "no reason given"))
        return ParsedFrame(end, "novatel.abbreviated", None) if len(text) > 8 else NO_FRAME


class PromptFormat:
    """`[COM1]` and the like."""

    start_bytes = b"["
    _prompt = re.compile(rb"\[((?:[INX]?COM|USB|AUX|FILE|SPECIAL|THISPORT)\d{0,2})\]")
    _part = re.compile(rb"\[[A-Z]*\d{0,2}")

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[Prompt] | RejectedFrame | None:
        prompt = self._prompt.match(buffer, at)
        if prompt is not None:
            return ParsedFrame(prompt.end(), "novatel.prompt", Prompt(start, prompt[1].decode("ascii")))
        part = self._part.match(buffer, at, at + 12)
        return None if part is not None and part.end() == len(buffer) and len(buffer) - at < 12 else NO_FRAME


FORMATS = (BinaryFormat(), AsciiFormat(), TextFormat(), PromptFormat())
