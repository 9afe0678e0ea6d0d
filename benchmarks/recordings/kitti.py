"""KITTI, as GTSAM carries it: a car in Karlsruhe, 471 s, 3.7 km; IMU 100 Hz, GPS 1 Hz.

Conventions of the files, verified with the data (the tests check these):

- Time is seconds of the day; both files count alike. The day is not in the files: the epoch below is the day of the
  drive, 2011-09-30, and no figure rests on it. By cross-correlation the IMU's stamps lie 0.02 s (rate about z against
  the turning of the chords between fixes) to 0.04 s (force along x against their speed) after the fixes': as good
  as none at 1 Hz, and nothing is moved.
- The IMU's axes are forward, left, up: mean specific force (-0.05, 0.27, 9.79) m/s2; its rate about z goes with the
  rate of the course counter-clockwise (correlation 0.98), its force along x with the change of speed (0.99), along y
  with speed times turning (0.96). Gyros rad/s, force m/s2.
- Its first row lies 1.9 s before the second, with a `dt` of the whole time of day. It is a sample like any other;
  after it 1.9 s are missing, and so are they in the log. The first fixes are 2.9 s apart for the same reason.
- GPS: x east, y north, z up, meters, from an origin that the files do not name. They are put on the tangent plane of a
  place in Karlsruhe, so that latitudes and longitudes come out; distances are those of the file.
- The antenna: positions are those of the unit itself (OXTS RT 3003), no lever arm.
- How good a fix is: GTSAM's example for this file weighs it by "0.07 m". It writes `Precisions(1.0/0.07)`, which is a
  sigma of 0.26 m on each axis; its C++ and Python forms write the same. The data sheet of the RT 3003 speaks of 0.02
  m with RTK and 0.6 m with SBAS. The 0.07 m is taken, as a sigma on each axis, for it is the figure that the source
  names; who believes 0.26 m passes another `sigma`.
- The metadata's figures (accelerometer 0.01 m/s2/sqrt(Hz), gyro 1.75e-4 rad/s/sqrt(Hz)) are densities. The wire type
  asks for the covariance of a sample: density squared times the rate of 100 Hz.
"""

from __future__ import annotations

import calendar
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.recordings.log_writer import Arrival, write_samples
from modelserver.earth.geodesy import LocalFrame, geodetic_from_ecef
from modelserver.messages import FixType, GpsSample, ImuSample, SensorHeader
from modelserver.transforms.so3 import Matrix3

Array = npt.NDArray[np.float64]

MIDNIGHT = calendar.timegm((2011, 9, 30, 0, 0, 0)) * 1_000_000
ORIGIN = (49.0, 8.4, 110.0)
"""Latitude and longitude in degrees, height above the ellipsoid in meters: Karlsruhe, roughly."""
GPS_SIGMA = 0.07
"""Meters on each axis; see above."""
ACCELEROMETER_DENSITY = 0.01
GYROSCOPE_DENSITY = 0.000175
"""Metadata: AccelerometerSigma m/s2/sqrt(Hz), GyroscopeSigma rad/s/sqrt(Hz)."""
RATE_HZ = 100.0


def files(data: Path) -> tuple[Path, Path]:
    """Return the files of the IMU and of the fixes."""
    folder = data / "kitti"
    return folder / "KittiEquivBiasedImu.txt", folder / "KittiGps_converted.txt"


def convert(data: Path, log: Path, sigma: float = GPS_SIGMA) -> dict[str, int]:
    """Write the log; return the number of messages by channel. OSError where the files are absent."""
    inertial, fixes = files(data)
    imu = np.loadtxt(inertial, skiprows=1)
    gps = np.loadtxt(fixes, delimiter=",", skiprows=1)
    return write_samples(log, [*_imu(imu), *_gps(gps, sigma)])


def _imu(table: Array) -> Iterator[Arrival]:
    gyro = _diagonal(GYROSCOPE_DENSITY**2 * RATE_HZ)
    force = _diagonal(ACCELEROMETER_DENSITY**2 * RATE_HZ)
    for number, (t, _, fx, fy, fz, wx, wy, wz) in enumerate(table.tolist()):
        utime = MIDNIGHT + round(t * 1e6)
        yield (
            utime,
            "IMU",
            ImuSample(
                SensorHeader(utime, "imu", number, utime),
                angular_velocity=(wx, wy, wz),
                specific_force=(fx, fy, fz),
                angular_velocity_covariance=gyro,
                specific_force_covariance=force,
            ),
        )


def _gps(table: Array, sigma: float) -> Iterator[Arrival]:
    plane = LocalFrame.at(*ORIGIN)
    for number, (t, east, north, up) in enumerate(table.tolist()):
        utime = MIDNIGHT + round(t * 1e6)
        latitude, longitude, height = geodetic_from_ecef(plane.to_ecef((east, north, up)))
        yield (
            utime,
            "GPS",
            GpsSample(
                SensorHeader(utime, "gps", number, utime),
                FixType.DIFFERENTIAL,
                latitude,
                longitude,
                height_ellipsoidal=height,
                position_covariance=_diagonal(sigma**2),
            ),
        )


def _diagonal(variance: float) -> Matrix3:
    return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)
