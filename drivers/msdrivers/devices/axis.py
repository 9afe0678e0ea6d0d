"""Driver of a nodding axis on Modbus/TCP: its register map, polling of angle and rate, setup of the nodding motion.

Polling: one request at a time, at `poll_hz`. The angle is stamped in the middle between request and reply; delay and
delay_sigma are half the round trip and the deviation of a uniform distribution over it.

Validation (`_validate`): an angle is plausible if an axis of at most `fastest_deg` could have reached it from
the last plausible one. An implausible one becomes the suspect; if the next is plausible from it, it was the earlier
one that was wrong.

Setup (`AxisDriver._run_setup`): read the commanded registers, write the settings, read them back; between two polls.
The values found first are restored on close.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple, TypeAlias

from modelserver.messages import NAN, JointSample, JointsSample, SensorHeader
from msdrivers.devices import Strict, check_choice, check_factor, check_ranges
from msdrivers.devices.stream import BoundedCounter
from msdrivers.endpoint import (
    LAST_ADDRESS,
    MAX_READ,
    EndpointPhase,
    EndpointStatus,
    HostTime,
    MeasuredSample,
    ModbusFailure,
    ModbusRequest,
    ModbusUnit,
    Output,
    ReadRegisters,
    Registers,
    RegistersWritten,
    Reopen,
    Send,
    WriteRegisters,
    describe_request,
    explain_exception,
    is_reply_to,
)

_MAX_FLOAT32: Final = (2**24 - 1) << 104
"""IEEE 754, binary32: 24 bits of 1 at the highest exponent, which is a whole number."""

_TYPES: Final = {
    "int16": ("h", -0x8000, 0x7FFF),
    "uint16": ("H", 0, 0xFFFF),
    "int32": ("i", -0x8000_0000, 0x7FFF_FFFF),
    "uint32": ("I", 0, 0xFFFF_FFFF),
    "float32": ("f", -_MAX_FLOAT32, _MAX_FLOAT32),
}
"""Each type's code of `struct`, its lowest and its highest number."""

_ORDERS: Final = ("ABCD", "CDAB", "BADC", "DCBA")

_FLOAT32_TOLERANCE: Final = 4 * 2.0**-23
"""Relative: a device that stores another unit rounds twice on writing and twice on reading."""


@dataclass(frozen=True, slots=True)
class RegisterMap(Strict):
    """A number in degrees or degrees a second: that of the registers times `scale_deg` plus `offset_deg`."""

    address: int
    """Address of the protocol, from 0: what manuals call 40001 is 0."""
    registers: int = 1
    """1 for a number of 16 bits, 2 for 32."""
    is_signed: bool = True
    """Two's complement; False: from 0 up."""
    high_word_first: bool = True
    """Of two registers the first holds the higher 16 bits, as the standard has bytes; False: the lower."""
    scale_deg: float = 1.0
    """Degrees (a second) for each unit; negative turns the sense."""
    offset_deg: float = 0.0
    """Degrees (a second) at 0."""
    type: Literal["int16", "uint16", "int32", "uint32", "float32"] | None = None
    """Instead of `registers` and `is_signed`; None: a whole number as they describe it."""
    order: Literal["ABCD", "CDAB", "BADC", "DCBA"] | None = None
    """Instead of `high_word_first`: the order in which the bytes are sent, A the highest. None: ABCD, or CDAB with
    `high_word_first: false`. Of 16 bits, BADC and DCBA swap the bytes."""

    def __post_init__(self) -> None:
        check_choice(self, registers=(1, 2), type=(None, *_TYPES), order=(None, *_ORDERS))
        if self.type is not None:
            # a default that is written cannot be distinguished from nothing written, and contradicts nothing
            if self.registers not in (1, self.word_count):
                count = self.word_count
                raise ValueError(f"registers is left out with type: {self.type} has {count}, got {self.registers}")
            if not self.is_signed and self.lowest < 0:
                raise ValueError(f"is_signed is left out with type: {self.type} is signed, got false")
        if self.order in ("ABCD", "BADC") and not self.high_word_first:
            raise ValueError(f"high_word_first is left out with order: {self.order} has the high word first")
        if not 0 <= self.address <= LAST_ADDRESS + 1 - self.word_count:
            last = LAST_ADDRESS + 1 - self.word_count
            raise ValueError(f"address is 0 to {last}, got {self.address}; a manual's 40001 is 0")
        check_factor(self.scale_deg, "scale_deg")
        if not math.isfinite(self.offset_deg):
            raise ValueError(f"offset_deg is a number, got {self.offset_deg:g}")

    @property
    def _type(self) -> tuple[str, int, int]:
        return _TYPES[self.type or f"{'' if self.is_signed else 'u'}int{16 * self.registers}"]

    @property
    def word_count(self) -> int:
        return struct.calcsize(f">{self._type[0]}") // 2

    @property
    def is_float(self) -> bool:
        return self.type == "float32"

    @property
    def lowest(self) -> int:
        return self._type[1]

    @property
    def highest(self) -> int:
        return self._type[2]

    def to_number(self, values: Sequence[int]) -> float:
        """Return the number of the registers: a whole one except of float32, which may be non-finite."""
        data = struct.pack(f">{len(values)}H", *self._reorder(values))
        number: float = struct.unpack(f">{self._type[0]}", data)[0]
        return number

    def to_words(self, number: float) -> tuple[int, ...]:
        """Return the registers of a number. Raises ValueError for one that they do not hold."""
        if not self.lowest <= number <= self.highest:
            raise ValueError(f"{number} is not within {self.lowest} to {self.highest}")
        data = struct.pack(f">{self._type[0]}", number if self.is_float else int(number))
        return self._reorder(struct.unpack(f">{self.word_count}H", data))

    def to_degrees(self, values: Sequence[int]) -> float:
        """Return the value of registers in degrees (a second)."""
        return self.to_number(values) * self.scale_deg + self.offset_deg

    def from_degrees(self, degrees: float) -> tuple[int, ...]:
        """Return the registers nearest to a value. Raises ValueError for one that they do not hold."""
        return self.to_words(self._find_nearest(degrees))

    def can_hold(self, degrees: float) -> bool:
        return self.lowest <= self._find_nearest(degrees) <= self.highest

    def is_same(self, values: Sequence[int], degrees: float) -> bool:
        """Return whether registers that are read have the value that was written, but for rounding of float32."""
        if self.is_float:
            return math.isclose(self.to_number(values), self._find_nearest(degrees), rel_tol=_FLOAT32_TOLERANCE)
        return tuple(values) == self.from_degrees(degrees)

    def _find_nearest(self, degrees: float) -> float:
        number = (degrees - self.offset_deg) / self.scale_deg
        return number if self.is_float else round(number)

    def _reorder(self, values: Sequence[int]) -> tuple[int, ...]:
        """Return registers as sent in the order ABCD, or the reverse: both are the same swap."""
        order = self.order or ("ABCD" if self.high_word_first else "CDAB")
        words = values[::-1] if order in ("CDAB", "DCBA") else values
        return tuple((word & 0xFF) << 8 | word >> 8 for word in words) if order in ("BADC", "DCBA") else tuple(words)


@dataclass(frozen=True, slots=True)
class AxisRegisters(Strict):
    """Registers of the axis. Angles and rates are the joint's, in its positive direction."""

    angle: RegisterMap
    """Angle of the axis."""
    rate: RegisterMap | None = None
    """Rate of the axis; None: no rate is published."""
    sequence: RegisterMap | None = None
    """Sequence number of the measurement; an unchanged one means that nothing new was measured."""
    table: Literal["holding", "input"] = "holding"
    """Table of angle, rate and sequence; the others are holding registers."""
    lower_limit: RegisterMap | None = None
    """Lower limit of the nodding motion, written."""
    upper_limit: RegisterMap | None = None
    """Upper limit of the nodding motion, written."""
    nod_rate: RegisterMap | None = None
    """Rate of the nodding motion, written; 0: stationary."""

    def __post_init__(self) -> None:
        check_choice(self, table=("holding", "input"))
        if len(self.commanded) not in (0, 3):
            raise ValueError(
                "lower_limit, upper_limit and nod_rate are given together or not at all: nodding needs all"
            )
        spread = max(each.address + each.word_count for each in self.measured.values()) - self.begin
        if spread > MAX_READ:
            raise ValueError(
                f"angle, rate and sequence lie {spread} registers apart; at most {MAX_READ} are read at one instant"
            )

    @property
    def measured(self) -> Mapping[str, RegisterMap]:
        """Registers read at each poll, by name."""
        return self._get_given("angle", "rate", "sequence")

    @property
    def begin(self) -> int:
        """The first address that is read at each poll."""
        return min(each.address for each in self.measured.values())

    @property
    def commanded(self) -> Mapping[str, RegisterMap]:
        """Registers written to set the nodding motion, by name; empty for a read-only axis."""
        return self._get_given("lower_limit", "upper_limit", "nod_rate")

    def _get_given(self, *names: str) -> dict[str, RegisterMap]:
        return {name: each for name in names if (each := getattr(self, name)) is not None}


MIN_POLL_HZ = 50.0


@dataclass(frozen=True, slots=True)
class NodSettings(Strict):
    """Nodding motion. Degrees and degrees per second."""

    lower_deg: float
    """Lower limit."""
    upper_deg: float
    """Upper limit."""
    rate_deg: float = 30.0
    """Rate between the limits; 0: stationary."""

    def __post_init__(self) -> None:
        if not self.lower_deg < self.upper_deg:
            raise ValueError(f"lower_deg is below upper_deg, {self.upper_deg:g}, got {self.lower_deg:g}")


@dataclass(frozen=True, slots=True)
class AxisSettings(Strict):
    """Settings of an axis. Raises ValueError with the key for an invalid value."""

    source: str
    """Source of the samples."""
    joint: str
    """Name of the constraint in the geometry file that the axis moves."""
    registers: AxisRegisters
    """Its register map."""
    nod: NodSettings | None = None
    """Nodding motion to set; None: the axis is only read."""
    step_deg: float = 0.072
    """Resolution of the angle, degrees."""
    lowest_deg: float = -90.0
    """Lowest possible angle, degrees; lower readings are rejected."""
    highest_deg: float = 90.0
    """Highest possible angle, degrees."""
    slowest_deg: float = 2.0
    """Lowest nodding rate, degrees per second."""
    fastest_deg: float = 90.0
    """Highest nodding rate, degrees per second; faster readings are rejected."""
    poll_hz: float = 100.0
    """Poll rate."""
    silence: float = 1.0
    """Seconds without a usable reply after which the driver is SILENT and reopens the line."""

    def __post_init__(self) -> None:
        if not (0 < len(self.joint) <= 200):
            raise ValueError("joint is the name of a constraint in the geometry file, got nothing or too long a text")
        check_ranges(self, poll_hz=(MIN_POLL_HZ, 1000.0), step_deg=(0.0, 10.0))
        check_ranges(self, lowest_deg=(-3600.0, 3600.0), highest_deg=(-3600.0, 3600.0))
        check_ranges(self, slowest_deg=(0.0, 3600.0), fastest_deg=(0.01, 3600.0))
        check_ranges(self, silence=(0.05, 3600.0))
        if not self.lowest_deg < self.highest_deg:
            raise ValueError(f"lowest_deg is below highest_deg, {self.highest_deg:g}, got {self.lowest_deg:g}")
        if not self.slowest_deg <= self.fastest_deg:
            raise ValueError(f"slowest_deg is at most fastest_deg, {self.fastest_deg:g}, got {self.slowest_deg:g}")
        if self.nod is not None:
            why = self._find_nod_problem(self.nod)
            if why:
                raise ValueError(f"nod cannot be done: {why}")

    def _find_nod_problem(self, nod: NodSettings) -> str:
        if not self.registers.commanded:
            return "registers names no lower_limit, upper_limit and nod_rate"
        if nod.rate_deg != 0.0 and not self.slowest_deg <= nod.rate_deg <= self.fastest_deg:
            allowed = f"{self.slowest_deg:g} to {self.fastest_deg:g} deg/s, or 0 (stationary)"
            return f"rate_deg {nod.rate_deg:g} is not {allowed}"
        if not (self.lowest_deg <= nod.lower_deg and nod.upper_deg <= self.highest_deg):
            allowed = f"{self.lowest_deg:g} to {self.highest_deg:g} degrees"
            return f"{nod.lower_deg:g} to {nod.upper_deg:g} degrees is not within {allowed}"
        for name, value in (("lower_limit", nod.lower_deg), ("upper_limit", nod.upper_deg), ("nod_rate", nod.rate_deg)):
            if not self.registers.commanded[name].can_hold(value):
                return f"the registers of {name} cannot hold {value:g}"
        return ""


_Step: TypeAlias = tuple[str, ModbusRequest]
"""What is done, and its request."""
_Steps: TypeAlias = Generator[_Step, Registers | RegistersWritten, None]


def _order_writes(lower: float, present_upper: float) -> tuple[str, ...]:
    """Return the order of writes in which the lower limit is never above the upper one."""
    if lower >= present_upper:
        return ("upper_limit", "lower_limit", "nod_rate")
    return ("lower_limit", "upper_limit", "nod_rate")


RATE_MARGIN = 1.1
"""An axis at its highest rate overshoots a little where it reverses."""


class _TimedAngle(NamedTuple):
    degrees: float
    at_ns: int
    half_interval_ns: int


REPLY_TIMEOUT_NS = 100_000_000
"""A controller on the vehicle's network answers within milliseconds; a lost request must not cost many readings."""

RETRY_DELAY_NS = 500_000_000
"""Delay before a retry after an exception: a device that rejects is asked twice a second, and not at each poll."""

BUSY_EXCEPTIONS = (5, 6)
"""Exception codes after which a retry makes sense: acknowledge, busy."""


class _PendingRequest(NamedTuple):
    """The request that awaits its reply."""

    request: ModbusRequest
    sent_ns: int
    is_poll: bool


class AxisDriver:
    """An `Endpoint` of `ModbusUnit`; see `AxisSettings`.

    A reading is taken in the middle between request and reply: a sample's delay is half the time between, its sigma
    that of an instant anywhere between. On leaving, the registers that were written get back what was found in them.
    """

    def __init__(self, settings: AxisSettings):
        self.settings, registers = settings, settings.registers
        self.max_silence = settings.silence
        self.counts = BoundedCounter()
        """Polls, samples, unanswered requests, skipped polls, and what was rejected by reason."""
        self._length = max(each.address + each.word_count for each in registers.measured.values()) - registers.begin
        self._last: _TimedAngle | None = None
        self._suspect: _TimedAngle | None = None
        self._number: float | None = None
        self._commanded: Mapping[str, RegisterMap] = registers.commanded
        self._steps: _Steps | None = None
        self._step: _Step | None = None
        """The next step of the setup; None when done."""
        self._found: dict[str, tuple[int, ...]] = {}
        """Original contents of the commanded registers, by name."""
        self._current: dict[str, float] = {}
        self._warning = ""
        self._pending: _PendingRequest | None = None
        self._transaction = 0
        self._period_ns = round(1e9 / settings.poll_hz)
        self._silence_ns = round(settings.silence * 1e9)
        self._next_ns = self._step_ns = self._received_ns = self._usable_ns = 0
        self._silent_ns: int | None = None
        self._is_open = False
        self._reported: set[str] = set()
        self._phase = EndpointPhase.WAITING
        self._seq = 0

    def on_open(self, now: HostTime) -> list[Output[ModbusUnit]]:
        self._is_open, self._pending = True, None
        self._last = self._suspect = self._number = None
        self._reported.clear()
        self._phase = EndpointPhase.WAITING
        self._next_ns = self._step_ns = self._received_ns = self._usable_ns = now.monotonic_ns
        self._silent_ns = now.monotonic_ns + self._silence_ns
        if self.settings.nod is not None:
            self._steps = self._run_setup(self.settings.nod)
            self._step = next(self._steps)
        return [EndpointStatus(self._phase, f"asking the axis for joint {self.settings.joint}"), *self._send_next(now)]

    def on_receive(self, unit: ModbusUnit, now: HostTime) -> list[Output[ModbusUnit]]:
        if isinstance(unit, ModbusFailure) and not unit.code:
            return self._on_line_error(f"the line to the axis broke: {unit.text}")
        pending = self._pending
        if pending is None or unit.transaction != pending.request.transaction or not self._is_open:
            self.counts["rejected.stale"] += 1
            return []
        if isinstance(unit, ModbusFailure):
            return self._on_exception(pending, unit, now)
        self._pending = None
        self._received_ns = now.monotonic_ns
        if not is_reply_to(unit, pending.request):
            self.counts["rejected.length"] += 1
            text = f"the reply to {describe_request(pending.request)} has another address or length; it is not used"
            return self._warn_once("length", text) + self._send_next(now)
        if pending.is_poll and isinstance(unit, Registers):
            return self._publish_reading(unit, pending, now) + self._send_next(now)
        outputs: list[Output[ModbusUnit]] = []
        if isinstance(unit, Registers | RegistersWritten):
            assert self._steps is not None
            self._step, self._warning = None, ""
            with contextlib.suppress(StopIteration):
                self._step = self._steps.send(unit)
            if self._warning:
                self.counts["readback"] += 1
                outputs.append(EndpointStatus(self._phase, self._warning, is_warning=True))
            elif self._step is None:
                outputs.append(EndpointStatus(self._phase, "the nodding motion is set"))
        return outputs + self._send_next(now)

    def on_timer(self, now: HostTime) -> list[Output[ModbusUnit]]:
        """Process timeouts; send the next request."""
        outputs: list[Output[ModbusUnit]] = []
        if self._pending is not None and now.monotonic_ns >= self._pending.sent_ns + REPLY_TIMEOUT_NS:
            outputs += self._on_timeout(now)
        if self._silent_ns is not None and now.monotonic_ns >= self._silent_ns:
            self._silent_ns = None
            # an axis that does not answer at all is reported by the reply timeout, when the line is reopened
            if self._received_ns > self._usable_ns:
                self._phase = EndpointPhase.SILENT
                self.counts["silences"] += 1
                why = f"no usable reading for {self.settings.silence:g} s although the axis answers"
                outputs.append(EndpointStatus(EndpointPhase.SILENT, f"{why}; see the counters rejected.*"))
        return outputs + self._send_next(now)

    def get_deadline(self) -> int | None:
        if not self._is_open:
            return None
        if self._pending is not None:
            next_ns = self._pending.sent_ns + REPLY_TIMEOUT_NS
        else:
            next_ns = min(self._next_ns, self._step_ns) if self._step is not None else self._next_ns
        return next_ns if self._silent_ns is None else min(next_ns, self._silent_ns)

    def on_close(self, now: HostTime) -> list[Output[ModbusUnit]]:
        """Write back what was found before this driver wrote."""
        self._is_open = False
        if not self._found or self._found.keys() != self._commanded.keys():
            return []
        lower = self._commanded["lower_limit"].to_degrees(self._found["lower_limit"])
        return [
            Send(WriteRegisters(self._commanded[name].address, self._found[name], self._new_transaction()))
            for name in _order_writes(lower, self._current["upper_limit"])
        ]

    def _run_setup(self, nod: NodSettings) -> _Steps:
        """Read the commanded registers, write the motion and read it back."""
        for name, mapped in self._commanded.items():
            reply = yield self._read(name)
            if isinstance(reply, Registers):
                self._current[name] = mapped.to_degrees(reply.values)
                self._found.setdefault(name, reply.values)
        wanted = {"lower_limit": nod.lower_deg, "upper_limit": nod.upper_deg, "nod_rate": nod.rate_deg}
        order = _order_writes(nod.lower_deg, self._current["upper_limit"])
        for name in order:
            mapped = self._commanded[name]
            text = f"writing {wanted[name]:g} to {name} (register {mapped.address})"
            yield text, WriteRegisters(mapped.address, mapped.from_degrees(wanted[name]))
            self._current[name] = wanted[name]
        for name in order:
            mapped, reply = self._commanded[name], (yield self._read(name))
            if isinstance(reply, Registers) and not mapped.is_same(reply.values, wanted[name]):
                self._current[name] = mapped.to_degrees(reply.values)
                actual = f"{name} is {self._current[name]:g} where {wanted[name]:g} was written"
                self._warning = f"{actual}: the axis's own limit"

    def _read(self, name: str) -> _Step:
        mapped = self._commanded[name]
        return f"reading {name} (register {mapped.address})", ReadRegisters(mapped.address, mapped.word_count)

    def _send_next(self, now: HostTime) -> list[Output[ModbusUnit]]:
        """Send what is due, if nothing is under way: a reading, else a step of the nodding's set-up between two."""
        at = now.monotonic_ns
        if self._pending is not None or not self._is_open:
            return []
        is_poll = at >= self._next_ns
        if not is_poll and not (self._step is not None and at >= self._step_ns):
            return []
        transaction = self._new_transaction()
        request: ModbusRequest
        if self._step is not None and not is_poll:
            request = replace(self._step[1], transaction=transaction)
        else:
            registers = self.settings.registers
            request = ReadRegisters(registers.begin, self._length, registers.table, transaction)
            self.counts["polls"] += 1
            late = (at - self._next_ns) // self._period_ns
            self.counts["skipped"] += late
            self._next_ns += (late + 1) * self._period_ns
        self._pending = _PendingRequest(request, at, is_poll)
        return [Send(request)]

    def _new_transaction(self) -> int:
        self._transaction = self._transaction % 0xFFFF + 1
        return self._transaction

    def _publish_reading(self, unit: Registers, pending: _PendingRequest, now: HostTime) -> list[Output[ModbusUnit]]:
        round_trip_ns = now.monotonic_ns - pending.sent_ns
        joint, word = self._validate(unit.values, pending.sent_ns + round_trip_ns // 2, round_trip_ns // 2)
        if word:
            self.counts[word if word == "repeated" else f"rejected.{word}"] += 1
        outputs = self._warn_once(word, _WARNINGS[word]) if word else []
        if joint is None:
            return outputs
        self._usable_ns = now.monotonic_ns
        self._silent_ns = now.monotonic_ns + self._silence_ns
        header = SensorHeader(now.utime, self.settings.source, self._seq, now.utime)
        self._seq += 1
        self.counts["samples"] += 1
        if self._phase is not EndpointPhase.STREAMING:
            self._phase = EndpointPhase.STREAMING
            outputs = [EndpointStatus(self._phase, f"the axis reports joint {self.settings.joint}"), *outputs]
            self._reported -= {"rejected", "length"}

        round_trip = round_trip_ns * 1e-9
        return [
            *outputs,
            MeasuredSample(JointsSample(header, (joint,)), round_trip / 2.0, round_trip / math.sqrt(12.0)),
        ]

    def _validate(self, values: Sequence[int], at_ns: int, half_interval_ns: int) -> tuple[JointSample | None, str]:
        """Return the sample of a reading and a warning; None without a valid angle. `rate` is a warning about the rate.

        `at_ns` is when they were read, give or take `half_interval_ns`. Words: `repeated`, `range`, `jump`, `rate`.
        """
        settings, registers = self.settings, self.settings.registers

        def get_words(name: str) -> Sequence[int]:
            mapped = registers.measured[name]
            begin = mapped.address - registers.begin
            return values[begin : begin + mapped.word_count]

        if registers.sequence is not None:
            number = registers.sequence.to_number(get_words("sequence"))
            if number == self._number:
                return None, "repeated"
            self._number = number
        degrees = registers.angle.to_degrees(get_words("angle"))
        if not settings.lowest_deg - settings.step_deg <= degrees <= settings.highest_deg + settings.step_deg:
            return None, "range"
        place = _TimedAngle(degrees, at_ns, half_interval_ns)
        believed = self._last is None or self._can_reach(self._last, place)
        if not believed and not (self._suspect is not None and self._can_reach(self._suspect, place)):
            self._suspect = place
            return None, "jump"
        self._last, self._suspect = place, None
        rate, word = NAN, ""
        if registers.rate is not None:
            rate = registers.rate.to_degrees(get_words("rate"))
            if abs(rate) > RATE_MARGIN * settings.fastest_deg:
                rate, word = NAN, "rate"
        sigma = settings.step_deg / math.sqrt(12.0)
        return JointSample(settings.joint, math.radians(degrees), math.radians(sigma), math.radians(rate)), word

    def _can_reach(self, before: _TimedAngle, after: _TimedAngle) -> bool:
        seconds = (after.at_ns - before.at_ns + before.half_interval_ns + after.half_interval_ns) * 1e-9
        reach = RATE_MARGIN * self.settings.fastest_deg * seconds + 2.0 * self.settings.step_deg
        return abs(after.degrees - before.degrees) <= reach

    def _on_timeout(self, now: HostTime) -> list[Output[ModbusUnit]]:
        self.counts["unanswered"] += 1
        self._pending = None
        if now.monotonic_ns - self._received_ns < self._silence_ns:
            return self._send_next(now)
        why = f"the axis has not answered for {self.settings.silence:g} s"
        return self._on_line_error(f"{why}; check its power, the network cable, address and port")

    def _on_exception(
        self, pending: _PendingRequest, failure: ModbusFailure, now: HostTime
    ) -> list[Output[ModbusUnit]]:
        self.counts.add(f"rejected.exception_{failure.code}")
        self._pending = None
        self._received_ns = now.monotonic_ns
        again_ns = now.monotonic_ns + RETRY_DELAY_NS
        if pending.is_poll:
            self._next_ns = again_ns
            if failure.code not in BUSY_EXCEPTIONS:
                self._phase = EndpointPhase.SILENT
            text = f"the axis rejects {describe_request(pending.request)}: {explain_exception(failure.code)}"
            retry = f"retried every {RETRY_DELAY_NS * 1e-9:g} s, nothing is published"
            return self._warn_once("rejected", f"{text}; {retry}")
        text = f"the axis rejects {self._step[0] if self._step else ''}: {explain_exception(failure.code)}"
        if failure.code in BUSY_EXCEPTIONS:
            self._step_ns = again_ns
            return [*self._warn_once("nod", f"{text}; trying again"), *self._send_next(now)]
        self._step = None
        return [*self._warn_once("nod", f"{text}; its nodding motion is not changed"), *self._send_next(now)]

    def _on_line_error(self, why: str) -> list[Output[ModbusUnit]]:
        if not self._is_open:
            return []
        self._is_open, self._pending, self._silent_ns = False, None, None
        self._phase = EndpointPhase.SILENT
        self.counts["line_errors"] += 1
        return [EndpointStatus(EndpointPhase.SILENT, why), Reopen(why)]

    def _warn_once(self, word: str, text: str) -> list[Output[ModbusUnit]]:
        if word in self._reported:
            return []
        self._reported.add(word)
        return [EndpointStatus(self._phase, text, is_warning=True)]


_WARNINGS = {
    "repeated": "the sequence number does not change; a reading with the same number is not published",
    "range": "an angle outside lowest_deg and highest_deg; are scale_deg, is_signed and high_word_first right? "
    "(With type and order: are they?)",
    "jump": "an angle that the axis cannot have reached since the last reading; it is not published",
    "rate": "a rate above fastest_deg; is the scale of `rate` right? It is published as not measured",
}
