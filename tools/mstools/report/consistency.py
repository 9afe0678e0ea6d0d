"""Consistency of the innovations: NIS by kind of measurement. Pure.

NIS is a decision's statistic y' S^-1 y of the innovation y with covariance S. In a consistent filter it is chi-square
distributed with as many degrees of freedom as y has components: its mean per degree of freedom is 1, and 5 % exceed the
95 % limit (Bar-Shalom, Li and Kirubarajan (2001) 5.4).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from modelserver.estimation.filter.kalman import gate_limit
from modelserver.messages import Decision, Verdict


@dataclass(frozen=True, slots=True)
class Consistency:
    """Innovations of one kind of measurement.

    Attributes
    ----------
    count, numbers : innovations and their components
    rejected : innovations that the gate rejected; included in `mean` and `beyond`
    mean : mean NIS per degree of freedom
    beyond : share of innovations beyond the 95 % limit
    """

    kind: str
    count: int
    numbers: int
    rejected: int
    mean: float
    beyond: float


def has_nis(decision: Decision) -> bool:
    """Return whether a decision has an innovation and was not set aside on purpose."""
    return decision.dof > 0 and math.isfinite(decision.statistic) and decision.verdict is not Verdict.MONITORED


def compute_consistency(decisions: Iterable[Decision]) -> list[Consistency]:
    """Return the consistency of each kind of measurement, by name."""
    kinds: dict[str, list[Decision]] = {}
    for each in decisions:
        if has_nis(each):
            kinds.setdefault(each.kind, []).append(each)
    return [_summarize(kind, found) for kind, found in sorted(kinds.items())]


def _summarize(kind: str, found: list[Decision]) -> Consistency:
    numbers = sum(each.dof for each in found)
    beyond = sum(each.statistic > gate_limit(each.dof, 0.05) for each in found)
    return Consistency(
        kind,
        len(found),
        numbers,
        sum(each.verdict is Verdict.REJECTED for each in found),
        sum(each.statistic for each in found) / numbers,
        beyond / len(found),
    )


def compute_running_nis(decisions: Iterable[Decision], window_s: float) -> tuple[list[int], list[float]]:
    """Return utimes and the mean NIS per degree of freedom in the `window_s` before each."""
    utimes: list[int] = []
    means: list[float] = []
    window: list[Decision] = []
    first = 0
    total = 0.0
    numbers = 0
    for each in sorted(filter(has_nis, decisions), key=lambda decision: decision.utime):
        window.append(each)
        total += each.statistic
        numbers += each.dof
        while window[first].utime < each.utime - window_s * 1e6:
            total -= window[first].statistic
            numbers -= window[first].dof
            first += 1
        utimes.append(each.utime)
        means.append(max(total, 0.0) / numbers)
    return utimes, means
