"""How long the pose of a replay was valid, why it was not, and what to do: the answer of a report. Pure.

A state holds until the next one, for `HOLD_S` at most; time without a state is not valid. The main reason is that of
most of the time that is not valid. LIMIT_EXCEEDED follows from other reasons, and counts where it is the only one.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

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
    Invalid.GNSS_INCONSISTENT: "fixes drift, jump, or alternate between two receivers; or gyro or wheels drift: "
    "compare fixes and track in the report; it ends with agreement",
    Invalid.MISMOUNTED: "correct the mount of the IMU (modelserver calibrate imu), or the signs of the wheels",
    Invalid.STALE_JOINT: "check the driver of the joint, or give the joint a default",
    Invalid.JOINT_UNKNOWN: "check the driver of the joint, or give the joint a default",
}
"""What to do about each reason for which a pose is invalid."""

LIMIT = 0.05
"""Share of the time after the first valid pose up to which poses may be invalid without a finding: a gap of a minute in
a drive of twenty, as below a bridge, is no fault of the vehicle.
"""


@dataclass(frozen=True, slots=True)
class ValiditySummary:
    """Validity of a replay's poses; durations in seconds.

    Attributes
    ----------
    duration : of the log
    valid : with a valid pose
    first_valid : from the log's first event to the first valid pose, nan without one
    after, invalid_after : time with a state from then on, and the part of it without a valid pose
    reasons, reasons_after : time with each reason in the whole log and from then on, longest first
    """

    duration: float
    valid: float
    first_valid: float
    after: float
    invalid_after: float
    reasons: Mapping[Invalid, float]
    reasons_after: Mapping[Invalid, float]

    @property
    def share(self) -> float:
        """Share of the log with a valid pose."""
        return min(self.valid / self.duration, 1.0) if self.duration > 0.0 else 0.0

    @property
    def invalid(self) -> float:
        return max(self.duration - self.valid, 0.0)

    @property
    def is_interrupted(self) -> bool:
        """Whether poses were invalid for more than `LIMIT` of the time after the first valid one."""
        return self.invalid_after > LIMIT * self.after


def summarize_validity(data: ReplayData) -> ValiditySummary:
    states = data.snapshots
    # a drive that begins again, as after a step of the clock, has no time between its states
    held = [min(max(b.t - a.t, 0.0), HOLD_S) for a, b in pairwise(states)]
    held += [min(max(data.duration - each.t, 0.0), HOLD_S) for each in states[-1:]]
    first = next((n for n, each in enumerate(states) if not each.invalid), len(states))
    bad = sum(seconds for each, seconds in zip(states[first:], held[first:], strict=True) if each.invalid)
    after = sum(held[first:])
    return ValiditySummary(
        duration=data.duration,
        valid=after - bad,
        first_valid=states[first].t if first < len(states) else math.nan,
        after=after,
        invalid_after=bad,
        reasons=_sum_reasons(states, held),
        reasons_after=_sum_reasons(states[first:], held[first:]),
    )


def _sum_reasons(states: Sequence[StateSample], held: Sequence[float]) -> dict[Invalid, float]:
    reasons: defaultdict[Invalid, float] = defaultdict(float)
    for each, seconds in zip(states, held, strict=True):
        for flag in Invalid:
            if flag in each.invalid and (flag is not Invalid.LIMIT_EXCEEDED or each.invalid == flag):
                reasons[flag] += seconds
    return dict(sorted(reasons.items(), key=lambda item: -item[1]))
