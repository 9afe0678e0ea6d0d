"""How long the pose of a replay was valid, why it was not, and what to do: the answer of a report. Pure.

A state holds until the next one, for `HOLD_S` at most; time without a state is not valid, and a reason of its own. The
first reason is that of most of the time; of equal ones NO_IMU is first, as without an IMU fixes are not used either.
LIMIT_EXCEEDED follows from other reasons, and counts where it is the only one.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from modelserver.messages import Invalid
from mstools.report.replay_data import HOLD_S, ReplayData, StateSample

REMEDIES: Mapping[Invalid, str] = {
    Invalid.NO_FIX: "check antenna and receiver; modelserver status shows rates and rejected fixes",
    Invalid.STALE_GPS: "check antenna and receiver; modelserver status shows rates and rejected fixes",
    Invalid.NO_IMU: "check the driver; without an IMU use localization.mode: no_imu",
    Invalid.STALE_IMU: "check the driver; without an IMU use localization.mode: no_imu",
    Invalid.NO_ORIGIN: "wait for good fixes (localization.filter.origin_fixes), or configure the origin",
    Invalid.NOT_MOVED_YET: "drive with GPS until the heading is aligned; the health report states how far",
    Invalid.STATIONARY_HEADING: "move, or add a second antenna",
    Invalid.GPS_REJECTED: "compare fixes and track in the report; wait for re-initialization",
    Invalid.LIMIT_EXCEEDED: "restore GPS, or raise horizontal_limit or heading_limit if your task allows it",
    Invalid.CLOCK_STEPPED: "drive until the heading is known; do not set clocks while driving",
    Invalid.TILTED: "check the mount of the IMU in the geometry",
    Invalid.GNSS_INCONSISTENT: "compare fixes and track in the report: fixes drift, jump, or alternate between two "
    "receivers, or gyro or wheels drift; it ends with agreement",
    Invalid.MISMOUNTED: "correct the mount of the IMU (modelserver calibrate imu), or the signs of the wheels",
    Invalid.STALE_JOINT: "check the driver of the joint, or give the joint a default",
    Invalid.JOINT_UNKNOWN: "check the driver of the joint, or give the joint a default",
}
"""What to do about each reason for which a pose is invalid."""

NO_SAMPLES = "compare the channels in the log with those in the vehicle file, and check recorder, bus and devices"

LIMIT = 0.05
"""Share of the time after the first valid pose up to which poses may be invalid without a finding: a gap of a minute in
a drive of twenty, as below a bridge, is no fault of the vehicle.
"""


class InvalidTime(NamedTuple):
    """Time with a reason for which the pose is invalid: the reason in words, seconds, and the remedy."""

    reason: str
    seconds: float
    remedy: str


@dataclass(frozen=True, slots=True)
class ValiditySummary:
    """Validity of a replay's poses; durations in seconds.

    Attributes
    ----------
    duration : of the log
    valid : with a valid pose
    first_valid : from the log's first event to the first valid pose, nan without one
    reasons, reasons_after : time with each reason in the whole log and after the first valid pose, longest first
    """

    duration: float
    valid: float
    first_valid: float
    reasons: tuple[InvalidTime, ...]
    reasons_after: tuple[InvalidTime, ...]

    @property
    def share(self) -> float:
        """Share of the log with a valid pose."""
        return self.valid / self.duration if self.duration > 0.0 else 0.0

    @property
    def invalid(self) -> float:
        return self.duration - self.valid

    @property
    def after(self) -> float:
        """Time after the first valid pose; nan without one."""
        return self.duration - self.first_valid

    @property
    def invalid_after(self) -> float:
        """The part of `after` without a valid pose."""
        return self.after - self.valid

    @property
    def is_interrupted(self) -> bool:
        """Whether poses were invalid for more than `LIMIT` of the time after the first valid one."""
        return self.invalid_after > LIMIT * self.after


def summarize_validity(data: ReplayData) -> ValiditySummary:
    states = data.snapshots
    held = _find_holds([*(min(max(each.t, 0.0), data.duration) for each in states), data.duration])
    first = next((n for n, each in enumerate(states) if not each.invalid), len(states))
    first_valid = states[first].t if first < len(states) else math.nan
    return ValiditySummary(
        duration=data.duration,
        valid=sum(seconds for each, seconds in zip(states, held, strict=True) if not each.invalid),
        first_valid=first_valid,
        reasons=_sum_reasons(states, held, data.duration),
        reasons_after=_sum_reasons(states[first:], held[first:], data.duration - first_valid),
    )


def _find_holds(times: Sequence[float]) -> list[float]:
    """Return how long each state holds, seconds; `times` are those of the states and the end.

    Before heading alignment states come in the order of arrival, some a little late: no time counts twice. Beyond
    `HOLD_S` it was a step of the clock backward, from where time counts on.
    """
    held, latest = [], -math.inf
    for begin, end in pairwise(times):
        latest = begin if begin < latest - HOLD_S else max(begin, latest)
        held.append(min(max(end - latest, 0.0), HOLD_S))
    return held


def _sum_reasons(states: Sequence[StateSample], held: Sequence[float], duration: float) -> tuple[InvalidTime, ...]:
    seconds: defaultdict[Invalid, float] = defaultdict(float)
    for each, time in zip(states, held, strict=True):
        for flag in Invalid:
            if flag in each.invalid and (flag is not Invalid.LIMIT_EXCEEDED or each.invalid == flag):
                seconds[flag] += time
    order = sorted(seconds, key=lambda flag: flag is not Invalid.NO_IMU)
    found = [
        InvalidTime(f"{flag.explain()} ({flag.name})", min(seconds[flag], duration), REMEDIES[flag]) for flag in order
    ]
    if (rest := duration - sum(held)) > HOLD_S:
        found.append(InvalidTime("no sample, or none that could be used", rest, NO_SAMPLES))
    return tuple(sorted(found, key=lambda each: -round(each.seconds, 1)))
