"""How a recording's fixes are withheld, and how far the causal estimates at their times are from them.

- `half`: every second fix (odd index) is withheld; the error at each of them, the first 30 s left out.
- `outage`: four gaps of 30 s, beginning at 20, 40, 60 and 80 % of the time from the first fix to the last; all fixes in
  a gap are withheld. A gap's figure is the mean error over its last 2 s.
- `p2x`: the same with all four moved on by 0, 3, 6, 9, 12 and 15 % of the time, each in a run of its own. The figure is
  the mean over all gaps. A gap that would end after the recording is no gap and left out: at 15 % the last one on
  most recordings.

An error is horizontal, in the frame of the antenna, at the fix's stamp; the estimate is made from the events that had
arrived before (`modelserver.service.offline`). The scorer is the common one that stands beside the recordings, given
an estimate at each withheld fix. Estimates that are marked invalid count; where there is none, the figure says so.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.overrides import vehicle_with
from benchmarks.withheld import Fixes, common_scorer, read_fixes
from modelserver.service.offline import OfflineRun
from modelserver.wire.eventlog import LogEvent, LogFile

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Scorer = Callable[..., dict[str, Any]]

SKIP_S = 30.0
GAP_S = 30.0
STARTS = (0.2, 0.4, 0.6, 0.8)
SHIFTS = (0.0, 0.03, 0.06, 0.09, 0.12, 0.15)


@dataclass(frozen=True)
class Job:
    """One run over a log: `withhold` is `half`, or the gaps' shift as a share of the recording."""

    log: Path
    vehicle: Path
    data: Path
    withhold: str | float
    settings: Mapping[str, str] = field(default_factory=dict)
    mode: str = ""
    transform: Callable[[Iterable[LogEvent]], Iterator[LogEvent]] | None = None


@dataclass(frozen=True)
class Gap:
    """One gap: when it began, seconds from the first fix, and the mean error over its last 2 s, metres."""

    start: float
    end_error: float


@dataclass(frozen=True)
class Outcome:
    """What a run came to. Metres.

    `n` withheld fixes scored, `missing` of them without an estimate; `rmse`, `p95` and `max` for `half`; `gaps` for
    the others. `valid` is the share of estimates that are marked valid.
    """

    n: int
    missing: int
    valid: float
    rmse: float = float("nan")
    p95: float = float("nan")
    max: float = float("nan")
    gaps: tuple[Gap, ...] = ()
    rejected: Mapping[tuple[str, str], int] = field(default_factory=dict)


@dataclass(frozen=True)
class Protocol:
    """Which fixes of a log are withheld. Times are seconds from the first fix."""

    fixes: Fixes
    withhold: str | float

    @cached_property
    def t(self) -> Array:
        """The fixes' times."""
        times: Array = (self.fixes.utime - self.fixes.utime[0]) * 1e-6
        return times

    @property
    def duration(self) -> float:
        """Seconds from the first fix to the last."""
        return float(self.t[-1])

    @property
    def starts(self) -> list[float]:
        """Where gaps begin, as shares of the duration; none in `half`."""
        if isinstance(self.withhold, str):
            return []
        whole = [start + self.withhold for start in STARTS]
        return [start for start in whole if start * self.duration + GAP_S <= self.duration]

    @cached_property
    def withheld(self) -> Mask:
        """Which fixes are withheld."""
        if self.withhold == "half":
            return self.fixes.withheld
        mask = np.zeros(len(self.t), bool)
        for start in self.starts:
            begin = start * self.duration
            mask |= (self.t > begin) & (self.t <= begin + GAP_S)
        return mask

    def given(self, events: Iterable[LogEvent], channel: str) -> Iterator[LogEvent]:
        """Yield the events without the withheld fixes, which are known by their order on the channel."""
        number = -1
        for event in events:
            if event.channel == channel:
                number += 1
                if self.withheld[number]:
                    continue
            yield event

    def meta(self) -> dict[str, Any]:
        """Return what the scorer wants to know."""
        return {
            "t_first": 0.0,
            "duration": self.duration,
            "skip": SKIP_S,
            "outage_at": self.starts,
            "outage_len": GAP_S,
        }


def run(job: Job) -> Outcome:
    """Run the localization over a log with fixes withheld, and score it. Needs the common scorer."""
    scorer = common_scorer(job.data)
    if scorer is None:
        raise FileNotFoundError(f"no tools/score_trajectory.py beside {job.data}")
    with tempfile.TemporaryDirectory() as directory:
        vehicle = vehicle_with(job.vehicle, job.settings, job.mode, Path(directory))
        gps = vehicle.config.sensors.gps
        assert gps is not None, "a recording that is scored by its fixes has a GPS"
        with LogFile(job.log) as recording:
            protocol = Protocol(read_fixes(recording), job.withhold)
            events: Iterable[LogEvent] = protocol.given(recording, gps.channel)
            if job.transform is not None:
                events = job.transform(events)
            estimated, valid, rejected = _estimates(OfflineRun(vehicle, events, gps.frame), protocol)
        return _scored(protocol, estimated, valid, rejected, scorer, Path(directory))


def _estimates(replayed: OfflineRun, protocol: Protocol) -> tuple[Array, Mask, Mapping[tuple[str, str], int]]:
    """Return east, north, up, yaw at the withheld fixes, whether they are valid, and what was rejected."""
    # stamps of one receiver rise, but nothing forces a recording's to
    at = np.maximum.accumulate(protocol.fixes.utime[protocol.withheld])
    found, valid = [], []
    for row in replayed.rows(at.tolist()):
        w, x, y, z = row.rotation
        found.append((row.easting, row.northing, row.up, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
        valid.append(row.valid)
    return np.array(found, float).reshape(-1, 4), np.array(valid, bool), dict(replayed.rejected)


def _scored(
    protocol: Protocol,
    estimated: Array,
    valid: Mask,
    rejected: Mapping[tuple[str, str], int],
    scorer: Scorer,
    directory: Path,
) -> Outcome:
    t = protocol.t[protocol.withheld]
    counted = t >= SKIP_S
    missing = int((~np.isfinite(estimated[counted, :2]).all(1)).sum())
    share = float(valid[counted].mean())
    if np.isfinite(estimated).all(1).sum() < 10:
        return Outcome(int(counted.sum()), missing, share, rejected=rejected)
    est, true, meta = (directory / name for name in ("est.csv", "fixes.csv", "meta.json"))
    # rows without a pose stay: the scorer drops them, and carries on from the last
    np.savetxt(est, np.column_stack([t, estimated]), "%.6f", ",", header="t,e,n,u,yaw", comments="")
    flat = np.column_stack([protocol.t, protocol.fixes.place, np.zeros(len(protocol.t))])
    np.savetxt(true, flat, "%.6f", ",", header="t,e,n,u", comments="")
    meta.write_text(json.dumps(protocol.meta()), encoding="utf-8")
    if protocol.withhold == "half":
        found = scorer(est, true, meta, "half")
        numbers = {key: found[key] for key in ("rmse", "p95", "max")}
        return Outcome(found["n"], missing, share, **numbers, rejected=rejected)
    found = scorer(est, true, meta, "outage")
    starts = [start * protocol.duration for start in protocol.starts]
    gaps = tuple(Gap(start, float(end)) for start, end in zip(starts, found["end"], strict=True))
    return Outcome(int(counted.sum()), missing, share, max=found["max"], gaps=gaps, rejected=rejected)


def mean_gap_end(outcomes: Iterable[Outcome]) -> float:
    """Return the mean of the gap-end errors over all gaps of all runs, metres; nan where there is none."""
    ends = [gap.end_error for each in outcomes for gap in each.gaps]
    return float(np.mean(ends)) if ends else float("nan")
