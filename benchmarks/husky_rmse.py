"""Horizontal error on the Husky recording against fixes that the localization never saw, beside simple peers.

Every second fix of `husky/test1.bag` is taken out of the log; the rest is replayed offline, and the antenna's
estimate for the instant of each withheld fix, made from what had arrived before it, is compared with that fix.
The fixes themselves wander by about a metre, and neighbours wander together: the figure says how well the way
between two fixes is carried, not how true the fixes are.

The peers get the same fixes: the last one held, and the last two carried on in a straight line.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import numpy.typing as npt
import pyproj

from modelserver.config import load_config
from modelserver.messages import GpsSample
from modelserver.service.daemon import Vehicle, load_vehicle
from modelserver.service.offline import Run
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools.import_bag import import_bag

Array = npt.NDArray[np.float64]

ROOT = Path(__file__).resolve().parent.parent
SKIPPED = 77
SKIP_S = 20.0
"""Seconds at the beginning that are not scored: the heading is not known before the vehicle has moved."""


@dataclass(frozen=True)
class Fixes:
    """The fixes of a log: stamps (microseconds), UTM easting and northing (n, 2)."""

    utime: npt.NDArray[np.int64]
    place: Array

    @property
    def withheld(self) -> npt.NDArray[np.bool_]:
        """Which fixes are withheld: every second one."""
        return np.arange(len(self.utime)) % 2 == 1


@dataclass(frozen=True)
class Score:
    """How far estimates are from the withheld fixes, horizontally, metres."""

    n: int
    missing: int
    rmse: float
    p95: float
    max: float


def data_directory() -> Path:
    return Path(os.environ.get("MODELSERVER_DATA", ROOT.parent / "shared" / "data"))


def read_fixes(events: Iterable[LogEvent]) -> Fixes:
    samples = [sample for event in events if (sample := _fix(event)) is not None]
    zone = int((samples[0].longitude_deg + 180) // 6) + 1
    to_utm = pyproj.Transformer.from_crs(4326, f"+proj=utm +zone={zone} +datum=WGS84", always_xy=True)
    east, north = to_utm.transform([s.longitude_deg for s in samples], [s.latitude_deg for s in samples])
    return Fixes(np.array([s.header.utime for s in samples]), np.column_stack([east, north]))


def _fix(event: LogEvent) -> GpsSample | None:
    if event.channel != "GPS":
        return None
    sample: GpsSample = decode("gps_t", event.data)
    return sample


def without_withheld(events: Iterable[LogEvent]) -> Iterator[LogEvent]:
    """Yield the events without every second fix."""
    count = 0
    for event in events:
        if event.channel == "GPS":
            count += 1
            if count % 2 == 0:
                continue
        yield event


def write_log(path: Path, events: Iterable[LogEvent]) -> None:
    out = lcm.EventLog(str(path), "w", overwrite=True)
    for event in events:
        out.write_event(event.utime, event.channel, event.data)
    out.close()


def estimates(vehicle: Vehicle, log: Path, utimes: Iterable[int], frame: str) -> Array:
    """Return east, north and yaw of a frame at some times (n, 3); nan where there is no pose.

    Poses that are not valid count as well: leaving them out would flatter.
    """
    found = []
    with LogFile(log) as recording:
        for row in Run(vehicle, recording, frame).rows(utimes):
            w, x, y, z = row.rotation
            yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            found.append((row.easting, row.northing, yaw))
    return np.array(found)


def hold_last(fixes: Fixes) -> Array:
    """Return the place of the fix before, for each withheld one."""
    return fixes.place[np.flatnonzero(fixes.withheld) - 1]


def straight_on(fixes: Fixes) -> Array:
    """Return the line through the last two fixes that were given, for each withheld one."""
    k = np.flatnonzero(fixes.withheld)
    last, before = k - 1, np.maximum(k - 3, 0)
    seconds = (fixes.utime[last] - fixes.utime[before]) * 1e-6
    ahead = (fixes.utime[k] - fixes.utime[last]) * 1e-6
    share = np.divide(ahead, seconds, out=np.zeros_like(ahead), where=seconds > 0)
    result: Array = fixes.place[last] + (fixes.place[last] - fixes.place[before]) * share[:, None]
    return result


def score(fixes: Fixes, estimated: Array, scorer: Callable[..., dict[str, Any]] | None = None) -> Score:
    """Compare estimates at the withheld fixes with them; by the common scorer where there is one."""
    t = (fixes.utime - fixes.utime[0]) * 1e-6
    if scorer is not None:
        with tempfile.TemporaryDirectory() as directory:
            est, true, meta = (Path(directory) / name for name in ("est.csv", "fixes.csv", "meta.json"))
            yaw = estimated[:, 2:3] if estimated.shape[1] > 2 else np.zeros((len(estimated), 1))
            rows = np.column_stack([t[fixes.withheld], estimated[:, :2], np.zeros(len(estimated)), yaw])
            np.savetxt(est, rows, "%.6f", ",", header="t,e,n,u,yaw", comments="")
            flat = np.column_stack([t, fixes.place, np.zeros(len(t))])
            np.savetxt(true, flat, "%.6f", ",", header="t,e,n,u", comments="")
            meta.write_text(json.dumps({"t_first": 0.0, "duration": float(t[-1]), "skip": SKIP_S}))
            found = scorer(est, true, meta, "half")
        return Score(**{key: found[key] for key in ("n", "missing", "rmse", "p95", "max")})
    k = t[fixes.withheld] >= SKIP_S
    off = np.hypot(*(estimated[k, :2] - fixes.place[fixes.withheld][k]).T)
    good = off[np.isfinite(off)]
    return Score(
        len(good),
        len(off) - len(good),
        float(np.sqrt((good**2).mean())),
        float(np.percentile(good, 95)),
        float(good.max()),
    )


def common_scorer(data: Path) -> Callable[..., dict[str, Any]] | None:
    """Return the scorer that stands beside the recordings, None where there is none."""
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


def run(log: Path, directory: Path, scorer: Callable[..., dict[str, Any]] | None = None) -> dict[str, Score]:
    """Return the scores of the localization and its peers on a log; `directory` takes the filtered one."""
    half = directory / "half.lcm"
    with LogFile(log) as recording:
        fixes = read_fixes(recording)
        write_log(half, without_withheld(recording))
    vehicle = load_vehicle(load_config(ROOT / "config" / "husky" / "vehicle.yaml"))
    gps = vehicle.config.sensors.gps
    assert gps is not None
    at = fixes.utime[fixes.withheld].tolist()
    return {
        "modelserver": score(fixes, estimates(vehicle, half, at, gps.frame), scorer),
        "last fix held": score(fixes, hold_last(fixes), scorer),
        "last two fixes straight on": score(fixes, straight_on(fixes), scorer),
    }


def main() -> int:
    data = data_directory()
    bag = data / "husky" / "test1.bag"
    if not bag.is_file():
        print(f"skipped: no {bag}; set MODELSERVER_DATA to the folder of recordings")
        return SKIPPED
    scorer = common_scorer(data)
    with tempfile.TemporaryDirectory() as directory:
        log = Path(directory) / "whole.lcm"
        import_bag(bag, log)
        scores = run(log, Path(directory), scorer)
    out = io.StringIO()
    print(f"{'':28}{'n':>5}{'missing':>9}{'rmse m':>9}{'p95 m':>9}{'max m':>9}{'rmse ratio':>12}", file=out)
    ours = scores["modelserver"].rmse
    for name, each in scores.items():
        numbers = f"{each.n:5}{each.missing:9}{each.rmse:9.3f}{each.p95:9.3f}{each.max:9.3f}{ours / each.rmse:12.2f}"
        print(f"{name:28}{numbers}", file=out)
    print(out.getvalue() + f"scored by {'the common scorer' if scorer else 'this module'}, first {SKIP_S:g} s left out")
    return 0


if __name__ == "__main__":
    sys.exit(main())
