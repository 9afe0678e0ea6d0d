"""Sensor rig: the frames of sensors, wheels and axles on the vehicle, from the geometry model. Pure.

With the calibration of a magnetometer (and the field that it should measure), and with the findings: configured sensors
that localization cannot use, and why, by the vehicle's frames and the mode.
`find_unusable` checks what does not change while the filter runs; `modelserver check` reports it before a start. What
only the running filter knows (an inertial unit that measures no gravity, a steering angle that timed out) is added in
`LocalizerSummary.findings`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import ClassVar, Final, Literal, NamedTuple, TypeAlias

from modelserver.earth import magnetism
from modelserver.errors import QueryError
from modelserver.geometry.model import Model
from modelserver.messages import Mode, SensorFinding
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

# --- magnetometer -------------------------------------------------------------------------------------------

_YEAR_US = 31_557_600_000_000


@dataclass(frozen=True, slots=True)
class MagnetometerCalibration:
    """Correction of the measured magnetic field, along the unit's own axes: soft_iron (measured - hard_iron).

    hard_iron: the vehicle's own field, tesla. soft_iron: correction of the distortion by iron, 3 by 3, row-major, no
    unit. `modelserver calibrate magnetometer` finds both. declination_deg: true yaw of magnetic north at the place,
    degrees, east positive; default: that of the World Magnetic Model.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    hard_iron: tuple[float, float, float] = (0.0, 0.0, 0.0)
    soft_iron: tuple[float, float, float, float, float, float, float, float, float] = (
        *(1.0, 0.0, 0.0),
        *(0.0, 1.0, 0.0),
        *(0.0, 0.0, 1.0),
    )
    declination_deg: float | None = None

    def __post_init__(self) -> None:
        a, b, c, d, e, f, g, h, i = self.soft_iron
        if not a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0:
            raise ValueError(
                "soft_iron is a correction close to 1 0 0 0 1 0 0 0 1; this one has no positive determinant"
            )
        if self.declination_deg is not None and not -180.0 <= self.declination_deg <= 180.0:
            raise ValueError(f"declination_deg is between -180 and 180, got {self.declination_deg:g}")

    def apply(self, measured: Vector3) -> Vector3:
        """Return the field corrected for the vehicle's own, along the unit's axes, tesla."""
        x, y, z = (a - b for a, b in zip(measured, self.hard_iron, strict=True))
        a, b, c, d, e, f, g, h, i = self.soft_iron
        return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)

    def declination(self, field: Vector3) -> float:
        """Return the angle from true to magnetic north, clockwise, radians: the configured one, else by `field`."""
        if self.declination_deg is not None:
            return math.radians(self.declination_deg)
        return math.atan2(field[0], field[1])


def magnetic_field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3 | None:
    """Return the earth's field along east, north, up, tesla, cached for 0.1 degree of place and a month.

    None where no model covers the time or the place.
    """
    month = utime // (_YEAR_US // 12) * (_YEAR_US // 12)
    if not magnetism.is_covered(month):
        return None
    return _compute_field(round(latitude_deg, 1), round(longitude_deg, 1), round(height, -3), month)


@lru_cache(maxsize=64)
def _compute_field(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3 | None:
    try:
        return magnetism.field_at(latitude_deg, longitude_deg, height, utime)
    except magnetism.MagnetismError:
        return None


# --- sensors on the vehicle -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Mounts:
    """The poses of the sensor frames in the base frame: x forward, y left, z up.

    For the antenna only the position is used: the phase center.
    """

    X_base_imu: Pose
    X_base_antenna: Pose

    @classmethod
    def from_model(cls, model: Model, base_frame: str, gps_frame: str, imu_frame: str) -> Mounts:
        """Return the mounts of a model; names are full, `Body:Frame`.

        Raises UnknownBodyError, UnknownFrameError or NotConnectedError.
        """
        return cls(
            X_base_imu=model.get_transformation(imu_frame, base_frame).pose,
            X_base_antenna=model.get_transformation(gps_frame, base_frame).pose,
        )


Kinematics: TypeAlias = Literal["skid_steer", "differential", "ackermann"]

MIN_WHEELBASE = 0.1
"""Meters between the rolling frame and a steered axle below which a steering angle gives no curvature."""

SteeringGeometry: TypeAlias = Literal["ackermann", "parallel"]


@dataclass(frozen=True, slots=True)
class SteeringSignal:
    """The steering angle of an axle as the vehicle controller measures it (VEHICLE_STATUS.steering_angle).

    `wheels` are the steered wheels. `geometry`: `ackermann`, the angle is that of one equivalent wheel in the middle of
    the axle and each wheel follows its own circle; `parallel`, all wheels are at the angle itself. `sigma` and `limit`
    in radians: an angle beyond the limit is invalid. `max_age` in seconds: an older one is not used.
    """

    wheels: tuple[str, ...]
    geometry: SteeringGeometry = "ackermann"
    sigma: float = 0.035
    limit: float = 0.7
    max_age: float = 0.2

    def wheel_angles(self, angle: float, contacts: Mapping[str, Vector3]) -> dict[str, float]:
        """Return each wheel's angle, rad, from the contact points in the rolling frame, m.

        The curvature of the rolling frame's path is tan(angle) / wheelbase; a wheel at (x, y) rolls along the circle
        about (0, 1 / curvature), at atan2(curvature x, 1 - curvature y).
        """
        known = [name for name in self.wheels if name in contacts]
        if self.geometry == "parallel" or not known:
            return dict.fromkeys(known, angle)
        wheelbase = self.wheelbase(contacts)
        if abs(wheelbase) < MIN_WHEELBASE:
            return {}
        curvature = math.tan(angle) / wheelbase
        return {name: math.atan2(curvature * contacts[name][0], 1.0 - curvature * contacts[name][1]) for name in known}

    def wheelbase(self, contacts: Mapping[str, Vector3]) -> float:
        """Return the distance of the steered axle ahead of the rolling frame, m; 0 where unknown."""
        ahead = [contacts[name][0] for name in self.wheels if name in contacts]
        return sum(ahead) / len(ahead) if ahead else 0.0


SPEEDOMETER: Final = "speedometer"
"""Name of the wheel that stands for a vehicle's one speed."""


@dataclass(frozen=True, slots=True)
class SpeedometerSignal:
    """The one speed of a vehicle that its controller measures (VEHICLE_STATUS.forward_speed), to `sigma`, m/s.

    It is that of a wheel at the rolling frame, which `wheel_frames` then has under the name SPEEDOMETER.
    `is_unsigned`: it is a magnitude, also when the vehicle reverses.
    """

    sigma: float = 0.1
    is_unsigned: bool = False


class YawGyro(NamedTuple):
    """A gyro that measures the turn rate of the vehicle alone.

    `axis` is the sensor's axis nearest to the vehicle's up, 0 to 2, and `share` the component of up along it: the
    turn rate w of a level vehicle shows as share w.
    """

    axis: int
    share: float


@dataclass(frozen=True)
class SensorRig:
    """The vehicle's frames that localization uses. The body axes are those of `rolling_frame`.

    `rolling_frame` moves along its own x axis; `imu_frame`, `gps_frame` and `second_antenna_frame` are full names,
    empty where there is none; `wheel_frames` has the frame of each wheel's contact point by the wheel's name.
    `steering` is the measured steering angle, where one is configured; `has_wheels` is whether wheels are configured at
    all, with frames or without. `speedometer`: there is one speed instead of wheels. `yaw_gyro_frame` is the frame of a
    gyro that measures the turn rate alone; there is no `imu_frame` then. Raises QueryError for a frame that the model
    does not have or join to the rolling frame.
    """

    model: Model
    rolling_frame: str
    imu_frame: str = ""
    gps_frame: str = ""
    second_antenna_frame: str = ""
    wheel_frames: Mapping[str, str] = field(default_factory=dict)
    kinematics: Kinematics = "differential"
    magnetometer: MagnetometerCalibration = field(default_factory=MagnetometerCalibration)
    steering: SteeringSignal | None = None
    has_wheels: bool = False
    speedometer: SpeedometerSignal | None = None
    yaw_gyro_frame: str = ""

    def __post_init__(self) -> None:
        imu = self.pose(self.imu_frame).xyz if self.imu_frame else (0.0, 0.0, 0.0)
        object.__setattr__(self, "imu", imu)
        object.__setattr__(self, "base", self.lever_arm_to((0.0, 0.0, 0.0)))
        for frame in (self.gps_frame, self.second_antenna_frame, self.yaw_gyro_frame, *self.wheel_frames.values()):
            if frame:
                self.pose(frame)

    def pose(self, frame: str) -> Pose:
        """Return the pose of a frame in the rolling frame. Raises QueryError."""
        return self.model.get_transformation(frame, self.rolling_frame).pose

    @property
    def yaw_gyro(self) -> YawGyro | None:
        """The gyro that measures the turn rate alone, None without one. Raises QueryError."""
        if not self.yaw_gyro_frame:
            return None
        up = so3.rotate(so3.conjugate(self.pose(self.yaw_gyro_frame).wxyz), (0.0, 0.0, 1.0))
        axis = max(range(3), key=lambda k: abs(up[k]))
        return YawGyro(axis, up[axis])

    def geometry_key(self) -> tuple[object, ...]:
        """Return everything that localization takes from the geometry: equal where nothing of it has moved."""
        frames = (self.imu_frame, self.yaw_gyro_frame, self.gps_frame, self.second_antenna_frame)
        wheels = ((wheel, frame, self.pose(frame)) for wheel, frame in sorted(self.wheel_frames.items()))
        return (self.rolling_frame, *((frame, self.pose(frame)) for frame in frames if frame), *wheels)

    def find_problem(self, frame: str) -> str:
        """Return why measurements of a frame cannot be used, "" if they can.

        `frame`: it does not exist, or is not joined to the rolling frame. `on_joint`: a joint moves it relative to the
        vehicle.
        """
        try:
            path = self.model.get_kinematic_path(frame, self.rolling_frame)
        except QueryError:
            return "frame"
        return "on_joint" if path.joints else ""

    def lever_arm(self, frame: str) -> Vector3:
        """Return the lever arm from the inertial unit to a frame's origin, body axes, m. Raises QueryError."""
        return self.lever_arm_to(self.pose(frame).xyz)

    def lever_arm_to(self, point: Vector3) -> Vector3:
        """Return the lever arm from the inertial unit to a point of the rolling frame, body axes, m."""
        a, b, c = self.imu
        return (point[0] - a, point[1] - b, point[2] - c)

    imu: Vector3 = field(init=False, compare=False)
    """Position of the inertial unit in the rolling frame; 0 without one."""
    base: Vector3 = field(init=False, compare=False)
    """Lever arm from the inertial unit to the rolling frame's origin, body axes, m."""


# --- sensors that cannot be used ----------------------------------------------------------------------------

MIN_BASELINE = 0.01
"""Meters between two antennas, horizontally, below which they give no heading."""

MIN_UP_SHARE = 0.9
"""Component of up along the axis of a gyro that measures the turn rate alone: 26 deg."""

_EXCLUDING_MODES: dict[str, tuple[Mode, ...]] = {
    "gps": (Mode.NO_GPS, Mode.DEAD_RECKONING),
    "imu": (Mode.NO_IMU,),
    "wheels": (Mode.NO_WHEELS, Mode.RAW),
}
"""By sensor: the modes that do not use it."""


def find_unusable(rig: SensorRig, mode: Mode) -> tuple[SensorFinding, ...]:
    """Return the configured sensors, or parts of their configuration, that a mode of localization cannot use."""
    return (
        *_check_mode(rig, mode),
        *_check_wheels(rig, mode),
        *_check_yaw_gyro(rig, mode),
        *_check_steering(rig),
        *_check_antennas(rig),
        *_check_heading(rig),
    )


def _check_mode(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    configured = {
        "gps": bool(rig.gps_frame),
        "imu": _has_gyro(rig),
        "wheels": bool(rig.wheel_frames),
    }
    for sensor, modes in _EXCLUDING_MODES.items():
        if configured[sensor] and mode in modes:
            yield SensorFinding(
                "speedometer" if sensor == "wheels" and rig.speedometer is not None else sensor,
                "mode",
                "localization.mode",
                f"mode {mode.name.lower()} does not use it",
                "switch to mode full where it should be used",
                is_choice=True,
            )


def _check_wheels(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    frames = "sensors.wheels.frames"
    if rig.has_wheels and not rig.wheel_frames:
        text = "frames names no wheels, so they are not used"
        yield SensorFinding(
            "wheels",
            "frames",
            frames,
            text,
            "write frames: {NAME: BODY:FRAME} with the names that the driver publishes",
        )
    elif len(rig.wheel_frames) == 1 and mode not in _EXCLUDING_MODES["wheels"]:
        sensor, element = ("wheels", frames) if rig.speedometer is None else ("speedometer", "sensors.speedometer")
        has_gyro = _has_gyro(rig) and mode is not Mode.NO_IMU
        if has_gyro:
            text = "one speed: used for the speed and while stationary, not for the turn rate, which is the IMU's"
            fix = ""
        else:
            text = "one speed and no IMU: nothing measures the turn rate, so the heading follows the fixes in each turn"
            fix = "name the wheels of both sides, or an IMU (imu.yaw_rate_only: true for a gyro alone)"
        yield SensorFinding(sensor, "single", element, text, fix, is_choice=has_gyro)


def _has_gyro(rig: SensorRig) -> bool:
    return bool(rig.imu_frame or rig.yaw_gyro_frame)


def _check_yaw_gyro(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    if rig.yaw_gyro is None:
        return
    share = abs(rig.yaw_gyro.share)
    if share < MIN_UP_SHARE:
        text = (
            f"its axis nearest to up is {math.degrees(math.acos(share)):.0f} deg off: it does not measure the turn rate"
        )
        yield SensorFinding("imu", "axis", "sensors.imu.frame", text, "correct the frame in the geometry")
    elif mode is Mode.RAW:
        text = "raw mode needs all three rates: with yaw_rate_only the IMU is not used"
        yield SensorFinding("imu", "mode", "localization.mode", text, "write mode: full")
    else:
        text = (
            "yaw rate only: used for the heading; the vehicle is taken to be level, and wheels or a speedometer are "
            "needed to know whether it is stationary or reverses"
        )
        yield SensorFinding("imu", "yaw_rate", "sensors.imu.yaw_rate_only", text, is_choice=True)


def _check_steering(rig: SensorRig) -> Iterator[SensorFinding]:
    signal, element = rig.steering, "sensors.wheels.steering"
    if signal is None:
        return
    if rig.kinematics == "skid_steer":
        text = "a skid-steered vehicle has no wheels that steer: the steering angle is not used"
        yield SensorFinding("wheels", "kinematics", element, text, "write kinematics: ackermann, or remove steering")
        return
    unknown = [name for name in signal.wheels if name not in rig.wheel_frames]
    if unknown:
        known = ", ".join(rig.wheel_frames) or "none"
        text = f"frames has no wheel {', '.join(unknown)}: the steering angle is not used for it (known: {known})"
        yield SensorFinding("wheels", "names", f"{element}.wheels", text, "write the names that frames has")
    contacts = {name: rig.pose(frame).xyz for name, frame in rig.wheel_frames.items()}
    steered = [name for name in signal.wheels if name in contacts]
    if signal.geometry == "ackermann" and steered and abs(signal.wheelbase(contacts)) < MIN_WHEELBASE:
        text = (
            f"the steered wheels are {signal.wheelbase(contacts):.2f} m ahead of the rolling frame: an angle gives no "
            "curvature and is not used"
        )
        fix = "name the middle of the axle that does not steer as rolling_frame, or write geometry: parallel"
        yield SensorFinding("wheels", "wheelbase", element, text, fix)


def _check_antennas(rig: SensorRig) -> Iterator[SensorFinding]:
    if not (rig.gps_frame and rig.second_antenna_frame):
        return
    a, b = rig.pose(rig.gps_frame).xyz, rig.pose(rig.second_antenna_frame).xyz
    if math.hypot(b[0] - a[0], b[1] - a[1]) <= MIN_BASELINE:
        text = f"{rig.second_antenna_frame} is above {rig.gps_frame}: the two antennas give no heading"
        fix = "name the frame of the other antenna's phase center"
        yield SensorFinding("gps", "baseline", "sensors.gps.second_frame", text, fix)


def _check_heading(rig: SensorRig) -> Iterator[SensorFinding]:
    if rig.gps_frame and not (_has_gyro(rig) or rig.wheel_frames or rig.second_antenna_frame):
        text = "no IMU, no wheels and no second antenna: heading is known above localization.filter.reverse_speed alone"
        yield SensorFinding("gps", "alone", "sensors.gps", text, "name an IMU or wheels")
