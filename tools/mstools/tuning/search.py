"""Coordinate search of `modelserver tune`: each setting is multiplied or divided by 2 while that helps. Pure.

Objective: mean log-likelihood of withheld fixes, with the constraints that neither their RMSE nor the error at the ends
of gaps gets noticeably worse, and that the filter is not overconfident there (NEES). A step must gain MIN_GAIN, or it
would fit the noise of this log. Settings that change nothing are left out after the first round. Deterministic;
converges to a local optimum within MAX_FACTOR.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

Settings: TypeAlias = Mapping[str, float]

FACTOR = 2.0

MIN_GAIN = 0.02
"""Gain in mean log-likelihood below which a step is not accepted."""

MIN_EFFECT = 1e-4
"""Change of the likelihood below which a setting has no effect on this log."""

RMSE_SLACK = 1.02
GAPS_SLACK = 1.05
"""Factors by which a step may worsen the error at withheld fixes, and at the ends of gaps."""

NEES_LIMIT = 2.0
"""Mean NEES at gap ends beyond which a step may not lead: four gaps with two axes each exceed it with a probability of
5 % if the covariance is right (chi-square with 8 degrees of freedom)."""

MAX_FACTOR = 8.0
"""Largest ratio of a proposal to the initial setting, and its reciprocal."""


@dataclass(frozen=True, slots=True)
class Score:
    """Score of settings: log-likelihood and RMSE at withheld fixes, mean error and NEES at gap ends (nan: none)."""

    likelihood: float
    rmse: float
    gaps: float = math.nan
    nees: float = math.nan


@dataclass(frozen=True, slots=True)
class Parameter:
    """A setting to search, with its bounds. `from_value`: smallest start of upward steps."""

    name: str
    low: float = 0.0
    high: float = math.inf
    from_value: float = 0.0


@dataclass(frozen=True, slots=True)
class SearchStep:
    """An accepted step."""

    name: str
    before: float
    after: float
    score: Score


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of the search: changed settings, accepted steps, and settings without effect on this log."""

    settings: Settings
    score: Score
    steps: tuple[SearchStep, ...]
    insensitive: tuple[str, ...]


Evaluate: TypeAlias = Callable[[Sequence[Settings]], Sequence[Score | None]]
"""Scores settings, each given as changes of the initial ones; None for settings out of range."""


def search(
    begin: Settings,
    first: Score,
    parameters: Sequence[Parameter],
    evaluate: Evaluate,
    rounds: int = 2,
    on_step: Callable[[SearchStep], object] | None = None,
) -> SearchResult:
    """Step each parameter up and down by `FACTOR` while that helps, round after round until nothing changes.

    `begin` has the initial values of all parameters, `first` their score. `on_step` is called with each accepted step.
    """
    values = dict(begin)
    best = first
    steps: list[SearchStep] = []
    insensitive: list[str] = []

    def change(trial: Settings) -> dict[str, float]:
        return {name: value for name, value in trial.items() if value != begin[name]}

    for number in range(rounds):
        accepted_before = len(steps)
        for parameter in parameters:
            name = parameter.name
            if name in insensitive:
                continue
            both = [_step(parameter, values[name], begin[name], up) for up in (True, False)]
            trials = [each for each in both if each]
            scores = evaluate([change({**values, name: trial}) for trial in trials])
            if number == 0 and all(s is None or abs(s.likelihood - best.likelihood) < MIN_EFFECT for s in scores):
                insensitive.append(name)
                continue
            while (accepted := _best(best, trials, scores)) is not None:
                trial, best = accepted
                steps.append(SearchStep(name, values[name], trial, best))
                if on_step is not None:
                    on_step(steps[-1])
                farther = _step(parameter, trial, begin[name], trial > values[name])
                values[name] = trial
                trials = [farther] if farther else []
                scores = evaluate([change({**values, name: each}) for each in trials]) if trials else []
        if len(steps) == accepted_before:
            break
    return SearchResult(change(values), best, tuple(steps), tuple(insensitive))


def _step(parameter: Parameter, value: float, begin: float, up: bool) -> float | None:
    """Return the value after a step, None where it is out of bounds."""
    trial = max(value, parameter.from_value) * FACTOR if up else value / FACTOR
    start = max(begin, parameter.from_value) if up else begin
    high, low = min(parameter.high, start * MAX_FACTOR), max(parameter.low, start / MAX_FACTOR)
    trial = min(max(trial, low), high)
    return None if trial == value or (trial > value) != up else trial


def _best(best: Score, trials: Sequence[float], scores: Sequence[Score | None]) -> tuple[float, Score] | None:
    """Return the trial with the largest sufficient gain without loss of accuracy or consistency; None without one."""
    good = [
        (trial, score)
        for trial, score in zip(trials, scores, strict=True)
        if score is not None
        and score.likelihood > best.likelihood + MIN_GAIN
        and score.rmse <= best.rmse * RMSE_SLACK
        and (math.isnan(best.gaps) or score.gaps <= best.gaps * GAPS_SLACK)
        and (math.isnan(best.nees) or score.nees <= max(NEES_LIMIT, best.nees))
    ]
    return max(good, key=lambda each: each[1].likelihood, default=None)
