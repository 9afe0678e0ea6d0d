"""What a DBC file says: signals found by name, frames to numbers, numbers to frames. cantools does the bits."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from modelserver.errors import ConfigError, Location, ModelServerError, Problem, Severity, Suggested, shown, suggestions
from msdrivers.protocol.can.frame import CanFrame, FrameKey

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

MAX_TEXT = 8 << 20
"""Characters of a DBC file; more is taken for another file."""

_UNFIT = "is this the DBC file of the vehicle, saved as plain text?"
_LINE = re.compile(r"at line (\d+)")


class FrameError(ModelServerError, ValueError):
    """A frame does not hold what the DBC says of its identifier. `reason` is one word."""

    def __init__(self, reason: str, message: str):
        self.reason = reason
        super().__init__(message)


@dataclass(frozen=True, slots=True)
class BoundSignal:
    """A signal that is there: of which frame, which bits, which range.

    `minimum` and `maximum` are physical values, None without.
    """

    key: FrameKey
    message: str
    name: str
    length: int
    is_signed: bool
    is_float: bool
    scale: float
    offset: float
    minimum: float | None
    maximum: float | None

    def physical(self, raw: float) -> float | None:
        """Return the physical value of the bits; None where it is no number or out of the DBC's range: not said."""
        value = raw * self.scale + self.offset
        slack = 1e-6 * abs(self.scale)
        if value != value or value in (float("inf"), float("-inf")):
            return None
        if self.minimum is not None and value < self.minimum - slack:
            return None
        if self.maximum is not None and value > self.maximum + slack:
            return None
        return value

    def raw(self, physical: float) -> int:
        """Return the bits nearest to a physical value, within the signal's length and the DBC's range."""
        if self.minimum is not None:
            physical = max(physical, self.minimum)
        if self.maximum is not None:
            physical = min(physical, self.maximum)
        low = -(1 << (self.length - 1)) if self.is_signed else 0
        return min(max(round((physical - self.offset) / self.scale), low), low + (1 << self.length) - 1)

    def bits(self, physical: float) -> float:
        """Return what `CanDatabase.encode` takes for a physical value: for a floating-point signal a number."""
        return (physical - self.offset) / self.scale if self.is_float else self.raw(physical)


@dataclass(frozen=True, slots=True)
class CanDatabase:
    """The messages of a DBC file called `name`."""

    name: str
    messages: Mapping[str, Message] = field(repr=False)
    by_key: Mapping[FrameKey, Message] = field(repr=False)

    def decode(self, frame: CanFrame) -> dict[str, float]:
        """Return the bits of each signal of a frame, by name, without scale.

        Raises FrameError: `unknown` identifier, `length` that the DBC does not give it, `multiplexer` that it does
        not know, `bits` that make no value.
        """
        message = self.by_key.get(frame.key)
        if message is None:
            raise FrameError("unknown", f"{self.name} has no message {frame.key}")
        if len(frame.data) != message.length:
            raise FrameError(
                "length",
                f"frame {frame.key} ({message.name}) has {len(frame.data)} bytes where {self.name} says "
                f"{message.length}: the DBC is of another version of the controller, or another device uses the same "
                f"identifier",
            )
        from cantools.database.errors import Error

        try:
            values = message.decode_simple(
                frame.data, decode_choices=False, scaling=False, allow_truncated=False, allow_excess=False
            )
        except Error as error:
            raise FrameError("multiplexer", f"frame {frame.key} ({message.name}): {error}") from None
        except (ValueError, KeyError, OverflowError) as error:
            raise FrameError("bits", f"frame {frame.key} ({message.name}): {error}") from None
        return {name: value for name, value in values.items() if isinstance(value, int | float)}

    def encode(self, message: str, raw: Mapping[str, float]) -> CanFrame:
        """Return the frame of a message; `raw` holds the bits of each of its signals, as `BoundSignal.raw` gives."""
        found = self.messages[message]
        data = found.encode(dict(raw), scaling=False, strict=False)
        return CanFrame(found.frame_id, bytes(data), found.is_extended_frame)

    def signals(self, message: str) -> dict[str, BoundSignal]:
        """Return the signals of a message by name; KeyError for a message that it does not have."""
        found = self.messages[message]
        return {signal.name: _bound(found, signal) for signal in found.signals}


def parse_dbc(text: str, name: str) -> CanDatabase:
    """Return what the text of a DBC file called `name` says. Raises ConfigError with the line."""
    from cantools.database import load_string
    from cantools.database.can import Database
    from cantools.database.errors import UnsupportedDatabaseFormatError

    if len(text) > MAX_TEXT:
        raise ConfigError([Problem(Severity.ERROR, "larger than 8 MiB", Location(name), _UNFIT)])
    try:
        database = load_string(text, "dbc")
    except UnsupportedDatabaseFormatError as error:
        line = _LINE.search(str(error))
        said = f"not a DBC file that can be read: {shown(str(error.e_dbc or error), 100)}"
        problem = Problem(Severity.ERROR, said, Location(name, int(line[1]) if line else 0), _UNFIT)
        raise ConfigError([problem]) from None
    assert isinstance(database, Database)
    messages = {message.name: message for message in database.messages}
    by_key: dict[FrameKey, Message] = {}
    problems = []
    for found in database.messages:
        key = FrameKey(found.frame_id, found.is_extended_frame)
        other = by_key.setdefault(key, found)
        if other is not found:
            fix = "keep the one that the controller speaks"
            said = f"messages {other.name} and {found.name} have one identifier, {key}"
            problems.append(Problem(Severity.ERROR, said, Location(name), fix))
    if problems:
        raise ConfigError(problems)
    return CanDatabase(name, messages, by_key)


class Binder:
    """Looks mapped signals up and gathers every problem, so that a person sees all of them at once."""

    def __init__(self, database: CanDatabase, place: str):
        """Take the database, and where in the settings the mapping stands, e.g. `drivers.wheels`."""
        self._database = database
        self._place = place
        self.problems: list[Problem] = []

    def signal(self, path: str, key: str, *, whole: bool = False, bits: int = 64) -> BoundSignal | None:
        """Return the signal `Message.Signal` that stands at `key` in the settings; None and a problem without.

        `whole`: its bits are needed as a whole number of at most `bits` bits.
        """
        message_name, _, name = path.partition(".")
        message = self.message(message_name, key, f"{{}}.{name}" if name else "{}")
        if message is None:
            return None
        signal = next((each for each in message.signals if each.name == name), None)
        if signal is None:
            known = [each.name for each in message.signals]
            # at a key of its own name the signal stands without its message
            form = "{}" if key.endswith(f".{name}") else f"{message_name}.{{}}"
            self._missing(key, f"message {message_name} has no signal", name, known, form)
            return None
        if whole and (signal.is_float or signal.length > bits):
            kind = "a floating-point number" if signal.is_float else f"{signal.length} bits long"
            self.problem(
                key, f"{path} is {kind}; a whole number of at most {bits} bits is needed", "map another signal"
            )
            return None
        return _bound(message, signal)

    def message(self, name: str, key: str, form: str = "{}") -> Message | None:
        """Return the message of that name; None and a problem without. `form` is how the settings write it."""
        message = self._database.messages.get(name)
        if message is None:
            self._missing(key, "there is no message", name, list(self._database.messages), form)
        return message

    def problem(self, key: str, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Note something wrong with the setting at `key`: there it is mended, not in the DBC file."""
        source = Location(element=f"{self._place}.{key}")
        said = f"{self._database.name}: {message}"
        self.problems.append(Problem(Severity.ERROR, said, source, fix, nearest))

    def finish(self) -> None:
        """Raise ConfigError where there were problems."""
        if self.problems:
            raise ConfigError(self.problems)

    def _missing(self, key: str, what: str, name: str, known: list[str], form: str) -> None:
        near = Suggested.of(form.replace("{}", name), *(form.replace("{}", each) for each in suggestions(name, known)))
        listed = ", ".join(known[:10]) + (", ..." if len(known) > 10 else "")
        fix = f"write {near[0]}" if near else f"known there: {listed or 'nothing'}"
        self.problem(key, f"{what} {shown(name)}", fix, near)


def _bound(message: Message, signal: Signal) -> BoundSignal:
    return BoundSignal(
        FrameKey(message.frame_id, message.is_extended_frame),
        message.name,
        signal.name,
        signal.length,
        signal.is_signed,
        signal.is_float,
        float(signal.scale),
        float(signal.offset),
        None if signal.minimum is None else float(signal.minimum),
        None if signal.maximum is None else float(signal.maximum),
    )
