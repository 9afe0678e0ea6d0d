"""Frames of NovAtel receivers: binary and ASCII logs with CRC, command responses and prompts without; logs encoded.

The CRC-32 has the reflected polynomial 0xEDB88320, starts from 0 and has no final inversion.
"""

from __future__ import annotations

import csv
import re
import zlib
from struct import Struct

from msdrivers.protocol.framing import NO_FRAME, ParsedFrame, RejectedFrame
from msdrivers.protocol.novatel import (
    MAX_ANTENNA,
    MESSAGE_IDS,
    CommandResponse,
    LogHeader,
    NovatelLog,
    Prompt,
    TimeStatus,
)
from msdrivers.protocol.novatel.bodies import BODIES, parse_integer

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
    """Encode a log with a long header, binary or ASCII by `log.header.is_binary`, as the receiver does.

    Raises:
        ValueError: a log without body, or one whose name has no number.
    """
    header, body = log.header, log.body
    if body is None or header.name not in _IDS:
        raise ValueError(f"{header.name} cannot be written")
    layout = BODIES[header.name]
    if header.is_binary:
        head = _LONG_HEADER.pack(
            _IDS[header.name],
            header.antenna,
            _PORTS.get(header.port) or (int(header.port) if header.port.isdecimal() else 0),
            layout.size,
            header.sequence,
            header.time_status,
            header.week,
            header.milliseconds,
            header.receiver_status,
        )
        frame = b"\xaa\x44\x12\x1c" + head + layout.pack(body)
        return frame + crc32(frame).to_bytes(4, "little")
    text = (
        f"{header.label},{header.port or 'COM1'},{header.sequence},0.0,{TimeStatus(header.time_status).name},"
        f"{header.week},{header.milliseconds / 1000.0:.3f},{header.receiver_status:08x},0000,0;"
        f"{','.join(layout.format(body))}"
    )
    return f"#{text}*{crc32(text.encode('ascii')):08x}\r\n".encode("ascii")


class BinaryFormat:
    """Long headers (AA 44 12) and short ones (AA 44 13)."""

    start_bytes = b"\xaa"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[NovatelLog] | RejectedFrame | None:
        """See `framing.FrameFormat`."""
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
        """See `framing.FrameFormat`."""
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
        """See `framing.FrameFormat`."""
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
        """See `framing.FrameFormat`."""
        prompt = self._prompt.match(buffer, at)
        if prompt is not None:
            return ParsedFrame(prompt.end(), "novatel.prompt", Prompt(start, prompt[1].decode("ascii")))
        part = self._part.match(buffer, at, at + 12)
        return None if part is not None and part.end() == len(buffer) and len(buffer) - at < 12 else NO_FRAME
