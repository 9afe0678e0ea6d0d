"""Devices on a CAN bus: DBC databases (by cantools), instants of several frames, and the common part of the drivers.

Mapping: what another vehicle configures instead of coding. A signal is named `Message.Signal` as in the DBC. Its value
is the DBC's physical one, with the DBC's own scale and offset; `scale` in the settings brings it to SI units and our
signs, e.g. 0.2778 for km/h, -1 for a sign that is the other way.

Database: the range that a DBC gives a signal is no authority: in public files every ninth is of raw values, of the
other sign or made up. It bounds what is sent, and a received value outside it is used. Only what the file or J1939
reserves for "not available" or "error" is no value. cantools reads a whole file or nothing. So a file that it rejects
is split into its statements, and each message is read by itself with what belongs to it: those that can be read may be
mapped, and the others are problems of the file.

J1939 (SAE J1939-21, 5.2): a 29-bit identifier is priority (3 bits), PGN (18 bits; with a PDU format below 240 its low
byte is the destination instead) and source address (8 bits). A DBC file has any priority, and customarily 0xFE, the
null address, as source. So frames of a J1939 message are matched by PGN: from the source that the settings state, else
from the file's own, else from the first that sends it, until that is silent. Messages of more than 8 bytes come in
several packets (transport protocol), which are not supported.

Driver (`CanDriver`): decoding, assembly of instants, silence, malformed frames, bus-off.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import TYPE_CHECKING, Final, NamedTuple

from modelserver.errors import ConfigError, Location, Problem, Severity, Suggestion, quote, suggest_name
from modelserver.messages import Sample, SensorHeader
from msdrivers.devices import Strict, check_factor, check_ranges, check_signal
from msdrivers.endpoint import (
    CanFrame,
    EndpointPhase,
    EndpointStatus,
    FrameKey,
    HostTime,
    MeasuredSample,
    Output,
    Reopen,
)

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal


MAX_SOURCE_ADDRESS: Final = 0xFD
"""0xFE is the null address, 0xFF all (SAE J1939-81)."""

MAX_J1939_BYTES: Final = 8
"""Of a message in one frame."""

_PDU1_FORMATS: Final = 240


def find_pgn(arbitration_id: int) -> int:
    pgn = arbitration_id >> 8 & 0x3FFFF
    return pgn if pgn >> 8 & 0xFF >= _PDU1_FORMATS else pgn & 0x3FF00


def parse_pgn(name: str) -> int | None:
    """Return the PGN of a message that is named by it, such as 65215 or 0xFEBF; None for a name."""
    try:
        return int(name, 16) if name[:2].lower() == "0x" else int(name) if name.isdecimal() else None
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class SignalMap(Strict):
    """A number: `signal` times `scale` plus `offset`, in SI units and radians."""

    signal: str
    """Message.Signal in the DBC file."""
    scale: float = 1.0
    """Factor of the signal's physical value."""
    offset: float = 0.0
    """Offset after scaling."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.scale, "scale")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset is a number, got {self.offset:g}")

    def to_si(self, physical: float) -> float:
        return physical * self.scale + self.offset

    def from_si(self, value: float) -> float:
        return (value - self.offset) / self.scale


@dataclass(frozen=True, slots=True, kw_only=True)
class BusSettings(Strict):
    """Settings that drivers on a CAN bus have. Raises ValueError with the key for an invalid value."""

    source: str
    """Source of the samples."""
    dbc: str
    """Path of the DBC file, relative to the file that holds these settings."""
    window: float = 0.02
    """Seconds to wait for the other frames of an instant; shorter than the time between two instants."""
    silence: float = 1.0
    """Timeout for usable frames, seconds."""
    delay: float = 0.0
    """Seconds from the measurement to the frame's arrival, as far as known."""
    delay_sigma: float = 0.0
    """Standard deviation of `delay`, seconds."""
    source_address: Mapping[str, int] = field(default_factory=dict)
    """J1939 source address by message, where several devices send one PGN; others are matched from any one source."""

    def __post_init__(self) -> None:
        if not self.dbc:
            raise ValueError("dbc is the path of a DBC file, got nothing")
        for name, address in self.source_address.items():
            if not 0 <= address <= MAX_SOURCE_ADDRESS:
                raise ValueError(f"source_address of {quote(name)} is 0 to {MAX_SOURCE_ADDRESS} (0xFD), got {address}")
        check_ranges(self, window=(0.0, 1.0), silence=(0.05, 3600.0), delay=(0.0, 5.0), delay_sigma=(0.0, 5.0))


_UNUSED_FIX = "correct it, or leave it: the other messages can be used"

_NO_VALUE = re.compile(
    r"not? ?(?:available|avail|valid|defined|data|signal)|invalid|\b(?:sna|na|n/a|error|fault|failure|undefined)\b",
    re.IGNORECASE,
)
"""Names in a value table that stand for no measurement."""

_J1939_NAMES = {0xFF: "not available", 0xFE: "error"}
"""By the highest byte of a number of a byte and more: SAE J1939-71, 5.1.4."""


class FrameError(ValueError):
    """A frame that does not match the DBC; `reason` is the counter's name, `summary` what is wrong in a few words."""

    def __init__(self, reason: str, message: str, summary: str = ""):
        self.reason, self.summary = reason, summary
        super().__init__(message)


@dataclass(frozen=True, slots=True)
class BoundSignal:
    """A signal of the database; `minimum` and `maximum` are physical values, infinite without limits.

    names: of raw values, by the file's value table. is_j1939: the file states that protocol for the frame.
    """

    key: FrameKey
    message: str
    name: str
    length: int
    is_signed: bool
    is_float: bool
    scale: float
    offset: float
    minimum: float
    maximum: float
    names: Mapping[int, str] = field(default_factory=dict)
    is_j1939: bool = False
    unit: str = ""

    @property
    def path(self) -> str:
        return f"{self.message}.{self.name}"

    def to_physical(self, raw: float) -> float | None:
        """Return the physical value of raw bits; None (missing) if it is not finite, or reserved."""
        value = raw * self.scale + self.offset
        return value if isfinite(value) and not self.find_reserved(raw) else None

    def is_outside(self, raw: float) -> bool:
        value, slack = raw * self.scale + self.offset, 1e-6 * abs(self.scale)
        return not self.minimum - slack <= value <= self.maximum + slack

    def find_reserved(self, raw: float) -> str:
        """Return what raw bits stand for if that is no value, by the file's value table or by J1939; else nothing.

        A file seldom states the protocol: frames with 29-bit identifiers are J1939's where the value is outside the
        range, too.
        """
        if self.is_float or not isfinite(raw):
            return ""
        name = self.names.get(int(raw), "")
        if name and (self.is_outside(raw) or _NO_VALUE.search(name)):
            return name
        if self.length < 8 or self.is_signed or not (self.is_j1939 or (self.key.is_extended and self.is_outside(raw))):
            return ""
        reserved = _J1939_NAMES.get(int(raw) >> (self.length - 8))
        return f"{reserved} in J1939" if reserved else ""

    def to_raw(self, physical: float) -> int:
        """Return the raw bits nearest to a physical value, clamped to the signal's length and the DBC's range."""
        physical = min(max(physical, self.minimum), self.maximum)
        low = -(1 << (self.length - 1)) if self.is_signed else 0
        return min(max(round((physical - self.offset) / self.scale), low), low + (1 << self.length) - 1)

    def to_bits(self, physical: float) -> float:
        """Return the input of `CanDatabase.encode` for a physical value: raw bits, or a float for a float signal."""
        return (physical - self.offset) / self.scale if self.is_float else self.to_raw(physical)


@dataclass(frozen=True, slots=True)
class CanDatabase:
    """The messages of a DBC file called `name`.

    flaws: what is wrong with the messages that cannot be used, by name, as errors; with anything else, as warnings
    under "". is_j1939: the file states that protocol for all its messages with 29-bit identifiers.
    """

    name: str
    messages: Mapping[str, Message] = field(repr=False)
    by_key: Mapping[FrameKey, Message] = field(repr=False)
    flaws: Mapping[str, tuple[Problem, ...]] = field(default_factory=dict)
    is_j1939: bool = False

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """What is wrong with the file, none of which affects a signal that could be bound."""
        found = dict.fromkeys(each for several in self.flaws.values() for each in several)
        return tuple(replace(each, severity=Severity.WARNING, fix=_UNUSED_FIX) for each in found)

    def decode(self, frame: CanFrame) -> dict[str, float]:
        """Decode a frame to the raw value of each signal by name.

        Raises FrameError with the reason `unknown` (identifier), `length`, `multiplexer` or `bits`.
        """
        message = self.by_key.get(frame.key)
        if message is None:
            raise FrameError("unknown", f"{self.name} has no message {frame.key}")
        what, size = f"frame {frame.key} ({message.name})", len(frame.data)
        if size != message.length:
            why = "the DBC is of another version of the controller, or another device uses the same identifier"
            text = f"{what} has {size} bytes, {self.name} expects {message.length}: {why}"
            raise FrameError("length", text, f"with {size} bytes instead of {message.length}")
        from cantools.database.errors import Error

        try:
            values = message.decode_simple(
                frame.data, decode_choices=False, scaling=False, allow_truncated=False, allow_excess=False
            )
        except Error as error:
            raise FrameError("multiplexer", f"{what}: {error}", "with an unknown multiplexer") from None
        except (ValueError, KeyError, OverflowError) as error:
            raise FrameError("bits", f"{what}: {error}", "with bits that are no number") from None
        return {name: value for name, value in values.items() if isinstance(value, int | float)}

    def encode(self, message: str, raw: Mapping[str, float]) -> CanFrame:
        """Encode a message; `raw` has the raw value of each of its signals."""
        found = self.messages[message]
        data = found.encode(dict(raw), scaling=False, strict=False)
        return CanFrame(found.frame_id, bytes(data), found.is_extended_frame)

    def bind_signals(self, message: str) -> dict[str, BoundSignal]:
        """Return the signals of a message by name. Raises KeyError for an unknown message."""
        found = self.messages[message]
        return {signal.name: _bind_signal(found, signal, self.is_j1939) for signal in found.signals}

    def find_by_pgn(self, pgn: int) -> list[str]:
        return [
            name for name, each in self.messages.items() if each.is_extended_frame and find_pgn(each.frame_id) == pgn
        ]


class SignalBinder:
    """Looks up mapped signals and collects every problem, so that all are reported at once."""

    def __init__(self, database: CanDatabase, place: str):
        """`place` is the mapping's key path in the settings, e.g. `drivers.wheels`."""
        self._database = database
        self._place = place
        self.problems: list[Problem] = []

    def bind_mapped(self, settings: object, prefix: str = "", /, **bits: int) -> dict[str, BoundSignal]:
        """Return the signals of those attributes that are mapped, by name; `bits`: of each, see `bind_signal`."""
        paths = {name: getattr(mapped, "signal", mapped) for name in bits if (mapped := getattr(settings, name))}
        found = {name: self.bind_signal(path, f"{prefix}{name}", bits[name]) for name, path in paths.items()}
        return {name: signal for name, signal in found.items() if signal is not None}

    def bind_signal(self, path: str, key: str, bits: int = 0) -> BoundSignal | None:
        """Return the signal `Message.Signal` of the setting `key`; add a problem and return None if it is unknown.

        The message may be named by its PGN. bits: it must be an integer of at most so many; 0: any number.
        """
        message_name, _, name = path.partition(".")
        pgn = parse_pgn(message_name)
        if pgn is not None:
            names = self._database.find_by_pgn(pgn)
            if len(names) != 1:
                listed = ", ".join(names[:10]) or "none"
                fix = f"name one of them: {listed}" if names else "name a message of the file, or correct the PGN"
                self.add_problem(key, f"{len(names)} messages have PGN {pgn} (0x{pgn:X}); one is needed", fix)
                return None
            message_name = names[0]
        if message_name in self._database.flaws:
            self.problems += self._database.flaws[message_name]
            return None
        message = self._database.messages.get(message_name)
        if message is None:
            form = f"{{}}.{name}" if name else "{}"
            self._add_missing(key, "there is no message", message_name, list(self._database.messages), form)
            return None
        signal = next((each for each in message.signals if each.name == name), None)
        if signal is None:
            known = [each.name for each in message.signals]
            # a key with the signal's own name has no message name in its value
            form = "{}" if key.endswith(f".{name}") else f"{message_name}.{{}}"
            self._add_missing(key, f"message {message_name} has no signal", name, known, form)
            return None
        if bits and (signal.is_float or signal.length > bits):
            kind = "a floating-point number" if signal.is_float else f"{signal.length} bits long"
            self.add_problem(
                key, f"{path} is {kind}; a whole number of at most {bits} bits is needed", "map another signal"
            )
            return None
        bound = _bind_signal(message, signal, self._database.is_j1939 or pgn is not None)
        if bound.is_j1939 and message.length > MAX_J1939_BYTES:
            what = f"message {message_name} has {message.length} bytes, which J1939 sends in several packets"
            self.add_problem(key, f"{what}; those are not supported", "map a signal of a message of at most 8 bytes")
            return None
        return bound

    def add_problem(self, key: str, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Add a problem that is fixed at the setting `key`, not in the DBC file."""
        source = Location(element=f"{self._place}.{key}")
        self.problems.append(Problem(Severity.ERROR, f"{self._database.name}: {message}", source, fix, nearest))

    def finish(self) -> None:
        """Raise ConfigError if there were problems."""
        if self.problems:
            raise ConfigError(self.problems)

    def _add_missing(self, key: str, what: str, name: str, known: list[str], form: str) -> None:
        near = Suggestion.of(
            form.replace("{}", name), *(form.replace("{}", each) for each in suggest_name(name, known))
        )
        listed = ", ".join(known[:10]) + (", ..." if len(known) > 10 else "")
        fix = f"write {near[0]}" if near else f"known there: {listed or 'nothing'}"
        self.add_problem(key, f"{what} {quote(name)}", fix, near)


def _bind_signal(message: Message, signal: Signal, is_j1939: bool) -> BoundSignal:
    return BoundSignal(
        FrameKey(message.frame_id, message.is_extended_frame),
        message.name,
        signal.name,
        signal.length,
        signal.is_signed,
        signal.is_float,
        float(signal.scale),
        float(signal.offset),
        -inf if signal.minimum is None else float(signal.minimum),
        inf if signal.maximum is None else float(signal.maximum),
        {int(number): str(name) for number, name in (signal.choices or {}).items()},
        message.is_extended_frame and (is_j1939 or message.protocol == "j1939"),
        signal.unit or "",
    )


class CanFrameSet(NamedTuple):
    """Raw signal values of the frames of one instant, by frame and name, with the first frame's receive time."""

    monotonic_ns: int
    utime: int
    values: dict[FrameKey, dict[str, float]]
    is_complete: bool

    def raw(self, signal: BoundSignal | None) -> float | None:
        """Return the raw value of a signal; None if it was not received."""
        return None if signal is None else self.values.get(signal.key, {}).get(signal.name)

    def physical(self, signal: BoundSignal | None) -> float | None:
        """Return the physical value of a signal; None if it is missing."""
        raw = self.raw(signal)
        return None if raw is None or signal is None else signal.to_physical(raw)


class CanFrameAssembler:
    """Collects the frames of one instant, for at most `window_ns` after the first.

    A repeated frame starts the next instant: the missing frames of the last one were lost.
    """

    def __init__(self, needed: frozenset[FrameKey], window_ns: int):
        """`needed` are the kinds of frame that make an instant."""
        self._needed = needed
        self._window_ns = window_ns
        self.clear()

    def clear(self) -> None:
        self._pending: dict[FrameKey, dict[str, float]] = {}
        self._started_ns = self._utime = 0

    def add(self, key: FrameKey, values: dict[str, float], monotonic_ns: int, utime: int) -> list[CanFrameSet]:
        """Add a frame's values; return the instants that it completes or ends."""
        ended = self.pop_expired(monotonic_ns)
        if key in self._pending:
            ended.append(self._finish_set(False))
        if not self._pending:
            self._started_ns, self._utime = monotonic_ns, utime
        self._pending[key] = values
        if self._pending.keys() >= self._needed:
            ended.append(self._finish_set(True))
        return ended

    def pop_expired(self, monotonic_ns: int) -> list[CanFrameSet]:
        """Return the incomplete instant whose window has passed, if any."""
        due = self.get_deadline()
        return [self._finish_set(False)] if due is not None and monotonic_ns >= due else []

    def get_deadline(self) -> int | None:
        """Return when the window of the incomplete instant ends, monotonic nanoseconds; None without one."""
        return self._started_ns + self._window_ns if self._pending else None

    def _finish_set(self, is_complete: bool) -> CanFrameSet:
        ended = CanFrameSet(self._started_ns, self._utime, self._pending, is_complete)
        self._pending = {}
        return ended


MAX_DBC_CHARS: Final = 8 << 20
"""Largest DBC file in characters."""

_WRONG_FILE_FIX = "is this the DBC file of the vehicle, saved as plain text?"
_FIX = "correct it there"
_BYTE_ORDER_MARKS = ("\ufeff", "\u00ef\u00bb\u00bf")
"""As text, and read as Latin-1."""

_KEYWORD = re.compile(r"\s*(BO_|SG_|[A-Z][A-Z_]*_)\b")
_MESSAGE = re.compile(r"\s*BO_\s+(\d+)\s+(\w+)\s*:")
_OF_MESSAGE = re.compile(r"\s*(VAL_|SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)\b|\s*BA_\s+\"VFrameFormat\"\s+BO_\s+(\d+)\b")
_FRAME_FORMAT = re.compile(r"\s*BA_DEF_(DEF_)?\s+(BO_\s+)?\"VFrameFormat\"")
_J1939_FILE = re.compile(r"^\s*BA_\s+\"ProtocolType\"\s+\"J1939\"", re.MULTILINE)
_PLACE = re.compile(r"at line (\d+)")
_HEAD: Final = 'VERSION ""\nNS_ :\nBS_:\nBU_:\n'


class _Statement(NamedTuple):
    """A statement of the file and the number of its first line."""

    line: int
    text: str


def parse_dbc(text: str, name: str) -> CanDatabase:
    """Parse the text of a DBC file called `name`. Raises ConfigError with the line for a file that has no message."""
    if len(text) > MAX_DBC_CHARS:
        raise ConfigError([Problem(Severity.ERROR, "larger than 8 MiB", Location(name), _WRONG_FILE_FIX)])
    for mark in _BYTE_ORDER_MARKS:
        text = text.removeprefix(mark)
    flaws: dict[str, tuple[Problem, ...]] = {}
    try:
        messages = _load(text)
    except _RejectedError as error:
        messages, flaws = _load_each(text, name, str(error), error.line)
        if not messages and not any(flaws):
            message = f"not a DBC file that can be read: {quote(str(error), 100)}"
            raise ConfigError([Problem(Severity.ERROR, message, Location(name, error.line), _WRONG_FILE_FIX)]) from None
    by_key: dict[FrameKey, Message] = {}
    for found in messages:
        key = FrameKey(found.frame_id, found.is_extended_frame)
        other = by_key.setdefault(key, found)
        if other is not found:
            what = f"messages {other.name} and {found.name} have one identifier, {key}"
            problem = Problem(Severity.ERROR, what, Location(name), "keep the one that the controller uses")
            flaws |= {other.name: (problem,), found.name: (problem,)}
    return CanDatabase(
        name,
        {each.name: each for each in messages if each.name not in flaws},
        {key: each for key, each in by_key.items() if each.name not in flaws},
        flaws,
        _J1939_FILE.search(text) is not None,
    )


class _RejectedError(Exception):
    """What cantools rejects a text with; `line` is 0 where it has none."""

    def __init__(self, message: str):
        place = _PLACE.search(message)
        self.line = int(place[1]) if place else 0
        super().__init__(" ".join(message.split()))


def _load(text: str) -> Sequence[Message]:
    from cantools.database import load_string
    from cantools.database.can import Database
    from cantools.database.errors import Error, UnsupportedDatabaseFormatError

    try:
        database = load_string(text, "dbc")
    except UnsupportedDatabaseFormatError as error:
        raise _RejectedError(str(error.e_dbc or error)) from None
    except (Error, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        # what its reader does not expect
        raise _RejectedError(f"{type(error).__name__}: {error}") from None
    assert isinstance(database, Database)
    return database.messages


def _split(text: str) -> Iterator[_Statement]:
    """Yield the statements: each begins with its keyword on a line of its own, a message has its signals."""
    lines: list[str] = []
    begin, is_quoted = 1, False
    for number, line in enumerate(text.splitlines(), 1):
        keyword = None if is_quoted else _KEYWORD.match(line)
        if keyword and keyword[1] != "SG_" and lines:
            yield _Statement(begin, "\n".join(lines))
            lines = []
        if not lines:
            begin = number
        lines.append(line)
        is_quoted ^= line.replace('\\"', "").count('"') % 2 == 1
    if lines:
        yield _Statement(begin, "\n".join(lines))


def _load_each(text: str, name: str, why: str, line: int) -> tuple[list[Message], dict[str, tuple[Problem, ...]]]:
    """Return the messages that can be read by themselves, and what is wrong with the others and the rest."""
    statements = list(_split(text))
    formats = "\n".join(each.text for each in statements if _FRAME_FORMAT.match(each.text))
    parts: dict[str, list[_Statement]] = {}
    for each in statements:
        if found := _OF_MESSAGE.match(each.text):
            parts.setdefault(found[2] or found[3], []).append(each)
    messages: list[Message] = []
    flaws: dict[str, tuple[Problem, ...]] = {}
    rest: list[Problem] = []
    known = set()
    for each in statements:
        if (named := _MESSAGE.match(each.text)) is None:
            continue
        known.add(named[1])
        own = parts.get(named[1], [])
        # a table of names is not needed
        needed = [part for part in own if not part.text.lstrip().startswith("VAL_")]
        try:
            messages += _load_message(each, own, formats)
        except _RejectedError as error:
            try:
                messages += _load_message(each, needed, formats)
                rest += [_describe(error, part, name) for part in own if part not in needed]
            except _RejectedError as inner:
                flaws[named[2]] = (_describe(inner, each, name),)
    for number in parts.keys() - known:
        first = parts[number][0]
        what = f"{quote(first.text.strip(), 60)} is of message {number}, which is not there"
        rest.append(Problem(Severity.ERROR, what, Location(name, first.line), _FIX))
    if not (rest or flaws):
        rest = [Problem(Severity.ERROR, f"a part of it cannot be read: {quote(why, 100)}", Location(name, line), _FIX)]
    if rest:
        flaws[""] = tuple(rest)
    return messages, flaws


def _load_message(message: _Statement, own: Sequence[_Statement], formats: str) -> Sequence[Message]:
    return _load(_HEAD + "\n".join((message.text, formats, *(each.text for each in own), "")))


def _describe(error: _RejectedError, statement: _Statement, name: str) -> Problem:
    """Return the problem of a statement, at the signal that it names, else at its own place."""
    words = re.findall(r"\w+", str(error))
    lines = statement.text.splitlines()
    signals = [(n, found[1]) for n, line in enumerate(lines) if (found := re.match(r"\s*SG_\s+(\w+)", line))]
    at = min(max(error.line - 1 - _HEAD.count("\n"), 0), len(lines) - 1)
    offset = next((n for n, signal in signals if signal in words), at)
    return Problem(Severity.ERROR, quote(str(error), 160), Location(name, statement.line + offset), _FIX)


MAX_SEEN = 8
"""Identifiers, and kinds of what is wrong with frames, that are remembered for the status text."""


class CanDriver(ABC):
    """Base of an `Endpoint` of CAN frames: decodes the needed frames and assembles those of one instant.

    Silence, errors and recovery are reported once per change. Without needed frames there is no silence.
    """

    def __init__(self, database: CanDatabase, signals: Iterable[BoundSignal], settings: BusSettings):
        """The frames of `signals` are needed; the others see `WheelsSettings`. Raises ConfigError."""
        signals = list(signals)
        self.settings = settings
        self.max_silence = settings.silence if signals else inf
        self.phase = EndpointPhase.WAITING
        self.is_bus_off = False
        """The interface is bus-off; nothing can be sent."""
        self.counts: Counter[str] = Counter()
        """Frames, samples, incomplete instants, silences, commands, and rejections by reason. `outside_range`: values
        outside the range of the DBC, which are used; `rejected.reserved`: those that stand for no measurement."""
        self.problems = database.warnings
        """What is wrong with parts of the DBC file that are not used, which `modelserver check` reports."""
        self._needed: Mapping[FrameKey, str] = {signal.key: signal.message for signal in signals}
        self._database, self._silence_s = database, settings.silence
        self._assembler = CanFrameAssembler(frozenset(self._needed), round(settings.window * 1e9))
        self._stated = _bind_source_addresses(settings, database, self._needed)
        self._by_pgn: dict[int, list[FrameKey]] = {}
        """Messages that are matched by PGN; not where the file has several of one PGN, and so means its identifiers."""
        is_j1939 = {signal.key for signal in signals if signal.is_j1939}
        for key in self._needed:
            pgn = find_pgn(key.arbitration_id)
            if key in self._stated or (key in is_j1939 and len(database.find_by_pgn(pgn)) == 1):
                self._by_pgn.setdefault(pgn, []).append(key)
        self._sources: dict[FrameKey, tuple[int, int]] = {}
        """Source address that is used, and when its last frame arrived, monotonic nanoseconds."""
        self._seq = 0
        self._silence_deadline_ns: int | None = None
        self._received = 0
        self._others: dict[FrameKey, None] = {}
        self._useless: Counter[str] = Counter()
        """Since the last usable data: frames, those that are not needed, and what is wrong with the others."""
        self._reasons: dict[str, None] = {}
        """Why values of the last instant cannot be used."""
        self._reported: set[object] = set()

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Discard incomplete instants and start the silence timer."""
        self._assembler.clear()
        self._sources.clear()
        self.phase, self.is_bus_off = EndpointPhase.WAITING, False
        self._reported.clear()
        self._restart_silence_timer(now)
        text = f"waiting for {self._format_needed()}"
        return [EndpointStatus(EndpointPhase.WAITING, text)] if self._needed else []

    def on_receive(self, unit: CanFrame, now: HostTime) -> list[Output[CanFrame]]:
        if unit.is_error:
            return self._on_error_frame(unit)
        self._received += 1
        key, outputs = self._match(unit, now)
        if key is None:
            self.counts["other_frames"] += 1
            if len(self._others) < MAX_SEEN:
                self._others.setdefault(unit.key)
            return outputs
        if key in self._by_pgn.get(find_pgn(key.arbitration_id), ()):
            # J1939 pads frames to 8 bytes
            length = self._database.by_key[key].length
            unit = replace(unit, arbitration_id=key.arbitration_id, data=unit.data[:length])
        try:
            values = self._database.decode(unit)
        except FrameError as error:
            self.counts[f"rejected.{error.reason}"] += 1
            self._note_useless(f"{self._needed[unit.key]} ({unit.key}) {error.summary}")
            return self._report_once(unit.key, f"{error}; such frames are counted and not used")
        self.counts["frames"] += 1
        # its own receive time, if the interface stamped it
        utime = unit.utime if 0 < unit.utime <= now.utime else now.utime
        arrival_ns = now.monotonic_ns - (now.utime - utime) * 1000
        return outputs + self._publish(self._assembler.add(key, values, arrival_ns, utime), now)

    def _match(self, frame: CanFrame, now: HostTime) -> tuple[FrameKey | None, list[Output[CanFrame]]]:
        """Return the kind of a frame, None if it is not needed; and a warning about a second source of a PGN."""
        pgn = find_pgn(frame.arbitration_id)
        keys = self._by_pgn.get(pgn, ()) if frame.is_extended else ()
        if not keys:
            return (frame.key if frame.key in self._needed else None), []
        source = frame.arbitration_id & 0xFF
        stated = [key for key in keys if key in self._stated]
        if stated:
            return next((key for key in stated if self._stated[key] == source), None), []
        (key,) = keys
        used, last_ns = self._sources.get(key, (source, now.monotonic_ns))
        is_own = source == key.arbitration_id & 0xFF
        outputs: list[Output[CanFrame]] = []
        if source != used and now.monotonic_ns - last_ns < self._silence_s * 1e9:
            name, chosen = self._needed[key], source if is_own else used
            first, second = sorted((source, used))
            what = f"source addresses 0x{first:02X} and 0x{second:02X} send PGN {pgn} ({name})"
            fix = f"that of 0x{chosen:02X} is used; state it: source_address: {{{name}: 0x{chosen:02X}}}"
            outputs = self._report_once(("sources", key), f"{what}; {fix}")
            if not is_own:
                return None, outputs
        self._sources[key] = (source, now.monotonic_ns)
        return key, outputs

    def on_timer(self, now: HostTime) -> list[Output[CanFrame]]:
        """Publish instants whose window has passed; report silence after its timeout."""
        outputs = self._publish(self._assembler.pop_expired(now.monotonic_ns), now)
        if self._silence_deadline_ns is not None and now.monotonic_ns >= self._silence_deadline_ns:
            self._silence_deadline_ns = None
            self.phase = EndpointPhase.SILENT
            self.counts["silences"] += 1
            outputs.append(EndpointStatus(EndpointPhase.SILENT, self._explain_silence()))
        return outputs

    def get_deadline(self) -> int | None:
        deadlines = (self._assembler.get_deadline(), self._silence_deadline_ns)
        return min((each for each in deadlines if each is not None), default=None)

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        return []

    def _publish(self, instants: list[CanFrameSet], now: HostTime) -> list[Output[CanFrame]]:
        self.counts["incomplete"] += sum(not each.is_complete for each in instants)
        return [output for each in instants for output in self._publish_instant(each, now)]

    @abstractmethod
    def _publish_instant(self, instant: CanFrameSet, now: HostTime) -> list[Output[CanFrame]]:
        """Make the sample of a complete or expired instant."""

    def _make_header(self, instant: CanFrameSet) -> SensorHeader:
        self._seq += 1
        return SensorHeader(instant.utime, self.settings.source, self._seq - 1, instant.utime)

    def _publish_sample(self, sample: Sample, text: str, now: HostTime) -> list[Output[CanFrame]]:
        """Publish a sample; `text`: the status of a driver that was not streaming."""
        self.counts["samples"] += 1
        self._restart_silence_timer(now)
        measured = MeasuredSample(sample, self.settings.delay, self.settings.delay_sigma)
        if self.phase is EndpointPhase.STREAMING:
            return [measured]
        self.phase = EndpointPhase.STREAMING
        return [EndpointStatus(EndpointPhase.STREAMING, text), measured]

    def _report_once(self, what: object, text: str, is_warning: bool = True) -> list[Output[CanFrame]]:
        """Return a status, once for what it is about since the line was opened."""
        if what in self._reported:
            return []
        self._reported.add(what)
        return [EndpointStatus(self.phase, text, is_warning)]

    def _note_useless(self, what: str) -> None:
        """Note what is wrong with a frame, or with the frames of an instant."""
        if what in self._useless or len(self._useless) < MAX_SEEN:
            self._useless[what] += 1

    def _note_empty(self) -> None:
        self.counts["rejected.empty"] += 1
        self._note_useless(f"no value that can be used ({', '.join(self._reasons) or 'no number'})")

    def _check_values(self, signals: Iterable[BoundSignal | None], instant: CanFrameSet) -> list[Output[CanFrame]]:
        """Count values outside the DBC's range, and those that stand for no measurement; each is reported once."""
        outputs: list[Output[CanFrame]] = []
        self._reasons.clear()
        for signal in signals:
            raw = instant.raw(signal)
            if signal is None or raw is None or raw != raw:
                continue
            if name := signal.find_reserved(raw):
                self.counts["rejected.reserved"] += 1
                self._reasons[name] = None
                text = f"{signal.path} is {raw:.0f}, {quote(name, 60)}: that is no measurement, and it is not used"
            elif signal.is_outside(raw):
                self.counts["outside_range"] += 1
                name = "range"
                value, limits = raw * signal.scale + signal.offset, f"[{signal.minimum:g}|{signal.maximum:g}]"
                text = (
                    f"{signal.path} is {value:g} {signal.unit}".rstrip() + f", outside its range {limits} in "
                    f"{self._database.name}: it is used, for such ranges are often wrong"
                )
            else:
                continue
            outputs += self._report_once((signal.path, name), text)
        return outputs

    def _on_error_frame(self, frame: CanFrame) -> list[Output[CanFrame]]:
        """Request the reopening of a bus that is off, once."""
        self.counts["error_frames"] += 1
        if not frame.is_bus_off or self.is_bus_off:
            return []
        self.counts["bus_off"] += 1
        self.is_bus_off, self.phase, self._silence_deadline_ns = True, EndpointPhase.SILENT, None
        why = "the CAN interface went bus-off: too many frames failed"
        fix = "check wiring, the terminators at both ends (60 ohm between the lines) and the bit rate"
        return [
            EndpointStatus(EndpointPhase.SILENT, f"{why}; {fix}; nothing is published or sent until it is back"),
            Reopen(why),
        ]

    def _restart_silence_timer(self, now: HostTime) -> None:
        self._silence_deadline_ns = now.monotonic_ns + round(self._silence_s * 1e9) if self._needed else None
        self._received = 0
        self._others.clear()
        self._useless.clear()

    def _explain_silence(self) -> str:
        head = f"no usable {self._format_needed()} for {self._silence_s:g} s"
        if not self._received:
            return f"{head}, and nothing on the bus: check power, wiring, the interface's name and the bit rate"
        wrong = [f"{number} x {what}" for what, number in self._useless.most_common()]
        if self._others:
            keys = ", ".join(map(str, self._others)) + (", ..." if len(self._others) == MAX_SEEN else "")
            wrong.append(f"others: {keys}")
        fix = "" if self._useless else "; is the controller on, and is this its DBC and its bus?"
        return f"{head}; received {self._received} frames: {'; '.join(wrong) or 'not all of an instant'}{fix}"

    def _format_needed(self) -> str:
        def describe(key: FrameKey) -> str:
            pgn = find_pgn(key.arbitration_id)
            source = f" from 0x{self._stated[key]:02X}" if key in self._stated else ""
            return f"PGN {pgn}{source}" if key in self._by_pgn.get(pgn, ()) else str(key)

        return ", ".join(f"{name} ({describe(key)})" for key, name in sorted(self._needed.items()))


def _bind_source_addresses(
    settings: BusSettings, database: CanDatabase, needed: Mapping[FrameKey, str]
) -> dict[FrameKey, int]:
    """Return the stated source addresses. Raises ConfigError for a message without a mapped signal, or a PGN."""
    binder = SignalBinder(database, f"drivers.{settings.source}")
    keys = {name: key for key, name in needed.items()}
    bound = {}
    for name, address in settings.source_address.items():
        key = keys.get(name)
        if key is None:
            near = suggest_name(name, keys)
            listed = ", ".join(keys)
            fix = f"write {near[0]}" if near else f"messages with mapped signals: {listed or 'none'}"
            binder.add_problem("source_address", f"no signal of message {quote(name)} is mapped", fix, near)
        elif not key.is_extended:
            fix = "leave it out: frames with an 11-bit identifier have no source address"
            binder.add_problem("source_address", f"message {name} has the identifier {key}", fix)
        else:
            bound[key] = address
    binder.finish()
    return bound
