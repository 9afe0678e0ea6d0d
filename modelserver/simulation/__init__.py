"""A simulated vehicle with truth and sensors: deterministic from a seed, no clock, no device. Pure.

trajectory = Trajectory(figure_eight(speed=2.0, radius=8.0))
simulation = Simulation(model, "Raptor:CG", trajectory, origin_at(50.27, -111.1, 700.0),
                        gps_frame="GPSAntenna:PhaseCentre", imu_frame="Microstrain:Sensor", seed=7)
for sample in simulation.events(30.0):      # in order of arrival
    ...
simulation.truth(sample.header.utime).enu   # where the base frame really was
"""

from modelserver.simulation.figures import figure_eight, straight, there_and_back
from modelserver.simulation.gps import GpsModel
from modelserver.simulation.imu import ImuModel
from modelserver.simulation.scenario import Simulation, Truth
from modelserver.simulation.trajectory import Motion, Phase, Trajectory
from modelserver.simulation.wheels import WheelsModel

__all__ = [
    "GpsModel",
    "ImuModel",
    "Motion",
    "Phase",
    "Simulation",
    "Trajectory",
    "Truth",
    "WheelsModel",
    "figure_eight",
    "straight",
    "there_and_back",
]
