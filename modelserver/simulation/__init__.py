"""Simulated vehicle with truth and sensors: deterministic from a seed, without clock or device. Pure.

trajectory = Trajectory(figure_eight(speed=2.0, radius=8.0))
simulation = Simulation(model, "Raptor:CG", trajectory, origin_at(50.27, -111.1, 700.0),
                        gps_frame="GPSAntenna:PhaseCenter", imu_frame="Microstrain:Sensor", seed=7)
for sample in simulation.events(30.0):      # in order of arrival
    ...
simulation.truth(sample.header.utime).enu   # true pose of the base frame

Options: errors of every sensor (`GpsModel`, `ImuModel`, ...), another motion, more sensors.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from modelserver import messages
from modelserver.earth.geodesy import Geodesy
from modelserver.geometry.model import Model
from modelserver.simulation.sensors import *
from modelserver.simulation.trajectory import *
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3, conjugate, rotate

START_UTIME = 1_750_000_000_000_000
"""Default start of a simulation: a whole second in June 2025."""

Event: TypeAlias = messages.Sample


@dataclass(frozen=True, slots=True)
class Truth:
    """True motion of the base frame at one instant.

    Attributes
    ----------
    enu, utm : pose in World:ENU and World:UTM, relative to the origin
    latitude_deg, longitude_deg, height : the same position on the ellipsoid
    velocity, acceleration : along east, north, up of the origin
    twist : velocity and angular velocity along the axes of the base frame
    yaw, yaw_rate : counter-clockwise from true east, not wrapped
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
    """One run. The same arguments give the same samples, however they are requested.

    The trajectory is that of `rolling_frame`, whose x axis points along the path: the frame that does not slide
    sideways (the middle of the rear axle of a vehicle with front-wheel steering), by default the base frame. It moves
    on the tangent plane of the origin. Sensor poses are the model's.
    """

    def __init__(
        self,
        model: Model,
        base_frame: str,
        trajectory: Trajectory,
        origin: messages.Origin,
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
        second_gps_frame: str | None = None,
        motion: MotionModel | None = None,
        more_sensors: Sequence[Callable[[Run], Iterator[Event]]] = (),
    ):
        """Set up vehicle, drive and sensors; a sensor without a frame is absent.

        Parameters
        ----------
        origin : origin of the world frames and of the drive's east and north
        wheel_frames : frame of each wheel's contact point, by the wheel's name
        status_model : of a vehicle controller; None for none
        second_gps_frame : second antenna of the GPS receiver
        motion : the trajectory as it is driven, on uneven ground for example; by default the trajectory itself
        more_sensors : each returns the samples of one more sensor of the run

        Raises UnknownBodyError, UnknownFrameError or NotConnectedError for frames that the model does not have or
        connect.
        """
        rolling = rolling_frame or base_frame

        def pose_of(frame: str) -> Pose:
            return model.get_transformation(frame, rolling).pose

        self.trajectory = trajectory
        self.drive: MotionModel = motion or trajectory
        self.geodesy = Geodesy(origin)
        self.start_utime = start_utime
        self._X_VB = pose_of(base_frame)
        run = Run(self.drive, self.geodesy, start_utime, seed)
        sensors: list[Iterator[Event]] = []
        if imu_frame is not None:
            sensors.append(simulate_imu(imu_model or ImuModel(), run, pose_of(imu_frame)))
        if wheel_frames:
            contacts = {name: pose_of(frame).xyz for name, frame in wheel_frames.items()}
            sensors.append(simulate_wheels(wheels_model or WheelsModel(), run, contacts))
        if status_model is not None:
            sensors.append(simulate_status(status_model, run))
        if gps_frame is not None:
            second = pose_of(second_gps_frame).xyz if second_gps_frame is not None else None
            sensors.append(simulate_fixes(gps_model or GpsModel(), run, pose_of(gps_frame), second))
        sensors += [simulate(run) for simulate in more_sensors]
        self._arrivals = heapq.merge(*sensors, key=lambda sample: sample.header.host_utime)
        self._next: Event | None = next(self._arrivals, None)
        self._until = start_utime

    def events(self, duration: float) -> Iterator[Event]:
        """Return the samples that arrive in the next `duration` seconds, in order of arrival (host_utime)."""
        self._until += round(duration * 1e6)
        return self._events_until(self._until)

    def _events_until(self, until: int) -> Iterator[Event]:
        while self._next is not None and self._next.header.host_utime < until:
            sample, self._next = self._next, next(self._arrivals, None)
            yield sample

    def truth(self, utime: int) -> Truth:
        """Return the true motion of the base frame at `utime`; before and after the drive it is stationary."""
        motion = self.drive.at((utime - self.start_utime) * 1e-6)
        enu = motion.pose_of(self._X_VB)
        latitude, longitude, height = self.geodesy.geodetic_from_enu(enu.xyz)
        velocity = motion.velocity_at(self._X_VB.xyz)
        to_base = conjugate(enu.wxyz)
        return Truth(
            utime,
            enu,
            self.geodesy.pose_in_utm(enu),
            latitude,
            longitude,
            height,
            velocity,
            motion.acceleration_at(self._X_VB.xyz),
            (rotate(to_base, velocity), rotate(to_base, motion.angular_rate())),
            motion.yaw,
            motion.yaw_rate,
        )
