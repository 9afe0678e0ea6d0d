"""Settings of the driver of a 3DM-GX1."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from msdrivers.protocol.gx1 import MEASUREMENTS, CommandByte


class HeadingSource(Enum):
    """Source of the yaw of the device's own orientation."""

    VERTICAL_GYRO = "vertical_gyro"
    """From its gyros alone: it begins anywhere and drifts."""
    MAGNETIC = "magnetic"
    """From its magnetometers."""


@dataclass(frozen=True, slots=True)
class Gx1Settings:
    """Settings of the device. Seconds; raises ValueError with the key for an invalid value.

    message: the streamed message, one of `protocol.gx1.MEASUREMENTS`. polled: another of them, polled every
    `poll_period`.
    heading: what the yaw of a stabilized orientation is; an instantaneous one is always magnetic.
    temperature_period: between polls of the temperature, 0 for never.
    capture_bias_at_start: capture the gyro biases once, at the first setup; the vehicle must be stationary.
    bauds: the rates to try; the line is opened at the first. Empty: the line has none.
    silence: timeout for streamed messages, after which the setup is repeated.
    tick: of the device's timer; None to take it from the EEPROM.
    specific_force_sign: 1 if the device's acceleration is specific force, -1 if it is the opposite: documents differ,
    and the driver reports which it is while the device is stationary.
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
        known = ", ".join(str(int(command)) for command in sorted(MEASUREMENTS))
        for name, command in (("message", self.message), ("polled", self.polled)):
            if command is not None and command not in MEASUREMENTS:
                raise ValueError(f"{name}: {command} is no measurement of a 3DM-GX1; there are {known}")
        if self.polled == self.message:
            raise ValueError(f"polled: {int(self.message)} is streamed already; leave it out or choose another")
        if (
            CommandByte.INSTANTANEOUS_EULER in (self.message, self.polled)
            and self.heading is HeadingSource.VERTICAL_GYRO
        ):
            raise ValueError(
                "heading: the instantaneous orientation (13) has its yaw from the magnetometers, which a vertical "
                "gyro does not use; choose heading magnetic, or the stabilized orientation (14)"
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
