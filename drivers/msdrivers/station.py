"""What stands at an end of a line: bytes, frames or replies and instants in; what to send and what was measured out.

A driver is one, and the emulator of its device is one: neither opens a port nor reads a clock. The runner owns both and
carries between them, so that every decision can be tested with a list of instants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

from modelserver.messages import Sample, VehicleCommand


class Now(NamedTuple):
    """An instant: monotonic nanoseconds for time-outs, and the host's clock in microseconds of UTC for stamps."""

    monotonic_ns: int
    utime: int


class StationPhase(Enum):
    """How far a driver has come with its device."""

    WAITING = "waiting"
    """Nothing heard since the line was opened."""
    CONFIGURING = "configuring"
    """The device answers, and is being set up."""
    STREAMING = "streaming"
    """Samples come."""
    SILENT = "silent"
    """The device has stopped to speak, or speaks what cannot be used."""


U = TypeVar("U")
"""The unit that a line carries: bytes, a CAN frame, a Modbus request or reply."""


@dataclass(frozen=True, slots=True)
class Send(Generic[U]):
    """Put a unit on the line."""

    unit: U


@dataclass(frozen=True, slots=True)
class Measured:
    """A sample that the device gave. In its header stand source, seq, host_utime and device_utime (0: it has none).

    `header.utime` is for the runner to find, from both times. `delay` is what is known of the way from the measurement
    to the instant that the device's time names, or without a device's time to the reception, seconds. `tick`: the
    device's time goes in steps so long, seconds.
    """

    sample: Sample
    delay: float = 0.0
    delay_sigma: float = 0.0
    tick: float = 1e-6


@dataclass(frozen=True, slots=True)
class StationStatus:
    """A word for the log and the health channel: the driver's phase, and what there is to say for a person.

    `is_trouble`: something is wrong even where the phase is not SILENT, e.g. the device has refused what it was told.
    """

    phase: StationPhase
    text: str
    is_trouble: bool = False


@dataclass(frozen=True, slots=True)
class Reopen:
    """Close the line and open it anew, e.g. at another baud rate; `why` is for a person."""

    why: str
    baud: int | None = None


Output: TypeAlias = Send[U] | Measured | StationStatus | Reopen


class Station(Protocol[U]):
    """One end of a line. Methods return what is to be done, in order, and change the station's own state."""

    def opened(self, now: Now) -> Sequence[Output[U]]:
        """The line is open (again): begin from the start."""

    def received(self, unit: U, now: Now) -> Sequence[Output[U]]:
        """Something came in."""

    def woken(self, now: Now) -> Sequence[Output[U]]:
        """The instant that `due` named has come."""

    def due(self) -> int | None:
        """Return the monotonic nanoseconds at which to be woken; None: only by what comes in."""

    def leaving(self, now: Now) -> Sequence[Output[U]]:
        """The line is about to be closed in order: leave the device as it was found, or as settings say."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Counters for people: messages by kind, bytes skipped, rejected by reason (`rejected.checksum`)."""


@runtime_checkable
class CommandableStation(Protocol[U]):
    """A station that takes commands from the bus too."""

    def command(self, command: VehicleCommand, now: Now) -> Sequence[Output[U]]:
        """Take a command."""
        ...

    def refuse(self, reason: str, text: str, now: Now) -> Sequence[Output[U]]:
        """Take that something came as a command and cannot be one; `reason` is a word, `text` for a person."""
        ...


@runtime_checkable
class Quiet(Protocol):
    """A station that knows for how long nothing need come."""

    @property
    def quiet(self) -> float:
        """Seconds without a unit that are normal; inf where nothing is expected to come at all."""
        ...
