"""Measurement models of IMU orientation and magnetometer heading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.estimation.filter.layout import ErrorState
from modelserver.estimation.filter.measurements.base import Compared, Scene, azimuth, register, wrapped
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.magnetometer import MagnetometerCalibration, magnetic_field
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import ImuSample, OrientationReference, YawSource
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

PERIOD = 0.5
"""Seconds between two uses: the unit's own filter and the field's disturbances change no faster."""

_HALF = math.sqrt(0.5)
_ENU_FROM = {
    OrientationReference.ENU: so3.IDENTITY,
    # east, north, up of a vector of north, east, down: half a turn about the line between east and north
    OrientationReference.NED: (0.0, _HALF, _HALF, 0.0),
}


def attitude_in_enu(sample: ImuSample, q_body_imu: Quaternion) -> Quaternion | None:
    """Return the body's attitude by the unit's own word, its reference turned to east, north, up; None: not told."""
    turn = _ENU_FROM.get(sample.orientation_reference)
    if sample.orientation is None or turn is None or not all(map(math.isfinite, sample.orientation)):
        return None
    try:
        q = so3.normalize(sample.orientation)
    except ValueError:
        return None
    return so3.normalize(so3.multiply(so3.multiply(turn, q), so3.conjugate(q_body_imu)))


@dataclass(frozen=True, slots=True)
class _OfUnit:
    mount: Quaternion

    @classmethod
    def of(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls(rig.pose(rig.imu_frame).wxyz) if rig.imu_frame else None


@register
class Tilt(_OfUnit):
    """The vertical by the unit's own orientation: its up along the body against the state's."""

    kind: ClassVar[str] = "imu_tilt"
    sample: ClassVar[type] = ImuSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: ImuSample) -> int | None:
        """Return the sample's stamp; None where it tells no orientation."""
        return sample.header.utime if sample.orientation is not None else None

    def compare(self, scene: Scene, sample: ImuSample) -> Compared | str:
        """Compare the two horizontal components of the unit's up, along N's axes: up_told - up = theta x up."""
        if scene.age < PERIOD:
            return ""
        told = attitude_in_enu(sample, self.mount)
        if told is None:
            return "orientation"
        up = so3.rotate(so3.conjugate(told), (0.0, 0.0, 1.0))
        x, y, z = so3.rotate(scene.nav.attitude, up)
        # R_told' e = R_true' e; R R_true' e = exp(-theta) e = e - theta x e
        H = scene.jacobian(2)
        H[0, 7], H[1, 6] = -z, z
        settings = scene.settings
        lasting = max(settings.orientation_time / min(scene.age, settings.orientation_time), 1.0)
        R = np.eye(2) * settings.orientation_sigma**2 * lasting
        return Compared(np.array((x, y)), H, R)


@register
class Yaw(_OfUnit):
    """Yaw by the unit's own orientation, where it is against north and magnetic headings are used (report 5.1)."""

    kind: ClassVar[str] = "imu_yaw"
    sample: ClassVar[type] = ImuSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: ImuSample) -> int | None:
        """Return the sample's stamp; None where its yaw has no zero."""
        return None if sample.orientation is None or sample.yaw_source is YawSource.NONE else sample.header.utime

    def compare(self, scene: Scene, sample: ImuSample) -> Compared | str:
        """Compare yaw."""
        if scene.age < PERIOD or scene.site is None:
            return ""
        told = yaw_told(scene, sample, self.mount)
        if isinstance(told, str):
            return told
        magnetic = sample.yaw_source is YawSource.MAGNETIC
        expected, H = azimuth(so3.rotate(scene.nav.attitude, (1.0, 0.0, 0.0)), scene.layout.size)
        settings = scene.settings
        sigma = settings.magnetic_sigma if magnetic else settings.orientation_sigma
        lasting = max(settings.magnetic_time / min(scene.age, settings.magnetic_time), 1.0)
        unused = "vertical_gyro" if magnetic and not settings.use_magnetometer else ""
        return Compared(np.array((wrapped(told - expected),)), H, np.array(((sigma * sigma * lasting,),)), unused)


@register
@dataclass(frozen=True, slots=True)
class Magnetometer:
    """Heading by the magnetic field: calibrated, against the world magnetic model's direction at the place."""

    kind: ClassVar[str] = "magnetometer"
    sample: ClassVar[type] = ImuSample
    states: ClassVar[tuple[ErrorState, ...]] = ()
    mount: Quaternion
    calibration: MagnetometerCalibration

    @classmethod
    def of(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return it where there is an inertial unit."""
        return cls(rig.pose(rig.imu_frame).wxyz, rig.magnetometer) if rig.imu_frame else None

    def instant(self, sample: ImuSample) -> int | None:
        """Return the sample's stamp; None where it has no field."""
        return sample.header.utime if sample.magnetic_field is not None else None

    def compare(self, scene: Scene, sample: ImuSample) -> Compared | str:
        """Compare the azimuth of the felt field with that of the model; a field of another strength is disturbed."""
        if scene.age < PERIOD or scene.site is None or sample.magnetic_field is None:
            return ""
        if not all(map(math.isfinite, sample.magnetic_field)):
            return "nan"
        felt = so3.rotate(self.mount, self.calibration.apply(sample.magnetic_field))
        model = model_field(scene, sample.header.utime)
        if model is None:
            return "no_model"
        strength = math.hypot(*model)
        settings = scene.settings
        if abs(math.hypot(*felt) - strength) > settings.magnetic_strength * strength:
            return "disturbed"
        expected, H = azimuth(so3.rotate(scene.nav.attitude, felt), scene.layout.size)
        residual = wrapped(0.5 * math.pi - self.calibration.declination(model) - expected)
        lasting = max(settings.magnetic_time / min(scene.age, settings.magnetic_time), 1.0)
        R = np.array(((settings.magnetic_sigma**2 * lasting,),))
        return Compared(np.array((residual,)), H, R, "" if settings.use_magnetometer else "vertical_gyro")


def model_field(scene: Scene, utime: int) -> Vector3 | None:
    """Return the earth's magnetic field, tesla, along N's axes at N's origin: it turns by a degree in 100 km."""
    assert scene.site is not None
    latitude, longitude, height = geodetic_from_ecef(scene.site.ecef)
    return magnetic_field(latitude, longitude, height, utime)


def yaw_told(scene: Scene, sample: ImuSample, mount: Quaternion) -> float | str:
    """Return the body's yaw from true east by the unit's own orientation, radians; or in one word why not."""
    told = attitude_in_enu(sample, mount)
    if told is None:
        return "orientation"
    x, y, _ = so3.rotate(told, (1.0, 0.0, 0.0))
    if sample.yaw_source is not YawSource.MAGNETIC:
        return math.atan2(y, x)
    calibration = scene.rig.magnetometer
    model = model_field(scene, sample.header.utime) if calibration.declination_deg is None else (0.0, 1.0, 0.0)
    if model is None:
        return "no_model"
    # a magnetic azimuth counts from magnetic north: seen from true north it lies to the east by the declination
    return math.atan2(y, x) - calibration.declination(model)


__all__ = ["Magnetometer", "Tilt", "Yaw", "attitude_in_enu", "model_field", "yaw_told"]
