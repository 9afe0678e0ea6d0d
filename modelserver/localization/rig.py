"""Where everything sits on the vehicle, taken from the geometry model alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from modelserver.errors import QueryError
from modelserver.geometry.model import Model
from modelserver.localization.magnetometer import MagnetometerCalibration
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3

Kinematics: TypeAlias = Literal["skid_steer", "differential", "ackermann"]

LEAST_WHEELBASE = 0.1
"""Meters between the rolling frame and a steered axle below which a steering angle tells no curvature."""

SteeringGeometry: TypeAlias = Literal["ackermann", "parallel"]


@dataclass(frozen=True, slots=True)
class SteeringSignal:
    """The steering angle of an axle as the vehicle controller measures it (VEHICLE_STATUS.steering_angle).

    `wheels` are the wheels that steer by it. `geometry`: `ackermann`, the angle is that of one equivalent wheel in the
    middle of the axle and each wheel points along its own circle; `parallel`, all wheels point along the angle itself.
    `sigma` and `limit` in radians: beyond the limit an angle is damage. `max_age` in seconds: an older one is not used.
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
        if abs(wheelbase) < LEAST_WHEELBASE:
            return {}
        curvature = math.tan(angle) / wheelbase
        return {name: math.atan2(curvature * contacts[name][0], 1.0 - curvature * contacts[name][1]) for name in known}

    def wheelbase(self, contacts: Mapping[str, Vector3]) -> float:
        """Return how far the steered axle is ahead of the rolling frame, m; 0 where it is not known."""
        ahead = [contacts[name][0] for name in self.wheels if name in contacts]
        return sum(ahead) / len(ahead) if ahead else 0.0


@dataclass(frozen=True)
class Rig:
    """The vehicle's frames as the filter needs them. The body's axes are those of `rolling_frame`.

    `rolling_frame` moves along its own x axis; `imu_frame`, `gps_frame` and `second_antenna_frame` are full names,
    empty where there is none; `wheel_frames` has the frame of each wheel's contact point by the wheel's name.
    `steering` is the steering angle that the vehicle controller measures, where the vehicle file names one;
    `has_wheels` is whether it names wheels at all, with frames or without.
    Raises QueryError for a frame that the model does not have or join to the rolling frame.
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

    def __post_init__(self) -> None:
        imu = self.pose(self.imu_frame).xyz if self.imu_frame else (0.0, 0.0, 0.0)
        object.__setattr__(self, "imu", imu)
        object.__setattr__(self, "base", self.lever_to((0.0, 0.0, 0.0)))
        for frame in (self.gps_frame, self.second_antenna_frame, *self.wheel_frames.values()):
            if frame:
                self.pose(frame)

    def pose(self, frame: str) -> Pose:
        """Return the pose of a frame in the rolling frame. Raises QueryError."""
        return self.model.get_transformation(frame, self.rolling_frame).pose

    def places(self) -> tuple[object, ...]:
        """Return all that localization takes from the geometry beforehand: equal where nothing of it has moved."""
        frames = (self.imu_frame, self.gps_frame, self.second_antenna_frame)
        wheels = ((wheel, frame, self.pose(frame)) for wheel, frame in sorted(self.wheel_frames.items()))
        return (self.rolling_frame, *((frame, self.pose(frame)) for frame in frames if frame), *wheels)

    def fault(self, frame: str) -> str:
        """Return in a word why what is told of a frame cannot be used; empty where it can.

        `frame`: it is not there, or nothing joins it to the rolling frame. `on_joint`: a joint moves it against the
        vehicle, and where the joint stood is not known here.
        """
        try:
            route = self.model.route(frame, self.rolling_frame)
        except QueryError:
            return "frame"
        return "on_joint" if route.legs else ""

    def lever(self, frame: str) -> Vector3:
        """Return what leads from the inertial unit's point to a frame's origin, body axes, m. Raises QueryError."""
        return self.lever_to(self.pose(frame).xyz)

    def lever_to(self, point: Vector3) -> Vector3:
        """Return what leads from the inertial unit's point to a point of the rolling frame, body axes, metres."""
        a, b, c = self.imu
        return (point[0] - a, point[1] - b, point[2] - c)

    imu: Vector3 = field(init=False, compare=False)
    """Where the inertial unit is in the rolling frame; without one, the rolling frame's origin itself."""
    base: Vector3 = field(init=False, compare=False)
    """What leads from the inertial unit's point to the rolling frame's origin, body axes, metres."""
