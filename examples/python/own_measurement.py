"""A measurement of your own, without a change in the library: a ground-speed radar, and the error of scale it has.

A simulated drive without wheel encoders loses GPS for 30 s; printed is how far off the pose is then, without the radar
and with it. The first part is all that a measurement takes.

    python examples/python/own_measurement.py
"""

import math
import random
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modelserver.config import load_config
from modelserver.earth.geodesy import origin_at
from modelserver.localization.filter.layout import ErrorState
from modelserver.localization.filter.localizer import FilterLocalizer
from modelserver.localization.filter.measurements import REGISTRY, Compared, register
from modelserver.localization.filter.nav import jacobian_of_body_velocity
from modelserver.localization.filter.setup import Setup
from modelserver.messages import ImuSample, SensorHeader
from modelserver.service.daemon import load_vehicle
from modelserver.simulation import GpsModel, ImuModel, Simulation, Timing, Trajectory, figure_eight

# --- the measurement ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RadarSample:
    """Speed over ground straight ahead, m/s, too large by a share that depends on how the radar is mounted."""

    header: SensorHeader
    speed: float
    sigma: float = 0.05


@register
class Radar:
    """speed = (1 + radar_scale) v_x, v_x the forward speed of the rolling frame."""

    kind, sample = "radar", RadarSample
    states = (ErrorState(("radar_scale",), sigma=0.1, walk=1e-4),)

    @classmethod
    def of(cls, rig, settings):
        """Return the measurement for a vehicle: every vehicle can have a radar."""
        return cls()

    def instant(self, sample):
        """Return when it was measured."""
        return sample.header.utime

    def compare(self, scene, sample):
        """Return residual, Jacobian and noise."""
        scale, base = 1.0 + scene.extra("radar_scale"), scene.rig.base
        ahead = scene.nav.body_velocity(base)[0]
        H = scale * jacobian_of_body_velocity(scene.nav, base, scene.layout.size)[:1]
        H[0, scene.layout.index("radar_scale")] = ahead
        return Compared(np.array([sample.speed - scale * ahead]), H, np.array([[sample.sigma**2]]))


# --- a drive to try it on -----------------------------------------------------------------------------------

VEHICLE = Path(__file__).parents[2] / "config" / "raptor" / "vehicle.yaml"
LOST = (30.0, 60.0)


def error_when_lost(kinds):
    """Return how far the pose is off at the end of the time without GPS, metres, with some kinds of measurement."""
    vehicle = load_vehicle(load_config(VEHICLE))
    base, sensors, origin = vehicle.config.base_frame, vehicle.config.sensors, origin_at(50.27, -111.18, 700.0)
    drive = Simulation(
        vehicle.model,
        base,
        Trajectory(figure_eight(speed=3.0, radius=15.0, stand=4.0, laps=2)),
        origin,
        gps_frame=sensors.gps.frame,
        imu_frame=sensors.imu.frame,
        rolling_frame=vehicle.config.rolling_frame,
        gps_model=GpsModel(outages=(LOST,)),
        imu_model=ImuModel(Timing(50.0)),
    )
    X_rolling_base = vehicle.model.get_transformation(base, vehicle.config.rolling_frame).pose
    localizer = FilterLocalizer.start(Setup(vehicle.rig, kinds=kinds), origin)
    radar = random.Random(1)
    for sample in drive.events(LOST[1]):
        localizer, _ = localizer.take(sample)
        if isinstance(sample, ImuSample) and sample.header.seq % 5 == 0:
            header = SensorHeader(sample.header.utime, "radar", sample.header.seq)
            ahead = drive.truth(header.utime).twist[0][0]  # at the base frame, straight before the rolling one
            localizer, _ = localizer.take(RadarSample(header, 1.06 * ahead + radar.gauss(0.0, 0.05)))
    found = (localizer.estimate(localizer.utime).enu @ X_rolling_base).xyz
    return math.dist(found[:2], drive.truth(localizer.utime).enu.xyz[:2])


if __name__ == "__main__":
    every = list(REGISTRY.values())
    without = [kind for kind in every if kind is not Radar]
    print(f"30 s without GPS, by the inertial unit alone: off by {error_when_lost(without):.2f} m")
    print(f"30 s without GPS, with the radar:             off by {error_when_lost(every):.2f} m")
