"""Sensor rig: the frames of sensors, wheels and axles on the vehicle, from the geometry model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, TypeAlias

from modelserver.errors import QueryError
from modelserver.estimation.magnetometer import MagnetometerCalibration
from modelserver.geometry.model import Model
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3


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
