"""A measurement of your own, without changing the library: a ground-speed radar with a scale factor error.

A simulated drive without wheel encoders loses GPS for 30 s; the position error at the end is printed without and with
the radar. The first part is all that a measurement needs; as an installed package it is used by the daemon.

    python examples/python/own_measurement.py
"""

import math
import random
from pathlib import Path

import numpy as np

from modelserver.config.vehicle_file import load_config
from modelserver.earth.geodesy import origin_at
from modelserver.estimation.filter.eskf import ErrorState
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.measurements import MEASUREMENT_TYPES, Innovation
from modelserver.estimation.filter.measurements.measurement import body_velocity_jacobian, read_covariance
from modelserver.estimation.filter.state import Setup
from modelserver.messages import ImuSample, MeasurementSample, SensorHeader
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import GpsModel, ImuModel, Simulation, Timing, Trajectory, figure_eight

# --- the measurement ----------------------------------------------------------------------------------------


class Radar:
    """speed = (1 + radar_scale) v_x: the forward speed, and a scale from the angle at which the radar is mounted."""

    values = ("forward speed over ground, m/s",)
    states = (ErrorState(("radar_scale",), sigma=0.1, walk=1e-4),)
    is_absolute = False

    def evaluate(self, context, sample):
        """Return residual, Jacobian and noise covariance."""
        scale, base = 1.0 + context.extra("radar_scale"), context.rig.base
        forward = context.nav.body_velocity(base)[0]
        H = scale * body_velocity_jacobian(context.nav, base, context.layout.size)[:1]
        H[0, context.layout.index("radar_scale")] = forward
        residual = np.array([sample.values[0] - scale * forward])
        return Innovation(residual, H, read_covariance(sample, sigma=0.05))


RADAR = Radar()


# --- a simulated drive --------------------------------------------------------------------------------------

VEHICLE = Path(__file__).parents[2] / "config" / "raptor" / "vehicle.yaml"
OUTAGE = (30.0, 60.0)


def simulate_outage(own):
    """Return the position error at the end of the GPS outage, meters; `own`: sources of measurements with types."""
    vehicle = load_vehicle(load_config(VEHICLE))
    base, sensors, origin = vehicle.config.base_frame, vehicle.config.sensors, origin_at(50.27, -111.18, 700.0)
    drive = Simulation(
        vehicle.model,
        base,
        Trajectory(figure_eight(speed=3.0, radius=15.0, stationary=4.0, laps=2)),
        origin,
        gps_frame=sensors.gps.frame,
        imu_frame=sensors.imu.frame,
        rolling_frame=vehicle.config.rolling_frame,
        gps_model=GpsModel(outages=(OUTAGE,)),
        imu_model=ImuModel(Timing(50.0)),
    )
    X_rolling_base = vehicle.model.get_transformation(base, vehicle.config.rolling_frame).pose
    localizer = FilterLocalizer.start(Setup(vehicle.rig, own=own), origin)
    radar = random.Random(1)
    for sample in drive.events(OUTAGE[1]):
        localizer, _ = localizer.process(sample)
        if isinstance(sample, ImuSample) and sample.header.seq % 5 == 0:
            header = SensorHeader(sample.header.utime, "radar", sample.header.seq)
            forward = drive.truth(header.utime).twist[0][0]  # at the base frame, on the x axis of the rolling one
            localizer, _ = localizer.process(MeasurementSample(header, (1.06 * forward + radar.gauss(0.0, 0.05),)))
    found = (localizer.estimate(localizer.utime).enu @ X_rolling_base).xyz
    return math.dist(found[:2], drive.truth(localizer.utime).enu.xyz[:2])


if __name__ == "__main__":
    MEASUREMENT_TYPES.add("ground_radar", RADAR)
    print(f"30 s without GPS, IMU only:       error {simulate_outage({}):.2f} m")
    print(f"30 s without GPS, with the radar: error {simulate_outage({'radar': 'ground_radar'}):.2f} m")
