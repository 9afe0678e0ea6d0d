"""A car in Dresden, 216 s: a cheap inertial unit at 50 Hz and a receiver whose values are refreshed at about 10 Hz.

The file has names and no units; the data decide. Correlations are over the moving part, smoothed over 0.5 s, each at
the delay where it is largest (the tests hold them):

- Rates are degrees per second (the file's own yaw changes by 0.93 of the summed yaw rate, its roll and pitch by more),
  accelerations m/s2 (their mean has length 9.78).
- **The accelerometer has the other sign than the gyro.** `ax, ay, az` are the reaction turned round (gravity's own
  direction: az = -9.6): -ax goes with the change of speed (0.83), -ay with speed times turning to the left (0.67), and
  the yaw rate with turning to the left (0.79). No mount can fix that, since no rotation turns the one and not the
  other. So the specific force is -(ax, ay, az), and then all axes are forward, left, up.
- Gravity lies 10.3 degrees off in pitch and 1.4 in roll, with the sensor's x axis pointing down; the file's own pitch
  agrees (mean 10.2, correlation with the force 0.89). The street rises by 0.7 degrees on the whole. It is the
  mount, and stands in the vehicle's geometry.
- Time: `millis` is the logging computer's clock, and stamps the inertial rows. `time` is the receiver's clock; it runs
  0.2 to 0.3 s *ahead* of the computer's when it shows up, so the computer's is slow by that and more, and the two
  do not give the age of a fix. Motion does: position follows the inertial unit by 0.5 s (force against the
  change of the speed over the positions 0.54 s, yaw rate against their turning 0.46 s), speed and course by 1.0 s
  (0.96 and 1.04 s). A fix's `utime` is therefore its arrival minus POSITION_LATENCY, and its `velocity_latency` is
  VELOCITY_LATENCY; `host_utime` is the arrival, `device_utime` the receiver's clock. Without, a car at 8 m/s is 4 m
  behind itself.
- A new position shows up in one row, the speed and course that go with it one to three rows later: a fix holds the
  speed and course that were there when its position came. Rows in which the position does not change make no fix.
- `altitude` is above mean sea level: 112 m, as the Elbe's bank is there; 44 m less than the ellipsoid's. The undulation
  is not in the file and none is claimed.
- `epe` is the receiver's own figure, 2.4 to 7.7 m, and does not follow the dilutions (correlation with HDOP -0.36).
  Whether it is meant for 68 or 95 % and in the plane or in space is not documented; it is taken for one standard
  deviation in the plane, the larger reading: `epe`/sqrt(2) on each horizontal axis, and VDOP/HDOP times `epe` upward.
  No fix is differential.
- The course is compass degrees (from north, clockwise): it agrees with the direction of the positions (median 0.4
  degrees). Speed is km/h: 1.03 of the speed over the positions is 1.
"""

from __future__ import annotations

import calendar
import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.recordings.log_writer import Arrival, write_samples
from modelserver.messages import FixType, GpsSample, ImuSample, SensorHeader
from modelserver.transforms.so3 import Matrix3

POSITION_LATENCY = 0.5
"""Seconds from the instant a position holds for to the row it shows up in, by the computer's clock; see above."""
VELOCITY_LATENCY = 0.5
"""Seconds by which speed and course are older than the position that they are reported with."""

_FIX_TYPES = {"2": FixType.FIX_2D, "3": FixType.FIX_3D}


def file(data: Path) -> Path:
    """Return the file."""
    return data / "dresden" / "2014-03-26-000-Data.csv"


def convert(data: Path, log: Path, latency: float = POSITION_LATENCY) -> dict[str, int]:
    """Write the log; return the number of messages by channel. OSError where the file is absent."""
    with file(data).open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    return write_samples(log, [*_imu(rows), *_gps(rows, latency)])


def _arrival(row: Mapping[str, str]) -> int:
    return round(float(row["millis"]) * 1e3)


def _imu(rows: list[dict[str, str]]) -> Iterator[Arrival]:
    for number, row in enumerate(rows):
        utime = _arrival(row)
        x, y, z = (math.radians(float(row[key])) for key in ("rollrate", "pitchrate", "yawrate"))
        fx, fy, fz = (-float(row[key]) for key in ("ax", "ay", "az"))
        header = SensorHeader(utime, "imu", number, utime)
        yield (
            utime,
            "IMU",
            ImuSample(header, (x, y, z), (fx, fy, fz), temperature_celsius=float(row["temp"])),
        )


def _gps(rows: list[dict[str, str]], latency: float) -> Iterator[Arrival]:
    place: tuple[str, str] | None = None
    number = 0
    for row in rows:
        before, place = place, (row["latitude"], row["longitude"])
        if before is None or place == before:
            continue  # the age of the first row's position is unknown
        arrival = _arrival(row)
        header = SensorHeader(arrival - round(latency * 1e6), "gps", number, arrival, device_utime=_receiver_utime(row))
        number += 1
        yield arrival, "GPS", _fix(row, header)


def _fix(row: Mapping[str, str], header: SensorHeader) -> GpsSample:
    pdop, hdop, vdop = (float(row[key]) for key in ("pdop", "hdop", "vdop"))
    return GpsSample(
        header,
        _FIX_TYPES.get(row["fix"], FixType.NONE),
        float(row["latitude"]),
        float(row["longitude"]),
        height_msl=float(row["altitude"]),
        satellites=int(row["satellites_used"]),
        hdop=hdop,
        vdop=vdop,
        pdop=pdop,
        position_covariance=_covariance(float(row["epe"]), vdop / hdop),
        velocity_latency=VELOCITY_LATENCY,
        speed=float(row["speed"]) / 3.6,
        course=math.remainder(math.radians(90.0 - float(row["course"])), math.tau),
    )


def _covariance(epe: float, upward: float) -> Matrix3:
    across, up = epe**2 / 2.0, (epe * upward) ** 2
    return (across, 0.0, 0.0, 0.0, across, 0.0, 0.0, 0.0, up)


def _receiver_utime(row: Mapping[str, str]) -> int:
    """Return the receiver's clock: `date` is ddmmyy, `time` hhmmss and milliseconds."""
    date, time = row["date"].zfill(6), row["time"].zfill(9)
    day = calendar.timegm(
        (2000 + int(date[4:6]), int(date[2:4]), int(date[:2]), int(time[:2]), int(time[2:4]), int(time[4:6]))
    )
    return day * 1_000_000 + int(time[6:]) * 1_000
