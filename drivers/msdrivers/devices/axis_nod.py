"""Setting up the nodding: what was there is read, what is wished is written, what was taken is read back."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

from msdrivers.devices.axis_settings import AxisSettings, NodMap
from msdrivers.protocol.modbus.numbers import RegisterMap
from msdrivers.protocol.modbus.registers import ReadRegisters, Registers, WriteRegisters, Written


class _Read(NamedTuple):
    """Read a commanded register: what was `wanted` there in degrees, None to remember what is found."""

    name: str
    wanted: float | None


class _Write(NamedTuple):
    """Write a commanded register, degrees."""

    name: str
    degrees: float


_Step: TypeAlias = _Read | _Write


class Nodding:
    """The steps that are left. One is asked at a time, and either `done` or tried again."""

    def __init__(self, settings: AxisSettings):
        """Take the settings."""
        self._registers: Mapping[str, RegisterMap] = settings.registers.commanded
        self._steps: deque[_Step] = deque()
        self._nod: NodMap | None = None
        self.found: dict[str, tuple[int, ...]] = {}
        """What was in the commanded registers before anything was written, by name."""
        self._holds: dict[str, float] = {}

    def begin(self, nod: NodMap) -> None:
        """Begin to bring a wish about, in place of what was under way."""
        self._nod = nod
        self._steps = deque(_Read(name, None) for name in self._registers)

    def drop(self) -> None:
        """Leave out what is left."""
        self._steps.clear()

    @property
    def step(self) -> str:
        """What is to be done next, for a person; empty when all is done."""
        if not self._steps:
            return ""
        step = self._steps[0]
        mapped = self._registers[step.name]
        verb = "reading" if isinstance(step, _Read) else f"writing {step.degrees:g} to"
        return f"{verb} {step.name} (register {mapped.address})"

    def request(self, transaction: int) -> ReadRegisters | WriteRegisters | None:
        """Return what to ask for the next step; None when all is done."""
        if not self._steps:
            return None
        step = self._steps[0]
        mapped = self._registers[step.name]
        if isinstance(step, _Read):
            return ReadRegisters(mapped.address, mapped.registers, transaction=transaction)
        return WriteRegisters(mapped.address, mapped.of_degrees(step.degrees), transaction)

    def done(self, reply: Registers | Written) -> str:
        """Go on after the reply to the step; return what there is to tell, empty where all is as wished."""
        step = self._steps.popleft()
        told = ""
        if isinstance(step, _Write):
            self._holds[step.name] = step.degrees
        if isinstance(step, _Read) and isinstance(reply, Registers):
            mapped = self._registers[step.name]
            self._holds[step.name] = mapped.degrees(reply.values)
            if step.wanted is None:
                self.found.setdefault(step.name, reply.values)
            elif tuple(reply.values) != mapped.of_degrees(step.wanted):
                told = (
                    f"{step.name} is {self._holds[step.name]:g} where {step.wanted:g} was written: the axis's own limit"
                )
        if not self._steps and self._nod is not None:
            self._plan(self._nod)
        return told

    def restored(self) -> list[WriteRegisters]:
        """Return what brings the registers back to what was found."""
        if not self.found or self.found.keys() != self._registers.keys():
            return []
        degrees = {name: self._registers[name].degrees(words) for name, words in self.found.items()}
        order = _order(degrees["lower_limit"], self._holds["upper_limit"])
        return [WriteRegisters(self._registers[name].address, self.found[name]) for name in order]

    def _plan(self, nod: NodMap) -> None:
        wanted = {"lower_limit": nod.lower_deg, "upper_limit": nod.upper_deg, "nod_rate": nod.rate_deg}
        order = _order(nod.lower_deg, self._holds["upper_limit"])
        self._steps.extend(_Write(name, wanted[name]) for name in order)
        self._steps.extend(_Read(name, wanted[name]) for name in order)
        self._nod = None


def _order(lower: float, present_upper: float) -> tuple[str, ...]:
    """Return in which order to write, so that the lower limit is never above the upper one."""
    if lower >= present_upper:
        return ("upper_limit", "lower_limit", "nod_rate")
    return ("lower_limit", "upper_limit", "nod_rate")
