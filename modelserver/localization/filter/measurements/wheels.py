"""What wheels measure: the speed of each contact point along the way it rolls."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np

from modelserver.localization.filter.layout import ErrorState
from modelserver.localization.filter.measurements.base import INSTANT, Compared, Scene, register
from modelserver.localization.filter.nav import jacobian_of_body_velocity
from modelserver.localization.filter.settings import FilterSettings
from modelserver.localization.rig import Rig
from modelserver.messages import WheelsSample
from modelserver.spatial.so3 import Vector3, cross

SCALE, YAW = "wheel_scale", "wheel_yaw"
"""How much too far all wheels tell, and by how much the way they roll is turned to the left of the geometry's x."""

EASED = 4.0
"""Up to so many times its limit a slip is used with wider noise: twice what the gate lets through."""

LONGEST = 1.0
"""Seconds between two samples over which travel still tells a speed."""


def wheel_states(settings: FilterSettings) -> tuple[ErrorState, ...]:
    """Return the error states of wheels."""
    return (
        ErrorState((SCALE,), settings.wheel_scale_sigma, settings.wheel_scale_walk),
        ErrorState((YAW,), settings.wheel_yaw_sigma, settings.wheel_yaw_walk),
    )


class Rolling(NamedTuple):
    """One wheel between two samples: mean speed (m/s) and its variance, steering (rad), contact point (body axes, m).

    `mean`: of the whole time between, from travel; else of the instant.
    """

    speed: float
    variance: float
    steering: float
    contact: Vector3
    mean: bool


def rolling(
    sample: WheelsSample, before: WheelsSample | None, contacts: dict[str, Vector3], settings: FilterSettings
) -> list[Rolling]:
    """Return what each known wheel of a sample tells: from its travel since the sample before, else from its speed."""
    dt = 0.0 if before is None else (sample.header.utime - before.header.utime) * 1e-6
    earlier = {wheel.name: wheel for wheel in before.wheels} if before is not None and 0.0 < dt <= LONGEST else {}
    found = []
    for wheel in sample.wheels:
        contact = contacts.get(wheel.name)
        if contact is None or not math.isfinite(wheel.steering):
            continue
        last = earlier.get(wheel.name)
        way = wheel.travel - last.travel if last is not None else math.nan
        if math.isfinite(way):
            sigma = wheel.travel_sigma if 0.0 < wheel.travel_sigma < 10.0 else settings.wheel_sigma * 0.5
            found.append(Rolling(way / dt, 2.0 * (sigma / dt) ** 2, wheel.steering, contact, True))
        elif math.isfinite(wheel.speed):
            sigma = wheel.speed_sigma if 0.0 < wheel.speed_sigma < 10.0 else settings.wheel_sigma
            found.append(Rolling(wheel.speed, sigma * sigma, wheel.steering, contact, False))
    return found


@register
@dataclass(frozen=True, slots=True)
class WheelSpeed:
    """Speed of the wheels: measured = (1 + scale) d . (v + w x c), d the way a wheel rolls, c its contact point.

    Each wheel is one number; of a skid-steered vehicle, whose wheels slide in every turn, the mean of all is.
    """

    kind: ClassVar[str] = "wheel_speed"
    sample: ClassVar[type] = WheelsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()
    contacts: dict[str, Vector3]
    skid: bool
    half_track: float
    imu: Vector3

    @classmethod
    def of(cls, rig: Rig, settings: FilterSettings) -> Self | None:
        """Return it where the vehicle file names wheels."""
        if not rig.wheel_frames:
            return None
        contacts = {name: rig.pose(frame).xyz for name, frame in rig.wheel_frames.items()}
        half = max(abs(contact[1]) for contact in contacts.values())
        return cls(contacts, rig.kinematics == "skid_steer", half, rig.imu)

    def instant(self, sample: WheelsSample) -> int | None:
        """Return the sample's stamp."""
        return sample.header.utime

    def compare(self, scene: Scene, sample: WheelsSample) -> Compared | str:
        """Compare the mean speeds since the sample before with the mean motion since then, or speeds of the instant."""
        settings = scene.settings
        wheels = rolling(sample, scene.before, self.contacts, settings)
        if not wheels:
            known = any(wheel.name in self.contacts for wheel in sample.wheels)
            return ("nan" if known else "names") if sample.wheels else "empty"
        top = settings.maximum_speed
        if not all(abs(wheel.speed) <= top for wheel in wheels):
            return "range"
        if self.skid:
            wheels = [_mean(wheels)]
        return self._compared(scene, wheels)

    def by_travel(self, sample: WheelsSample, before: WheelsSample | None) -> bool:
        """Return whether a wheel tells the way since a sample before."""
        earlier = {wheel.name: wheel.travel for wheel in before.wheels} if before is not None else {}
        return any(math.isfinite(wheel.travel - earlier.get(wheel.name, math.nan)) for wheel in sample.wheels)

    def _compared(self, scene: Scene, wheels: list[Rolling]) -> Compared:
        nav, layout, settings = scene.nav, scene.layout, scene.settings
        dt = scene.age
        scale, yaw = 1.0 + scene.extra(SCALE), scene.extra(YAW)
        base = scene.rig.base
        now = nav.body_velocity(base)
        rate = nav.turn_rate
        residuals, rows, noises = [], [], []
        body = jacobian_of_body_velocity(nav, base, layout.size)
        for wheel in wheels:
            if wheel.mean:
                motion = nav.rolled
                swing = cross(nav.turned, wheel.contact)
                v = (
                    (motion[0] + swing[0]) / dt,
                    (motion[1] + swing[1]) / dt,
                    (motion[2] + swing[2]) / dt,
                )
            else:
                swing = cross(rate, wheel.contact)
                v = (now[0] + swing[0], now[1] + swing[1], now[2] + swing[2])
            c, s = math.cos(wheel.steering + yaw), math.sin(wheel.steering + yaw)
            along = c * v[0] + s * v[1]
            row = scale * (c * body[0] + s * body[1])
            # an error of the gyro's bias changes w x c by c x error: d . (c x error) = (d x c) . error
            x, y, z = wheel.contact
            row[9:12] += (scale * s * z, -scale * c * z, scale * (c * y - s * x))
            row[layout.index(SCALE)] = along
            row[layout.index(YAW)] = scale * (c * v[1] - s * v[0])
            residuals.append(wheel.speed - scale * along)
            rows.append(row)
            variance = wheel.variance
            if not wheel.mean:
                # the rate of the instant has the gyro's noise, which a longer way averages
                variance += ((c * y - s * x) * settings.gyro_noise) ** 2 / INSTANT
            noises.append(variance + self._slip(nav.force, along, rate[2], settings) * _lasting(dt, settings))
        return Compared(np.array(residuals), np.array(rows), np.diag(noises), separable=True, eased=EASED)

    def _slip(self, force: Vector3, speed: float, turn: float, settings: FilterSettings) -> float:
        """Return the variance of slip, (m/s)2: on firm ground, under acceleration, and of a skid-steered in turns."""
        push = min(abs(force[0]), 5.0)
        share = settings.slip_share + settings.slip_acceleration * push
        turning = settings.slip_turn * turn * self.half_track if self.skid else 0.0
        return (share * speed) ** 2 + turning * turning


def _lasting(dt: float, settings: FilterSettings) -> float:
    """Return by how much a noise that lasts must be widened where samples `dt` seconds apart count as independent."""
    return max(settings.slip_time / dt, 1.0) if 0.0 < dt < settings.slip_time else 1.0


def _mean(wheels: list[Rolling]) -> Rolling:
    """Return the mean of the left and of the right wheels, so that the turn falls out, also with a wheel missing."""
    sides: dict[bool, list[Rolling]] = {}
    for wheel in wheels:
        sides.setdefault(wheel.contact[1] > 0.0, []).append(wheel)
    speed = variance = y = z = 0.0
    for side in sides.values():
        part = 1.0 / (len(side) * len(sides))
        for wheel in side:
            speed += part * wheel.speed
            variance += part * part * wheel.variance
            y, z = y + part * wheel.contact[1], z + part * wheel.contact[2]
    # along x the mean contact point does not matter to the way it rolls, and in a skid nothing rolls about it
    return Rolling(speed, variance, 0.0, (0.0, y, z), all(wheel.mean for wheel in wheels))


def standing_wheels(
    sample: WheelsSample, before: WheelsSample | None, contacts: dict[str, Vector3], settings: FilterSettings
) -> bool | None:
    """Return whether the wheels stand; None where they do not tell."""
    wheels = rolling(sample, before, contacts, settings)
    if not wheels:
        return None
    return all(abs(wheel.speed) <= settings.standing_speed for wheel in wheels)


def turn_rate(
    sample: WheelsSample, before: WheelsSample | None, measurement: WheelSpeed, settings: FilterSettings
) -> float:
    """Return the turn rate that the wheels tell, rad/s; 0 where they do not.

    Each wheel rolls at d . (v + w x c): two unknowns, forward speed and turn rate, by least squares. A skid-steered
    vehicle's wheels slide: it turns by less than its sides' difference says, how much less nobody knows.
    """
    wheels = rolling(sample, before, measurement.contacts, settings)
    if len(wheels) < 2:
        return 0.0
    rows = []
    for wheel in wheels:
        c, s = math.cos(wheel.steering), math.sin(wheel.steering)
        x, y, _ = wheel.contact
        rows.append((c, s * x - c * y))
    A = np.array(rows)
    found, _, rank, _ = np.linalg.lstsq(A, np.array([wheel.speed for wheel in wheels]), rcond=1e-6)
    return float(found[1]) if rank == 2 and abs(found[1]) < 10.0 else 0.0
