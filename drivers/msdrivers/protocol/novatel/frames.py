"""Frame formats of NovAtel receivers: binary and ASCII logs with CRC, command responses and prompts without."""

from __future__ import annotations

import re
from dataclasses import dataclass

from msdrivers.protocol.framing import NO_FRAME, ParsedFrame, RejectedFrame
from msdrivers.protocol.novatel import ascii as text_logs
from msdrivers.protocol.novatel.binary import LONG_HEADER, READERS, SHORT_HEADER, crc32
from msdrivers.protocol.novatel.logs import MAX_ANTENNA, MESSAGE_IDS, Body, LogHeader, NovatelLog, TimeStatus

MAX_LOG_BYTES = 1024
"""Bytes of a log. Longer ones (raw observations) are not read here; a broken length must not swallow good logs."""
_MAX_NAME_BYTES = 40
_WEEK_MS = 604_800_000


@dataclass(frozen=True, slots=True)
class CommandResponse:
    """Response to a command. error: its text, empty for `<OK`."""

    start: int
    error: str = ""

    @property
    def is_ok(self) -> bool:
        """Whether the command was accepted."""
        return not self.error


@dataclass(frozen=True, slots=True)
class Prompt:
    """`[COM1]`: follows every answer, and greets after the receiver has started."""

    start: int
    port: str


class BinaryFormat:
    """Long headers (AA 44 12) and short ones (AA 44 13)."""

    start_bytes = b"\xaa"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[NovatelLog] | RejectedFrame | None:
        """See `framing.FrameFormat`."""
        available = len(buffer) - at
        if available < 4:
            return None if b"\xaa\x44".startswith(buffer[at : at + 2]) else NO_FRAME
        if buffer[at + 1] != 0x44:
            return NO_FRAME
        if buffer[at + 2] == 0x12:
            return self._scan_long(buffer, at, available, start)
        if buffer[at + 2] == 0x13:
            return self._scan_short(buffer, at, available, start)
        return NO_FRAME

    def _scan_long(
        self, buffer: bytearray, at: int, available: int, start: int
    ) -> ParsedFrame[NovatelLog] | RejectedFrame | None:
        head = buffer[at + 3]
        if head < LONG_HEADER.size:
            return RejectedFrame("novatel_header")
        if available < LONG_HEADER.size:
            return None
        _, _, ident, kind, port, length, sequence, _, status, week, ms, receiver, _, _ = LONG_HEADER.unpack_from(
            buffer, at
        )
        expected, reader = READERS.get(ident, (length, None))
        if ms >= _WEEK_MS or kind & 0x60 or length != expected:
            return RejectedFrame("novatel_header")
        end = at + head + length
        if end + 4 - at > MAX_LOG_BYTES:
            return RejectedFrame("novatel_length")
        if len(buffer) < end + 4:
            return None
        if not _has_valid_crc(buffer, at, end):
            return RejectedFrame("novatel_checksum")
        name = MESSAGE_IDS.get(ident) or f"id {ident}"
        body = None
        # an answer to a binary command has the id of the command, and another body
        if reader is not None and not kind & 0x80:
            body = reader(buffer[at + head : end])
            if body is None:
                return RejectedFrame("novatel_value")
        header = LogHeader(name, week, ms, status, str(port), sequence, receiver, True, kind & MAX_ANTENNA)
        return ParsedFrame(end + 4, f"novatel.{header.label}", NovatelLog(header, body, start))

    def _scan_short(
        self, buffer: bytearray, at: int, available: int, start: int
    ) -> ParsedFrame[NovatelLog] | RejectedFrame | None:
        end = at + SHORT_HEADER.size + buffer[at + 3]
        if available < SHORT_HEADER.size:
            return None
        _, _, ident, week, ms = SHORT_HEADER.unpack_from(buffer, at)
        if ms >= _WEEK_MS:
            return RejectedFrame("novatel_header")
        if len(buffer) < end + 4:
            return None
        if not _has_valid_crc(buffer, at, end):
            return RejectedFrame("novatel_checksum")
        name = MESSAGE_IDS.get(ident) or f"id {ident}"
        header = LogHeader(name, week, ms, TimeStatus.UNKNOWN, "", 0, 0, True)
        return ParsedFrame(end + 4, f"novatel.{name}SB", NovatelLog(header, None, start))


def _has_valid_crc(buffer: bytearray, at: int, end: int) -> bool:
    return crc32(bytes(buffer[at:end])) == int.from_bytes(buffer[end : end + 4], "little")


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
        long = buffer[at] == 0x23
        try:
            header, parsed = _parse_text(content.decode("ascii"), long)
        except ValueError:
            return RejectedFrame("novatel_value")
        return ParsedFrame(end + 9, f"novatel.{header.label}", NovatelLog(header, parsed, start))


def _parse_text(content: str, long: bool) -> tuple[LogHeader, Body | None]:
    head, separator, body = content.partition(";")
    if not separator:
        raise ValueError("no end of the header")
    fields = head.split(",")
    header = text_logs.parse_long_header(fields) if long else text_logs.parse_short_header(fields)
    return header, text_logs.parse_body(header.name, text_logs.split_fields(body)) if long else None


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
