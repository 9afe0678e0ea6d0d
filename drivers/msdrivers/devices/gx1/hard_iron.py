"""Hard-iron calibration of the 3DM-GX1's magnetometer by its built-in procedure, with checks.

The device records minimum and maximum of the field on each axis while the vehicle turns (0x40, then 0x41 repeatedly),
computes the offsets as their middle and stores them in its EEPROM (0x42). Before that the spans are checked, so that
the turns were sufficient; afterwards the offsets are compared with the extremes and read back. After a failure the
previous offsets are restored.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from modelserver.transforms.so3 import Vector3
from msdrivers.devices.gx1 import script
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Send
from msdrivers.protocol.gx1 import CommandByte, EepromAddress, Gx1Packet, requests
from msdrivers.protocol.gx1.scaling import TESLA, is_saturated, vector_from_words

PROGRESS_PERIOD_S = 5.0
OFFSET_TOLERANCE = 0.02
"""Largest deviation of an offset from the middle of its extremes, as a fraction of their distance."""

OFFSET_TOLERANCE_COUNTS = 4
COMPUTE_TIMEOUT_S = 5.0
_AXES = "xyz"


@dataclass(frozen=True, slots=True)
class HardIronSettings:
    """Settings of the procedure.

    duration: seconds of turning. period: from one collection to the next. two_dimensional: the vehicle turns on level
    ground only; then x and y are found and `magnitude_z` is the raw value of the vertical field there.
    least_span: tesla that the greatest and least field of an axis must lie apart. bauds: the rates to try; the line is
    opened at the first. Empty: the line has none.
    """

    duration: float = 60.0
    period: float = 0.1
    two_dimensional: bool = True
    magnitude_z: int = 0
    min_span: float = 15e-6
    bauds: tuple[int, ...] = (38400, 115200)

    def __post_init__(self) -> None:
        if not 0.0 < self.period < self.duration:
            raise ValueError(f"period: must be above 0 and below the duration, got {self.period:g} s")
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds: must be above 0, got {self.bauds}")


@dataclass(frozen=True, slots=True)
class HardIronResult:
    """Result of the procedure. Offsets and spans along the sensor's axes, tesla; None if not reached.

    is_stored: the new offsets were stored and read back; else `text` has the reason.
    """

    is_stored: bool
    text: str
    offsets: Vector3 | None = None
    spans: Vector3 | None = None


class _FailedError(Exception):
    """The procedure cannot give a good result."""


class HardIronProcedure:
    """An `Endpoint` of bytes that runs the procedure once; `result` is set at its end."""

    def __init__(self, settings: HardIronSettings):
        self.settings = settings
        self.result: HardIronResult | None = None
        self._link = script.Gx1Receiver()
        self._script = script.ScriptRunner(self._link, self._run_procedure)
        self._line_state = script.LineState(list(settings.bauds))
        self._gain = 1
        self._before: tuple[int, ...] = ()
        self._is_started = False
        self._extremes: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        """Begin, or go on at another baud rate."""
        return [] if self.result else self._script.on_open(now)

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        """Process received bytes."""
        outputs: list[Output[bytes]] = []
        for reply in self._link.feed(unit, now):
            if self._script.is_running:
                outputs += self._script.on_reply(reply, now)
        return outputs

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        """Ask for what is due."""
        return self._script.on_timer(now)

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        return self._script.deadline_ns

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        """Restore offsets and continuous mode if the procedure was not completed."""
        self._script.stop()
        outputs: list[Output[bytes]] = []
        if self._is_started and self.result is None:
            words = zip(EepromAddress.HARD_IRON, self._before, strict=True)
            outputs += [Send(requests.make_write_eeprom(address, value)) for address, value in words]
            outputs.append(script.report("hard iron: interrupted, the offsets from before are written back"))
        if self._line_state.found_stream is not None and self.result is None:
            outputs.append(Send(self._line_state.make_restore_request()))
        return outputs

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, bytes skipped, rejected by reason."""
        return self._link.messages + self._link.parser.counts

    def _run_procedure(self) -> script.Script:
        while True:
            try:
                yield from self._prepare()
                break
            except (script.NoReplyError, script.UnusableDeviceError) as failure:
                text = f"hard iron: cannot begin: {failure}; trying again in {script.RETRY_DELAY_S:g} s"
            yield EndpointStatus(EndpointPhase.SILENT, text)
            yield script.PauseStep(script.RETRY_DELAY_S)
        try:
            offsets = yield from self._find_offsets()
            text = f"hard iron: done, offsets {_format_microtesla(offsets)} are stored and were read back"
            self.result = HardIronResult(True, text, offsets, self._get_spans())
        except (_FailedError, script.NoReplyError) as failure:
            text = yield from self._restore_offsets(str(failure))
            self.result = HardIronResult(False, text, spans=self._get_spans() if self._extremes[0] else None)
        yield Send(self._line_state.make_restore_request())
        yield script.report(text)

    def _prepare(self) -> script.ScriptPart[None]:
        device = yield from script.find_device(self._link, self._line_state)
        self._gain = (yield from script.read_gains()).magnetometer
        # after a reconnect the device has no offsets: keep those found first
        if not self._is_started:
            self._before = yield from script.read_words(EepromAddress.HARD_IRON)
        yield script.report(f"hard iron: {device}, offsets before {_to_signed(self._before)} counts")

    def _find_offsets(self) -> script.ScriptPart[Vector3]:
        self._is_started = True
        yield script.RequestStep(requests.make_hard_iron_start())
        how = "on level ground through full circles" if self.settings.two_dimensional else "about all its axes"
        yield script.report(f"hard iron: turn the vehicle {how}, for {self.settings.duration:g} s")
        yield from self._collect_extremes()
        self._check_spans()
        request = requests.make_hard_iron_compute(self.settings.two_dimensional, self.settings.magnitude_z)
        (reply,) = yield script.RequestStep(request, timeout=COMPUTE_TIMEOUT_S, attempts=1)
        yield from self._check_offsets(reply)
        return vector_from_words(reply.field("offset"), self._gain, TESLA)

    def _collect_extremes(self) -> script.ScriptPart[None]:
        link, seconds = self._link, 1e9
        begin = reported = link.now.monotonic_ns
        while link.now.monotonic_ns - begin < self.settings.duration * seconds:
            (reply,) = yield script.RequestStep(requests.make_poll(CommandByte.HARD_IRON_COLLECT))
            self._extremes = (reply.field("minimum"), reply.field("maximum"))
            if link.now.monotonic_ns - reported >= PROGRESS_PERIOD_S * seconds:
                reported = link.now.monotonic_ns
                done = (reported - begin) / seconds
                spans = _format_microtesla(self._get_spans())
                yield script.report(f"hard iron: {done:.0f} of {self.settings.duration:g} s, field spans {spans}")
            yield script.PauseStep(self.settings.period)

    def _get_spans(self) -> Vector3:
        low, high = self._extremes
        return vector_from_words((b - a for a, b in zip(low, high, strict=True)), self._gain, TESLA)

    def _list_checked_axes(self) -> range:
        return range(2 if self.settings.two_dimensional else 3)

    def _check_spans(self) -> None:
        spans = self._get_spans()
        for low_or_high in self._extremes:
            if is_saturated(low_or_high):
                raise _FailedError("the field is stronger than the device can measure: a magnet or motor is near")
        for axis in self._list_checked_axes():
            if spans[axis] < self.settings.min_span:
                raise _FailedError(
                    f"the field along {_AXES[axis]} changed by {spans[axis] * 1e6:.1f} uT, and at least "
                    f"{self.settings.min_span * 1e6:.1f} uT are needed: turn the vehicle further, for the whole time"
                )

    def _check_offsets(self, reply: Gx1Packet) -> script.ScriptPart[None]:
        low, high = self._extremes
        offsets = reply.field("offset")
        for axis in self._list_checked_axes():
            middle, span = (low[axis] + high[axis]) / 2, high[axis] - low[axis]
            if abs(offsets[axis] - middle) > OFFSET_TOLERANCE_COUNTS + OFFSET_TOLERANCE * span:
                raise _FailedError(
                    f"the device's offset along {_AXES[axis]} is {offsets[axis]} counts, but the middle of its "
                    f"extremes is {middle:g}: do the procedure again, away from iron and currents"
                )
        for axis, address in enumerate(EepromAddress.HARD_IRON):
            (stored,) = yield from script.read_words((address,))
            if stored != offsets[axis] & 0xFFFF:
                raise _FailedError(
                    f"the device gave an offset of {offsets[axis]} counts along {_AXES[axis]}, but its EEPROM (address "
                    f"{address}) holds {_to_signed((stored,))[0]}: it was not stored; do the procedure again"
                )

    def _restore_offsets(self, why: str) -> script.ScriptPart[str]:
        try:
            for address, value in zip(EepromAddress.HARD_IRON, self._before, strict=True):
                yield from script.write_word(address, value)
                if (yield from script.read_words((address,))) != (value,):
                    raise _FailedError(f"address {address} did not take {_to_signed((value,))[0]}")
        except (script.NoReplyError, _FailedError) as failure:
            return (
                f"hard iron: failed: {why}; and the offsets from before, {_to_signed(self._before)} counts, could not "
                f"be restored: {failure}; repeat the procedure before the magnetometer is used"
            )
        return f"hard iron: failed: {why}; the offsets are as they were before"


def _to_signed(words: Iterable[int]) -> list[int]:
    return [word - 65536 if word > 32767 else word for word in words]


def _format_microtesla(value: Vector3) -> str:
    return "(" + ", ".join(f"{axis * 1e6:.1f}" for axis in value) + ") uT"
