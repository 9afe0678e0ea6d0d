"""Simulation: a vehicle of a geometry model on a drive, what its sensors say, and where it really was."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from modelserver.earth.geodesy import Geodesy
from modelserver.geometry.model import Model
from modelserver.messages import (
    AbsolutePoseSample,
    GpsSample,
    ImuSample,
    Origin,
    RangeSample,
    RelativePoseSample,
    VehicleStatusSample,
    WheelsSample,
)
from modelserver.simulation import aiding, gps, imu, rigid, wheels
from modelserver.simulation.aiding import AbsolutePoseModel, RangeModel, RelativePoseModel
from modelserver.simulation.gps import GpsModel
from modelserver.simulation.imu import ImuModel
from modelserver.simulation.ride import ride
from modelserver.simulation.side_slip import SideSlip
from modelserver.simulation.terrain import Terrain
from modelserver.simulation.trajectory import MotionModel, Trajectory
from modelserver.simulation.wheels import StatusModel, WheelsModel
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3, conjugate, rotate

START_UTIME = 1_750_000_000_000_000
"""When a simulation starts unless told otherwise: a whole second in June 2025."""

Event = (
    GpsSample | ImuSample | WheelsSample | VehicleStatusSample | AbsolutePoseSample | RelativePoseSample | RangeSample
)


@dataclass(frozen=True, slots=True)
class Truth:
    """The base frame at one instant, without error.

    `enu` is its pose in World:ENU and `utm` in World:UTM, both relative to the origin. `latitude_deg`,
    `longitude_deg`, `height` are the same place on the ellipsoid. `velocity` and `acceleration` are along east, north,
    up of the origin; `twist` is the velocity and the angular velocity along the axes of the base frame.
    `yaw` is the vehicle's, counter-clockwise from true east, not wrapped, and `yaw_rate` its derivative.
    """

    utime: int
    enu: Pose
    utm: Pose
    latitude_deg: float
    longitude_deg: float
    height: float
    velocity: Vector3
    acceleration: Vector3
    twist: tuple[Vector3, Vector3]
    yaw: float
    yaw_rate: float


class Simulation:
    """One run. The same arguments give the same samples, however they are asked for.

    The trajectory is driven by `rolling_frame`, the frame whose x axis points along the way: that which does not
    slide sideways, on a vehicle that steers its front wheels the middle of the rear axle. Unless named it is the base
    frame. It moves on the tangent plane of the origin, its z up; with `terrain` on ground that rises above that plane,
    and with `side_slip` it points beside its way. Where the sensors sit comes from the model.
    """

    def __init__(
        self,
        model: Model,
        base_frame: str,
        trajectory: Trajectory,
        origin: Origin,
        *,
        gps_frame: str | None = None,
        imu_frame: str | None = None,
        wheel_frames: Mapping[str, str] | None = None,
        rolling_frame: str | None = None,
        seed: int = 1,
        start_utime: int = START_UTIME,
        gps_model: GpsModel | None = None,
        imu_model: ImuModel | None = None,
        wheels_model: WheelsModel | None = None,
        status_model: StatusModel | None = None,
        terrain: Terrain | None = None,
        side_slip: SideSlip | None = None,
        second_gps_frame: str | None = None,
        pose_frame: str | None = None,
        pose_model: AbsolutePoseModel | None = None,
        odometry_frame: str | None = None,
        odometry_model: RelativePoseModel | None = None,
        range_frame: str | None = None,
        beacons: Mapping[str, Vector3] | None = None,
        range_model: RangeModel | None = None,
    ):
        """Take the vehicle, its drive and its sensors; a sensor without frame is not there.

        `second_gps_frame` is that of a second antenna. `pose_frame` is seen from outside, `odometry_frame` sees its
        own way, `range_frame` hears the `beacons`, places in World:ENU by name.

        `status_model` is that of a vehicle controller; without it there is none.

        `wheel_frames` has the frame of each wheel's contact point by the wheel's name. `origin` is that of the
        world frames and of the drive's east and north. Raises UnknownBodyError, UnknownFrameError or
        NotConnectedError for frames that the model does not have or join.
        """
        rolling = rolling_frame or base_frame

        def mounted(frame: str) -> Pose:
            return model.get_transformation(frame, rolling).pose

        self.trajectory = trajectory
        self.drive: MotionModel = ride(trajectory, terrain, side_slip, seed)
        """The trajectory as it is driven: on its ground and with its side slip."""
        self.geodesy = Geodesy(origin)
        self.start_utime = start_utime
        self._X_VB = mounted(base_frame)
        drive = self.drive
        sensors: list[Iterator[Event]] = []
        common = (self.geodesy, start_utime, seed)
        if imu_frame is not None:
            sensors.append(imu.readings(imu_model or ImuModel(), drive, mounted(imu_frame), *common, "imu"))
        if wheel_frames:
            contacts = {name: mounted(frame).xyz for name, frame in wheel_frames.items()}
            sensors.append(wheels.turns(wheels_model or WheelsModel(), drive, contacts, start_utime, seed, "wheels"))
        if status_model is not None:
            sensors.append(wheels.statuses(status_model, drive, start_utime, seed, "vehicle"))
        if gps_frame is not None:
            second = mounted(second_gps_frame).xyz if second_gps_frame is not None else None
            sensors.append(gps.fixes(gps_model or GpsModel(), drive, mounted(gps_frame), *common, "gps", second))
        if pose_frame is not None:
            poses = pose_model or AbsolutePoseModel()
            sensors.append(
                aiding.absolute_poses(poses, drive, pose_frame, mounted(pose_frame), *common, "absolute_pose")
            )
        if odometry_frame is not None:
            X_VF, odometry = mounted(odometry_frame), odometry_model or RelativePoseModel()
            sensors.append(
                aiding.relative_poses(odometry, drive, odometry_frame, X_VF, start_utime, seed, "relative_pose")
            )
        if range_frame is not None and beacons:
            lever, radio = mounted(range_frame).xyz, range_model or RangeModel()
            sensors.append(aiding.ranges(radio, drive, range_frame, lever, beacons, start_utime, seed, "range"))
        self._arrivals = heapq.merge(*sensors, key=lambda sample: sample.header.host_utime)
        self._next: Event | None = next(self._arrivals, None)
        self._until = start_utime

    def events(self, duration: float) -> Iterator[Event]:
        """Return the samples that arrive in the next `duration` seconds, in the order of arrival (host_utime).

        Each call goes on where the last one ended; what is left unread of one comes with the next.
        """
        self._until += round(duration * 1e6)
        return self._up_to(self._until)

    def _up_to(self, until: int) -> Iterator[Event]:
        while self._next is not None and self._next.header.host_utime < until:
            sample = self._next
            self._next = next(self._arrivals, None)
            yield sample

    def truth(self, utime: int) -> Truth:
        """Return where the base frame is at `utime`; before and after the drive it stands."""
        motion = self.drive.at((utime - self.start_utime) * 1e-6)
        enu = rigid.pose(motion, self._X_VB)
        latitude, longitude, height = self.geodesy.geodetic_from_enu(enu.xyz)
        velocity = rigid.velocity(motion, self._X_VB.xyz)
        to_base = conjugate(enu.wxyz)
        return Truth(
            utime,
            enu,
            self.geodesy.pose_in_utm(enu),
            latitude,
            longitude,
            height,
            velocity,
            rigid.acceleration(motion, self._X_VB.xyz),
            (rotate(to_base, velocity), rotate(to_base, rigid.angular_rate(motion))),
            motion.yaw,
            motion.yaw_rate,
        )
