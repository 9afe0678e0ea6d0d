"""How a 3DM-GX1 is to be used."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from msdrivers.protocol.gx1 import DATA, CommandByte


class HeadingSource(Enum):
    """Where the yaw of the device's own orientation comes from, as it is set up."""

    VERTICAL_GYRO = "vertical_gyro"
    """From its gyros alone: it begins anywhere and drifts."""
    MAGNETIC = "magnetic"
    """From its magnetometers."""


@dataclass(frozen=True, slots=True)
class Gx1Settings:
    """How to use the device. Seconds; raises ValueError where one setting contradicts another.

    message: what is streamed, one of `protocol.gx1.DATA`. polled: another of them that is polled every `poll_period`.
    heading: what the yaw of a stabilised orientation is; an instantaneous one is always magnetic.
    temperature_period: between polls of the temperature, 0 for never.
    capture_bias_at_start: let the device find its gyros' biases once, at the first set-up; the vehicle must stand.
    bauds: the rates to try; the line is opened at the first. Empty: the line has none.
    silence: without a streamed message for so long the device is set up anew.
    tick: of the device's timer; None to take it from the EEPROM.
    specific_force_sign: 1 where the device's acceleration is specific force, against gravity at rest, -1 where it is
    its opposite: documents differ, and the driver says which it is when the device rests.
    delay, delay_sigma: from the measurement to the instant that its ticks name.
    """

    source: str
    message: int = CommandByte.EULER_VECTORS
    heading: HeadingSource = HeadingSource.VERTICAL_GYRO
    polled: int | None = None
    poll_period: float = 0.1
    temperature_period: float = 10.0
    capture_bias_at_start: bool = False
    bauds: tuple[int, ...] = (38400, 115200)
    silence: float = 0.5
    tick: float | None = None
    specific_force_sign: int = 1
    delay: float = 0.0
    delay_sigma: float = 0.0

    def __post_init__(self) -> None:
        known = ", ".join(str(int(command)) for command in sorted(DATA))
        for name, command in (("message", self.message), ("polled", self.polled)):
            if command is not None and command not in DATA:
                raise ValueError(f"{name}: {command} is no measurement of a 3DM-GX1; there are {known}")
        if self.polled == self.message:
            raise ValueError(f"polled: {int(self.message)} is streamed already; leave it out or choose another")
        if (
            CommandByte.INSTANTANEOUS_EULER in (self.message, self.polled)
            and self.heading is HeadingSource.VERTICAL_GYRO
        ):
            raise ValueError(
                "heading: the instantaneous orientation (13) has its yaw from the magnetometers, which a vertical "
                "gyro does not use; choose heading magnetic, or the stabilised orientation (14)"
            )
        if self.specific_force_sign not in (1, -1):
            raise ValueError(f"specific_force_sign: must be 1 or -1, got {self.specific_force_sign}")
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds: must be above 0, got {self.bauds}")
        for name, value, least in (
            ("poll_period", self.poll_period, 0.01),
            ("silence", self.silence, 0.05),
            ("tick", 0.01 if self.tick is None else self.tick, 1e-4),
            ("temperature_period", self.temperature_period, 0.0),
            ("delay_sigma", self.delay_sigma, 0.0),
        ):
            if not least <= value < 1e6:
                raise ValueError(f"{name}: must be at least {least:g} s, got {value:g}")
