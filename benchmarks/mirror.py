"""A static get_transformation of PlatformMirror, beside a live daemon, relative to that of the model in-process."""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable

from benchmarks.support import RAPTOR, free_url, print_verdict, ratio, run_daemon
from modelserver.client.mirror import PlatformMirror
from modelserver.formats import load_model

ROUNDS = 41
PAIRS = 200
TIMES = 50


def _measure(get: Callable[[str, str], object], pairs: list[tuple[str, str]]) -> float:
    """Return the seconds of a lookup, with the same pairs repeated."""
    begin = time.perf_counter()
    for _ in range(TIMES):
        for a, b in pairs:
            get(a, b)
    return (time.perf_counter() - begin) / (TIMES * len(pairs))


def main() -> int:
    model = load_model(RAPTOR / "geometry.yaml")
    names = [f"{body.name}:{frame.name}" for body in model.bodies for frame in body]
    rng = random.Random(1)
    url = free_url()
    with run_daemon(url, RAPTOR / "vehicle.yaml"), PlatformMirror(url) as mirror:
        # POSE is received meanwhile: the receiving thread has its usual load
        mirror.wait(20.0, pose=False)
        pairs: list[tuple[str, str]] = []
        while len(pairs) < PAIRS:
            pair = (rng.choice(names), rng.choice(names))
            if not model.get_kinematic_path(*pair).joints:
                pairs.append(pair)
        for pair in pairs:
            here, there = mirror.get_transformation(*pair), model.get_transformation(*pair)
            if not here.pose.is_close(there.pose):
                print(f"  {pair}: the mirror returns {here}, the model {there}")
                return 1
        mine, own = [], []
        for number in range(ROUNDS):
            # alternate the order
            for get, times in ((mirror.get_transformation, mine), (model.get_transformation, own))[
                :: 1 - number % 2 * 2
            ]:
                times.append(_measure(get, pairs))
    print(f"  model {statistics.median(own) * 1e9:.0f} ns, mirror {statistics.median(mine) * 1e9:.0f} ns")
    return 0 if print_verdict("static lookup: mirror to model in-process", ratio(mine, own), 1.1, "x") else 1
