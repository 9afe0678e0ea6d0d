"""Verdict on an answer: whether it is as accurate, as new and as certain as its request demands. Pure.

The horizontal error, in x and y of the frame of reference, is beyond a limit with the probability
exp(-((limit - a) / s)^2 / 2), s along the longest axis of the error ellipse, a the allowance for suspected faults; the
heading error, about z, by both sides of a normal distribution (`filter.protection_levels`). Met is what has a
probability of 1 - min_integrity at most, or LIMIT_RISK, with which a pose is valid. What is not known is unmet.

The levels of the vehicle's pose count errors that its covariance lacks: of the lever arm and of the mounts. So its
covariance is enlarged to that of the levels, and the answer computed again from it; the configured limits then have the
probability `limit_risk`. A relation within the vehicle has its own covariance and no allowance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from modelserver.estimation.filter.protection_levels import (
    LEVEL_RISK,
    LIMIT_RISK,
    compute_factors,
    compute_limit_risks,
    compute_longest_variance,
)
from modelserver.estimation.history import History
from modelserver.messages import MET, NAN, Estimate, Invalid, PoseAnswer, PoseDemand, TimeQuery, Unmet
from modelserver.query.path import find_provenance, lookup_path
from modelserver.query.view import PlatformView, is_absolute


def check_demand(
    view: PlatformView, answer: PoseAnswer, demand: PoseDemand, time: TimeQuery, now: int
) -> tuple[Unmet, str]:
    """Return what an answer of `view` at `now` lacks of a demand, with the reason. Raises as `transformation`."""
    if not any(demand):
        return MET, ""
    ends = (answer.transformation.frame_of_interest, answer.transformation.frame_of_reference)
    steps = lookup_path(view, *ends, time, now).steps
    found = [data for step in steps if (data := find_provenance(view, step)) is not None]
    # a joint at its default has no data
    age = max(((now - stamp) * 1e-6 if stamp else math.inf for _, stamp in found), default=0.0)
    estimates = [each.estimate for each in steps if each.estimate is not None and is_absolute(each.edge.name)]
    if not estimates:
        return find_unmet(answer, demand, age=age)
    estimate = estimates[0]
    view = view._replace(history=History(0.0).append(_enlarge(estimate)))
    answer = view.transformation(*ends, time, now)
    return find_unmet(answer, demand, estimate.horizontal_allowance, estimate.limit_risk, age)


def _enlarge(estimate: Estimate) -> Estimate:
    """Return an estimate with the covariance that its levels are computed from, nan where they are not known."""
    if estimate.covariance is None:
        return estimate
    k, k_heading = compute_factors(LEVEL_RISK)
    sigma = (estimate.horizontal_level - estimate.horizontal_allowance) / k
    heading_sigma = estimate.heading_level / k_heading
    P = np.array(estimate.covariance).reshape(6, 6)
    # nan remains nan only in this order
    P[[0, 1], [0, 1]] += max(sigma**2 - compute_longest_variance(P), 0.0)
    P[5, 5] = max(heading_sigma**2, P[5, 5])
    return replace(estimate, covariance=tuple(P.ravel().tolist()))


def find_unmet(
    answer: PoseAnswer, demand: PoseDemand, allowance: float = 0.0, limit_risk: float = 0.0, age: float = 0.0
) -> tuple[Unmet, str]:
    """Return what an answer lacks of a demand, and what, by how much and what was asked for in words.

    Parameters
    ----------
    answer
        With the covariance of all its errors.
    demand
        As in the request, 0 for nothing.
    allowance
        For suspected faults of the position, m.
    limit_risk
        Probability that the vehicle's error is beyond a configured limit; nan where it is not known.
    age
        Of the newest data, seconds; infinite where there are none.
    """
    unmet, reasons = MET, list[str]()
    most = 1.0 - demand.min_integrity if demand.min_integrity else LIMIT_RISK
    P = answer.transformation.covariance
    sigma = heading_sigma = NAN
    if P is not None:
        sigma, heading_sigma = math.sqrt(compute_longest_variance(P)), math.sqrt(max(float(P[5, 5]), 0.0))
    limits = (demand.max_horizontal - allowance, demand.max_heading)
    risk, heading_risk = compute_limit_risks(sigma, heading_sigma, *limits)
    k, k_heading = compute_factors(most)
    # the comparisons are false for nan
    if demand.max_horizontal and not risk <= most:
        unmet |= Unmet.HORIZONTAL
        reasons.append(_describe_error("horizontal", allowance + k * sigma, demand.max_horizontal, "m", most))
    if demand.max_heading and not heading_risk <= most:
        unmet |= Unmet.HEADING
        bound, limit = (math.degrees(min(each, math.pi)) for each in (k_heading * heading_sigma, demand.max_heading))
        reasons.append(_describe_error("heading", bound, limit, "deg", most))
    if demand.max_age and not age <= demand.max_age:
        unmet |= Unmet.AGE
        known = f"the newest data are {age:.4g} s old" if age < math.inf else "a joint on the path has no data"
        reasons.append(f"{known}, asked for: at most {demand.max_age:.4g} s")
    if demand.min_integrity:
        invalid = Invalid(answer.transformation.invalid_reasons)
        has_limits = demand.max_horizontal or demand.max_heading
        if invalid:
            unmet |= Unmet.NOT_VALID
            reasons.append(f"the pose is not valid: {invalid.explain()}")
        elif not limit_risk <= (1.0 if has_limits else most):
            unmet |= Unmet.NOT_VALID
            known = "is not known" if math.isnan(limit_risk) else f"is {limit_risk:.2g}, asked for: at most {most:.2g}"
            reasons.append(f"the probability of an error beyond the configured limits {known}")
    return unmet, "; ".join(reasons)


def _describe_error(which: str, bound: float, limit: float, unit: str, risk: float) -> str:
    """Return by how much an error may be beyond a limit."""
    if math.isnan(bound):
        return f"the {which} error is not known, asked for: at most {limit:.4g} {unit}"
    return (
        f"the {which} error is up to {bound:.4g} {unit} at integrity {1.0 - risk:.12g}, asked for: {limit:.4g} {unit}"
    )
