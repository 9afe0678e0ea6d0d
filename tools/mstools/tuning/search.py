"""The search of `modelserver tune`: steps of a factor of two, one setting after the other. Pure, deterministic."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

Settings: TypeAlias = Mapping[str, float]

FACTOR = 2.0

LEAST_GAIN = 0.02
"""Gain in mean log-likelihood below which a step is not taken: it would follow this recording's chance."""

UNSEEN = 1e-4
"""Change of the likelihood below which a setting does nothing on this recording."""

RMSE_SLACK = 1.02
GAPS_SLACK = 1.05
"""By how much a step may worsen the error at withheld fixes, and at the ends of gaps: likelihood must not be bought
with accuracy."""

FARTHEST = 8.0
"""A proposal is at most so many times the setting, or this part of it, that the search began with."""


@dataclass(frozen=True, slots=True)
class Score:
    """How well settings do: mean log-likelihood and RMSE at withheld fixes, mean error at gap ends (nan: no gaps)."""

    likelihood: float
    rmse: float
    gaps: float = math.nan


@dataclass(frozen=True, slots=True)
class Parameter:
    """A setting to search: its least and largest value. `from_value`: where steps upward begin at least."""

    name: str
    low: float = 0.0
    high: float = math.inf
    from_value: float = 0.0


@dataclass(frozen=True, slots=True)
class SearchStep:
    """A step that was taken."""

    name: str
    before: float
    after: float
    score: Score


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Where the search came to: the settings that changed, the steps there, and what did nothing on this recording."""

    settings: Settings
    score: Score
    steps: tuple[SearchStep, ...]
    unseen: tuple[str, ...]


Evaluate: TypeAlias = Callable[[Sequence[Settings]], Sequence[Score | None]]
"""Scores settings, each a change of those that the search began with; None for settings that cannot be."""


def search(
    begin: Settings,
    first: Score,
    parameters: Sequence[Parameter],
    evaluate: Evaluate,
    rounds: int = 2,
    told: Callable[[SearchStep], object] | None = None,
) -> SearchResult:
    """Step each parameter up and down by `FACTOR` while that helps, round after round while anything moves.

    `begin` has the values of all parameters, `first` their score. `told` is called with each step taken.
    """
    values = dict(begin)
    best = first
    steps: list[SearchStep] = []
    unseen: list[str] = []

    def change(trial: Settings) -> dict[str, float]:
        return {name: value for name, value in trial.items() if value != begin[name]}

    for number in range(rounds):
        moved = False
        for parameter in parameters:
            name = parameter.name
            if name in unseen:
                continue
            trials = [t for t in (_stepped(parameter, values[name], begin[name], up) for up in (True, False)) if t]
            scores = evaluate([change({**values, name: trial}) for trial in trials])
            if number == 0 and all(s is None or abs(s.likelihood - best.likelihood) < UNSEEN for s in scores):
                unseen.append(name)
                continue
            taken = _best(best, trials, scores)
            while taken is not None:
                trial, score = taken
                up = trial > values[name]
                step = SearchStep(name, values[name], trial, score)
                values[name], best, moved = trial, score, True
                steps.append(step)
                if told is not None:
                    told(step)
                farther = _stepped(parameter, trial, begin[name], up)
                taken = None
                if farther:
                    taken = _best(best, [farther], evaluate([change({**values, name: farther})]))
        if not moved:
            break
    return SearchResult(change(values), best, tuple(steps), tuple(unseen))


def _stepped(parameter: Parameter, value: float, begin: float, up: bool) -> float | None:
    """Return the value a step on, None where that is out of bounds."""
    trial = max(value, parameter.from_value) * FACTOR if up else value / FACTOR
    start = max(begin, parameter.from_value) if up else begin
    high, low = min(parameter.high, start * FARTHEST), max(parameter.low, start / FARTHEST)
    trial = min(max(trial, low), high)
    return None if trial == value or (trial > value) != up else trial


def _best(best: Score, trials: Sequence[float], scores: Sequence[Score | None]) -> tuple[float, Score] | None:
    """Return the trial that gains most, of those that gain enough and cost no accuracy; None where none does."""
    good = [
        (trial, score)
        for trial, score in zip(trials, scores, strict=True)
        if score is not None and score.likelihood > best.likelihood + LEAST_GAIN and _as_accurate(score, best)
    ]
    return max(good, key=lambda each: each[1].likelihood, default=None)


def _as_accurate(score: Score, best: Score) -> bool:
    if not score.rmse <= best.rmse * RMSE_SLACK:
        return False
    return math.isnan(best.gaps) or score.gaps <= best.gaps * GAPS_SLACK
