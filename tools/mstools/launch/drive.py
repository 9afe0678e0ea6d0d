"""The simulated drive of `modelserver demo` and of emulated devices: the same start time gives the same truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.earth.geodesy import origin_at
from modelserver.formats import load_model
from modelserver.geometry import Model
from modelserver.messages import GpsSample, ImuSample, Sample, VehicleStatusSample, WheelsSample
from modelserver.simulation import GpsModel, ImuModel, Simulation, StatusModel, Timing, Trajectory, WheelsModel
from modelserver.simulation import trajectory as figures
from modelserver.simulation.trajectory import DrivePhase

SUFFIELD = (50.27, -111.18, 700.0)
"""Test site of the report's vehicle, roughly: latitude and longitude in degrees, height in meters."""

STATIONARY_SECONDS = 3.0
"""Leveling takes two seconds without motion, after the detection of the stationary vehicle."""

WHEELS_HZ = 100.0
"""Rate of wheels and vehicle controller."""

TYPICAL_WHEELBASE = 1.5
"""Meters; for a vehicle file without steered wheels."""

LAP_SECONDS = 25.0
"""A figure of eight takes a little longer."""


def make_simulation(
    config: VehicleConfig,
    start_utime: int,
    seconds: float,
    scenario: str = "eight",
    seed: int = 1,
    sensors: Sequence[type[Sample]] = (),
    gps_model: GpsModel | None = None,
    imu_model: ImuModel | None = None,
    wheels_model: WheelsModel | None = None,
) -> Simulation:
    """Return a drive of at least `seconds` with the measurements of the sample types in `sensors`."""
    gps, imu, wheels = config.sensors.gps, config.sensors.imu, config.sensors.wheels
    model = load_model(config.geometry, variables=config.variables)
    status = None
    if VehicleStatusSample in sensors:
        status = StatusModel(_get_wheelbase(config, model), wheels_model.timing if wheels_model else Timing(WHEELS_HZ))
    return Simulation(
        model,
        config.base_frame,
        Trajectory(_make_phases(scenario, seconds, seed), yaw=0.5),
        origin_at(*SUFFIELD),
        gps_frame=gps.frame if gps and GpsSample in sensors else None,
        imu_frame=imu.frame if imu and ImuSample in sensors else None,
        wheel_frames=wheels.frames if wheels and WheelsSample in sensors else None,
        rolling_frame=config.rolling_frame or config.base_frame,
        seed=seed,
        start_utime=start_utime,
        gps_model=gps_model,
        imu_model=imu_model,
        wheels_model=wheels_model,
        status_model=status,
    )


def _get_wheelbase(config: VehicleConfig, model: Model) -> float:
    """Return the distance of the steered axle from the rolling frame, m; `TYPICAL_WHEELBASE` if none is steered."""
    wheels = config.sensors.wheels
    if wheels is None or wheels.steering is None:
        return TYPICAL_WHEELBASE
    rolling = config.rolling_frame or config.base_frame
    steered = [wheels.frames[name] for name in wheels.steering.wheels if name in wheels.frames]
    ahead = [model.get_transformation(frame, rolling).pose.xyz[0] for frame in steered]
    return sum(ahead) / len(ahead) if ahead else TYPICAL_WHEELBASE


def _make_phases(scenario: str, seconds: float, seed: int) -> tuple[DrivePhase, ...]:
    if scenario == "stand":
        return figures.stationary(seconds)
    if scenario == "circle":
        # full circles, as for a magnetometer calibration
        return (DrivePhase(3.0, 4.0, 0.25), DrivePhase(seconds), DrivePhase(3.0, 0.0))
    if scenario == "straight":
        return figures.straight()
    if scenario == "city":
        return figures.city(seed, seconds)
    laps = max(1, math.ceil(seconds / LAP_SECONDS))
    return figures.figure_eight(speed=3.0, radius=6.0, stationary=STATIONARY_SECONDS, ramp=2.0, laps=laps)
