"""How well a vehicle file does on a log whose fixes are partly withheld: error, likelihood and consistency.

Two runs, each through the daemon's own core, as `modelserver replay` does it:

- `half`: every second fix is withheld.
- `outage`: all fixes are withheld in gaps that begin at 20, 40, 60 and 80 % of the time, each of 30 s, or of a tenth of
  the time where the log is shorter than 300 s.

At the stamp of each withheld fix the antenna is predicted from what had arrived before it, as a client would have been
told. The error is the horizontal distance to the fix. The likelihood is how probable the filter held that fix: the
density of its residual under the covariance of the innovation, with a share of fixes that are simply wrong, so that a
single one does not decide.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from modelserver.config import load_config
from modelserver.earth.geodesy import Geodesy, GeodesyError
from modelserver.errors import RecordingError
from modelserver.localization import gate
from modelserver.localization.filter import fixes, kalman, motion
from modelserver.localization.filter.localizer import FilterLocalizer
from modelserver.localization.filter.measurements.base import Scene
from modelserver.localization.filter.measurements.gps import GpsPosition
from modelserver.localization.interface import Localizer
from modelserver.localization.modes import ModeLocalizer
from modelserver.messages import Decision, GpsSample, Phase
from modelserver.service.daemon import Vehicle, load_vehicle
from modelserver.service.offline import OfflineRun, TrackRow
from modelserver.spatial.so3 import Array
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools.report.consistency import Consistency, by_kind

SKIP_S = 30.0
"""Seconds from the first fix on that are not scored, while heading is found; a quarter of a short log."""

GAP_S = 30.0
STARTS = (0.2, 0.4, 0.6, 0.8)

WRONG_SHARE = 0.02
"""Share of fixes that are held to be simply wrong."""

WRONG_SIGMA = 10.0
"""How far those are off besides, metres."""

UNKNOWN = math.log(WRONG_SHARE / (2.0 * math.pi * 100.0**2))
"""Log-likelihood of a withheld fix where nothing was known: anywhere within 100 m."""

Part = Literal["half", "outage"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run came to. `likelihood` is the mean log density of the withheld fixes, 1/m2; `rmse` metres.

    `gaps` are the mean errors over the last 2 s of each gap, metres; empty in `half`. `consistency` is of the fixes
    and other measurements that were given.
    """

    scored: int
    missing: int
    likelihood: float
    rmse: float
    gaps: tuple[float, ...] = ()
    consistency: tuple[Consistency, ...] = ()


@dataclass(frozen=True, slots=True)
class Job:
    """One run: the settings are those of localization.filter that differ from the vehicle file's."""

    log: Path
    config: Path
    part: Part
    settings: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class UsableFixes:
    """The fixes of a log that are good enough, by their order on the channel (`numbers`)."""

    samples: tuple[GpsSample, ...]
    numbers: tuple[int, ...]

    @property
    def begin(self) -> int:
        """Stamp of the first, utime."""
        return self.samples[0].header.utime

    @property
    def seconds(self) -> float:
        """Seconds from the first to the last."""
        return (self.samples[-1].header.utime - self.begin) * 1e-6

    @property
    def gap(self) -> float:
        """Length of a gap, seconds."""
        return min(GAP_S, 0.1 * self.seconds)

    def gap_of(self, sample: GpsSample) -> int | None:
        """Return in which gap a fix lies."""
        t = (sample.header.utime - self.begin) * 1e-6
        return next((n for n, s in enumerate(STARTS) if s * self.seconds < t <= s * self.seconds + self.gap), None)

    def withheld(self, part: Part) -> list[int]:
        """Return which are withheld, by index."""
        if part == "half":
            return list(range(1, len(self.samples), 2))
        return [n for n, sample in enumerate(self.samples) if self.gap_of(sample) is not None]


@lru_cache(maxsize=4)
def load(config: Path) -> Vehicle:
    """Return the vehicle of a vehicle file."""
    return load_vehicle(load_config(config), str(config))


def gps_channel(vehicle: Vehicle) -> str:
    """Return the channel on which the vehicle hears fixes. Raises RecordingError where it hears none."""
    gps = vehicle.config.sensors.gps
    if gps is None:
        raise RecordingError(
            f"{vehicle.config.vehicle}: its vehicle file names no GPS under sensors, and tune scores by withheld fixes"
        )
    return f"{vehicle.config.lcm.channel_prefix}{gps.channel}"


def stated_sigma(sample: GpsSample, vehicle: Vehicle) -> float:
    """Return the sigma that a good fix comes with, metres."""
    fix = gate.judge(sample, vehicle.config.localization.filter)
    return math.nan if isinstance(fix, str) else fix.sigma


@lru_cache(maxsize=4)
def read_fixes(log: Path, config: Path) -> UsableFixes:
    """Return the good fixes of a log. Raises RecordingError where there are too few, OSError."""
    vehicle = load(config)
    channel = gps_channel(vehicle)
    heard = vehicle.sensor_channels()[channel]
    settings = vehicle.config.localization.filter
    samples, numbers, met = [], [], 0
    with LogFile(log) as recording:
        for event in recording:
            if event.channel != channel:
                continue
            met += 1
            try:
                sample = heard.read(event.data)
            except ValueError:
                continue
            if isinstance(sample, GpsSample) and not isinstance(gate.judge(sample, settings), str):
                samples.append(sample)
                numbers.append(met - 1)
    if len(samples) < 20:
        raise RecordingError(
            f"{log}: {len(samples)} of {met} messages on {channel} are good fixes, and at least 20 are needed to "
            "withhold some of them; record a drive of a few minutes"
        )
    order = sorted(range(len(samples)), key=lambda n: samples[n].header.utime)
    return UsableFixes(tuple(samples[n] for n in order), tuple(numbers[n] for n in order))


def run(job: Job) -> Outcome:
    """Run the localization over a log with fixes withheld, and score it.

    Raises ValueError for settings out of range, RecordingError where there are too few fixes, OSError.
    """
    vehicle = changed(load(job.config), dict(job.settings))
    known = read_fixes(job.log, job.config)
    withheld = known.withheld(job.part)
    skip = known.begin + round(1e6 * min(SKIP_S, 0.25 * known.seconds))
    decisions: list[Decision] = []
    gps = vehicle.config.sensors.gps
    assert gps is not None
    with LogFile(job.log) as recording:
        events = _given(recording, gps_channel(vehicle), {known.numbers[n] for n in withheld})
        replay = OfflineRun(vehicle, events, gps.frame, on_decision=decisions.append)
        scored = [known.samples[n] for n in withheld]
        errors, densities, marks = [], [], []
        for sample, row in zip(scored, replay.rows([s.header.utime for s in scored]), strict=True):
            if job.part == "half" and sample.header.utime < skip:
                continue
            errors.append(_error(row, sample, replay.localizer))
            densities.append(_density(replay.localizer, sample))
            marks.append(sample)
    good = [error for error in errors if math.isfinite(error)]
    return Outcome(
        len(errors),
        len(errors) - len(good),
        sum(densities) / len(densities) if densities else math.nan,
        math.sqrt(sum(error * error for error in good) / len(good)) if good else math.inf,
        _gap_ends(known, marks, errors) if job.part == "outage" else (),
        tuple(by_kind(decisions)),
    )


def changed(vehicle: Vehicle, settings: Mapping[str, float]) -> Vehicle:
    """Return the vehicle with settings of its filter changed. Raises ValueError for one out of range."""
    if not settings:
        return vehicle
    localization = vehicle.config.localization
    settled = replace(localization.filter, **dict[str, Any](settings))
    return replace(vehicle, config=replace(vehicle.config, localization=replace(localization, filter=settled)))


def _given(events: Iterable[LogEvent], channel: str, withheld: set[int]) -> Iterator[LogEvent]:
    """Yield the events without the withheld fixes, which are known by their order on the channel."""
    number = -1
    for event in events:
        if event.channel == channel:
            number += 1
            if number in withheld:
                continue
        yield event


def _error(row: TrackRow, sample: GpsSample, localizer: Localizer | None) -> float:
    if localizer is None or not math.isfinite(row.easting):
        return math.nan
    origin = localizer.estimate(sample.header.utime).origin
    if origin is None:
        return math.nan
    height = sample.height_ellipsoidal if math.isfinite(sample.height_ellipsoidal) else 0.0
    try:
        east, north, _ = Geodesy(origin).utm_from_geodetic(sample.latitude_deg, sample.longitude_deg, height)
    except GeodesyError:
        return math.nan
    return math.hypot(row.easting - east, row.northing - north)


def _density(localizer: Localizer | None, sample: GpsSample) -> float:
    """Return the log density of a withheld fix, as the filter expected it."""
    if not isinstance(localizer, ModeLocalizer) or not isinstance(localizer.active, FilterLocalizer):
        return UNKNOWN
    setup, utime = localizer.active.setup, sample.header.utime
    state = localizer.active.deferred(utime).state
    measurement = next((each for each in setup.measurements.get(GpsSample, ()) if isinstance(each, GpsPosition)), None)
    if state.phase is not Phase.ALIGNED or measurement is None:
        return UNKNOWN
    state = motion.caught_up(setup, motion.at(setup, state, utime))
    nav = state.nav
    assert nav is not None
    seconds = (utime - state.fixed.utime) * 1e-6 if state.fixed is not None else 0.0
    nav = fixes.widened(setup, nav, state.restless, seconds)
    scene = Scene(nav, setup.layout, setup.settings, setup.rig, state.site, state.geodesy, state.standing)
    compared = measurement.compare(scene, sample)
    if isinstance(compared, str):
        return UNKNOWN
    S = kalman.innovation(nav.covariance, compared.jacobian, compared.noise)
    return mixed(compared.residual, S)


def mixed(residual: Array, S: Array) -> float:
    """Return the log density of a residual (m) under its covariance S (m, m), with a share that is simply wrong."""
    right = math.log(1.0 - WRONG_SHARE) + _normal(residual, S)
    wrong = math.log(WRONG_SHARE) + _normal(residual, S + np.eye(len(S)) * WRONG_SIGMA**2)
    return float(np.logaddexp(right, wrong))


def _normal(residual: Array, S: Array) -> float:
    sign, size = np.linalg.slogdet(S)
    if sign <= 0.0:
        return -math.inf
    return -0.5 * (kalman.statistic(residual, S) + float(size) + len(residual) * math.log(2.0 * math.pi))


def _gap_ends(known: UsableFixes, marks: list[GpsSample], errors: list[float]) -> tuple[float, ...]:
    """Return the mean error over the last 2 s of each gap; a gap without an estimate at its end is left out."""
    ends = []
    for number, start in enumerate(STARTS):
        end = known.begin + round(1e6 * (start * known.seconds + known.gap))
        last = [
            error
            for sample, error in zip(marks, errors, strict=True)
            if known.gap_of(sample) == number and sample.header.utime > end - 2_000_000 and math.isfinite(error)
        ]
        if last:
            ends.append(sum(last) / len(last))
    return tuple(ends)


__all__ = ["Job", "Outcome", "UsableFixes", "changed", "load", "mixed", "read_fixes", "run", "stated_sigma"]
