"""Measurement models of IMU orientation and magnetometer heading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.estimation.filter.error_layout import ErrorState
from modelserver.estimation.filter.eskf import Innovation
from modelserver.estimation.filter.measurements.measurement import (
    MeasurementContext,
    compute_azimuth,
    register,
    wrap_angle,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.magnetometer import MagnetometerCalibration, magnetic_field
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import ImuSample, OrientationReference, YawSource
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

PERIOD = 0.5
"""Seconds between two updates: the IMU's own filter and the disturbances of the field change no faster."""

_HALF = math.sqrt(0.5)
_ENU_FROM = {
    OrientationReference.ENU: so3.IDENTITY,
    # east, north, up of a vector of north, east, down: half a turn about the line between east and north
    OrientationReference.NED: (0.0, _HALF, _HALF, 0.0),
}


def get_attitude_in_enu(sample: ImuSample, q_body_imu: Quaternion) -> Quaternion | None:
    """Return the body's attitude by the IMU's own orientation, with respect to east, north, up; None without one."""
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
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls(rig.pose(rig.imu_frame).wxyz) if rig.imu_frame else None


@register
class ImuTilt(_OfUnit):
    """The vertical by the IMU's own orientation: its up along the body against the state's."""

    kind: ClassVar[str] = "imu_tilt"
    sample: ClassVar[type] = ImuSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: ImuSample) -> int | None:
        """Return the stamp of the sample; None without an orientation."""
        return sample.header.utime if sample.orientation is not None else None

    def evaluate(self, context: MeasurementContext, sample: ImuSample) -> Innovation | str:
        """Compare the two horizontal components of the IMU's up along N: up_measured - up = theta x up."""
        if context.age < PERIOD:
            return ""
        measured = get_attitude_in_enu(sample, self.mount)
        if measured is None:
            return "orientation"
        up = so3.rotate(so3.conjugate(measured), (0.0, 0.0, 1.0))
        x, y, z = so3.rotate(context.nav.attitude, up)
        # R_measured' e = R_true' e; R R_true' e = exp(-theta) e = e - theta x e
        H = context.zero_jacobian(2)
        H[0, 7], H[1, 6] = -z, z
        settings = context.settings
        correlated = max(settings.orientation_time / min(context.age, settings.orientation_time), 1.0)
        R = np.eye(2) * settings.orientation_sigma**2 * correlated
        return Innovation(np.array((x, y)), H, R)


@register
class ImuYaw(_OfUnit):
    """Yaw by the IMU's own orientation, if it is relative to north and magnetic headings are used (report 5.1)."""

    kind: ClassVar[str] = "imu_yaw"
    sample: ClassVar[type] = ImuSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: ImuSample) -> int | None:
        """Return the stamp of the sample; None if its yaw has no reference."""
        return None if sample.orientation is None or sample.yaw_source is YawSource.NONE else sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: ImuSample) -> Innovation | str:
        """Compare yaw."""
        if context.age < PERIOD or context.site is None:
            return ""
        measured = compute_yaw(context, sample, self.mount)
        if isinstance(measured, str):
            return measured
        magnetic = sample.yaw_source is YawSource.MAGNETIC
        expected, H = compute_azimuth(so3.rotate(context.nav.attitude, (1.0, 0.0, 0.0)), context.layout.size)
        settings = context.settings
        sigma = settings.magnetic_sigma if magnetic else settings.orientation_sigma
        correlated = max(settings.magnetic_time / min(context.age, settings.magnetic_time), 1.0)
        unused = "vertical_gyro" if magnetic and not settings.use_magnetometer else ""
        return Innovation(
            np.array((wrap_angle(measured - expected),)), H, np.array(((sigma * sigma * correlated,),)), unused
        )


@register
@dataclass(frozen=True, slots=True)
class Magnetometer:
    """Heading by the calibrated magnetic field, against the direction of the World Magnetic Model there."""

    kind: ClassVar[str] = "magnetometer"
    sample: ClassVar[type] = ImuSample
    states: ClassVar[tuple[ErrorState, ...]] = ()
    mount: Quaternion
    calibration: MagnetometerCalibration

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls(rig.pose(rig.imu_frame).wxyz, rig.magnetometer) if rig.imu_frame else None

    def get_utime(self, sample: ImuSample) -> int | None:
        """Return the stamp of the sample; None without a magnetic field."""
        return sample.header.utime if sample.magnetic_field is not None else None

    def evaluate(self, context: MeasurementContext, sample: ImuSample) -> Innovation | str:
        """Compare the azimuth of the measured field with that of the model; another strength means a disturbance."""
        if context.age < PERIOD or context.site is None or sample.magnetic_field is None:
            return ""
        if not all(map(math.isfinite, sample.magnetic_field)):
            return "nan"
        field = so3.rotate(self.mount, self.calibration.apply(sample.magnetic_field))
        model = compute_model_field(context, sample.header.utime)
        if model is None:
            return "no_model"
        strength = math.hypot(*model)
        settings = context.settings
        if abs(math.hypot(*field) - strength) > settings.magnetic_strength * strength:
            return "disturbed"
        expected, H = compute_azimuth(so3.rotate(context.nav.attitude, field), context.layout.size)
        residual = wrap_angle(0.5 * math.pi - self.calibration.declination(model) - expected)
        correlated = max(settings.magnetic_time / min(context.age, settings.magnetic_time), 1.0)
        R = np.array(((settings.magnetic_sigma**2 * correlated,),))
        return Innovation(np.array((residual,)), H, R, "" if settings.use_magnetometer else "vertical_gyro")


def compute_model_field(context: MeasurementContext, utime: int) -> Vector3 | None:
    """Return the earth's magnetic field along N at N's origin, tesla; it turns by a degree in 100 km."""
    assert context.site is not None
    latitude, longitude, height = geodetic_from_ecef(context.site.ecef)
    return magnetic_field(latitude, longitude, height, utime)


def compute_yaw(context: MeasurementContext, sample: ImuSample, mount: Quaternion) -> float | str:
    """Return the yaw from true east by the IMU's own orientation, rad; or in one word why not."""
    measured = get_attitude_in_enu(sample, mount)
    if measured is None:
        return "orientation"
    x, y, _ = so3.rotate(measured, (1.0, 0.0, 0.0))
    if sample.yaw_source is not YawSource.MAGNETIC:
        return math.atan2(y, x)
    calibration = context.rig.magnetometer
    model = (
        compute_model_field(context, sample.header.utime) if calibration.declination_deg is None else (0.0, 1.0, 0.0)
    )
    if model is None:
        return "no_model"
    # a magnetic azimuth counts from magnetic north, which is east of true north by the declination
    return math.atan2(y, x) - calibration.declination(model)
