"""IMU samples of a log as arrays."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from modelserver.errors import RecordingError, WireError, find_nearest_names
from modelserver.messages import FixType
from modelserver.transforms.so3 import Array, Vector3
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogFile
from mstools.terminal.output import format_count, show_progress

_NONE = (math.nan, math.nan, math.nan)


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


def read_recording(log: Path, channel: str, gps_channel: str, begin: float, end: float) -> ImuRecording:
    """Return the samples of a log between two times in seconds since its first message.

    Raises RecordingError where there is no log, nothing on the channel, or no inertial samples; OSError.
    """
    rows: list[tuple[float, ...]] = []
    utimes: list[int] = []
    fixes: list[Vector3] = []
    counts: Counter[str] = Counter()
    errors: list[str] = []
    with LogFile(log) as recording, show_progress(f"reading {log.name}", recording.size) as show:
        first: int | None = None
        for number, event in enumerate(recording):
            first = event.utime if first is None else first
            counts[event.channel] += 1
            if number % 4096 == 0:
                show(event.end)
            at = (event.utime - first) * 1e-6
            if event.channel not in (channel, gps_channel) or not begin <= at < end:
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
    latitude, longitude, _ = sorted(good)[len(good) // 2]
    heights = [each[2] for each in good if math.isfinite(each[2])]
    # a kilometer of height changes the field by 0.05 %
    return (latitude, longitude, float(np.median(heights)) if heights else 0.0)
