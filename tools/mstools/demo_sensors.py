"""The simulated vehicle of `modelserver demo`, and the process that publishes its sensors in real time.

Run by the demo as `python -m mstools.demo_sensors`; the demo makes the same simulation to know the truth.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

from modelserver.config import VehicleConfig, load_config
from modelserver.formats import load_model
from modelserver.geodesy import origin_at
from modelserver.messages import GpsSample, ImuSample
from modelserver.simulation import Simulation, Trajectory, figure_eight
from modelserver.simulation.scenario import Event
from modelserver.wire.codec import encode
from modelserver.wire.provider import open_lcm, resolve_url

SUFFIELD = (50.27, -111.18, 700.0)
"""Where the report's vehicle was tried, roughly: latitude and longitude in degrees, height in metres."""

STAND_SECONDS = 3.0
"""Levelling takes two seconds at rest, and a moment until rest is seen."""

LAP_SECONDS = 25.0
"""An eight takes a little longer."""


def simulation(config: VehicleConfig, start_utime: int, seconds: float, seed: int) -> Simulation:
    """Return the drive: at rest until the localization is level, then round an eight for `seconds` or more."""
    laps = math.ceil(seconds / LAP_SECONDS)
    sensors = config.sensors
    return Simulation(
        load_model(config.geometry, variables=config.variables),
        config.base_frame,
        Trajectory(figure_eight(speed=3.0, radius=6.0, stand=STAND_SECONDS, ramp=2.0, laps=laps), yaw=0.5),
        origin_at(*SUFFIELD),
        gps_frame=sensors.gps.frame if sensors.gps else None,
        imu_frame=sensors.imu.frame if sensors.imu else None,
        wheel_frames=sensors.wheels.frames if sensors.wheels else None,
        rolling_frame=config.rolling_frame or config.base_frame,
        seed=seed,
        start_utime=start_utime,
    )


def channel_of(sample: Event, config: VehicleConfig) -> str:
    """Return the channel that the vehicle file hears a sample on."""
    sensors = config.sensors
    sensor = (
        sensors.gps
        if isinstance(sample, GpsSample)
        else sensors.imu
        if isinstance(sample, ImuSample)
        else sensors.wheels
    )
    assert sensor is not None
    return f"{config.lcm.channel_prefix}{sensor.channel}"


def publish(config: VehicleConfig, url: str, start_utime: int, seconds: float, seed: int) -> None:
    """Publish the samples, each when it would have arrived, for `seconds`."""
    bus = open_lcm(resolve_url(url))
    run = simulation(config, start_utime, seconds, seed)
    # from here on the monotonic clock: a step of the time of day must not stop the sensors
    offset_ns = time.monotonic_ns() - time.time_ns()
    for sample in run.events(seconds):
        wait_ns = sample.header.host_utime * 1000 + offset_ns - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
        bus.publish(channel_of(sample, config), encode(sample))


def main() -> None:
    """Read the command line and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, required=True, help="the vehicle file")
    parser.add_argument("--url", default="", help="LCM provider")
    parser.add_argument("--start-utime", type=int, required=True, help="when the drive starts")
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    publish(load_config(given.config), given.url, given.start_utime, given.seconds, given.seed)


if __name__ == "__main__":
    main()
