"""Interface of an endpoint: the sans-I/O protocol object at one end of a device line, and the units that lines carry.

A driver is an endpoint, and so is the emulator of its device. An endpoint neither opens a port nor reads a clock: it
gets received units and timer events, and returns outputs: what to send, samples, status, or a request to reopen the
line. The runner does the I/O, so every decision can be tested with scripted times.

A unit is bytes, a CAN frame, or a Modbus request, reply or failure (MODBUS Application Protocol Specification V1.1b3).
Modbus addresses are those of the protocol, from 0; manuals that number holding registers from 40001 mean address 0 by
it. `transaction` ties a reply to its request, as the header of Modbus/TCP does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, Literal, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

from modelserver.messages import DriverPhase, Sample, VehicleCommand


class HostTime(NamedTuple):
    """The host's clocks at one instant: monotonic nanoseconds for timers, microseconds of UTC for stamps."""

    monotonic_ns: int
    utime: int


class TimeSource(Protocol):
    """A clock, and a way to wait."""

    def now(self) -> HostTime:
        """Return the instant."""

    def sleep(self, seconds: float) -> None:
        """Wait."""


EndpointPhase: TypeAlias = DriverPhase
"""Phase of the connection to the device. WAITING: nothing received since the line was opened. CONFIGURING: the device
answers and is being configured. STREAMING: samples arrive. SILENT: the device has stopped to speak, or speaks what
cannot be used. CLOSED is the runner's.
"""


U = TypeVar("U")
"""The unit that a line carries: bytes, a CAN frame, a Modbus request or reply."""


@dataclass(frozen=True, slots=True)
class Send(Generic[U]):
    """Put a unit on the line."""

    unit: U


@dataclass(frozen=True, slots=True)
class MeasuredSample:
    """Publish a sample, whose header has source, seq, host_utime and device_utime (0: the device has no time).

    The runner computes `header.utime`. `delay`: known time from the measurement to the device's time, or to
    `host_utime` without one, seconds. `tick`: resolution of the device's time, seconds.
    """

    sample: Sample
    delay: float = 0.0
    delay_sigma: float = 0.0
    tick: float = 1e-6


@dataclass(frozen=True, slots=True)
class EndpointStatus:
    """Report the driver's phase and a status text to the log and the health channel.

    `is_warning`: something is wrong although the phase is not SILENT, e.g. the device has rejected a command.
    """

    phase: EndpointPhase
    text: str
    is_warning: bool = False


@dataclass(frozen=True, slots=True)
class Reopen:
    """Close the line and reopen it, e.g. at another baud rate."""

    reason: str
    baud: int | None = None


Output: TypeAlias = Send[U] | MeasuredSample | EndpointStatus | Reopen


class Endpoint(Protocol[U]):
    """One end of a line. Each event method updates the endpoint's state and returns the outputs in order.

    One whose device may be silent for long has the attribute `max_silence`: seconds, inf where no data is expected.
    """

    def on_open(self, now: HostTime) -> Sequence[Output[U]]:
        """Start from the beginning: the line was opened or reopened."""

    def on_receive(self, unit: U, now: HostTime) -> Sequence[Output[U]]:
        """Process a received unit."""

    def on_timer(self, now: HostTime) -> Sequence[Output[U]]:
        """Do what is due: the deadline of `get_deadline` has passed."""

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds; None: only received units matter."""

    def on_close(self, now: HostTime) -> Sequence[Output[U]]:
        """Restore the device's state, as the settings demand, before the line is closed in order."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Counters of the health report: messages by kind, skipped bytes, rejections (`rejected.checksum`)."""


@runtime_checkable
class CommandableEndpoint(Protocol[U]):
    """An endpoint that also accepts commands from the bus."""

    def on_command(self, command: VehicleCommand, now: HostTime) -> Sequence[Output[U]]:
        """Process a command."""

    def reject_command(self, reason: str, text: str, now: HostTime) -> Sequence[Output[U]]:
        """Count and report a malformed command; `reason` is the counter's name."""


BUS_OFF = 0x40
"""Class of error in the identifier of an error frame, as Linux gives it (linux/can/error.h, CAN_ERR_BUSOFF)."""


class FrameKey(NamedTuple):
    """Identifier of a kind of frame."""

    arbitration_id: int
    is_extended: bool = False

    def __str__(self) -> str:
        return f"0x{self.arbitration_id:08X}" if self.is_extended else f"0x{self.arbitration_id:03X}"


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data frame, or with `is_error` an error frame of the interface.

    In an error frame `arbitration_id` holds the error classes. `utime`: receive time by the host's clock, microseconds;
    0: unknown. Frames are compared by content only.
    """

    arbitration_id: int
    data: bytes = b""
    is_extended: bool = False
    is_error: bool = False
    utime: int = field(default=0, compare=False)

    @property
    def key(self) -> FrameKey:
        return FrameKey(self.arbitration_id, self.is_extended)

    @property
    def is_bus_off(self) -> bool:
        """Whether the interface reports bus-off: too many of its frames failed."""
        return self.is_error and bool(self.arbitration_id & BUS_OFF)


BUS_OFF_FRAME = CanFrame(BUS_OFF, is_error=True)
"""The error frame of an interface that went bus-off."""

MAX_READ = 125
MAX_WRITE = 123
"""Registers in one request."""

LAST_ADDRESS = 0xFFFF


RegisterTable: TypeAlias = Literal["holding", "input"]
"""Table of a register; each has its own addresses. holding: read and written (functions 3 and 16). input: only read
(function 4)."""


@dataclass(frozen=True, slots=True)
class ReadRegisters:
    """Read `count` registers from `address` on."""

    address: int
    count: int
    table: RegisterTable = "holding"
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """Write registers from `address` on: numbers 0..65535."""

    address: int
    values: tuple[int, ...]
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class Registers:
    """The requested registers: numbers 0..65535 from `address` on."""

    address: int
    values: tuple[int, ...]
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class RegistersWritten:
    """`count` registers were written from `address` on."""

    address: int
    count: int
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class ModbusFailure:
    """An exception by which the device rejects a request; with code 0 the line failed, or the data was not Modbus."""

    text: str = ""
    code: int = 0
    transaction: int = 0


ModbusRequest: TypeAlias = ReadRegisters | WriteRegisters
ModbusUnit: TypeAlias = ModbusRequest | Registers | RegistersWritten | ModbusFailure

EXCEPTION_TEXTS = {
    1: "it does not know the function: use the other table (holding, input)",
    2: "it has no such register: check the addresses in the settings against its manual, which may count from 1",
    3: "it does not take the value or the count of registers: check limits and rate against its manual",
    4: "it failed at the task: look at the device itself",
    5: "it needs time for the task",
    6: "it is busy",
    8: "its memory is damaged: look at the device itself",
    10: "the gateway has no path to it: check the device's number (unit id)",
    11: "the gateway gets no reply from it: check its power and its number (unit id)",
}
"""Meaning of the exception codes (MODBUS Application Protocol V1.1b3, 7)."""


def explain_exception(code: int) -> str:
    return f"exception {code}: {EXCEPTION_TEXTS.get(code, 'a code that the standard does not have; see its manual')}"


def is_reply_to(unit: ModbusUnit, request: ModbusRequest) -> bool:
    """Return whether a unit is a reply to a request: of its kind, with its address and number of registers."""
    if isinstance(request, ReadRegisters):
        return (
            isinstance(unit, Registers)
            and (unit.address, len(unit.values)) == (request.address, request.count)
            and all(0 <= value <= 0xFFFF for value in unit.values)
        )
    return isinstance(unit, RegistersWritten) and (unit.address, unit.count) == (request.address, len(request.values))


def describe_request(request: ModbusRequest) -> str:
    if isinstance(request, ReadRegisters):
        return f"reading {request.count} {request.table} registers from {request.address}"
    return f"writing {len(request.values)} registers from {request.address}"
