"""A static get_transformation, cached and first, relative to a bare dict lookup by a pair of strings."""

from __future__ import annotations

import itertools
import random
import statistics
import time

from benchmarks.support import RAPTOR, build_large_model, print_verdict, ratio
from modelserver.formats import load_model
from modelserver.geometry.model import Model

ROUNDS = 15
PAIRS = 1000


def _frame_names(model: Model) -> list[str]:
    return [f"{body.name}:{frame.name}" for body in model.bodies for frame in body]


def _measure_warm(model: Model, rng: random.Random) -> tuple[list[float], list[float]]:
    """Return the seconds of a lookup per round, of the model's and of a dict's, with the same pairs and loop."""
    names = _frame_names(model)
    pairs = [(rng.choice(names), rng.choice(names)) for _ in range(PAIRS)]
    table = {pair: model.get_transformation(*pair) for pair in pairs}
    get = model.get_transformation
    model_times, dict_times = [], []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        for _ in range(50):
            for a, b in pairs:
                get(a, b)
        middle = time.perf_counter()
        for _ in range(50):
            for a, b in pairs:
                table[a, b]
        end = time.perf_counter()
        model_times.append((middle - begin) / (50 * PAIRS))
        dict_times.append((end - middle) / (50 * PAIRS))
    return model_times, dict_times


def _measure_cold(model: Model, rng: random.Random, count: int = 5000) -> float:
    """Return the median seconds of the first lookup of a pair."""
    names = _frame_names(model)
    every = list(itertools.product(names, names)) if len(names) < 100 else []
    pairs = rng.sample(every, min(count, len(every))) if every else [tuple(rng.sample(names, 2)) for _ in range(count)]
    times = []
    for a, b in pairs:
        begin = time.perf_counter()
        model.get_transformation(a, b)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main() -> int:
    rng = random.Random(1)
    holds = True
    ratios = {}
    for name, model in (
        ("Raptor", load_model(RAPTOR / "geometry.yaml")),
        ("10,000 frames", build_large_model().build()),
    ):
        first = _measure_cold(model, rng)
        mine, bare = _measure_warm(model, rng)
        ratios[name] = ratio(mine, bare)
        print(f"  {name}: dict {statistics.median(bare) * 1e9:.0f} ns, model {statistics.median(mine) * 1e9:.0f} ns")
        bound = 4.0 if name == "Raptor" else 8.0
        holds &= print_verdict(f"{name}: warm lookup to a dict lookup", ratios[name], bound, "x")
        holds &= print_verdict(f"{name}: a pair first seen", first * 1e6, 20.0, "us")
    holds &= print_verdict("10,000 frames to Raptor, warm", ratios["10,000 frames"] / ratios["Raptor"], 2.0, "x")
    return 0 if holds else 1
