"""DBC databases (by cantools): bind signals by name, decode and encode frames, assemble the frames of one instant.

The range that a DBC gives a signal is no authority: in public files every ninth is of raw values, of the other sign or
made up. It bounds what is sent, and a received value outside it is used. Only what the file or J1939 reserves for
"not available" or "error" is no value.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import TYPE_CHECKING, NamedTuple

from modelserver.errors import (
    ConfigError,
    Location,
    ModelServerError,
    Problem,
    Severity,
    Suggestion,
    quote,
    suggest_name,
)
from msdrivers.protocol.can.frame import CanFrame, FrameKey

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_UNUSED_FIX = "correct it, or leave it: the other messages can be used"

_NO_VALUE = re.compile(
    r"not? ?(?:available|avail|valid|defined|data|signal)|invalid|\b(?:sna|na|n/a|error|fault|failure|undefined)\b",
    re.IGNORECASE,
)
"""Names in a value table that stand for no measurement."""

_J1939_NAMES = {0xFF: "not available", 0xFE: "error"}
"""By the highest byte of a number of a byte and more: SAE J1939-71, 5.1.4."""


class FrameError(ModelServerError, ValueError):
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
    unit: str = ""
    names: Mapping[int, str] = field(default_factory=dict)
    is_j1939: bool = False

    @property
    def path(self) -> str:
        return f"{self.message}.{self.name}"

    def to_physical(self, raw: float) -> float | None:
        """Return the physical value of raw bits; None (missing) if it is not finite, or reserved."""
        value = raw * self.scale + self.offset
        return value if isfinite(value) and not self.find_reserved(raw) else None

    def is_outside(self, raw: float) -> bool:
        """Return whether the physical value of raw bits is outside the file's range."""
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
    under "".
    """

    name: str
    messages: Mapping[str, Message] = field(repr=False)
    by_key: Mapping[FrameKey, Message] = field(repr=False)
    flaws: Mapping[str, tuple[Problem, ...]] = field(default_factory=dict)

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
        if len(frame.data) != message.length:
            raise FrameError(
                "length",
                f"frame {frame.key} ({message.name}) has {len(frame.data)} bytes, {self.name} expects "
                f"{message.length}: the DBC is of another version of the controller, or another device uses the same "
                f"identifier",
                f"with {len(frame.data)} bytes instead of {message.length}",
            )
        from cantools.database.errors import Error

        try:
            values = message.decode_simple(
                frame.data, decode_choices=False, scaling=False, allow_truncated=False, allow_excess=False
            )
        except Error as error:
            raise FrameError(
                "multiplexer", f"frame {frame.key} ({message.name}): {error}", "with an unknown multiplexer"
            ) from None
        except (ValueError, KeyError, OverflowError) as error:
            raise FrameError(
                "bits", f"frame {frame.key} ({message.name}): {error}", "with bits that are no number"
            ) from None
        return {name: value for name, value in values.items() if isinstance(value, int | float)}

    def encode(self, message: str, raw: Mapping[str, float]) -> CanFrame:
        """Encode a message; `raw` has the raw value of each of its signals."""
        found = self.messages[message]
        data = found.encode(dict(raw), scaling=False, strict=False)
        return CanFrame(found.frame_id, bytes(data), found.is_extended_frame)

    def bind_signals(self, message: str) -> dict[str, BoundSignal]:
        """Return the signals of a message by name. Raises KeyError for an unknown message."""
        found = self.messages[message]
        return {signal.name: _bind_signal(found, signal) for signal in found.signals}


class SignalBinder:
    """Looks up mapped signals and collects every problem, so that all are reported at once."""

    def __init__(self, database: CanDatabase, place: str):
        """`place` is the mapping's key path in the settings, e.g. `drivers.wheels`."""
        self._database = database
        self._place = place
        self.problems: list[Problem] = []

    def bind_signal(self, path: str, key: str, *, whole: bool = False, bits: int = 64) -> BoundSignal | None:
        """Return the signal `Message.Signal` of the setting `key`; add a problem and return None if it is unknown.

        `whole`: it must be an integer of at most `bits` bits.
        """
        message_name, _, name = path.partition(".")
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
        if whole and (signal.is_float or signal.length > bits):
            kind = "a floating-point number" if signal.is_float else f"{signal.length} bits long"
            self.add_problem(
                key, f"{path} is {kind}; a whole number of at most {bits} bits is needed", "map another signal"
            )
            return None
        return _bind_signal(message, signal)

    def add_problem(self, key: str, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Add a problem of the setting `key`: it is fixed there, not in the DBC file."""
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


def _bind_signal(message: Message, signal: Signal) -> BoundSignal:
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
        signal.unit or "",
        {int(number): str(name) for number, name in (signal.choices or {}).items()},
        message.protocol == "j1939",
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
        """Discard the incomplete instant."""
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
