"""A simulated vehicle with truth and sensors: deterministic from a seed, no clock, no device. Pure.

trajectory = Trajectory(figure_eight(speed=2.0, radius=8.0))
simulation = Simulation(model, "Raptor:CG", trajectory, origin_at(50.27, -111.1, 700.0),
                        gps_frame="GPSAntenna:PhaseCentre", imu_frame="Microstrain:Sensor", seed=7)
for sample in simulation.events(30.0):      # in order of arrival
    ...
simulation.truth(sample.header.utime).enu   # where the base frame really was

More on request: ground that rises (`Terrain`), side slip (`SideSlip`), errors of every sensor, further sources;
`faults` has what goes wrong on the way from a sensor to the server.
"""

from modelserver.simulation.aiding import AbsolutePoseModel, RangeModel, RelativePoseModel
from modelserver.simulation.encoder import EncoderModel
from modelserver.simulation.figures import (
    city,
    figure_eight,
    reverse_eight,
    stand,
    stop_and_go,
    straight,
    there_and_back,
)
from modelserver.simulation.gps import GpsModel
from modelserver.simulation.imu import ImuModel
from modelserver.simulation.magnetometer import MagnetometerModel
from modelserver.simulation.ride import Ride, ride
from modelserver.simulation.scenario import Event, Simulation, Truth
from modelserver.simulation.side_slip import SideSlip
from modelserver.simulation.stamps import Timing
from modelserver.simulation.terrain import Terrain, Wave
from modelserver.simulation.trajectory import DrivePhase, MotionModel, Trajectory, TrajectoryMotion
from modelserver.simulation.triad import TriadModel
from modelserver.simulation.wheels import StatusModel, WheelsModel

__all__ = [
    "AbsolutePoseModel",
    "DrivePhase",
    "EncoderModel",
    "Event",
    "GpsModel",
    "ImuModel",
    "MagnetometerModel",
    "MotionModel",
    "RangeModel",
    "RelativePoseModel",
    "Ride",
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
    "reverse_eight",
    "ride",
    "stand",
    "stop_and_go",
    "straight",
    "there_and_back",
]
