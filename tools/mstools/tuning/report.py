"""Page of `modelserver tune`: the score of all settings that were tried, in order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from mstools.report import charts
from mstools.tuning.search import Score, Settings


class Attempt(NamedTuple):
    """Settings that were tried, and their score; None where the filter rejects them."""

    settings: Settings
    score: Score | None


def render_page(log: str, lines: Sequence[str], begin: Settings, attempts: Sequence[Attempt], best: Settings) -> str:
    """Return an HTML page: `lines` of the result, and the scores of all attempts.

    `begin` are the settings of the vehicle file, `best` those that are proposed. Raises as `charts.render_page`.
    """
    scored = [(number, each.settings, each.score) for number, each in enumerate(attempts) if each.score is not None]
    texts = [_describe(begin, settings) for _, settings, _ in scored]
    at = [float(number) for number, _, _ in scored]
    x = charts.Axis("settings in the order in which they were tried", -0.5, max(len(attempts) - 0.5, 0.5))
    proposed = next((number for number, settings, _ in scored if dict(settings) == dict(best)), 0)
    panels = []
    for title, unit, field, height in (
        ("Log-likelihood of a withheld fix", "", "likelihood", 200.0),
        ("RMSE at withheld fixes", "m", "rmse", 120.0),
        ("Mean error at the ends of gaps", "m", "gaps", 120.0),
        ("Mean NEES at the ends of gaps", "", "nees", 120.0),
    ):
        values = [float(getattr(score, field)) for _, _, score in scored]
        if not any(map(math.isfinite, values)):
            continue
        # settings that are far off would hide the differences between the others
        axis = charts.Axis(unit, *charts.value_range(values, 0.9))
        chosen = [n for n, number in enumerate(at) if number == proposed]
        drawn = [
            charts.Series("tried", at, values, charts.BLUE, 5.0, "dots", texts=texts),
            charts.Series(
                "proposed",
                [at[n] for n in chosen],
                [values[n] for n in chosen],
                charts.ORANGE,
                9.0,
                "dots",
                texts=[texts[n] for n in chosen],
            ),
        ]
        panels.append(charts.Panel(title, axis, drawn, height))
    return charts.render_text_page(f"Tuning: {log}", lines, [charts.render_panels("Scores", x, panels)])


def _describe(begin: Settings, settings: Settings) -> str:
    changed = [f"{name} {begin[name]:g} -> {value:g}" for name, value in settings.items() if value != begin[name]]
    return ", ".join(changed) or "the vehicle file's"
