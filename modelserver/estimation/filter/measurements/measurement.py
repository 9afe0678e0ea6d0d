"""Measurement model: residual, Jacobian H and measurement noise R of a sample, for the update of the filter.

A kind of measurement is a class with `@register`; `GpsPosition` in gnss.py is an example. Installed packages add theirs
as described below. Jacobians of points of the body for R_true = exp([theta]x) R:

    position        p + R l          by position I, by attitude -[R l]x
    velocity        v + R (w x l)    by velocity I, by attitude -[R (w x l)]x, by gyro bias R [l]x
    body velocity   R' v + w x l     by velocity R', by attitude R' [v]x, by gyro bias [l]x

with w = measured rate - bias: an error of the bias changes w x l by l x error.

Here are those of aiding sources, of the IMU's orientation and magnetometer, and of installed packages; gnss.py and
wheels.py have the others.

Aiding sources: pose, position, range to a beacon, relative pose (visual odometry). Visual localization, radio ranges, a
theodolite, an operator, another robot that has seen this one (its own pose with the relative pose that it measured,
composed by the publisher).

Installed packages: their types by name, and their place in the filter. A source of the vehicle file (`sensors.aiding`)
names the type of its measurements; `MEASUREMENT_TYPES` has the object that compares them with the state, which a
package adds by an entry point of the group `modelserver.measurements`. Its samples are all `MeasurementSample`, so the
wire, the journal and its schema are the same with and without it: a stored state has only the name of the type.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Final, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame, geodetic_from_ecef, rotation_about_up
from modelserver.estimation.filter.eskf import (
    ATTITUDE,
    GYRO_BIAS,
    VELOCITY,
    ZERO,
    ErrorLayout,
    ErrorState,
    Innovation,
    NavState,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import MagnetometerCalibration, SensorRig, magnetic_field
from modelserver.geometry import names
from modelserver.messages import (
    AbsolutePoseSample,
    ImuSample,
    MeasurementSample,
    OrientationReference,
    RangeSample,
    RelativePoseSample,
    YawSource,
)
from modelserver.plugins import PluginRegistry
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3, cross

IMU_AVERAGING: Final = 0.02
"""Seconds over which the angular rate of one IMU sample is a mean: a bandwidth of about 50 Hz."""


class MeasurementContext(NamedTuple):
    """What a measurement is compared with.

    Attributes
    ----------
    nav: the state at the measurement's instant, with its covariance there.
    site: tangent plane that N is east, north, up of; None before the filter is aligned, while N has no place on earth.
    geodesy: of the origin, None before it is known.
    is_stationary: whether the vehicle is stationary.
    age: seconds since the previous measurement of the kind and source; infinite for the first.
    previous: its sample.
    steering: steering angle that the vehicle controller measures, rad; nan without a fresh one.
    """

    nav: NavState
    layout: ErrorLayout
    settings: FilterSettings
    rig: SensorRig
    site: LocalFrame | None = None
    geodesy: Geodesy | None = None
    is_stationary: bool = False
    age: float = math.inf
    previous: Any = None
    steering: float = math.nan

    def zero_jacobian(self, rows: int) -> Array:
        return np.zeros((rows, self.layout.size))

    def extra(self, name: str) -> float:
        """Return the estimate of an additional state; 0 if it is not declared."""
        return self.nav.extras[self.layout.extra_index(name)] if name in self.layout else 0.0


class Measurement(Protocol):
    """One kind of measurement of a vehicle.

    Attributes
    ----------
    kind: its name in the ledger.
    sample: the type of sample that it reads.
    states: the additional error states that it needs.
    """

    kind: ClassVar[str]
    sample: ClassVar[type]
    states: ClassVar[tuple[ErrorState, ...]]

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return the measurement of a vehicle; None if the vehicle lacks what it needs."""
        ...

    def get_utime(self, sample: Any) -> int | None:
        """Return the instant of the measurement in a sample; None if the sample does not contain it."""
        ...

    def evaluate(self, context: MeasurementContext, sample: Any) -> Innovation | str:
        """Return the innovation, or in one word why there is none; an empty word is not counted."""
        ...


M = TypeVar("M", bound=type[Measurement])

REGISTRY: dict[str, type[Measurement]] = {}
"""Every kind of measurement that a new filter uses, by name; those of one sample are fused in this order."""


def register(kind: M) -> M:
    """Add a kind of measurement to those that every new filter uses (decorator)."""
    REGISTRY[kind.kind] = kind
    return kind


def choose_covariance(stated: Array | None, size: int, sigma: float) -> Array:
    """Return a stated covariance (size, size), made symmetric, if it is positive definite, else that of `sigma`."""
    if stated is not None:
        stated = 0.5 * (stated + stated.T)
        if np.isfinite(stated).all() and np.linalg.eigvalsh(stated)[0] > 0.0:
            return stated
    return np.eye(size) * sigma * sigma


def point_jacobian(nav: NavState, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the position of a point of the body in N; `lever` leads to it from the IMU, body axes, m."""
    H = np.zeros((3, size))
    x, y, z = so3.rotate(nav.attitude, lever)
    H[0, 0] = H[1, 1] = H[2, 2] = 1.0
    H[0, 7], H[0, 8] = z, -y
    H[1, 6], H[1, 8] = -z, x
    H[2, 6], H[2, 7] = y, -x
    return H


def point_velocity_jacobian(nav: NavState, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the velocity of a point of the body along N."""
    H = np.zeros((3, size))
    x, y, z = so3.rotate(nav.attitude, cross(nav.angular_rate, lever))
    H[0, 3] = H[1, 4] = H[2, 5] = 1.0
    H[0, 7], H[0, 8] = z, -y
    H[1, 6], H[1, 8] = -z, x
    H[2, 6], H[2, 7] = y, -x
    if lever != ZERO:
        H[:, GYRO_BIAS] = np.array(so3.matrix_rows(nav.attitude)) @ so3.skew(lever)
    return H


def body_velocity_jacobian(nav: NavState, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the velocity of a point of the body along the body axes."""
    H = np.zeros((3, size))
    Rt = np.array(so3.matrix_rows(so3.conjugate(nav.attitude)))
    H[:, VELOCITY] = Rt
    H[:, ATTITUDE] = Rt @ so3.skew(nav.velocity)
    if lever != ZERO:
        H[:, GYRO_BIAS] = so3.skew(lever)
    return H


def compute_azimuth(u: Vector3, size: int) -> tuple[float, Array]:
    """Return the azimuth of a vector along N's axes, rad from x, and its Jacobian (1, n) by the attitude.

    With du = theta x u: d(azimuth) = (u_x du_y - u_y du_x) / (u_x^2 + u_y^2).
    """
    x, y, z = u
    square = x * x + y * y
    H = np.zeros((1, size))
    H[0, 6:9] = (-z * x / square, -z * y / square, 1.0)
    return math.atan2(y, x), H


def wrap_angle(angle: float) -> float:
    """Return an angle within -pi to pi, rad."""
    return math.remainder(angle, math.tau)


# --- aiding sources -----------------------------------------------------------------------------------------

LONGEST_RELATIVE = 1.0
"""Seconds between the two instants of a relative pose, at most: it is compared as a mean velocity and angular rate."""


@dataclass(frozen=True, slots=True)
class _Anywhere:
    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls()


def transform_to_site(context: MeasurementContext, reference: str, point: Vector3) -> tuple[Vector3, Quaternion] | str:
    """Return a point of a world frame in N, and the rotation from its axes there to N; or in one word why not."""
    if context.site is None or context.geodesy is None:
        return ""
    geodesy, site, reference = context.geodesy, context.site, names.complete(reference)
    try:
        if reference == names.WORLD_ENU:
            return site.from_ecef(geodesy.tangent.to_ecef(point)), site.rotation_of(geodesy.tangent)
        if reference == names.WORLD_UTM:
            east, north, height = geodesy.origin.initial_utm
            latitude, longitude, up = geodesy.geodetic_from_utm(east + point[0], north + point[1], height + point[2])
            there = LocalFrame.at(latitude, longitude, up)
            # yaw from grid east to yaw from true east
            grid = rotation_about_up(-geodesy.convergence(latitude, longitude))
            return site.from_ecef(there.ecef), so3.multiply(site.rotation_of(there), grid)
    except GeodesyError:
        return "range"
    return "frame"


def _read_covariance(stated: tuple[float, ...] | None, start: int, sigma: float) -> Array:
    """Return the 3 x 3 block of a reported 6 x 6 covariance if it is positive definite, else that of `sigma`."""
    block = None
    if stated is not None and len(stated) == 36:
        block = np.array(stated).reshape(6, 6)[start : start + 3, start : start + 3]
    return choose_covariance(block, 3, sigma)


@register
class AbsolutePose(_Anywhere):
    """Pose of a frame of the vehicle in World:ENU or World:UTM: position, orientation or both."""

    kind: ClassVar[str] = "absolute_pose"
    sample: ClassVar[type] = AbsolutePoseSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: AbsolutePoseSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: AbsolutePoseSample) -> Innovation | str:
        """Compare what is measured, position first."""
        if fault := context.rig.find_problem(sample.frame_of_interest):
            return fault
        position, orientation = sample.position, sample.orientation
        found = transform_to_site(context, sample.frame_of_reference, position or (0.0, 0.0, 0.0))
        if isinstance(found, str):
            return found
        place, turn = found
        if not all(map(math.isfinite, place)):
            return "nan"
        nav, settings = context.nav, context.settings
        turning = np.array(so3.matrix_rows(turn))
        residuals: list[Array] = []
        rows: list[Array] = []
        noises: list[Array] = []
        if position is not None:
            lever = context.rig.lever_arm(sample.frame_of_interest)
            residuals.append(np.subtract(place, nav.point(lever)))
            rows.append(point_jacobian(nav, lever, context.layout.size))
            noises.append(turning @ _read_covariance(sample.covariance, 0, settings.aiding_sigma) @ turning.T)
        if orientation is not None:
            try:
                measured = so3.normalize(orientation)
            except ValueError:
                return "nan"
            mounted = context.rig.pose(sample.frame_of_interest).wxyz
            q = so3.multiply(so3.multiply(turn, measured), so3.conjugate(mounted))
            error = so3.logarithm(so3.normalize(so3.multiply(q, so3.conjugate(nav.attitude))))
            H = context.zero_jacobian(3)
            H[:, ATTITUDE] = np.eye(3)
            residuals.append(np.array(error))
            rows.append(H)
            noises.append(turning @ _read_covariance(sample.covariance, 3, settings.aiding_rotation_sigma) @ turning.T)
        if not residuals:
            return "empty"
        return Innovation(np.concatenate(residuals), np.vstack(rows), _block_diagonal(noises))


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    R = np.zeros((size, size))
    at = 0
    for block in blocks:
        R[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return R


@register
class BeaconRange(_Anywhere):
    """Distance from a frame of the vehicle to a beacon: |p + R l - b|."""

    kind: ClassVar[str] = "range"
    sample: ClassVar[type] = RangeSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: RangeSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: RangeSample) -> Innovation | str:
        """Compare the distance; within a meter of the beacon its direction is unknown."""
        if fault := context.rig.find_problem(sample.frame):
            return fault
        if not (math.isfinite(sample.distance) and sample.distance >= 0.0):
            return "nan" if not math.isfinite(sample.distance) else "range"
        found = transform_to_site(context, sample.frame_of_reference, sample.beacon_position)
        if isinstance(found, str):
            return found
        lever = context.rig.lever_arm(sample.frame)
        away = np.subtract(context.nav.point(lever), found[0])
        expected = float(np.linalg.norm(away))
        H = point_jacobian(context.nav, lever, context.layout.size)
        if expected < 1.0:
            return "near"
        sigma = sample.sigma if 0.0 < sample.sigma < 1e3 else context.settings.aiding_sigma
        line = away / expected
        P = context.nav.covariance[:3, :3]
        # second order: an error across the line lengthens it by its square over twice the distance
        across = max(float(np.trace(P) - line @ P @ line), 0.0)
        variance = sigma * sigma + (across / expected) ** 2
        return Innovation(np.array((sample.distance - expected,)), line[None, :] @ H, np.array(((variance,),)))


@register
class RelativePose(_Anywhere):
    """Motion of a frame of the vehicle since an earlier instant: its mean velocity and angular rate over that time."""

    kind: ClassVar[str] = "relative_pose"
    sample: ClassVar[type] = RelativePoseSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: RelativePoseSample) -> int | None:
        """Return the middle between the two instants, where over a short time the means hold."""
        return (sample.header.utime + sample.since_utime) // 2

    def evaluate(self, context: MeasurementContext, sample: RelativePoseSample) -> Innovation | str:
        """Compare the mean velocity and angular rate of the frame along the body axes."""
        dt = (sample.header.utime - sample.since_utime) * 1e-6
        if not 0.0 < dt <= LONGEST_RELATIVE:
            return "interval"
        if fault := context.rig.find_problem(sample.frame):
            return fault
        if not all(map(math.isfinite, sample.position)):
            return "nan"
        try:
            angle = so3.logarithm(so3.normalize(sample.orientation))
        except ValueError:
            return "nan"
        nav, settings = context.nav, context.settings
        mounted = context.rig.pose(sample.frame).wxyz
        lever = context.rig.lever_arm(sample.frame)
        # the displacement is along the earlier axes: half the rotation back gives those in the middle
        half = so3.exponential((-0.5 * angle[0], -0.5 * angle[1], -0.5 * angle[2]))
        displacement = so3.rotate(so3.multiply(mounted, half), sample.position)
        turn = so3.rotate(mounted, angle)
        v = np.array(displacement) / dt - nav.body_velocity(lever)
        w = np.array(turn) / dt - nav.angular_rate
        H = context.zero_jacobian(6)
        H[:3] = body_velocity_jacobian(nav, lever, context.layout.size)
        # angular rate = measured - bias
        H[3:, GYRO_BIAS] = -np.eye(3)
        M = np.array(so3.matrix_rows(mounted))
        R = np.zeros((6, 6))
        R[:3, :3] = M @ _read_covariance(sample.covariance, 0, settings.aiding_sigma) @ M.T / (dt * dt)
        R[3:, 3:] = M @ _read_covariance(sample.covariance, 3, settings.aiding_rotation_sigma) @ M.T / (dt * dt)
        # the noise of the gyros: of one sample, because the state has no mean
        R[3:, 3:] += np.eye(3) * settings.gyro_noise**2 / IMU_AVERAGING
        return Innovation(np.concatenate((v, w)), H, R)


# --- orientation and magnetometer of the IMU ----------------------------------------------------------------

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


# --- measurements of installed packages ---------------------------------------------------------------------

PLUGIN_GROUP = "modelserver.measurements"
"""Group of the entry points of measurements."""


class MeasurementType(Protocol):
    """What compares the measurements of one type with the state. Pure: the same arguments give the same bits.

    Attributes
    ----------
    states: the additional error states that it needs, one set for all sources of the type.
    values: names of the numbers of a sample, with units, in order.
    is_absolute: whether it measures a place or course in the world; mode dead_reckoning does not use it then.
    """

    states: tuple[ErrorState, ...]
    values: tuple[str, ...]
    is_absolute: bool

    def evaluate(self, context: MeasurementContext, sample: MeasurementSample) -> Innovation | str:
        """Return the innovation, or in one word why there is none."""
        ...


def _find_fault(name: str, loaded: Any) -> str:
    """Return why an object is no type of measurement; empty if it is one."""
    states, values = getattr(loaded, "states", None), getattr(loaded, "values", None)
    if isinstance(loaded, type):
        return f"is a class; name an object of it: {loaded.__name__.upper()} = {loaded.__name__}()"
    if not callable(getattr(loaded, "evaluate", None)):
        return "has no method evaluate(context, sample)"
    if not isinstance(states, tuple) or not all(isinstance(each, ErrorState) for each in states):
        return "has no tuple of ErrorState as states"
    if not isinstance(values, tuple) or not values or not all(isinstance(each, str) for each in values):
        return "has no tuple of names as values"
    return "" if isinstance(getattr(loaded, "is_absolute", None), bool) else "does not state whether it is_absolute"


MEASUREMENT_TYPES: PluginRegistry[MeasurementType] = PluginRegistry(PLUGIN_GROUP, _find_fault)
"""The types of measurements of installed packages, by name."""


def get_type(name: str) -> MeasurementType:
    """Return a type of measurement. Raises LookupError if no installed package defines it, or it cannot be used."""
    found = MEASUREMENT_TYPES.get(name)
    if found is None:
        why = MEASUREMENT_TYPES.problems.get(name, "no installed package defines it")
        raise LookupError(f"measurements of type {name}: {why}")
    return found


@register
@dataclass(frozen=True, slots=True)
class OwnMeasurement:
    """Measurement of an installed package, of the type with this name; an empty name: of an unknown source."""

    kind: ClassVar[str] = "own"
    sample: ClassVar[type] = MeasurementSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    type: str

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return None: `split_sample` makes one by the type of a sample's source."""
        return None

    @property
    def is_absolute(self) -> bool:
        """Whether it measures a place or course in the world."""
        return not self.type or get_type(self.type).is_absolute

    def get_utime(self, sample: MeasurementSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: MeasurementSample) -> Innovation | str:
        """Return what its type makes of it; `fault` where that fails, or returns what the filter cannot use."""
        if not self.type:
            return "source"
        if sample.frame and (fault := context.rig.find_problem(sample.frame)):
            return fault
        found = get_type(self.type)
        if len(sample.values) != len(found.values):
            return "size"
        if not all(map(math.isfinite, sample.values)):
            return "nan"
        try:
            innovation = found.evaluate(context, sample)
            if isinstance(innovation, str):
                return innovation
            size = len(innovation.residual)
            shapes = ((size,), (size, context.layout.size), (size, size))
            arrays = (innovation.residual, innovation.jacobian, innovation.noise)
            is_usable = size > 0 and all(map(_has_shape, arrays, shapes)) and _is_covariance(innovation.noise)
        except Exception:
            return "fault"  # of the package: the others' measurements are used on
        return innovation if is_usable else "fault"


def _has_shape(given: Array, shape: tuple[int, ...]) -> bool:
    return bool(given.shape == shape and np.isfinite(given).all())


def _is_covariance(given: Array) -> bool:
    return bool(np.array_equal(given, given.T) and np.linalg.eigvalsh(given)[0] > 0.0)


def read_covariance(sample: MeasurementSample, sigma: float) -> Array:
    """Return the covariance (n, n) of a sample's values if it states one that is positive definite, else of `sigma`."""
    n = len(sample.values)
    stated = np.array(sample.covariance).reshape(n, n) if sample.covariance else None
    return choose_covariance(stated, n, sigma)
