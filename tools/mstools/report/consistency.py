"""Consistency of the innovations: NIS by kind of measurement. Pure.

NIS is a decision's statistic y' S^-1 y of the innovation y with covariance S. In a consistent filter it is chi-square
distributed with as many degrees of freedom as y has components: its mean per degree of freedom is 1, and 5 % exceed the
95 % limit (Bar-Shalom, Li and Kirubarajan (2001) 5.4).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from modelserver.estimation.filter.eskf import chi_square_gate
from modelserver.messages import Decision, Verdict


@dataclass(frozen=True, slots=True)
class Consistency:
    """Innovations of one kind of measurement.

    Attributes
    ----------
    count : number of innovations
    rejected : innovations that the gate rejected; included in `mean` and `beyond`
    mean : mean NIS per degree of freedom
    beyond : share of innovations beyond the 95 % limit
    """

    kind: str
    count: int
    rejected: int
    mean: float
    beyond: float


def has_nis(decision: Decision) -> bool:
    """Return whether a decision has an innovation and was not set aside on purpose."""
    return decision.dof > 0 and math.isfinite(decision.statistic) and decision.verdict is not Verdict.MONITORED


def compute_consistency(decisions: Iterable[Decision]) -> list[Consistency]:
    """Return the consistency of each kind of measurement, by name."""
    known = sorted(filter(has_nis, decisions), key=lambda each: each.kind)
    return [_summarize(kind, list(found)) for kind, found in groupby(known, lambda each: each.kind)]


def _summarize(kind: str, found: list[Decision]) -> Consistency:
    rejected = sum(each.verdict is Verdict.REJECTED for each in found)
    beyond = sum(each.statistic > chi_square_gate(each.dof, 0.05) for each in found)
    mean = sum(each.statistic for each in found) / sum(each.dof for each in found)
    return Consistency(kind, len(found), rejected, mean, beyond / len(found))


def compute_running_nis(decisions: Iterable[Decision], window_s: float) -> tuple[list[int], list[float]]:
    """Return utimes and the mean NIS per degree of freedom in the `window_s` before each."""
    known = sorted(filter(has_nis, decisions), key=lambda decision: decision.utime)
    utimes = np.array([each.utime for each in known], dtype=np.int64)
    first = np.searchsorted(utimes, utimes - round(window_s * 1e6))
    totals = np.cumsum([0.0, *(each.statistic for each in known)])
    numbers = np.cumsum([0, *(each.dof for each in known)])
    means = np.maximum(totals[1:] - totals[first], 0.0) / (numbers[1:] - numbers[first])
    return utimes.tolist(), means.tolist()
