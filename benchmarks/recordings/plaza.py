"""A lawn mower among four radio beacons, Plaza 1 and 2: distance and heading increments, and ranges; no GPS.

J. Djugash, B. Hamner, S. Roth: "Navigating with ranging radios: five data sets with ground truth", J. Field Robotics
26(9), 2009. Of its files only the increments (`_DR`, 5 or 10 Hz) and the ranges (`_TD`, four a second) are here; the
truth and the beacons' survey are not. What can be had honestly:

- **Plaza 2's beacons.** GTSAM's `RangeISAMExample_plaza2.cpp` quotes the survey ("from TL file") and the start of the
  truth; they stand below. They belong to these ranges: a fit of start, bias and scale along the increments leaves
  0.85 m (standard deviation, 1,816 ranges, no beacon's mean off by more than 0.03 m), with the start 0.16 m from
  the quoted one. GTSAM's example for Plaza 1 lists the same places; Plaza 1's ranges deny it (10 m left).
- **Plaza 1's beacons** nobody states. `calibrate` solves for them, with the way of the mower, from the first quarter of
  the ranges: start at the origin, along x. Five of six random first guesses end in the same solution, 0.58 m left.
  It is self-calibration: what is scored comes after, but a common error of beacons and way shows in no range, and
  nothing ties the result to the ground.
- Range scale: ranges are 1.07 of the distance (Plaza 2 against the survey; 1.06 in Plaza 1 against the odometer), with
  no constant part. The sample's distance is divided by it. Its sigma of 1 m is the spread left, rounded up. Plaza 2's
  scale comes from the whole recording, so from the ranges that are scored as well: one number from 1,816.
- Heading increments are a gyro's, not two encoders' difference: while the mower stands they go on with a mean of -7e-4
  rad a step in Plaza 2 (-0.007 rad/s, spread 8e-5), and 2.3 rad in 409 s is what the fit takes out; in Plaza 1 the
  mean is 6e-6 a step. So the same increments are written twice: as WHEELS, two virtual wheels TRACK_WIDTH apart, and
  as a rate about z on IMU (no rate about x and y was measured: 0 is written). A vehicle file listens to one of them.
- Plaza 1's `_TD` is not in order: after line 1,988 time goes back by 64 s and after line 2,866 by 50 s. Ranges are
  put in the order of their stamps, which is when they count as having arrived; `_DR` rises throughout.
- Time is seconds from an unnamed beginning; the day below is not the recording's, nor is the origin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.recordings.log_writer import Arrival, write_samples
from modelserver.messages import AbsolutePoseSample, ImuSample, RangeSample, SensorHeader, WheelSample, WheelsSample

Array = npt.NDArray[np.float64]

EPOCH = 1_230_768_000_000_000
"""2009-01-01."""
TRACK_WIDTH = 1.0
FRAME = "Mower:Base"
REFERENCE = "World:ENU"
RANGE_SIGMA = 1.0
SURVEY_SCALE = 1.0714
BEACONS = (0, 1, 5, 6)
SURVEYED = np.array([(-33.6205, 26.9678), (-68.9265, 18.3778), (1.7095, -5.8122), (-37.5805, 69.2278)])
"""Plaza 2: positions of BEACONS, meters, x and y."""
SURVEYED_START = (-34.2086, 45.3008, math.pi - 2.021089)
"""Plaza 2: x, y and heading at the beginning, as quoted."""
CALIBRATION_SHARE = 0.25
"""Share of the recording that Plaza 1's beacons are found from."""
KNOT_S = 60.0


@dataclass(frozen=True)
class Beacons:
    """Beacon positions (4, 2) in the order of BEACONS, meters; ranges are `scale` times the distance."""

    positions: Array
    scale: float
    start: tuple[float, float, float]
    until: float = -math.inf
    residual: float = math.nan


def files(data: Path, name: str) -> tuple[Path, Path]:
    """Return the files of increments and ranges of `plaza1` or `plaza2`."""
    return tuple(data / "plaza" / f"{name.capitalize()}_{kind}.txt" for kind in ("DR", "TD"))  # type: ignore[return-value]


def read(data: Path, name: str) -> tuple[Array, Array]:
    """Return increments (n, 3): time, way, turn; and ranges (m, 3): time, index in BEACONS, range; by time."""
    increments, ranges = (np.loadtxt(path) for path in files(data, name))
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]
    ranges = ranges[ranges[:, 0] >= increments[0, 0]]
    index = np.searchsorted(BEACONS, ranges[:, 2])
    return increments, np.column_stack([ranges[:, 0], index, ranges[:, 3]])


def find_beacons(data: Path, name: str) -> Beacons:
    """Return where the beacons are: surveyed for Plaza 2, calibrated for Plaza 1 (needs scipy)."""
    if name == "plaza2":
        return Beacons(SURVEYED, SURVEY_SCALE, SURVEYED_START)
    return calibrate(*read(data, name))


def dead_reckon(increments: Array, start: tuple[float, float, float], extra_heading: Array | float = 0.0) -> Array:
    """Return x, y and heading after each increment (n, 3): dead reckoning from a start."""
    heading = start[2] + np.cumsum(increments[:, 2]) + extra_heading
    middle = heading - increments[:, 2] / 2
    x = start[0] + np.cumsum(increments[:, 1] * np.cos(middle))
    y = start[1] + np.cumsum(increments[:, 1] * np.sin(middle))
    return np.column_stack([x, y, heading])


def calibrate(increments: Array, ranges: Array, share: float = CALIBRATION_SHARE) -> Beacons:
    """Find beacons, range scale and the drift of the heading from the first part of a recording.

    The heading's error is a line between knots a minute apart, each step 0.1 rad (one sigma).
    """
    from scipy.optimize import least_squares

    t = increments[:, 0]
    until = t[0] + share * (t[-1] - t[0])
    used = ranges[ranges[:, 0] <= until]
    which = used[:, 1].astype(int)
    knots = np.arange(t[0], until + KNOT_S, KNOT_S)

    def residuals(p: Array) -> Array:
        scale, places, steps = p[0], p[1:9].reshape(4, 2), p[9:]
        drift = np.interp(t, knots, np.concatenate([[0.0], np.cumsum(steps)]))
        mower = dead_reckon(increments, (0.0, 0.0, 0.0), drift)
        x, y = (np.interp(used[:, 0], t, mower[:, k]) for k in (0, 1))
        left = used[:, 2] - scale * np.hypot(x - places[which, 0], y - places[which, 1])
        return np.concatenate([left, steps / 0.1])

    # any guess with separate beacons; nearly all give the same solution
    guess = np.random.default_rng(0).normal(0.0, 40.0, 8)
    found = least_squares(
        residuals, np.concatenate([[1.05], guess, np.zeros(len(knots) - 1)]), loss="soft_l1", x_scale="jac", max_nfev=80
    )
    left = residuals(found.x)[: len(used)]
    return Beacons(found.x[1:9].reshape(4, 2), float(found.x[0]), (0.0, 0.0, 0.0), float(until), float(np.std(left)))


def convert(data: Path, log: Path, name: str = "plaza2", given: Beacons | None = None) -> dict[str, int]:
    """Write the log; return the number of messages by channel: START (once), WHEELS, IMU, RANGE."""
    increments, ranges = read(data, name)
    where = given or find_beacons(data, name)
    return write_samples(log, [*_start(increments, where), *_odometry(increments), *_ranges(ranges, where)])


def utime_of(t: float) -> int:
    """Return the utime of a recording's time."""
    return EPOCH + round(t * 1e6)


def _start(increments: Array, where: Beacons) -> Iterator[Arrival]:
    utime = utime_of(increments[0, 0])
    x, y, heading = where.start
    covariance = np.diag([1.0, 1.0, 1.0, 0.05**2, 0.05**2, 0.2**2])
    yield (
        utime,
        "START",
        AbsolutePoseSample(
            SensorHeader(utime, "start", 0, utime),
            FRAME,
            REFERENCE,
            (x, y, 0.0),
            (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)),
            tuple(covariance.ravel().tolist()),
        ),
    )


def _odometry(increments: Array) -> Iterator[Arrival]:
    travel = np.zeros(2)
    before = math.nan
    for number, (t, way_, turn) in enumerate(increments.tolist()):
        utime = utime_of(t)
        travel += (way_ - turn * TRACK_WIDTH / 2, way_ + turn * TRACK_WIDTH / 2)
        wheels = tuple(WheelSample(name, float(each)) for name, each in zip(("left", "right"), travel, strict=True))
        yield utime, "WHEELS", WheelsSample(SensorHeader(utime, "wheels", number, utime), wheels)
        if t > before:
            header = SensorHeader(utime, "imu", number, utime)
            yield utime, "IMU", ImuSample(header, angular_velocity=(0.0, 0.0, turn / (t - before)))
        before = t


def _ranges(ranges: Array, where: Beacons) -> Iterator[Arrival]:
    for number, (t, which, distance) in enumerate(ranges.tolist()):
        utime = utime_of(t)
        x, y = where.positions[int(which)].tolist()
        yield (
            utime,
            "RANGE",
            RangeSample(
                SensorHeader(utime, "range", number, utime),
                FRAME,
                str(BEACONS[int(which)]),
                (x, y, 0.0),
                REFERENCE,
                distance / where.scale,
                RANGE_SIGMA,
            ),
        )


def range_residuals(mower: Array, t: Array, ranges: Array, where: Beacons) -> Array:
    """Return the distance from a path, x and y at times t, to the beacons minus the range, meters."""
    which = ranges[:, 1].astype(int)
    x, y = (np.interp(ranges[:, 0], t, mower[:, k]) for k in (0, 1))
    result: Array = np.hypot(x - where.positions[which, 0], y - where.positions[which, 1]) - ranges[:, 2] / where.scale
    return result


def scored_ranges(increments: Array, ranges: Array, where: Beacons) -> npt.NDArray[np.bool_]:
    """Return which ranges are withheld and scored: every second one, after 30 s and after the calibration's."""
    odd = np.arange(len(ranges)) % 2 == 1
    chosen: npt.NDArray[np.bool_] = odd & (ranges[:, 0] > max(increments[0, 0] + 30.0, where.until))
    return chosen


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def dead_reckoning_rms(data: Path, name: str, where: Beacons) -> Mapping[str, float]:
    """Return the RMS of the misses at the scored ranges by dead reckoning from the start, meters."""
    increments, ranges = read(data, name)
    chosen = scored_ranges(increments, ranges, where)
    mower = dead_reckon(increments, where.start)
    return {"n": int(chosen.sum()), "rms": rms(range_residuals(mower, increments[:, 0], ranges[chosen], where))}
