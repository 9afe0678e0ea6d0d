"""Fixes of a log, the folder of the recordings, and the common scorer."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyproj

from benchmarks.support import ROOT
from modelserver.messages import GpsSample
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FixTable:
    """Fixes of a log: stamps (microseconds), UTM easting and northing (n, 2)."""

    utime: npt.NDArray[np.int64]
    positions: Array

    @property
    def withheld(self) -> npt.NDArray[np.bool_]:
        """Mask of the withheld fixes: every second one."""
        return np.arange(len(self.utime)) % 2 == 1


def data_directory() -> Path:
    return Path(os.environ.get("MODELSERVER_DATA", ROOT.parent / "shared" / "data"))


def read_fixes(events: Iterable[LogEvent]) -> FixTable:
    samples = [sample for event in events if (sample := _fix(event)) is not None]
    zone = int((samples[0].longitude_deg + 180) // 6) + 1
    to_utm = pyproj.Transformer.from_crs(4326, f"+proj=utm +zone={zone} +datum=WGS84", always_xy=True)
    east, north = to_utm.transform([s.longitude_deg for s in samples], [s.latitude_deg for s in samples])
    return FixTable(np.array([s.header.utime for s in samples]), np.column_stack([east, north]))


def _fix(event: LogEvent) -> GpsSample | None:
    if event.channel != "GPS":
        return None
    sample: GpsSample = decode("gps_t", event.data)
    return sample


def load_scorer(data: Path) -> Callable[..., dict[str, Any]] | None:
    """Return the scorer beside the recordings, None where there is none."""
    path = data.parent / "tools" / "score_trajectory.py"
    if not path.is_file():
        return None
    spec = importlib.util.spec_from_file_location("score_trajectory", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Callable[..., dict[str, Any]] = module.score
    return found
