"""Interface of an endpoint: the sans-I/O protocol object at one end of a device line.

A driver is an endpoint, and so is the emulator of its device. An endpoint neither opens a port nor reads a clock: it
gets received units (bytes, CAN frames, Modbus messages) and timer events, and returns outputs: what to send, samples,
status, or a request to reopen the line. The runner does the I/O, so every decision can be tested with scripted times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

from modelserver.messages import Sample, VehicleCommand


class HostTime(NamedTuple):
    """The host's clocks at one instant: monotonic nanoseconds for timers, microseconds of UTC for stamps."""

    monotonic_ns: int
    utime: int


class EndpointPhase(Enum):
    """Phase of the connection to the device."""

    WAITING = "waiting"
    """Nothing received since the line was opened."""
    CONFIGURING = "configuring"
    """The device answers and is being configured."""
    STREAMING = "streaming"
    """Samples arrive."""
    SILENT = "silent"
    """The device has stopped to speak, or speaks what cannot be used."""


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
    """One end of a line. Each event method updates the endpoint's state and returns the outputs in order."""

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


@runtime_checkable
class HasMaxSilence(Protocol):
    """An endpoint that knows how long its device may be silent."""

    @property
    def max_silence(self) -> float:
        """Longest normal silence in seconds; inf where no data is expected."""
