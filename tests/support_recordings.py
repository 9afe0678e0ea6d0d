"""Small synthetic recordings: a straight drive to the east with the sensors of config/husky."""

from __future__ import annotations

import random
from collections.abc import Iterable
from pathlib import Path

import lcm
import pyproj

from modelserver.messages import FixType, GpsSample, ImuSample, SensorHeader
from modelserver.wire.codec import encode

REPOSITORY = Path(__file__).resolve().parents[1]
HUSKY = REPOSITORY / "config" / "husky" / "vehicle.yaml"

START = 1_700_000_000_000_000
SPEED = 2.0
EASTING, NORTHING, HEIGHT = 323_204.0, 4_693_737.0, -21.0
LATENCY = 5_000
"""Microseconds between a measurement and its arrival."""


def write_log(path: Path, events: Iterable[tuple[int, str, bytes]]) -> Path:
    """Write events (time of arrival, channel, bytes) and return the path."""
    log = lcm.EventLog(str(path), "w", overwrite=True)
    for utime, channel, data in events:
        log.write_event(utime, channel, data)
    log.close()
    return path


def drive(seconds: float, prefix: str = "") -> list[tuple[int, str, bytes]]:
    """Return the events of a drive along grid east: IMU at 50 Hz, fixes at 5 Hz, by order of arrival.

    The vehicle drives from the first sample on, with vibration.
    """
    to_geodetic = pyproj.Transformer.from_crs(32619, 4326, always_xy=True)
    shaken = random.Random(20050901).gauss
    events = []
    for n in range(round(seconds * 50)):
        utime = START + n * 20_000
        header = SensorHeader(utime, "imu", n, utime + LATENCY)
        # the unit's y axis points up, see config/husky/geometry.yaml
        rate = (shaken(0.0, 0.02), shaken(0.0, 0.02), shaken(0.0, 0.02))
        force = (shaken(0.0, 0.3), 9.81 + shaken(0.0, 0.3), shaken(0.0, 0.3))
        imu = ImuSample(header, angular_velocity=rate, specific_force=force)
        events.append((utime + LATENCY, f"{prefix}IMU", encode(imu)))
        if n % 10 == 0:
            longitude, latitude = to_geodetic.transform(EASTING + SPEED * n * 0.02, NORTHING)
            fix = GpsSample(
                SensorHeader(utime, "gps", n // 10, utime + LATENCY),
                FixType.DIFFERENTIAL,
                latitude,
                longitude,
                height_ellipsoidal=HEIGHT,
                position_covariance=(0.04, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0, 0.16),
            )
            events.append((utime + LATENCY, f"{prefix}GPS", encode(fix)))
    return events


def write_forward_vehicle(folder: Path) -> Path:
    """Write the Husky's vehicle file for `drive`, which starts at speed without wheels: a setting has the direction."""
    (folder / "geometry.yaml").write_bytes(HUSKY.with_name("geometry.yaml").read_bytes())
    path = folder / "vehicle.yaml"
    path.write_text(HUSKY.read_text().replace("  filter:\n", "  filter:\n    reverse_speed: 1.5\n"))
    return path
