"""What a mistyped name costs a server with 10,000 frames: a stranger may send such requests all day."""

from __future__ import annotations

import contextlib
import statistics

from benchmarks.support import interleaved, large_model, verdict
from modelserver.errors import QueryError


def main() -> int:
    model = large_model().build()

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
    times = interleaved(5, 3, {what: lambda name=name: ask(name) for what, name in typed.items()})
    holds = [verdict(what, statistics.median(values) * 1e3, 50.0, "ms") for what, values in times.items()]
    return 0 if all(holds) else 1
