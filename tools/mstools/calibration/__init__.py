"""Calibration of an IMU from a recording: its samples, and the ranges in which the vehicle was stationary.

Stationary ranges are found from the inertial unit alone: in blocks of a second, the spread of rates and specific forces
is near that of the quietest blocks, and their means are near those of the other stationary blocks. Limit: a steady
drive straight ahead with no more vibration than a running engine cannot be distinguished from standing.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modelserver.errors import ModelServerError, RecordingError, WireError, find_nearest_names
from modelserver.messages import FixType
from modelserver.transforms.so3 import Array, Vector3
from modelserver.wire.codec import decode
from mstools.terminal.output import format_count, read_with_progress


class CalibrationError(ModelServerError, ValueError):
    """The samples do not determine the result; the message states what is missing and what to do."""


# --- samples of a log ---------------------------------------------------------------------------------------

_NONE = (math.nan, math.nan, math.nan)

GPS_CHANNEL = "GPS"


@dataclass(frozen=True, slots=True)
class ImuRecording:
    """Samples of an IMU in the order of the log; missing values are NaN.

    Attributes
    ----------
    utimes : (n,) times of measurement
    times : (n,) seconds into the log, by arrival
    rates, forces, fields : (n, 3) rad/s, m/s2, tesla
    position : latitude and longitude in degrees, ellipsoidal height in meters, of the median fix; None without fixes
    malformed : messages of the channel that are no IMU samples
    damage : descriptions of the log's damage
    """

    utimes: npt.NDArray[np.int64]
    times: Array
    rates: Array
    forces: Array
    fields: Array
    position: Vector3 | None
    malformed: int
    damage: tuple[str, ...]


def read_recording(log: Path, channel: str, begin: float, end: float) -> ImuRecording:
    """Return the samples of a log between two times in seconds since its first message.

    Raises RecordingError where there is no log, nothing on the channel, or no inertial samples; OSError.
    """
    rows: list[tuple[float, ...]] = []
    utimes: list[int] = []
    fixes: list[Vector3] = []
    counts: Counter[str] = Counter()
    errors: list[str] = []
    with read_with_progress("reading", log) as (recording, events):
        first: int | None = None
        for event in events:
            first = event.utime if first is None else first
            counts[event.channel] += 1
            at = (event.utime - first) * 1e-6
            if event.channel not in (channel, GPS_CHANNEL) or not begin <= at < end:
                continue
            try:
                sample: Any = decode("imu_t" if event.channel == channel else "gps_t", event.data)
            except WireError as error:
                if event.channel == channel:
                    errors.append(str(error))
                continue
            if event.channel == channel:
                vectors = (sample.angular_velocity, sample.specific_force, sample.magnetic_field)
                rows.append((at, *chain.from_iterable(each or _NONE for each in vectors)))
                utimes.append(sample.header.utime)
            elif sample.fix_type is not FixType.NONE:
                fixes.append((sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal))
        damage = tuple(map(str, recording.damage))
    if channel not in counts:
        near = find_nearest_names(channel, counts)
        offer = f"nearest: {', '.join(near)}" if near else f"it has: {', '.join(sorted(counts))}"
        raise RecordingError(f"{log}: no messages on channel {channel}; {offer}; select the IMU's with --channel")
    if not rows and errors:
        raise RecordingError(f"{log}: channel {channel} has no imu_t: {errors[0]}; select the IMU's with --channel")
    if not rows:
        raise RecordingError(
            f"{log}: none of {format_count(counts[channel], 'message')} on {channel} lies between --from and --to"
        )
    times, rates, forces, fields = np.split(np.array(rows), (1, 4, 7), axis=1)
    stamps = np.array(utimes, dtype=np.int64)
    return ImuRecording(stamps, times[:, 0], rates, forces, fields, _median_fix(fixes), len(errors), damage)


def finite_rows(*columns: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the rows that are finite in all arrays (n, 3)."""
    return np.asarray(np.isfinite(np.hstack(columns)).all(axis=1), dtype=np.bool_)


def _median_fix(fixes: list[Vector3]) -> Vector3 | None:
    good = [each for each in fixes if math.isfinite(each[0]) and math.isfinite(each[1])]
    if not good:
        return None
    latitude, longitude, height = sorted(good)[len(good) // 2]
    # a kilometer of height changes the field by 0.05 %
    return (latitude, longitude, height if math.isfinite(height) else 0.0)


# --- ranges of samples --------------------------------------------------------------------------------------

MAX_GAP_PERIODS = 5.0
"""A step of more periods between stamps is a gap. Serial lines deliver unevenly and lose single samples; five in a row
are an interruption.
"""


@dataclass(frozen=True, slots=True)
class SampleRange:
    """Samples `start` to before `stop`, `seconds` long by their stamps."""

    start: int
    stop: int
    seconds: float

    @property
    def rate_hz(self) -> float:
        """Mean sampling rate; 0 for less than two samples or no time."""
        return (self.stop - self.start - 1) / self.seconds if self.seconds > 0.0 else 0.0


def median_period(utimes: npt.ArrayLike) -> float:
    """Return the median step between stamps (n,), microseconds, in seconds.

    Raises CalibrationError where there is none.
    """
    steps = np.diff(np.asarray(utimes, dtype=np.int64))
    usual = float(np.median(steps)) * 1e-6 if steps.size else 0.0
    if usual <= 0.0:
        raise CalibrationError(
            f"{steps.size + 1} samples without increasing stamps have no sampling rate: check the source's clock"
        )
    return usual


def find_gap_free_ranges(utimes: npt.ArrayLike) -> tuple[SampleRange, ...]:
    """Return the ranges of two samples or more without a gap or a step backward. `utimes`: (n,) microseconds.

    Within a range the samples count as evenly spaced at its mean rate: the jitter of stamps is the transport's, and
    interpolating lost samples would reduce the noise. Raises CalibrationError as `median_period`.
    """
    stamps = np.asarray(utimes, dtype=np.int64)
    limit = MAX_GAP_PERIODS * median_period(stamps)
    steps = np.diff(stamps) * 1e-6
    ends = np.flatnonzero((steps > limit) | (steps < 0.0)) + 1
    bounds = [0, *ends.tolist(), stamps.size]
    return tuple(
        SampleRange(a, b, float(stamps[b - 1] - stamps[a]) * 1e-6)
        for a, b in pairwise(bounds)
        if b - a >= 2 and stamps[b - 1] > stamps[a]
    )


BLOCK_S = 1.0
"""Seconds over which rates and forces are averaged."""

MIN_BLOCK_SAMPLES = 10
"""Least samples in a block: of fewer the spread is too uncertain."""


SPREAD_FACTOR = 3.0
"""Largest spread of a stationary block, as a multiple of the quietest tenth's: engines, wind and steps come and go. The
spread of ten samples has a standard error of a quarter, so of many blocks one has twice the least by chance.
"""
MAX_SPREADS = np.array([0.05] * 3 + [0.3] * 3)
"""Largest spreads in a block: of the rates, rad/s, five times the noise of a 3DM-GX1 at 100 Hz (1e-3 rad/sqrt(s)); of
the specific force, m/s2, seven times its noise (0.4 mg per sqrt(Hz)): driving on a road vibrates more.
"""
RATE_STEP = 0.01
"""Largest difference of a block's mean rate from that of the stationary blocks, rad/s: 0.6 deg/s is a bias' change with
temperature (3DM-GX1: 0.7 deg/s over its whole range), and a slow turn.
"""
FORCE_STEP = 0.2
"""Largest step of the mean specific force between blocks, m/s2: a fiftieth of g is a tilt of one degree."""
MAX_RATE = 0.1
"""Largest mean rate, rad/s: no unit's bias is as large as 6 deg/s, so the vehicle turns."""


def find_stationary_ranges(
    utimes: npt.ArrayLike, rates: npt.ArrayLike, forces: npt.ArrayLike
) -> tuple[SampleRange, ...]:
    """Return the ranges without a gap in which the vehicle was stationary, in order.

    `utimes`: (n,) microseconds; `rates`: (n, 3) rad/s; `forces`: (n, 3) m/s2, along the unit's axes, all finite. Raises
    CalibrationError as `median_period`.
    """
    stamps = np.asarray(utimes, dtype=np.int64)
    values = np.column_stack((np.asarray(rates, dtype=float), np.asarray(forces, dtype=float)))
    size = max(round(BLOCK_S / median_period(stamps)), MIN_BLOCK_SAMPLES)
    found: list[SampleRange] = []
    blocks = [(each, *_blocks(values[each.start : each.stop], size)) for each in find_gap_free_ranges(stamps)]
    if not any(len(means) for _, means, _ in blocks):
        return ()
    all_means = np.concatenate([means for _, means, _ in blocks])
    all_spreads = np.concatenate([spreads for _, _, spreads in blocks])
    quietest = np.quantile(all_spreads, 0.1, axis=0)
    largest = np.minimum(SPREAD_FACTOR * quietest + 1e-12, MAX_SPREADS)
    quiet = _is_quiet(all_means, all_spreads, largest)
    if not quiet.any():
        return ()
    usual = np.median(all_means[quiet, :3], axis=0)
    for stretch, means, spreads in blocks:
        # a vehicle that parks on another slope is stationary as well: compare only the rates with the other blocks
        near = (np.abs(means[:, :3] - usual) <= RATE_STEP).all(axis=1)
        stationary = _is_quiet(means, spreads, largest) & near
        # a gentle start does not increase the spread: it is a step from one block to the next
        stationary[1:] &= np.abs(np.diff(means[:, 3:], axis=0)).max(axis=1, initial=0.0) <= FORCE_STEP
        for a, b in _runs(stationary):
            start, stop = stretch.start + a * size, stretch.start + b * size
            found.append(SampleRange(start, stop, float(stamps[stop - 1] - stamps[start]) * 1e-6))
    return tuple(found)


def _blocks(values: Array, size: int) -> tuple[Array, Array]:
    """Return means and spreads, (blocks, 6) each, of whole blocks."""
    count = len(values) // size
    cut = values[: count * size].reshape(count, size, values.shape[1])
    return cut.mean(axis=1), cut.std(axis=1)


def _is_quiet(means: Array, spreads: Array, largest: Array) -> npt.NDArray[np.bool_]:
    turning = np.abs(means[:, :3]).max(axis=1, initial=0.0) > MAX_RATE
    quiet: npt.NDArray[np.bool_] = (spreads <= largest).all(axis=1) & ~turning
    return quiet


def _runs(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and end of the runs of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
