"""The Husky A200 in a car park, `husky/test1.bag`, as `modelserver import-bag` writes it; and its body turned round.

Times, by cross-correlation: the unit's rate about y follows the rate of the odometry's pose by 0.10 s (correlation
0.997, its scale 1.02 of it), the odometry's twist follows its pose by 0.5 s (0.99). Fixes follow the way that the
odometry and the gyro make by about 1 s, on a flat minimum (1.62 m rms at 1.0 s, 1.65 m at 0, over 60 s each). IMU
messages arrive 21 to 36 ms after their stamps, fixes and odometry within 1 ms. Nothing is moved.

`turned_geometry` and `turned_events` make the same recording of a vehicle whose front is its rear: every frame of
the body stands at (-x, -y, z), what is mounted with an orientation is turned by 180 degrees with it, and the wheels
roll backward where they rolled forward. Nothing that was measured outside the vehicle's own axes changes, so a
localization that has no favourite direction finds the antenna at the same places, and the vehicle's yaw half a turn
off.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from modelserver.messages import Direction, WheelSample, WheelsSample
from modelserver.wire import codec
from modelserver.wire.eventlog import LogEvent
from mstools.recordings.bag_log import import_bag

_BACK = {Direction.FORWARD: Direction.BACKWARD, Direction.BACKWARD: Direction.FORWARD}


def file(data: Path) -> Path:
    """Return the bag."""
    return data / "husky" / "test1.bag"


def convert(data: Path, log: Path) -> dict[str, int]:
    """Write the log; return the number of messages by channel. Needs rosbags."""
    report = import_bag(file(data), log, force=True)
    return {each.channel: each.written for each in report.topics if each.channel}


def write_turned_vehicle(
    vehicle: Path, directory: Path, body: str = "Husky", mounts: Collection[str] = ("ImuMount",)
) -> Path:
    """Write a vehicle file and its geometry with one body rotated by 180 degrees about z; return the vehicle file.

    `mounts` are the frames of the body that carry something with an orientation of its own. The others keep their axes
    along the body's, as a wheel's contact frame and the base frame must: their x is the new front.
    """
    settings = yaml.safe_load(vehicle.read_text(encoding="utf-8"))
    given = yaml.safe_load((vehicle.parent / settings["geometry"]).read_text(encoding="utf-8"))
    (directory / "turned_geometry.yaml").write_text(yaml.safe_dump(turn_geometry(given, body, mounts)), "utf-8")
    settings["geometry"] = "turned_geometry.yaml"
    path = directory / "turned_vehicle.yaml"
    path.write_text(yaml.safe_dump(settings, sort_keys=False), "utf-8")
    return path


def turn_geometry(given: dict[str, Any], body: str, mounts: Collection[str]) -> dict[str, Any]:
    """Return a geometry file's content with one body rotated; see `write_turned_vehicle`."""
    frames = {}
    for name, frame in given["bodies"][body]["frames"].items():
        x, y, z = frame.get("xyz", (0.0, 0.0, 0.0))
        frames[name] = {**frame, "xyz": [-x, -y, z]}
        if name in mounts:
            roll, pitch, yaw = frame.get("rpy_deg", (0.0, 0.0, 0.0))
            # fixed-axis angles apply yaw last: a rotation of the body adds to it
            frames[name]["rpy_deg"] = [roll, pitch, math.remainder(yaw + 180.0, 360.0)]
    bodies = {**given["bodies"], body: {**given["bodies"][body], "frames": frames}}
    return {**given, "bodies": bodies}


def reverse_wheels(events: Iterable[LogEvent], channel: str = "WHEELS") -> Iterator[LogEvent]:
    """Yield the events with reversed travel, speed and direction of the wheels."""
    for event in events:
        if event.channel == channel:
            sample: WheelsSample = codec.decode("wheels_t", event.data)
            wheels = tuple(_reverse(each) for each in sample.wheels)
            yield event._replace(data=codec.encode(replace(sample, wheels=wheels)))
        else:
            yield event


def _reverse(wheel: WheelSample) -> WheelSample:
    direction = _BACK.get(wheel.direction, wheel.direction)
    return replace(wheel, travel=-wheel.travel, speed=-wheel.speed, direction=direction)
