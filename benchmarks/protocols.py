"""Protocols for withholding fixes of a recording, and the error of the causal estimates at their times.

- `half`: every second fix (odd index) is withheld; the error at each of them, without the first 30 s.
- `outage`: four gaps of 30 s, beginning at 20, 40, 60 and 80 % of the time from the first fix to the last; all fixes in
  a gap are withheld. The value of a gap is the mean error over its last 2 s.
- `p2x`: the same with all four shifted by 0, 3, 6, 9, 12 and 15 % of the time, each in a run of its own. The value is
  the mean over all gaps. A gap that would end after the recording is left out: at 15 % the last one of most recordings.

An error is horizontal, in the frame of the antenna, at the fix's stamp; the estimate uses the events that arrived
before (`modelserver.server.recordings`). Three numbers belong together: accuracy, share of time valid, and error beyond
the limit while valid (`Integrity`). The common scorer is stored beside the recordings and gets an estimate at each
withheld fix. Invalid estimates count; missing ones are reported. `load_with_overrides` changes a vehicle file for an
experiment.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyproj
import yaml

from benchmarks.support import ROOT
from modelserver.config.vehicle_file import load_config
from modelserver.messages import GpsSample
from modelserver.server.recordings import OfflineRun
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent, LogFile

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Scorer = Callable[..., dict[str, Any]]

SKIP_S = 30.0
GAP_S = 30.0
STARTS = (0.2, 0.4, 0.6, 0.8)
SHIFTS = (0.0, 0.03, 0.06, 0.09, 0.12, 0.15)


@dataclass(frozen=True)
class ReplayJob:
    """One run over a log: `withhold` is `half`, or the shift of the gaps as a share of the recording."""

    log: Path
    vehicle: Path
    data: Path
    withhold: str | float
    settings: Mapping[str, str] = field(default_factory=dict)
    mode: str = ""
    transform: Callable[[Iterable[LogEvent]], Iterator[LogEvent]] | None = None


@dataclass(frozen=True)
class FixGap:
    """One gap: its start, seconds from the first fix, and the mean error over its last 2 s, meters."""

    start: float
    end_error: float


@dataclass(frozen=True)
class Integrity:
    """Validity and levels from the first valid estimate on, by the time between withheld fixes, seconds.

    `seconds` in all, `valid` of them, `gap` the longest time without; `misleading` valid with an error beyond the limit
    (HMI); `beyond_level` and `beyond_protection` with one beyond the level or the protection level, valid or not.
    `ratio` is the median level over the 95th percentile of the error.
    """

    seconds: float = 0.0
    valid: float = 0.0
    gap: float = 0.0
    misleading: float = 0.0
    beyond_level: float = 0.0
    beyond_protection: float = 0.0
    ratio: float = math.nan


@dataclass(frozen=True)
class ReplayScore:
    """Result of a run. Meters.

    `n` withheld fixes scored, `missing` of them without an estimate; `rmse`, `p95` and `max` for `half`; `gaps` for the
    others. `valid` is the share of valid estimates.
    """

    n: int
    missing: int
    valid: float
    rmse: float = float("nan")
    p95: float = float("nan")
    max: float = float("nan")
    gaps: tuple[FixGap, ...] = ()
    rejected: Mapping[tuple[str, str], int] = field(default_factory=dict)
    integrity: Integrity = Integrity()


@dataclass(frozen=True)
class FixTable:
    """Fixes of a log: stamps (microseconds), UTM easting and northing (n, 2)."""

    utime: npt.NDArray[np.int64]
    positions: Array

    @property
    def withheld(self) -> npt.NDArray[np.bool_]:
        """Mask of the withheld fixes: every second one."""
        return np.arange(len(self.utime)) % 2 == 1


@dataclass(frozen=True)
class Protocol:
    """Selection of the withheld fixes of a log. Times are seconds from the first fix."""

    fixes: FixTable
    withhold: str | float

    @cached_property
    def times(self) -> Array:
        """Times of the fixes."""
        times: Array = (self.fixes.utime - self.fixes.utime[0]) * 1e-6
        return times

    @property
    def duration(self) -> float:
        """Seconds from the first fix to the last."""
        return float(self.times[-1])

    @property
    def gap_starts(self) -> list[float]:
        """Starts of the gaps as shares of the duration; none in `half`."""
        if isinstance(self.withhold, str):
            return []
        whole = [start + self.withhold for start in STARTS]
        return [start for start in whole if start * self.duration + GAP_S <= self.duration]

    @cached_property
    def withheld(self) -> Mask:
        """Mask of the withheld fixes."""
        if self.withhold == "half":
            return self.fixes.withheld
        mask = np.zeros(len(self.times), bool)
        for start in self.gap_starts:
            begin = start * self.duration
            mask |= (self.times > begin) & (self.times <= begin + GAP_S)
        return mask

    def filter_events(self, events: Iterable[LogEvent], channel: str) -> Iterator[LogEvent]:
        """Yield the events without the withheld fixes, which are identified by their index on the channel."""
        number = -1
        for event in events:
            if event.channel == channel:
                number += 1
                if self.withheld[number]:
                    continue
            yield event

    def to_dict(self) -> dict[str, Any]:
        """Return the metadata for the scorer."""
        return {
            "t_first": 0.0,
            "duration": self.duration,
            "skip": SKIP_S,
            "outage_at": self.gap_starts,
            "outage_len": GAP_S,
        }


def run(job: ReplayJob) -> ReplayScore:
    """Run the localization over a log with withheld fixes, and score it. Needs the common scorer."""
    scorer = load_scorer(job.data)
    if scorer is None:
        raise FileNotFoundError(f"no tools/score_trajectory.py beside {job.data}")
    with tempfile.TemporaryDirectory() as directory:
        vehicle = load_with_overrides(job.vehicle, job.settings, job.mode, Path(directory))
        gps = vehicle.config.sensors.gps
        assert gps is not None, "a recording that is scored by its fixes has a GPS"
        with LogFile(job.log) as recording:
            protocol = Protocol(read_fixes(recording), job.withhold)
            events: Iterable[LogEvent] = protocol.filter_events(recording, gps.channel)
            if job.transform is not None:
                events = job.transform(events)
            estimated, valid, levels, rejected = _estimate_fixes(OfflineRun(vehicle, events, gps.frame), protocol)
        score = _score(protocol, estimated, valid, rejected, scorer, Path(directory))
        return replace(score, integrity=measure_integrity(protocol, estimated, valid, levels))


def _estimate_fixes(
    replayed: OfflineRun, protocol: Protocol
) -> tuple[Array, Mask, Array, Mapping[tuple[str, str], int]]:
    """Return east, north, up, yaw at the withheld fixes, their validity, their levels, and the rejected samples.

    The levels (n, 3) are level, protection level and limit of the horizontal position, m.
    """
    # stamps of a recording may not be sorted
    at = np.maximum.accumulate(protocol.fixes.utime[protocol.withheld])
    found, valid, levels = [], [], []
    for row in replayed.rows(at.tolist()):
        w, x, y, z = row.rotation
        found.append((row.easting, row.northing, row.up, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
        valid.append(row.valid)
        if replayed.localizer is None:
            levels.append((math.nan,) * 3)
            continue
        estimate, limit = replayed.localizer.estimate(row.utime), replayed.localizer.summary(row.utime).horizontal_limit
        levels.append((estimate.horizontal_level, estimate.horizontal_protection_level, limit))
    table, bounds = np.array(found, float).reshape(-1, 4), np.array(levels, float).reshape(-1, 3)
    return table, np.array(valid, bool), bounds, dict(replayed.rejected)


def measure_integrity(protocol: Protocol, estimated: Array, valid: Mask, levels: Array) -> Integrity:
    """Return validity and levels at the withheld fixes, of which a pause counts for three seconds at most."""
    if not valid.any():
        return Integrity()
    first = int(np.argmax(valid))
    t = protocol.times[protocol.withheld][first:]
    seconds = np.minimum(np.diff(t, append=t[-1]), 3.0)
    error = np.hypot(*(estimated[first:, :2] - protocol.fixes.positions[protocol.withheld][first:]).T)
    level, protection, limit = levels[first:].T
    is_valid = valid[first:]
    gap = longest = 0.0
    for duration, each in zip(seconds.tolist(), is_valid.tolist(), strict=True):
        gap = 0.0 if each else gap + duration
        longest = max(longest, gap)

    def count(mask: Mask) -> float:
        return float(seconds[mask].sum())

    return Integrity(
        float(seconds.sum()),
        count(is_valid),
        longest,
        count(is_valid & ~(error <= limit)),
        count(error > level),
        count(error > protection),
        float(np.nanmedian(level) / np.nanpercentile(error, 95.0)),
    )


def _score(
    protocol: Protocol,
    estimated: Array,
    valid: Mask,
    rejected: Mapping[tuple[str, str], int],
    scorer: Scorer,
    directory: Path,
) -> ReplayScore:
    t = protocol.times[protocol.withheld]
    counted = t >= SKIP_S
    missing = int((~np.isfinite(estimated[counted, :2]).all(1)).sum())
    share = float(valid[counted].mean())
    if np.isfinite(estimated).all(1).sum() < 10:
        return ReplayScore(int(counted.sum()), missing, share, rejected=rejected)
    est, true, meta = (directory / name for name in ("est.csv", "fixes.csv", "meta.json"))
    # rows without a pose stay: the scorer drops them, and continues from the last
    np.savetxt(est, np.column_stack([t, estimated]), "%.6f", ",", header="t,e,n,u,yaw", comments="")
    flat = np.column_stack([protocol.times, protocol.fixes.positions, np.zeros(len(protocol.times))])
    np.savetxt(true, flat, "%.6f", ",", header="t,e,n,u", comments="")
    meta.write_text(json.dumps(protocol.to_dict()), encoding="utf-8")
    if protocol.withhold == "half":
        found = scorer(est, true, meta, "half")
        numbers = {key: found[key] for key in ("rmse", "p95", "max")}
        return ReplayScore(found["n"], missing, share, **numbers, rejected=rejected)
    found = scorer(est, true, meta, "outage")
    starts = [start * protocol.duration for start in protocol.gap_starts]
    gaps = tuple(FixGap(start, float(end)) for start, end in zip(starts, found["end"], strict=True))
    return ReplayScore(int(counted.sum()), missing, share, max=found["max"], gaps=gaps, rejected=rejected)


def mean_gap_end(outcomes: Iterable[ReplayScore]) -> float:
    """Return the mean of the gap-end errors over all gaps of all runs, meters; nan without gaps."""
    ends = [gap.end_error for each in outcomes for gap in each.gaps]
    return float(np.mean(ends)) if ends else float("nan")


# --- recordings and vehicle files ---------------------------------------------------------------------------


def data_directory() -> Path:
    return Path(os.environ.get("MODELSERVER_DATA", ROOT.parent / "shared" / "data"))


def read_fixes(events: Iterable[LogEvent]) -> FixTable:
    samples = [sample for event in events if (sample := _decode_fix(event)) is not None]
    zone = int((samples[0].longitude_deg + 180) // 6) + 1
    to_utm = pyproj.Transformer.from_crs(4326, f"+proj=utm +zone={zone} +datum=WGS84", always_xy=True)
    east, north = to_utm.transform([s.longitude_deg for s in samples], [s.latitude_deg for s in samples])
    return FixTable(np.array([s.header.utime for s in samples]), np.column_stack([east, north]))


def _decode_fix(event: LogEvent) -> GpsSample | None:
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


def load_with_overrides(path: Path, settings: Mapping[str, str], mode: str, directory: Path) -> Vehicle:
    """Load a vehicle file with changed values; `directory` gets the changed file, if there is one.

    A key with a dot is a path in the vehicle file (`sensors.wheels.channel`); one without is a filter setting
    (`localization.filter.KEY`). A value is YAML; an empty one removes the key. `mode` is `localization.mode`, unless
    empty. Raises ConfigError with the nearest known key for an unknown one.
    """
    if not settings and not mode:
        return load_vehicle(load_config(path), str(path))
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["geometry"] = str((path.parent / content["geometry"]).resolve())
    for key, value in settings.items():
        _set_value(content, (key if "." in key else f"localization.filter.{key}").split("."), value)
    if mode:
        _set_value(content, ["localization", "mode"], mode)
    changed = directory / path.name
    changed.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return load_vehicle(load_config(changed), str(changed))


def _set_value(content: dict[str, Any], keys: list[str], value: str) -> None:
    for key in keys[:-1]:
        content = content.setdefault(key, {})
    if value:
        content[keys[-1]] = yaml.safe_load(value)
    else:
        content.pop(keys[-1], None)
