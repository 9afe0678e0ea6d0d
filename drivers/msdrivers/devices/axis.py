"""The driver of a nodding axis on Modbus/TCP: reads angle and rate, and tells it how to nod."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from modelserver.messages import JointsSample, SensorHeader
from msdrivers.devices.axis_nod import Nodding
from msdrivers.devices.axis_readings import Readings
from msdrivers.devices.axis_settings import AxisSettings, NodMap
from msdrivers.protocol.bounded_counter import BoundedCounter
from msdrivers.protocol.modbus.registers import (
    FailureKind,
    ModbusFailure,
    ModbusUnit,
    ReadRegisters,
    Registers,
    Table,
    WriteRegisters,
    Written,
    described,
    explain,
    fits,
)
from msdrivers.station import Measured, Now, Output, Reopen, Send, StationPhase, StationStatus

BUSY = (5, 6)
"""Exceptions of a device that will do it later."""


class _Asked(NamedTuple):
    """The request that waits for its reply."""

    request: ReadRegisters | WriteRegisters
    sent_ns: int
    is_poll: bool


class AxisDriver:
    """A `Station` of `ModbusUnit`; see `AxisSettings`. One request is under way at a time.

    A reading is taken in the middle between request and reply: a sample's delay is half the time between, its sigma
    that of an instant anywhere between. On leaving, the registers that were written get back what was found in them.
    """

    def __init__(self, settings: AxisSettings):
        """Take the settings."""
        self.settings = settings
        registers = settings.registers
        self._table = Table(registers.table)
        self._length = max(each.address + each.registers for each in registers.measured.values()) - registers.begin
        self._readings = Readings(settings)
        self._nodding = Nodding(settings)
        self._nod = settings.nod
        self._asked: _Asked | None = None
        self._transaction = 0
        self._period_ns = round(1e9 / settings.poll_hz)
        self._next_ns = 0
        self._step_ns = 0
        self._heard_ns = self._usable_ns = 0
        self._silent_ns: int | None = None
        self._is_open = False
        self._told: set[str] = set()
        self._phase = StationPhase.WAITING
        self._seq = 0
        self._counts = BoundedCounter()

    def opened(self, now: Now) -> list[Output[ModbusUnit]]:
        """Begin: set the nodding up, then read."""
        self._is_open, self._asked = True, None
        self._readings.clear()
        self._told.clear()
        self._phase = StationPhase.WAITING
        self._next_ns = self._step_ns = self._heard_ns = self._usable_ns = now.monotonic_ns
        self._silent_ns = now.monotonic_ns + self._silence_ns
        if self._nod is not None:
            self._nodding.begin(self._nod)
        return [StationStatus(self._phase, f"asking the axis for joint {self.settings.joint}"), *self._ask(now)]

    def nod(self, nod: NodMap, now: Now) -> list[Output[ModbusUnit]]:
        """Nod otherwise from now on; what the axis cannot do is refused and told."""
        why = self.settings.against(nod)
        if why:
            self._counts["rejected.nod"] += 1
            return [StationStatus(self._phase, f"nodding refused: {why}", is_trouble=True)]
        self._nod = nod
        self._told -= {"nod"}
        if not self._is_open:
            return []
        self._nodding.begin(nod)
        # a step that is under way belongs to the wish before
        if self._asked is not None and not self._asked.is_poll:
            self._asked = None
        return self._ask(now)

    def received(self, unit: ModbusUnit, now: Now) -> list[Output[ModbusUnit]]:
        """Take a reply, or the word that there is none."""
        if isinstance(unit, ModbusFailure) and unit.kind is FailureKind.LINE:
            return self._broken(f"the line to the axis broke: {unit.text}")
        asked = self._asked
        if asked is None or unit.transaction != asked.request.transaction or not self._is_open:
            self._counts["rejected.stale"] += 1
            return []
        if isinstance(unit, ModbusFailure):
            if unit.kind is FailureKind.SILENCE:
                return self._unanswered(now)
            return self._refused(asked, unit, now)
        self._asked = None
        self._heard_ns = now.monotonic_ns
        if not fits(unit, asked.request):
            self._counts["rejected.length"] += 1
            return self._tell(
                "length",
                f"the reply to {described(asked.request)} has another address or number of registers; it is not used",
            ) + self._ask(now)
        if asked.is_poll and isinstance(unit, Registers):
            return self._measured(unit, asked, now) + self._ask(now)
        outputs: list[Output[ModbusUnit]] = []
        if isinstance(unit, Registers | Written):
            said = self._nodding.done(unit)
            if said:
                self._counts["readback"] += 1
                outputs.append(StationStatus(self._phase, said, is_trouble=True))
            elif not self._nodding.step:
                outputs.append(StationStatus(self._phase, "the axis nods as it was told"))
        return outputs + self._ask(now)

    def woken(self, now: Now) -> list[Output[ModbusUnit]]:
        """Ask, or see that nothing comes."""
        outputs: list[Output[ModbusUnit]] = []
        if self._asked is not None and now.monotonic_ns >= self._asked.sent_ns + self._reply_ns:
            outputs += self._unanswered(now)
        if self._silent_ns is not None and now.monotonic_ns >= self._silent_ns:
            self._silent_ns = None
            # an axis that does not answer at all is told by and by, when the line is opened anew
            if self._heard_ns > self._usable_ns:
                self._phase = StationPhase.SILENT
                self._counts["silences"] += 1
                why = f"no usable reading for {self.settings.silence:g} s although the axis answers"
                outputs.append(StationStatus(StationPhase.SILENT, f"{why}; the counters say what was rejected"))
        return outputs + self._ask(now)

    def due(self) -> int | None:
        """Return when to be woken."""
        if not self._is_open:
            return None
        if self._asked is not None:
            next_ns = self._asked.sent_ns + self._reply_ns
        else:
            next_ns = min(self._next_ns, self._step_ns) if self._nodding.step else self._next_ns
        return next_ns if self._silent_ns is None else min(next_ns, self._silent_ns)

    def leaving(self, now: Now) -> list[Output[ModbusUnit]]:
        """Write back what was found before this driver wrote."""
        self._is_open = False
        return [Send(replace(request, transaction=self._new_transaction())) for request in self._nodding.restored()]

    @property
    def quiet(self) -> float:
        """Seconds for which nothing need come."""
        return self.settings.silence

    @property
    def counts(self) -> Mapping[str, int]:
        """Polls, samples, unanswered requests, skipped polls, and what was rejected by reason."""
        return self._counts

    @property
    def _reply_ns(self) -> int:
        return round(self.settings.reply * 1e9)

    @property
    def _silence_ns(self) -> int:
        return round(self.settings.silence * 1e9)

    def _ask(self, now: Now) -> list[Output[ModbusUnit]]:
        """Send what is due, if nothing is under way: a reading, else a step of the nodding's set-up between two."""
        at = now.monotonic_ns
        if self._asked is not None or not self._is_open:
            return []
        is_poll = at >= self._next_ns
        if not is_poll and not (self._nodding.step and at >= self._step_ns):
            return []
        transaction = self._new_transaction()
        request = None if is_poll else self._nodding.request(transaction)
        if request is None:
            request = ReadRegisters(self.settings.registers.begin, self._length, self._table, transaction)
            self._counts["polls"] += 1
            late = (at - self._next_ns) // self._period_ns
            self._counts["skipped"] += late
            self._next_ns += (late + 1) * self._period_ns
        self._asked = _Asked(request, at, is_poll)
        return [Send(request)]

    def _new_transaction(self) -> int:
        self._transaction = self._transaction % 0xFFFF + 1
        return self._transaction

    def _measured(self, unit: Registers, asked: _Asked, now: Now) -> list[Output[ModbusUnit]]:
        turn_ns = now.monotonic_ns - asked.sent_ns
        joint, word = self._readings.take(unit.values, asked.sent_ns + turn_ns // 2, turn_ns // 2)
        if word:
            self._counts[word if word == "repeated" else f"rejected.{word}"] += 1
        told = self._tell(word, _WORDS[word]) if word else []
        if joint is None:
            return told
        self._usable_ns = now.monotonic_ns
        self._silent_ns = now.monotonic_ns + self._silence_ns
        header = SensorHeader(now.utime, self.settings.source, self._seq, now.utime)
        self._seq += 1
        self._counts["samples"] += 1
        if self._phase is not StationPhase.STREAMING:
            self._phase = StationPhase.STREAMING
            told = [StationStatus(self._phase, f"the axis tells joint {self.settings.joint}"), *told]
            self._told -= {"refused", "length"}
        turn = turn_ns * 1e-9
        return [*told, Measured(JointsSample(header, (joint,)), turn / 2.0, turn / math.sqrt(12.0))]

    def _unanswered(self, now: Now) -> list[Output[ModbusUnit]]:
        self._counts["unanswered"] += 1
        self._asked = None
        if now.monotonic_ns - self._heard_ns < self._silence_ns:
            return self._ask(now)
        why = f"the axis has not answered for {self.settings.silence:g} s"
        return self._broken(f"{why}; check its power, the network cable, address and port")

    def _refused(self, asked: _Asked, failure: ModbusFailure, now: Now) -> list[Output[ModbusUnit]]:
        self._counts.add(f"rejected.exception_{failure.code}")
        self._asked = None
        self._heard_ns = now.monotonic_ns
        again_ns = now.monotonic_ns + round(self.settings.retry * 1e9)
        if asked.is_poll:
            self._next_ns = again_ns
            if failure.code not in BUSY:
                self._phase = StationPhase.SILENT
            text = f"the axis refuses {described(asked.request)}: {explain(failure.code)}; asked again every"
            return self._tell("refused", f"{text} {self.settings.retry:g} s, nothing is published")
        text = f"the axis refuses {self._nodding.step}: {explain(failure.code)}"
        if failure.code in BUSY:
            self._step_ns = again_ns
            return [*self._tell("nod", f"{text}; trying again"), *self._ask(now)]
        self._nodding.drop()
        return [*self._tell("nod", f"{text}; it is read and not told how to nod"), *self._ask(now)]

    def _broken(self, why: str) -> list[Output[ModbusUnit]]:
        if not self._is_open:
            return []
        self._is_open, self._asked, self._silent_ns = False, None, None
        self._phase = StationPhase.SILENT
        self._counts["broken"] += 1
        return [StationStatus(StationPhase.SILENT, why), Reopen(why)]

    def _tell(self, word: str, text: str) -> list[Output[ModbusUnit]]:
        if word in self._told:
            return []
        self._told.add(word)
        return [StationStatus(self._phase, text, is_trouble=True)]


_WORDS = {
    "repeated": "the axis's number of measurements stands still; a reading with the same number is not published",
    "range": "an angle beyond lowest_deg and highest_deg; are scale_deg, is_signed and high_word_first right?",
    "jump": "an angle that the axis cannot have come to since the last reading; it is not published",
    "rate": "a rate above fastest_deg; is the scale of `rate` right? It is published as not measured",
}
