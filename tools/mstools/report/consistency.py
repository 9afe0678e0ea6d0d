"""Whether innovations are as large as the filter expects them: NIS by kind of measurement. Pure.

NIS is a decision's statistic, residual' S^-1 residual. If all is well it is chi-square distributed with as many degrees
of freedom as numbers were compared: its mean over them is 1, and one in twenty passes the 95 % limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from modelserver.localization.filter.kalman import gate_limit
from modelserver.messages import Decision, Verdict


@dataclass(frozen=True, slots=True)
class Consistency:
    """The innovations of one kind. `mean` is of NIS over its degrees of freedom, `beyond` the share over 95 %.

    `count` were compared, `refused` of them by the gate; those count in `mean` and `beyond` as well. `numbers` is how
    many numbers were compared in all.
    """

    kind: str
    count: int
    numbers: int
    refused: int
    mean: float
    beyond: float


def counts(decision: Decision) -> bool:
    """Return whether a decision's statistic speaks of consistency: compared, and not set aside on purpose."""
    return decision.dof > 0 and math.isfinite(decision.statistic) and decision.verdict is not Verdict.MONITORED


def by_kind(decisions: Iterable[Decision]) -> list[Consistency]:
    """Return the consistency of each kind that was compared, by name."""
    kinds: dict[str, list[Decision]] = {}
    for each in decisions:
        if counts(each):
            kinds.setdefault(each.kind, []).append(each)
    return [_of(kind, found) for kind, found in sorted(kinds.items())]


def _of(kind: str, found: list[Decision]) -> Consistency:
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


def running(decisions: Iterable[Decision], window_s: float) -> tuple[list[int], list[float]]:
    """Return instants (utime) and the mean of NIS over its degrees of freedom in the `window_s` before each."""
    utimes: list[int] = []
    means: list[float] = []
    held: list[Decision] = []
    first = 0
    total = 0.0
    numbers = 0
    for each in sorted(filter(counts, decisions), key=lambda decision: decision.utime):
        held.append(each)
        total += each.statistic
        numbers += each.dof
        while held[first].utime < each.utime - window_s * 1e6:
            total -= held[first].statistic
            numbers -= held[first].dof
            first += 1
        utimes.append(each.utime)
        means.append(max(total, 0.0) / numbers)
    return utimes, means
