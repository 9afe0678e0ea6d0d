"""Signals of poses that are shown as numbers and over time: speed, heading, standard deviation, ellipsoid.

They are derived from rows of `Drive.poses` and `Drive.motion`, see `mstools.recordings.drive`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3
from mstools.recordings.drive import COVARIANCE, EPOCH, QUATERNION, Drive

SPEED_SPAN_US: Final = 400_000
"""Time over which positions are differenced to a speed: without odometry a correction of 0.1 m is 0.25 m/s then."""

MAX_GAP_US: Final = 1_000_000
"""Longer gaps between poses interrupt lines and strips, and have no speed."""

CHI_SQUARE_3: Final = {50: 2.366, 68: 3.527, 95: 7.815, 99: 11.345}
"""Quantiles of chi-square with three degrees of freedom by confidence in percent (NIST e-Handbook, 1.3.6.7.4)."""


class PoseSignals(NamedTuple):
    """Horizontal speed in m/s, heading in degrees, horizontal standard deviation in m; nan where not known."""

    speed: float = math.nan
    heading: float = math.nan
    sigma: float = math.nan


def compute_signals(drive: Drive, utime: int) -> PoseSignals:
    """Return the signals of the last pose at or before a time; the speed of the last one is that of the time before."""
    here = drive.poses.find(utime)
    if here < 0:
        return PoseSignals()
    row = drive.poses.rows[here : here + 1]
    motion = drive.motion
    first, last = np.searchsorted(motion.utimes, (utime - MAX_GAP_US, utime + MAX_GAP_US))
    utimes = motion.utimes[first:last]
    at = int(np.searchsorted(utimes, utime, side="right")) - 1
    return PoseSignals(
        float(compute_speeds(utimes, motion.rows[first:last])[at]) if at >= 0 else math.nan,
        float(compute_headings(row[:, QUATERNION])[0]),
        float(compute_sigmas(row)[0]),
    )


def compute_speeds(utimes: npt.NDArray[np.int64], rows: Array) -> Array:
    """Return the horizontal speed at each row of poses, m/s: of the positions around it; nan at resets and gaps."""
    if len(utimes) < 2:
        return np.full(len(utimes), math.nan)
    half = SPEED_SPAN_US // 2
    first = np.searchsorted(utimes, utimes - half)
    last = np.searchsorted(utimes, utimes + half, side="right") - 1
    # at a lower rate the neighbors
    first = np.where(first == last, np.maximum(first - 1, 0), first)
    seconds = (utimes[last] - utimes[first]) * 1e-6
    steps = np.linalg.norm(rows[last, :2] - rows[first, :2], axis=1)
    is_one = (rows[last, EPOCH] == rows[first, EPOCH]) & (seconds > 0.0) & (seconds * 1e6 <= MAX_GAP_US)
    return np.where(is_one, steps / np.where(seconds > 0.0, seconds, 1.0), math.nan)


def compute_headings(quaternions: Array) -> Array:
    """Return the headings of rotations (n, 4), scalar first: degrees clockwise from grid north, 0 to 360."""
    w, x, y, z = quaternions.T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    found: Array = np.mod(90.0 - np.degrees(yaw), 360.0)
    return found


def compute_sigmas(rows: Array) -> Array:
    """Return the standard deviations of horizontal positions along the worst direction, meters."""
    east, east_north, _, north, *_ = rows[:, COVARIANCE].T
    # a log may hold any numbers, and infinite ones are nan here
    with np.errstate(over="ignore", invalid="ignore"):
        middle, half = 0.5 * (east + north), np.hypot(0.5 * (east - north), east_north)
        found: Array = np.sqrt(np.maximum(middle + half, 0.0))
    return found


def compute_ellipsoid(covariance: Array, quantile: float) -> tuple[Vector3, Pose]:
    """Return the semi-axes in meters and the orientation of the ellipsoid (p - m)' inv(P) (p - m) = quantile.

    `covariance` is P (3, 3), m2. By the eigenvalues of P.
    """
    values, vectors = np.linalg.eigh(covariance)
    if np.linalg.det(vectors) < 0.0:
        vectors[:, 0] = -vectors[:, 0]
    x, y, z = (math.sqrt(max(value, 0.0) * quantile) for value in values.tolist())
    matrix = np.eye(4)
    matrix[:3, :3] = vectors
    return (x, y, z), Pose.from_matrix(matrix)
