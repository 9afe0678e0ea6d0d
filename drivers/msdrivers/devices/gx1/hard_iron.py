"""The hard-iron procedure of the 3DM-GX1: turn the vehicle, let the device find its own field, check the result.

The device notes the least and greatest field of each axis while it is turned (0x40, then 0x41 again and again), finds
the offsets of the middle between them and stores them (0x42). Here the turns are checked before, and the offsets after:
against the extremes, and by reading them back. What fails leaves the offsets as they were.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from modelserver.spatial.so3 import Vector3
from msdrivers.devices.gx1.contact import (
    RETRY_S,
    ContactState,
    Part,
    UnusableError,
    contact,
    read_gains,
    read_word,
    read_words,
    write_word,
)
from msdrivers.devices.gx1.dialogue import Ask, Dialogue, NoReplyError, Pause, Script
from msdrivers.devices.gx1.link import Gx1Link
from msdrivers.protocol.gx1 import Address, CommandByte, Packet, requests
from msdrivers.protocol.gx1.scaling import TESLA, is_saturated, vector
from msdrivers.station import Now, Output, Send, StationPhase, StationStatus

PROGRESS_S = 5.0
AGREE = 0.02
"""How far an offset may lie from the middle of its extremes, as a share of their distance; a few counts besides."""

FEW = 4
COMPUTE_S = 5.0
_AXES = "xyz"


@dataclass(frozen=True, slots=True)
class HardIronSettings:
    """How the procedure is to be done.

    duration: seconds of turning. period: from one collection to the next. two_dimensional: the vehicle turns on level
    ground only; then x and y are found and `magnitude_z` is the device's own word for the vertical field there.
    least_span: tesla that the greatest and least field of an axis must lie apart. bauds: the rates to try; the line is
    opened at the first. Empty: the line has none.
    """

    duration: float = 60.0
    period: float = 0.1
    two_dimensional: bool = True
    magnitude_z: int = 0
    least_span: float = 15e-6
    bauds: tuple[int, ...] = (38400, 115200)

    def __post_init__(self) -> None:
        if not 0.0 < self.period < self.duration:
            raise ValueError(f"period: must be above 0 and below the duration, got {self.period:g} s")
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds: must be above 0, got {self.bauds}")


@dataclass(frozen=True, slots=True)
class HardIronResult:
    """How the procedure ended. Offsets and spans are along the sensor's axes, tesla; None where it did not come so far.

    `stored`: the device holds the new offsets, and they were read back. Else `text` says why not.
    """

    stored: bool
    text: str
    offsets: Vector3 | None = None
    spans: Vector3 | None = None


class _FailedError(Exception):
    """The procedure cannot give a good result."""


class HardIron:
    """A `Station` of bytes that does the procedure once; then `result` is there and the line may be closed."""

    def __init__(self, settings: HardIronSettings):
        """Take the settings."""
        self.settings = settings
        self.result: HardIronResult | None = None
        self._link = Gx1Link()
        self._dialogue = Dialogue(self._link, self._procedure)
        self._found = ContactState(list(settings.bauds))
        self._gain = 1
        self._before: tuple[int, ...] = ()
        self._begun = False
        self._extremes: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())

    def opened(self, now: Now) -> list[Output[bytes]]:
        """Begin, or go on at another baud rate."""
        return [] if self.result else self._dialogue.opened(now)

    def received(self, unit: bytes, now: Now) -> list[Output[bytes]]:
        """Take bytes."""
        outputs: list[Output[bytes]] = []
        for reply in self._link.feed(unit, now):
            if self._dialogue.running:
                outputs += self._dialogue.take(reply, now)
        return outputs

    def woken(self, now: Now) -> list[Output[bytes]]:
        """Ask for what is due."""
        return self._dialogue.woken(now) if self._dialogue.running else []

    def due(self) -> int | None:
        """Return when to be woken."""
        return self._dialogue.due

    def leaving(self, now: Now) -> list[Output[bytes]]:
        """Leave offsets and continuous mode as they were found, if the procedure was not done to its end."""
        self._dialogue.stop()
        outputs: list[Output[bytes]] = []
        if self._begun and self.result is None:
            outputs += [
                Send(requests.write_eeprom(address, value))
                for address, value in zip(Address.HARD_IRON, self._before, strict=True)
            ]
            outputs.append(
                StationStatus(
                    StationPhase.CONFIGURING, "hard iron: interrupted, the offsets from before are written back"
                )
            )
        if self._found.streamed is not None and self.result is None:
            outputs.append(Send(self._found.restored()))
        return outputs

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, bytes skipped, rejected by reason."""
        return self._link.messages + self._link.parser.counts

    def _procedure(self) -> Script:
        while True:
            try:
                yield from self._prepare()
            except NoReplyError as silence:
                why = str(silence)
            except UnusableError as unusable:
                why = str(unusable)
            else:
                break
            yield StationStatus(StationPhase.SILENT, f"hard iron: cannot begin: {why}; trying again in {RETRY_S:g} s")
            yield Pause(RETRY_S)
        try:
            offsets = yield from self._find()
            text = f"hard iron: done, offsets {_microtesla(offsets)} are stored and were read back"
            self.result = HardIronResult(True, text, offsets, self._spans())
        except (_FailedError, NoReplyError) as failure:
            text = yield from self._undo(str(failure))
            self.result = HardIronResult(False, text, spans=self._spans() if self._extremes[0] else None)
        yield Send(self._found.restored())
        yield StationStatus(StationPhase.CONFIGURING, text)

    def _prepare(self) -> Part[None]:
        device = yield from contact(self._link, self._found)
        self._gain = (yield from read_gains()).magnetometer
        # begun before and the line lost: the device has no offsets now
        if not self._begun:
            self._before = yield from read_words(Address.HARD_IRON)
        yield StationStatus(
            StationPhase.CONFIGURING, f"hard iron: {device}, offsets before {_signed(self._before)} counts"
        )

    def _find(self) -> Part[Vector3]:
        self._begun = True
        yield Ask(requests.hard_iron_start())
        how = "on level ground through full circles" if self.settings.two_dimensional else "about all its axes"
        yield StationStatus(
            StationPhase.CONFIGURING, f"hard iron: turn the vehicle {how}, for {self.settings.duration:g} s"
        )
        yield from self._collect()
        self._check_turns()
        kind = self.settings.two_dimensional
        (reply,) = yield Ask(requests.hard_iron_compute(kind, self.settings.magnitude_z), timeout=COMPUTE_S, tries=1)
        yield from self._check_offsets(reply)
        return vector(reply.field("offset"), self._gain, TESLA)

    def _collect(self) -> Part[None]:
        link, seconds = self._link, 1e9
        begin = told = link.now.monotonic_ns
        while link.now.monotonic_ns - begin < self.settings.duration * seconds:
            (reply,) = yield Ask(requests.poll(CommandByte.HARD_IRON_COLLECT))
            self._extremes = (reply.field("minimum"), reply.field("maximum"))
            if link.now.monotonic_ns - told >= PROGRESS_S * seconds:
                told = link.now.monotonic_ns
                done = (told - begin) / seconds
                yield StationStatus(
                    StationPhase.CONFIGURING,
                    f"hard iron: {done:.0f} of {self.settings.duration:g} s, field spans {_microtesla(self._spans())}",
                )
            yield Pause(self.settings.period)

    def _spans(self) -> Vector3:
        low, high = self._extremes
        return vector((b - a for a, b in zip(low, high, strict=True)), self._gain, TESLA)

    def _checked_axes(self) -> range:
        return range(2 if self.settings.two_dimensional else 3)

    def _check_turns(self) -> None:
        spans = self._spans()
        for low_or_high in self._extremes:
            if is_saturated(low_or_high):
                raise _FailedError("the field is stronger than the device can measure: a magnet or motor is near")
        for axis in self._checked_axes():
            if spans[axis] < self.settings.least_span:
                raise _FailedError(
                    f"the field along {_AXES[axis]} changed by {spans[axis] * 1e6:.1f} uT, and at least "
                    f"{self.settings.least_span * 1e6:.1f} uT are needed: turn the vehicle further, for the whole time"
                )

    def _check_offsets(self, reply: Packet) -> Part[None]:
        low, high = self._extremes
        offsets = reply.field("offset")
        for axis in self._checked_axes():
            middle, span = (low[axis] + high[axis]) / 2, high[axis] - low[axis]
            if abs(offsets[axis] - middle) > FEW + AGREE * span:
                raise _FailedError(
                    f"the device's offset along {_AXES[axis]} is {offsets[axis]} counts, but the middle of its "
                    f"extremes is {middle:g}: do the procedure again, away from iron and currents"
                )
        for axis, address in enumerate(Address.HARD_IRON):
            stored = yield from read_word(address)
            if stored != offsets[axis] & 0xFFFF:
                raise _FailedError(
                    f"the device gave an offset of {offsets[axis]} counts along {_AXES[axis]}, but its EEPROM (address "
                    f"{address}) holds {_signed((stored,))[0]}: it was not stored; do the procedure again"
                )

    def _undo(self, why: str) -> Part[str]:
        try:
            for address, value in zip(Address.HARD_IRON, self._before, strict=True):
                yield from write_word(address, value)
                if (yield from read_word(address)) != value:
                    raise _FailedError(f"address {address} did not take {_signed((value,))[0]}")
        except (NoReplyError, _FailedError) as failure:
            return (
                f"hard iron: failed: {why}; and the offsets from before, {_signed(self._before)} counts, could not be "
                f"written back: {failure}; do the procedure again before the magnetometer is used"
            )
        return f"hard iron: failed: {why}; the offsets are as they were before"


def _signed(words: Iterable[int]) -> list[int]:
    return [word - 65536 if word > 32767 else word for word in words]


def _microtesla(value: Vector3) -> str:
    return "(" + ", ".join(f"{axis * 1e6:.1f}" for axis in value) + ") uT"
