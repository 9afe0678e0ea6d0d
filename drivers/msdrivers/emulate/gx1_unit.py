"""Configuration, EEPROM, clock and faults of an emulated 3DM-GX1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from modelserver.transforms.so3 import Vector3
from msdrivers.emulate.faults import InjectedFault
from msdrivers.protocol.gx1 import EepromAddress, Gains
from msdrivers.protocol.gx1.scaling import tick_from_timer_words

GAINS = Gains(8500, 7000, 2000)


@dataclass(frozen=True, slots=True)
class Eeprom:
    """The device's memory: it outlives restarts. 128 words, unsigned, at even addresses 0..254."""

    words: tuple[int, ...] = (0,) * 128

    @classmethod
    def make_factory(cls, gains: Gains = GAINS, hundred_hertz: bool = True) -> Eeprom:
        """Return one with gains, and the timer words of 100 Hz or those of 6.5536 ms a tick."""
        timer = (4, 10, 250, 10) if hundred_hertz else (16, 16, 256, 1)
        words = dict(zip(EepromAddress.TIMER, timer, strict=True))
        return cls().write(words | dict(zip(EepromAddress.GAINS, gains, strict=True)))

    def read_word(self, address: int) -> int:
        """Return a word; 0 at an invalid address."""
        return self.words[address // 2] if 0 <= address < 256 and address % 2 == 0 else 0

    def write(self, changes: Mapping[int, int]) -> Eeprom:
        """Return the memory with words changed."""
        words = list(self.words)
        for address, value in changes.items():
            words[address // 2] = value & 0xFFFF
        return Eeprom(tuple(words))


@dataclass(frozen=True, slots=True)
class Gx1Unit:
    """One device. SI units.

    cycle_ticks: ticks from one streamed reply to the next. tick_offset: its ticks when it starts. drift: how much
    faster its clock runs than the host's, as a fraction. delay: from a measurement until it is sent. boot_time: how
    long it is silent after a restart. field_offset: its own magnetic field, which its hard-iron offsets are to remove.
    gyro_bias: bias of its gyros. force_sign: 1 if it reports specific force, -1 for its opposite.
    celsius: its temperature. streamed_at_start: the command that it streams when the line is opened, 0 for none.
    faults: `drop` or `corrupt` the next `amount` replies, `stall` for `amount` seconds, `restart`, `jump` by `amount`
    ticks.
    """

    serial: int = 1234
    firmware: int = 3100
    cycle_ticks: int = 1
    tick_offset: int = 0
    drift: float = 0.0
    delay: float = 0.003
    boot_time: float = 1.0
    bias_capture: float = 3.0
    field_offset: Vector3 = (0.0, 0.0, 0.0)
    gyro_bias: Vector3 = (0.0, 0.0, 0.0)
    force_sign: int = 1
    celsius: float = 23.0
    streamed_at_start: int = 0
    faults: tuple[InjectedFault, ...] = ()

    def __post_init__(self) -> None:
        for fault in self.faults:
            if fault.kind not in ("drop", "corrupt", "stall", "restart", "jump"):
                raise ValueError(f"kind: there are drop, corrupt, stall, restart, jump; got {fault.kind!r}")


@dataclass(frozen=True, slots=True)
class UnitClock:
    """The device's clock since it was switched on at `started_ns`, monotonic nanoseconds of the host.

    tick_s: seconds of a tick by the device. drift: how much faster it runs than the host's clock. offset: ticks that
    it began with.
    """

    started_ns: int
    tick_s: float
    drift: float
    offset: int

    @classmethod
    def make(cls, eeprom: Eeprom, unit: Gx1Unit, started_ns: int, offset: int) -> UnitClock:
        """Return the clock as the timer words have it; 10 ms a tick where they are zero."""
        tick_s = tick_from_timer_words(map(eeprom.read_word, EepromAddress.TIMER))
        return cls(started_ns, tick_s or 0.01, unit.drift, offset)

    def instant_of(self, tick: int) -> int:
        """Return when a tick since the start begins."""
        return self.started_ns + round(tick * self.tick_s / (1.0 + self.drift) * 1e9)

    def ticks_at(self, at_ns: int) -> int:
        """Return the counter at an instant."""
        # a nanosecond more, lest the instant of a tick rounds to the one before
        seconds = ((at_ns - self.started_ns) * 1e-9 + 1e-9) * (1.0 + self.drift)
        return (int(seconds / self.tick_s) + self.offset) % 65536
