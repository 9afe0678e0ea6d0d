"""Common part of the drivers on a CAN bus: decoding, assembly of instants, silence, malformed frames, bus-off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping

from modelserver.errors import quote
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Reopen
from msdrivers.protocol.can.database import BoundSignal, CanDatabase, CanFrameAssembler, CanFrameSet, FrameError
from msdrivers.protocol.can.frame import CanFrame, FrameKey

MAX_SEEN = 8
"""Identifiers, and kinds of what is wrong with frames, that are remembered for the status text."""


MAX_FLAWS = 3
"""Warnings about the DBC file at a start: `modelserver check` has all."""


def get_arrival_time(frame: CanFrame, now: HostTime) -> HostTime:
    """Return the receive time of a frame that is read `now`: its own stamp if it has one."""
    if not 0 < frame.utime <= now.utime:
        return now
    return HostTime(now.monotonic_ns - (now.utime - frame.utime) * 1000, frame.utime)


class CanDriver(ABC):
    """Base of an `Endpoint` of CAN frames: decodes the needed frames and assembles those of one instant.

    Silence, errors and recovery are reported once per change. Without needed frames there is no silence.
    """

    def __init__(self, database: CanDatabase, needed: Mapping[FrameKey, str], silence: float, window: float):
        """`needed` are the kinds of frame and their names; the others see `WheelsSettings`."""
        self.phase = EndpointPhase.WAITING
        self.is_bus_off = False
        """The interface is bus-off; nothing can be sent."""
        self.counts: Counter[str] = Counter()
        """Frames, samples, incomplete instants, silences, commands, and rejections by reason. `outside_range`: values
        outside the range of the DBC, which are used; `rejected.reserved`: those that stand for no measurement."""
        self.problems = database.warnings
        """What is wrong with parts of the DBC file that are not used."""
        self._database, self._needed, self._silence_s = database, needed, silence
        self._assembler = CanFrameAssembler(frozenset(needed), round(window * 1e9))
        self._seq = 0
        self._silence_deadline_ns: int | None = None
        self._received = 0
        self._others: Counter[FrameKey] = Counter()
        self._useless: Counter[str] = Counter()
        """Since the last usable data: frames, those that are not needed, and what is wrong with the others."""
        self._reasons: dict[str, None] = {}
        """Why values of the last instant cannot be used."""
        self._reported: set[object] = set()

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Discard incomplete instants and start the silence timer."""
        self._assembler.clear()
        self.phase, self.is_bus_off = EndpointPhase.WAITING, False
        self._reported.clear()
        self._restart_silence_timer(now)
        flaws = [
            EndpointStatus(EndpointPhase.WAITING, str(each), is_warning=True) for each in self.problems[:MAX_FLAWS]
        ]
        if not self._needed:
            return [*flaws]
        return [*flaws, EndpointStatus(EndpointPhase.WAITING, f"waiting for {self._format_needed()}")]

    def on_receive(self, unit: CanFrame, now: HostTime) -> list[Output[CanFrame]]:
        """Process a received frame."""
        if unit.is_error:
            return self._on_error_frame(unit)
        self._received += 1
        if unit.key not in self._needed:
            self.counts["other_frames"] += 1
            if unit.key in self._others or len(self._others) < MAX_SEEN:
                self._others[unit.key] += 1
            return []
        try:
            values = self._database.decode(unit)
        except FrameError as error:
            return self._on_malformed_frame(unit, error)
        self.counts["frames"] += 1
        arrival = get_arrival_time(unit, now)
        return self._publish(self._assembler.add(unit.key, values, arrival.monotonic_ns, arrival.utime), now)

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
        """Return when to call `on_timer`, monotonic nanoseconds."""
        deadlines = (self._assembler.get_deadline(), self._silence_deadline_ns)
        return min((each for each in deadlines if each is not None), default=None)

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        return []

    @abstractmethod
    def _publish(self, instants: list[CanFrameSet], now: HostTime) -> list[Output[CanFrame]]:
        """Make the samples of complete and expired instants."""

    def _on_usable(self, now: HostTime, text: str) -> list[Output[CanFrame]]:
        """Record usable data; report `text` at the first."""
        self._restart_silence_timer(now)
        if self.phase is EndpointPhase.STREAMING:
            return []
        self.phase = EndpointPhase.STREAMING
        return [EndpointStatus(EndpointPhase.STREAMING, text)]

    def _on_malformed_frame(self, frame: CanFrame, error: FrameError) -> list[Output[CanFrame]]:
        """Count a malformed frame; reported once per kind."""
        self.counts[f"rejected.{error.reason}"] += 1
        self._note_useless(f"{self._needed[frame.key]} ({frame.key}) {error.summary}")
        if frame.key in self._reported:
            return []
        self._reported.add(frame.key)
        return [EndpointStatus(self.phase, f"{error}; such frames are counted and not used", is_warning=True)]

    def _note_useless(self, what: str) -> None:
        """Note what is wrong with a frame, or with the frames of an instant."""
        if what in self._useless or len(self._useless) < MAX_SEEN:
            self._useless[what] += 1

    def _note_empty(self) -> None:
        """Count an instant without any value."""
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
            if (signal.path, name) not in self._reported:
                self._reported.add((signal.path, name))
                outputs.append(EndpointStatus(self.phase, text, is_warning=True))
        return outputs

    def _on_error_frame(self, frame: CanFrame) -> list[Output[CanFrame]]:
        """Process an error frame of the interface; bus-off requests a reopening, once."""
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
        return ", ".join(f"{name} ({key})" for key, name in sorted(self._needed.items()))
