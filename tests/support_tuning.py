"""A simulated drive of the Raptor as a log with its vehicle file, for tests of tools that process a whole drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from support_recordings import REPOSITORY, write_log

from modelserver.config.vehicle_file import load_config
from modelserver.earth.geodesy import origin_at
from modelserver.messages import GpsSample, ImuSample, WheelsSample
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import ImuModel, Simulation, Timing, Trajectory, figure_eight
from modelserver.wire.codec import encode

RAPTOR = REPOSITORY / "config" / "raptor" / "vehicle.yaml"


def write_simulated_log(folder: Path, seconds: float, **models: Any) -> tuple[Path, Path]:
    """Write the log of a figure-eight drive; `models` go to the `Simulation`. Return log and vehicle file."""
    config = load_config(RAPTOR)
    vehicle = load_vehicle(config, str(RAPTOR))
    sensors = config.sensors
    models.setdefault("imu_model", ImuModel(Timing(25.0)))
    assert sensors.gps is not None
    assert sensors.imu is not None
    assert sensors.wheels is not None
    drive = Simulation(
        vehicle.model,
        config.base_frame,
        Trajectory(figure_eight(speed=3.0, radius=8.0, stationary=4.0, ramp=2.0, laps=8)),
        origin_at(50.27, -111.18, 700.0),
        gps_frame=sensors.gps.frame,
        imu_frame=sensors.imu.frame,
        wheel_frames=sensors.wheels.frames,
        rolling_frame=config.rolling_frame,
        seed=4,
        **models,
    )
    channels = {GpsSample: sensors.gps.channel, ImuSample: sensors.imu.channel, WheelsSample: sensors.wheels.channel}
    events = [(each.header.host_utime, channels[type(each)], encode(each)) for each in drive.events(seconds)]
    return write_log(folder / "drive.lcm", events), RAPTOR


def write_vehicle(vehicle: Path, folder: Path, localization: dict[str, Any]) -> Path:
    """Write a copy of a vehicle file with other keys in its section localization; return its path."""
    content = yaml.safe_load(vehicle.read_text(encoding="utf-8"))
    content["geometry"] = str((vehicle.parent / content["geometry"]).resolve())
    content.setdefault("localization", {}).update(localization)
    path = folder / "vehicle.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path
