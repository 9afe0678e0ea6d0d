"""Reading the samples of an inertial unit from a log, as arrays."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from modelserver.errors import RecordingError, WireError, nearest_names
from modelserver.messages import FixType, GpsSample, ImuSample
from modelserver.spatial.so3 import Array, Vector3
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogFile
from mstools.terminal.output import counted
from mstools.terminal.progress import progress

_NONE = (math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class Recorded:
    """The samples of a unit, in the order of the log; what it did not say is NaN.

    utimes: (n,) instants of measurement. at: (n,) seconds into the log, by arrival. rates, forces, fields: (n, 3)
    rad/s, m/s2, tesla. place: latitude and longitude in degrees, height above the ellipsoid, metres, of the middle
    fix, and None without one. bad: messages of the channel that are none. damage: in words, of the log.
    """

    utimes: npt.NDArray[np.int64]
    at: Array
    rates: Array
    forces: Array
    fields: Array
    place: Vector3 | None
    bad: int
    damage: tuple[str, ...]


def read(log: Path, channel: str, gps_channel: str, begin: float, end: float) -> Recorded:
    """Return what a log holds between two times in seconds since its first message.

    Raises RecordingError where there is no log, nothing on the channel, or no inertial samples; OSError.
    """
    rows: list[tuple[float, ...]] = []
    utimes: list[int] = []
    fixes: list[Vector3] = []
    met: Counter[str] = Counter()
    bad = 0
    why = ""
    with LogFile(log) as recording, progress(f"reading {log.name}", recording.size) as show:
        first: int | None = None
        for number, event in enumerate(recording):
            first = event.utime if first is None else first
            met[event.channel] += 1
            if number % 4096 == 0:
                show(event.end)
            at = (event.utime - first) * 1e-6
            if event.channel not in (channel, gps_channel) or not begin <= at < end:
                continue
            try:
                if event.channel == channel:
                    sample: ImuSample = decode("imu_t", event.data)
                    rate, force, field = sample.angular_velocity, sample.specific_force, sample.magnetic_field
                    rows.append((at, *(rate or _NONE), *(force or _NONE), *(field or _NONE)))
                    utimes.append(sample.header.utime)
                else:
                    fix: GpsSample = decode("gps_t", event.data)
                    if fix.fix_type is not FixType.NONE:
                        fixes.append((fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal))
            except WireError as error:
                bad += event.channel == channel
                why = why or str(error)
        damage = tuple(map(str, recording.damage))
    if channel not in met:
        near = nearest_names(channel, met)
        offer = f"nearest: {', '.join(near)}" if near else f"it has: {', '.join(sorted(met))}"
        raise RecordingError(f"{log}: nothing on channel {channel}; {offer}; --channel names the unit's")
    if not rows and bad:
        raise RecordingError(f"{log}: channel {channel} carries no imu_t: {why}; --channel names the unit's")
    if not rows:
        raise RecordingError(
            f"{log}: none of {counted(met[channel], 'message')} on {channel} lies between --from and --to"
        )
    table = np.array(rows)
    return Recorded(
        utimes=np.array(utimes, dtype=np.int64),
        at=table[:, 0],
        rates=table[:, 1:4],
        forces=table[:, 4:7],
        fields=table[:, 7:10],
        place=_middle(fixes),
        bad=bad,
        damage=damage,
    )


def finite(*columns: Array) -> npt.NDArray[np.bool_]:
    """Return the rows (n,) that are finite in all arrays (n, 3)."""
    return np.asarray(np.isfinite(np.hstack(columns)).all(axis=1), dtype=np.bool_)


def _middle(fixes: list[Vector3]) -> Vector3 | None:
    good = [each for each in fixes if math.isfinite(each[0]) and math.isfinite(each[1])]
    if not good:
        return None
    latitude, longitude, _ = sorted(good)[len(good) // 2]
    heights = [each[2] for each in good if math.isfinite(each[2])]
    # a kilometre of height changes the field by half a thousandth
    return (latitude, longitude, float(np.median(heights)) if heights else 0.0)
