"""Cost of a mistyped name on a server with 10,000 frames: any sender may cause it all day."""

from __future__ import annotations

import contextlib
import statistics

from benchmarks.support import build_large_model, measure_interleaved, print_verdict
from modelserver.errors import QueryError


def main() -> int:
    model = build_large_model().build()

    def ask(name: str) -> None:
        with contextlib.suppress(QueryError):
            model.get_transformation(name, "Body0:Frame0")

    typed = {
        "a frame with a slip": "Body499:Frmae19",
        "a body with a slip": "Bdoy499:Frame19",
        "no Body:Frame at all": "Frame19",
        "100 characters": "Body499:" + "Frame19" * 13,
        "60,000 characters": "x" * 60_000,
    }
    times = measure_interleaved(5, 3, {what: lambda name=name: ask(name) for what, name in typed.items()})
    holds = [print_verdict(what, statistics.median(values) * 1e3, 50.0, "ms") for what, values in times.items()]
    return 0 if all(holds) else 1
