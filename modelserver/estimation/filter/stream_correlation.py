"""Correlation of the sensors' streams: offsets between their clocks, and wrong axes or signs.

The filter needs fixes, IMU and wheels that describe the same motion at the same time. If their stamps differ by
seconds, fixes are rejected or the heading is not found; if the turn rate has the wrong sign, the heading is wrong. Two
pairs of streams have the turns of the vehicle in common, whatever its heading and speed:

Fixes and turn rate. With p_i the displacement between two fixes, and u_i the integral of exp(i yaw) between their
stamps minus the lag t (the path at speed 1, by the turn rate alone), the angle between the two is the same for all i.
The coherence, with the angles doubled, so that reversing does not matter, and an error d of the turn rate,

    C(t) = max over d of |mean (p_i u_i*(t) exp(i d t_i) / |p_i u_i|)^2|                                         (1)

is 1 at the lag by which the fixes are late, and less at others, if the vehicle turns. With the mirrored path (u_i
instead of its conjugate) it is 1 if the turn rate has the wrong sign. If it is low either way and at each lag, the gyro
measures another axis than up.

Turn rates of gyro and wheels. On a grid of 2 STEP, with the angles a_k of the gyro and b_k of the wheels in each step,

    r(t) = sum b_k a_k(t) / sqrt(sum b_k^2 sum a_k^2(t))                                                         (2)

is 1 at the lag by which the wheels are late, and -1 if left and right are swapped, or the gyro is inverted.

A lag is reported if it explains what none near 0 does. Both pairs together show which stream it is that differs; of two
streams that disagree the gyro is taken to be right about the time, and the fixes about the direction. Each sample is
used before its stamp is judged, because a wrong clock is what is looked for, and no state of the filter is used. Once
the streams agreed for a while nothing more is compared.

Assumptions: displacements several times the error of the fixes; turns of more than a radian. All lags are compared over
the same data, so it takes 2 MAX_LAG longer than the drive to be compared. A vehicle on one circle, or straight ahead,
has the same coherence at each lag: nothing is reported.
"""

from __future__ import annotations

import cmath
import math
from enum import Enum
from itertools import pairwise
from typing import Final, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from modelserver.earth.geodesy import LocalFrame
from modelserver.estimation.filter.measurements.gnss import locate_fix, split_variance
from modelserver.estimation.filter.measurements.wheels import estimate_turn_rate
from modelserver.estimation.filter.sensor_monitors import read_turn_rate
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.inputs import evaluate_fix
from modelserver.messages import GpsSample, ImuSample, Mode, Sample, SensorFinding, SwitchMode, WheelsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array

STEP: Final = 0.25
"""Seconds between two points of a stream, at least."""

MAX_LAG: Final = 6.0
"""Seconds: a fix that is later is rejected by its stamp, or belongs to another part of the drive."""

TOLERATED_LAG: Final = 0.75
"""Seconds: a smaller lag is estimated by the filter, or is within the smoothing of the streams."""

WINDOW: Final = 60.0
"""Seconds of the drive that are compared."""

PERIOD: Final = 2.0
"""Seconds between two evaluations."""

GYRO_DRIFT: Final = 0.03
WHEEL_DRIFT: Final = 0.2
DRIFT_STEP: Final = 0.01
"""Error of the turn rate that is searched, rad/s: the bias of a cold gyro; a side of the vehicle that rolls 4 % farther
than the other at 5 m/s, 1 m apart; and the steps of the search."""

GYRO_STEP: Final = 0.04
"""Seconds between two samples of the gyro that are used, at least: turns are slow."""

MIN_DISPLACEMENT: Final = 5.0
"""Displacement between two fixes, in sigmas of it: a course to 0.2 rad."""

MAX_STEP_TIME: Final = 6.0
"""Longest duration of such a displacement, seconds: a vehicle that is slower stops in between."""

MIN_STEPS: Final = 12
MIN_TURN: Final = 1.5
"""Displacements, and turn (rad) by both streams, below which nothing is compared."""

GOOD: Final = 0.8
POOR: Final = 0.65
"""Coherence or correlation of streams that agree, at least, and of streams that contradict each other, at most."""

UNRELATED: Final = 0.45
"""Coherence of fixes and turn rate at each lag below which the turn rate is that of another axis."""

MIN_CONFIRMED: Final = 2
"""Evaluations in a row with the same result before it is reported."""

SETTLED: Final = 5
"""Evaluations in a row in which fixes and turn rate agree before the component stops."""

IMPROVEMENT: Final = 0.4
"""Share of the incoherence that an explanation may leave, at most."""

LAGS: Final = np.arange(-MAX_LAG, MAX_LAG + 0.5 * STEP, STEP)
NEAR: Final = np.abs(LAGS) <= TOLERATED_LAG


P = TypeVar("P", "TurnPoint", "Place", "WheelTurn")


class TurnPoint(NamedTuple):
    """The yaw by the turn rate, rad, and the path at speed 1 along it, s, at an instant."""

    utime: int
    yaw: float
    unit_path: complex


class Place(NamedTuple):
    """A fix: its position, m, and whether the step that leads to it is a displacement with a course."""

    utime: int
    position: complex
    has_course: bool


class WheelTurn(NamedTuple):
    """The angle by which the vehicle has turned by its wheels, rad, at an instant."""

    utime: int
    angle: float


class Relation(Enum):
    """How two streams are related."""

    AGREE = "agree"
    DELAYED = "delayed"
    MIRRORED = "mirrored"
    UNRELATED = "unrelated"


class Comparison(NamedTuple):
    """The result of comparing two streams.

    Attributes
    ----------
    relation: of the second stream to the first.
    seconds: by which the second is delayed; 0 for other relations.
    num_confirmed: evaluations in a row with this result.
    """

    relation: Relation
    seconds: float = 0.0
    num_confirmed: int = 1

    def confirm(self, before: Comparison | None) -> Comparison:
        """Return this result as one more in a row, if the one before agrees with it."""
        if before is None or before.relation != self.relation or abs(before.seconds - self.seconds) > 2.0 * STEP:
            return self
        return self._replace(num_confirmed=min(before.num_confirmed + 1, SETTLED))


class StreamCorrelation(NamedTuple):
    """The streams of the last minute, each by its own stamps.

    Attributes
    ----------
    turns, places, wheels: points of the turn rate, the fixes and the wheels, at most one each STEP.
    gyro_utime, yaw: of the last sample of the gyro, and the integral of its turn rate, rad.
    site: tangent plane of the positions.
    last_wheels: the last wheel sample.
    distance: driven by the fixes, m.
    evaluated_utime: of the last evaluation.
    fixes_to_turns, wheels_to_turns: their comparisons with the turn rate, once there are enough data.
    is_settled: whether the streams agreed, and nothing more is compared.
    """

    turns: tuple[TurnPoint, ...] = ()
    places: tuple[Place, ...] = ()
    wheels: tuple[WheelTurn, ...] = ()
    gyro_utime: int = 0
    yaw: float = 0.0
    site: LocalFrame | None = None
    last_wheels: WheelsSample | None = None
    distance: float = 0.0
    evaluated_utime: int = 0
    fixes_to_turns: Comparison | None = None
    wheels_to_turns: Comparison | None = None
    is_settled: bool = False

    def update(self, setup: Setup, mode: Mode, sample: Sample | SwitchMode) -> StreamCorrelation:
        """Return the correlation after a sample: itself, if the sample adds nothing."""
        if self.is_settled:
            return self
        if isinstance(sample, ImuSample):
            # most of the samples: decide without work
            if sample.header.utime - self.gyro_utime < GYRO_STEP * 1e6 and sample.header.utime >= self.gyro_utime:
                return self
            return self._add_gyro(setup, sample) if _has_gyro(setup, mode) else self
        if isinstance(sample, WheelsSample):
            return self._add_wheels(setup, sample, _has_gyro(setup, mode)) if mode is not Mode.NO_WHEELS else self
        if isinstance(sample, GpsSample) and setup.uses_gnss(mode):
            return self._add_fix(setup, sample, _has_gyro(setup, mode))
        return self

    def _add_gyro(self, setup: Setup, sample: ImuSample) -> StreamCorrelation:
        utime, rate = sample.header.utime, sample.angular_velocity
        if setup.yaw_gyro is not None:
            read = read_turn_rate(sample, setup.yaw_gyro)
            turn_rate = math.nan if isinstance(read, str) else read
        else:
            turn_rate = math.nan if rate is None else so3.rotate(setup.mount, rate)[2]
        if not math.isfinite(turn_rate):
            return self
        seconds = (utime - self.gyro_utime) * 1e-6
        if not 0.0 < seconds < MAX_STEP_TIME:
            # its first sample, a gap, or a clock that was set
            return StreamCorrelation(gyro_utime=utime)
        yaw = self.yaw + turn_rate * seconds
        return self._add_turn(utime, yaw)._replace(gyro_utime=utime, yaw=yaw)

    def _add_turn(self, utime: int, yaw: float) -> StreamCorrelation:
        if not self.turns:
            return self._replace(turns=(TurnPoint(utime, yaw, 0j),))
        last = self.turns[-1]
        seconds = (utime - last.utime) * 1e-6
        if seconds < STEP:
            return self
        path = last.unit_path + seconds * cmath.rect(1.0, 0.5 * (last.yaw + yaw))
        return self._replace(turns=(*_keep(self.turns, utime), TurnPoint(utime, yaw, path)))

    def _add_wheels(self, setup: Setup, sample: WheelsSample, has_gyro: bool) -> StreamCorrelation:
        before, utime = self.last_wheels, sample.header.utime
        if setup.wheels is None:
            return self
        if before is None or before.header.source != sample.header.source:
            return self._replace(last_wheels=sample, wheels=())
        seconds = (utime - before.header.utime) * 1e-6
        if 0.0 <= seconds < STEP:
            return self
        if not 0.0 < seconds < MAX_STEP_TIME:
            # by how much the vehicle has turned meanwhile is not known
            return self._replace(last_wheels=sample, wheels=(), turns=self.turns if has_gyro else ())
        turn = seconds * estimate_turn_rate(sample, before, setup.wheels, setup.settings).value
        angle = self.wheels[-1].angle + turn if self.wheels else turn
        streams = self._replace(last_wheels=sample, wheels=(*_keep(self.wheels, utime), WheelTurn(utime, angle)))
        if not has_gyro:
            # the wheels of a skid-steered vehicle turn it by an unknown share of their difference
            return streams if setup.wheels.skid else streams._add_turn(utime, angle)
        is_due = not setup.rig.gps_frame and (utime - self.evaluated_utime) * 1e-6 >= PERIOD
        return streams._evaluate(utime, has_gyro) if is_due else streams

    def _add_fix(self, setup: Setup, sample: GpsSample, has_gyro: bool) -> StreamCorrelation:
        settings, utime = setup.settings, sample.header.utime
        fix = evaluate_fix(sample, settings, True)
        if isinstance(fix, str):
            return self
        site = self.site or LocalFrame.at(fix.latitude_deg, fix.longitude_deg, 0.0)
        east, north, _ = locate_fix(fix, site, 0.0)
        position = complex(east, north)
        if not self.places or not (utime - self.places[-1].utime) * 1e-6 > -STEP:
            return self._replace(site=site, places=(Place(utime, position, False),), evaluated_utime=utime)
        last = self.places[-1]
        seconds = (utime - last.utime) * 1e-6
        if seconds < STEP:
            return self
        displacement = abs(position - last.position)
        white, correlated = split_variance(fix.sigma**2, fix, sample.fix_type, settings)
        drift = correlated * math.sqrt(2.0 * min(seconds / settings.gps_correlation_time, 1.0))
        x, y, _ = setup.rig.pose(setup.rig.gps_frame).xyz
        least = max(MIN_DISPLACEMENT * math.hypot(1.5 * math.sqrt(white), drift), 2.0 * math.hypot(x, y))
        has_course = displacement >= least and seconds < MAX_STEP_TIME
        if not has_course and seconds < MAX_STEP_TIME:
            return self
        places = (*_keep(self.places, utime), Place(utime, position, has_course))
        streams = self._replace(places=places, distance=self.distance + (displacement if has_course else 0.0))
        if (utime - self.evaluated_utime) * 1e-6 < PERIOD:
            return streams
        return streams._evaluate(utime, has_gyro)

    def _evaluate(self, utime: int, has_gyro: bool) -> StreamCorrelation:
        fixes = compare_places(self.turns, self.places, GYRO_DRIFT if has_gyro else WHEEL_DRIFT)
        wheels = compare_turns(self.turns, self.wheels) if has_gyro else None
        fixes = None if fixes is None else fixes.confirm(self.fixes_to_turns)
        wheels = None if wheels is None else wheels.confirm(self.wheels_to_turns)
        main, other = (fixes, wheels) if self.places else (wheels, None)
        agrees = main is not None and main.relation is Relation.AGREE and main.num_confirmed >= SETTLED
        if agrees and (other is None or other.relation is Relation.AGREE):
            return StreamCorrelation(is_settled=True)
        return self._replace(evaluated_utime=utime, fixes_to_turns=fixes, wheels_to_turns=wheels)

    def find_contradictions(self, *, has_gyro: bool, has_heading: bool) -> tuple[SensorFinding, ...]:
        """Return the findings; `has_gyro`: the turn rate is a gyro's, otherwise the wheels'."""
        fixes, wheels = (
            None if each is None or each.relation is Relation.AGREE or each.num_confirmed < MIN_CONFIRMED else each
            for each in (self.fixes_to_turns, self.wheels_to_turns)
        )
        driven = f"driven {self.distance:.0f} m" + ("" if has_heading else " without heading")
        turning = "imu" if has_gyro else "wheels"
        if fixes is not None and wheels is not None and fixes.relation is wheels.relation:
            # both differ from the gyro in the same way
            if fixes.relation is not Relation.DELAYED:
                return (_report(turning, fixes.relation, 0.0, driven),)
            if abs(fixes.seconds - wheels.seconds) < 1.0:
                return (_report(turning, fixes.relation, -0.5 * (fixes.seconds + wheels.seconds), driven),)
        found = []
        if fixes is not None:
            sensor = "gps" if fixes.relation is Relation.DELAYED else turning
            found.append(_report(sensor, fixes.relation, fixes.seconds, driven))
        if wheels is not None:
            found.append(_report("wheels", wheels.relation, wheels.seconds, driven))
        return tuple(found)


def _has_gyro(setup: Setup, mode: Mode) -> bool:
    return (setup.has_imu or setup.yaw_gyro is not None) and mode is not Mode.NO_IMU


_NAMES: Final = {"gps": "GPS", "imu": "the IMU", "wheels": "the wheels"}


def _report(sensor: str, relation: Relation, seconds: float, driven: str) -> SensorFinding:
    if relation is Relation.DELAYED:
        seems = "seem" if sensor == "wheels" else "seems"
        when = "late" if seconds > 0.0 else "early"
        text = f"{driven}: {_NAMES[sensor]} {seems} {abs(seconds):.1f} s {when}, by the turns of the drive"
        fix = f"check the clock that stamps its samples; a constant delay belongs into sensors.{sensor}.latency"
        return SensorFinding(sensor, "offset", f"sensors.{sensor}", text, fix)
    how = "has the opposite sign of" if relation is Relation.MIRRORED else "does not follow"
    text = f"{driven}: the turn rate by {_NAMES[sensor]} {how} the turns of the drive"
    if sensor == "wheels":
        return SensorFinding(sensor, "turn", "sensors.wheels.frames", text, "check the names of left and right wheels")
    fix = "check axes and sign of angular_velocity (counter-clockwise is positive) and the frame in the geometry"
    return SensorFinding(sensor, "turn", "sensors.imu.frame", text, fix)


# --- comparison ---------------------------------------------------------------------------------------------


def compare_places(turns: tuple[TurnPoint, ...], places: tuple[Place, ...], most_drift: float) -> Comparison | None:
    """Return how fixes are related to the turn rate, by equation (1); None without enough data.

    `most_drift` is the largest error of the turn rate that is searched, rad/s.
    """
    if len(turns) < 2:
        return None
    t = np.array([each.utime for each in turns]) * 1e-6
    low, high = turns[0].utime * 1e-6 + MAX_LAG, turns[-1].utime * 1e-6 - MAX_LAG
    steps = [
        (a.utime * 1e-6, b.utime * 1e-6, b.position - a.position)
        for a, b in pairwise(places)
        if b.has_course and a.utime * 1e-6 >= low and b.utime * 1e-6 <= high
    ]
    if len(steps) < MIN_STEPS or sum(abs(cmath.phase(q / p)) for (*_, p), (*_, q) in pairwise(steps)) < MIN_TURN:
        return None
    begin, end = (np.array([step[k] for step in steps]) for k in (0, 1))
    course = np.array([step[2] / abs(step[2]) for step in steps])
    path = np.array([each.unit_path for each in turns])

    def interpolate(at: Array) -> npt.NDArray[np.complex128]:
        found: npt.NDArray[np.complex128] = np.interp(at, t, path)
        return found

    lags = LAGS[:, None]
    u = interpolate(end[None, :] - lags) - interpolate(begin[None, :] - lags)
    u = u / np.maximum(np.abs(u), 1e-9)
    drifts = np.arange(-most_drift, most_drift + 0.5 * DRIFT_STEP, DRIFT_STEP)
    turned = np.exp(2j * np.outer(begin - begin.mean(), drifts)) / len(begin)
    coherence = np.abs((course * u.conj()) ** 2 @ turned).max(axis=1)
    mirrored = np.abs((course * u) ** 2 @ turned).max(axis=1)
    return _explain(coherence, float(mirrored[NEAR].max()), is_complete=len(steps) >= 2 * MIN_STEPS)


def compare_turns(turns: tuple[TurnPoint, ...], wheels: tuple[WheelTurn, ...]) -> Comparison | None:
    """Return how wheels are related to the gyro, by equation (2); None without enough data."""
    if len(turns) < 2 or len(wheels) < 2:
        return None
    low = max(turns[0].utime * 1e-6 + MAX_LAG, wheels[0].utime * 1e-6)
    high = min(turns[-1].utime * 1e-6 - MAX_LAG, wheels[-1].utime * 1e-6)
    grid = np.arange(low, high, 2.0 * STEP)
    if len(grid) < 2 * MIN_STEPS:
        return None
    b = np.diff(np.interp(grid, [each.utime * 1e-6 for each in wheels], [each.angle for each in wheels]))
    t, yaw = np.array([each.utime * 1e-6 for each in turns]), np.array([each.yaw for each in turns])
    a = np.diff(np.interp(grid[None, :] - LAGS[:, None], t, yaw), axis=1)
    if np.abs(b).sum() < MIN_TURN or np.abs(a[len(LAGS) // 2]).sum() < MIN_TURN:
        return None
    correlation = a @ b / np.maximum(np.sqrt((a * a).sum(axis=1) * (b @ b)), 1e-9)
    return _explain(correlation, float(-correlation[NEAR].min()), is_complete=False)


def _explain(agreement: Array, mirrored: float, *, is_complete: bool) -> Comparison | None:
    """Return how two streams are related, by their agreement at each lag and mirrored; None if nothing explains it.

    `is_complete`: there are enough data to state that the two are unrelated.
    """
    near, best = float(agreement[NEAR].max()), int(agreement.argmax())
    if near > POOR:
        return Comparison(Relation.AGREE) if near > GOOD else None
    if max(mirrored, float(agreement[best])) < max(GOOD, 1.0 - IMPROVEMENT * (1.0 - near)):
        is_unrelated = is_complete and max(mirrored, float(agreement[best])) < UNRELATED
        return Comparison(Relation.UNRELATED) if is_unrelated else None
    if mirrored >= agreement[best]:
        return Comparison(Relation.MIRRORED)
    return Comparison(Relation.DELAYED, float(LAGS[best]))


def _keep(points: tuple[P, ...], utime: int) -> tuple[P, ...]:
    oldest = utime - (WINDOW + 2.0 * MAX_LAG) * 1e6
    for n, each in enumerate(points):
        if each.utime >= oldest:
            return points[n:]
    return ()
