"""Loading a geometry file of 10,000 frames, including checks, relative to the bare parser on the same bytes."""

from __future__ import annotations

import io
import statistics
import tempfile
from pathlib import Path

import yaml
from lxml import etree

from benchmarks.support import build_large_model, measure_interleaved, print_verdict, ratio
from modelserver.formats import load_model, save_model


def main() -> int:
    model = build_large_model().build()
    holds = True
    with tempfile.TemporaryDirectory() as folder:
        for form, name, parse in (
            ("miro", "large.xml", lambda data: etree.parse(io.BytesIO(data))),
            ("yaml", "large.yaml", lambda data: yaml.compose(data, Loader=yaml.CSafeLoader)),
        ):
            path = Path(folder) / name
            path.write_text(save_model(model, form).text, encoding="utf-8")
            data = path.read_bytes()
            times = measure_interleaved(
                5, 1, {"load": lambda p=path: load_model(p), "parse": lambda d=data, f=parse: f(d)}
            )
            print(f"  {name}: {len(data) / 1e6:.1f} MB, {ratio(times['load'], times['parse']):.1f}x the bare parser")
            holds &= print_verdict(f"{name}: load of 10,000 frames", statistics.median(times["load"]), 3.0, "s")
    return 0 if holds else 1
