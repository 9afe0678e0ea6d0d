"""Simulated vehicle with truth and sensors: deterministic from a seed, without clock or device. Pure.

trajectory = Trajectory(figure_eight(speed=2.0, radius=8.0))
simulation = Simulation(model, "Raptor:CG", trajectory, origin_at(50.27, -111.1, 700.0),
                        gps_frame="GPSAntenna:PhaseCenter", imu_frame="Microstrain:Sensor", seed=7)
for sample in simulation.events(30.0):      # in order of arrival
    ...
simulation.truth(sample.header.utime).enu   # true pose of the base frame

Options: uneven ground (`Terrain`), side slip (`SideSlip`), errors of every sensor (`GpsModel`, `ImuModel`, ...), aiding
sensors.
"""

from modelserver.simulation.aiding import AbsolutePoseModel, RangeModel, RelativePoseModel
from modelserver.simulation.gps import GpsModel
from modelserver.simulation.ground_motion import GroundMotion, SideSlip, Terrain, Wave, make_motion
from modelserver.simulation.imu import ImuModel, MagnetometerModel, TriadModel
from modelserver.simulation.maneuvers import (
    city,
    figure_eight,
    stationary,
    straight,
)
from modelserver.simulation.scenario import Event, Simulation, Truth
from modelserver.simulation.timing import Timing
from modelserver.simulation.trajectory import DrivePhase, MotionModel, Trajectory, TrajectoryMotion
from modelserver.simulation.wheels import EncoderModel, StatusModel, WheelsModel

__all__ = [
    "AbsolutePoseModel",
    "DrivePhase",
    "EncoderModel",
    "Event",
    "GpsModel",
    "GroundMotion",
    "ImuModel",
    "MagnetometerModel",
    "MotionModel",
    "RangeModel",
    "RelativePoseModel",
    "SideSlip",
    "Simulation",
    "StatusModel",
    "Terrain",
    "Timing",
    "Trajectory",
    "TrajectoryMotion",
    "TriadModel",
    "Truth",
    "Wave",
    "WheelsModel",
    "city",
    "figure_eight",
    "make_motion",
    "stationary",
    "straight",
]
