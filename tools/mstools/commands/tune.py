"""`modelserver tune`: noise settings that fit a recording better, from fixes that were withheld.

Search: each setting is multiplied or divided by 2 while that helps. Objective: mean log-likelihood of withheld fixes,
with the constraints that neither their RMSE nor the error at the ends of gaps gets noticeably worse, and that the
filter is not overconfident there (NEES). A step must gain MIN_GAIN, or it would fit the noise of this log. Settings
that change nothing are left out after the first round. Deterministic; converges to a local optimum within MAX_FACTOR.

Evaluation: two runs, each through the daemon's own core, as `modelserver replay` does it:

- `half`: every second fix is withheld.
- `outage`: all fixes are withheld in gaps that begin at 20, 40, 60 and 80 % of the time, each of 30 s, or of a tenth of
  the time where the log is shorter than 300 s.

At the stamp of each withheld fix the antenna's position is predicted from the samples that arrived before. Error: the
horizontal distance to the fix. Likelihood: log density of the fix's residual y under the innovation covariance
S = H P H' + R. In `half` it is that of a mixture (1 - e) N(y; 0, S) + e N(y; 0, S + sigma_o^2 I) with a share e of
outliers, so that a single outlier does not dominate the mean. In `outage` it is log N(y; 0, S) at the ends of the gaps,
the median over the last fixes of each: without an allowance for outliers, which would forgive a covariance that is far
too small there. NEES: y' S^-1 y over its degrees of freedom, at the ends of the gaps too; its mean is 1 if the
covariance is right, and above if it is overconfident. Limits: fixes with time-correlated errors are not independent, so
that the likelihoods compare settings on one log and are no absolute measure.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from statistics import fmean, median, median_high
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
import typer

from modelserver.config.vehicle_file import load_config
from modelserver.earth.geodesy import Geodesy, GeodesyError
from modelserver.errors import ModelServerError, RecordingError
from modelserver.estimation import inputs as gate
from modelserver.estimation.filter import eskf, fusion, gnss_monitor
from modelserver.estimation.filter.fusion import create_context
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.measurements.gnss import GpsPosition
from modelserver.estimation.filter.state import Aligned
from modelserver.estimation.history import Localizer
from modelserver.estimation.modes import ModeLocalizer
from modelserver.messages import FixType, GpsSample
from modelserver.server.recordings import OfflineRun, TrackRow
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.transforms.so3 import Array
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools.archive.cluster import Cluster, block_interrupt, open_cluster
from mstools.terminal.options import SchedulerOption, argument, option
from mstools.terminal.output import check_outputs, escape, format_count, show_progress, write_file

Settings: TypeAlias = Mapping[str, float]

FACTOR = 2.0

MIN_GAIN = 0.02
"""Gain in mean log-likelihood below which a step is not accepted."""

MIN_EFFECT = 1e-4
"""Change of the likelihood below which a setting has no effect on this log."""

RMSE_SLACK = 1.02
GAPS_SLACK = 1.05
"""Factors by which a step may worsen the error at withheld fixes, and at the ends of gaps."""

NEES_LIMIT = 2.0
"""Mean NEES at gap ends beyond which a step may not lead: four gaps with two axes each exceed it with a probability of
5 % if the covariance is right (chi-square with 8 degrees of freedom)."""

MAX_FACTOR = 8.0
"""Largest ratio of a proposal to the initial setting, and its reciprocal."""


@dataclass(frozen=True, slots=True)
class Score:
    """Score of settings: log-likelihood and RMSE at withheld fixes, mean error and NEES at gap ends (nan: none)."""

    likelihood: float
    rmse: float
    gaps: float = math.nan
    nees: float = math.nan


@dataclass(frozen=True, slots=True)
class Parameter:
    """A setting to search, with its bounds.

    needs: the sensor or type of fix that it needs. quick: whether --quick includes it. from_value: smallest start of
    upward steps.
    """

    name: str
    low: float = 0.0
    high: float = math.inf
    needs: str = "gps"
    quick: bool = False
    from_value: float = 0.0


TUNABLES = (
    Parameter("gps_white_share", 0.01, 1.0, quick=True),
    Parameter("gps_sigma_floor", 0.005, 10.0, quick=True),
    Parameter("gps_correlation_time", 5.0, 600.0, quick=True),
    Parameter("uere", 0.1, 20.0, FixType.FIX_3D.name, quick=True),
    Parameter("uere_differential", 0.05, 5.0, FixType.DIFFERENTIAL.name, quick=True),
    Parameter("uere_rtk_float", 0.02, 2.0, FixType.RTK_FLOAT.name, quick=True),
    Parameter("uere_rtk_fixed", 0.005, 0.5, FixType.RTK_FIXED.name, quick=True),
    Parameter("accelerometer_noise", 1e-3, 1.0, "imu", quick=True),
    Parameter("gyro_noise", 1e-5, 0.05, "imu"),
    Parameter("wheel_sigma", 1e-3, 0.5, "wheels", quick=True),
    Parameter("slip_ratio", 1e-3, 0.2, "wheels", quick=True),
    Parameter("slip_turn", 0.01, 1.0, "skid_steer"),
    Parameter("roll_point_sigma", 5e-3, 1.0, "rolling"),
    Parameter("side_sigma", 2e-3, 0.5, "rolling"),
)
"""In search order."""


PARTS = ("half", "outage")

ROUNDS = 2
"""Rounds over all settings, at most: a second one follows what the first one changed."""


def command(
    log: Annotated[Path, argument("LOG", "LCM event log of a drive with fixes.")],
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file.")] = None,
    output: Annotated[str, option("-o --output YAML", "Write the proposal here, - for standard output.")] = "",
    quick: Annotated[bool, option("--quick", "One round over few settings: a first look.")] = False,
    force: Annotated[bool, option("--force", "Replace an existing file.")] = False,
    scheduler: SchedulerOption = "",
) -> None:
    """Tune the filter's noise settings on a recording; docs/tuning.md explains how.

    Every second fix is withheld, and all fixes in four gaps. A search changes each setting by factors of two while the
    likelihood of the withheld fixes increases, the accuracy does not decrease, and the covariance covers the errors at
    the ends of the gaps. It is deterministic for a log, a vehicle file and a version. Nothing is changed: the proposal
    is part of a vehicle file, to be reviewed and merged. With --scheduler the runs are tasks of a cluster; its workers
    must reach LOG and FILE under the same paths.

    \b
    Examples:
      modelserver tune drive.lcm -c config/husky/vehicle.yaml --quick
      modelserver tune drive.lcm -c config/husky/vehicle.yaml -o proposal.yaml
    """
    if config is None:
        raise typer.BadParameter("tune needs the vehicle file: -c FILE")
    check_outputs((log, config), "", output, force)
    log, config = (each.absolute() if scheduler else each for each in (log, config))
    vehicle = load(config)
    gps_channel(vehicle)
    fixes = read_fixes(log, config)
    if vehicle.config.localization.mode == "raw":
        raise RecordingError(f"{escape(str(config))}: localization.mode is raw, without a filter to tune")
    # a floor below the receiver's sigma has no effect: steps upward start there
    chosen = [
        replace(each, from_value=median_high(fixes.sigmas)) if each.name == "gps_sigma_floor" else each
        for each in choose_parameters(vehicle, fixes.samples, quick=quick)
    ]
    settings = vehicle.config.localization.filter
    begin = {each.name: float(getattr(settings, each.name)) for each in chosen}
    rounds = 1 if quick else ROUNDS
    bound = len(PARTS) * (1 + rounds * len(chosen) * 2)
    with show_progress(f"tuning on {log.name}", bound) as show, open_pool(scheduler) as runs:
        trials = Trials(runs, log, config, show)
        first = trials([{}])[0]
        before = trials.outcomes({})
        if first is None or not before[0].scored or before[0].missing == before[0].scored:
            raise RecordingError(
                f"{escape(str(log))}: no pose at any withheld fix, so there is no score: see "
                f"modelserver replay {escape(str(log))} -c {escape(str(config))} --report report.html"
            )
        found = search(begin, first, chosen, trials, rounds, _print_step)
    withheld, gaps = format_count(before[0].scored, "fix", "fixes"), format_count(len(before[1].gaps), "gap")
    head = f"{escape(str(log))}: {withheld} withheld in turn, {gaps}; {format_count(trials.count, 'run')}"
    typer.echo("\n".join((head, *format_result(found))), err=output == "-")
    write_file(output, format_proposal(str(log), found), replace=force)


def choose_parameters(vehicle: Vehicle, fixes: Sequence[GpsSample], *, quick: bool) -> list[Parameter]:
    """Return the parameters that the sensors of a vehicle and its fixes can tune."""
    # the range error of a plain fix is also that of one with two dimensions or without a type
    types = {max(each.fix_type, FixType.FIX_3D).name for each in fixes}
    return [
        each
        for each in TUNABLES
        if (each.needs in types or _has_sensor(vehicle, each.needs)) and (each.quick or not quick)
    ]


@dataclass
class Trials:
    """The search's evaluation: score settings by runs of all parts, with a cache."""

    runs: Callable[[Sequence[EvaluationJob]], list[EvaluationResult | None]]
    log: Path
    config: Path
    show: Callable[[float], None]
    count: int = 0
    results: dict[tuple[tuple[str, float], ...], list[EvaluationResult | None]] = field(default_factory=dict)

    def __call__(self, trials: Sequence[Settings]) -> list[Score | None]:
        """Return the scores of settings; None for those out of range."""
        keys = [tuple(sorted(each.items())) for each in trials]
        new = [key for key in dict.fromkeys(keys) if key not in self.results]
        outcomes = self.runs([EvaluationJob(self.log, self.config, part, key) for key in new for part in PARTS])
        self.count += len(outcomes)
        self.show(self.count)
        for n, key in enumerate(new):
            self.results[key] = outcomes[n * len(PARTS) : (n + 1) * len(PARTS)]
        return [self._score(self.results[key]) for key in keys]

    def outcomes(self, settings: Settings) -> list[EvaluationResult]:
        return [each for each in self.results[tuple(sorted(settings.items()))] if each is not None]

    def _score(self, outcomes: Sequence[EvaluationResult | None]) -> Score | None:
        good = [each for each in outcomes if each is not None]
        if len(good) < len(PARTS):
            return None
        return Score(fmean(each.likelihood for each in good), good[0].rmse, _mean(good[-1].gaps), _mean(good[-1].nees))


def _mean(values: Sequence[float]) -> float:
    return fmean(values) if values else math.nan


def format_result(found: SearchResult) -> list[str]:
    text = [f"{'':34}{'before':>10}{'after':>10}"]
    rows = [
        ("RMSE at withheld fixes, m", found.first.rmse, found.score.rmse),
        ("mean error at gap ends, m", found.first.gaps, found.score.gaps),
        ("NEES at gap ends", found.first.nees, found.score.nees),
        ("log-likelihood of a withheld fix", found.first.likelihood, found.score.likelihood),
    ]
    text += [f"{name:34}{a:10.3f}{b:10.3f}" for name, a, b in rows if math.isfinite(a)]
    text += [f"{name}: {found.begin[name]:g} -> {value:g}" for name, value in found.settings.items()]
    if not found.settings:
        text.append("No step helps enough: the settings fit this recording.")
    if found.insensitive:
        text.append(f"Without effect on this recording: {', '.join(found.insensitive)}.")
    return text


def format_proposal(log: str, found: SearchResult) -> str:
    """Format the proposed settings as part of a vehicle file."""
    likelihood = f"{found.first.likelihood:.3f} -> {found.score.likelihood:.3f}"
    head = [
        f"# Proposed by modelserver tune from {escape(log)}: log-likelihood of a withheld fix {likelihood},",
        f"# RMSE {found.first.rmse:.3f} -> {found.score.rmse:.3f} m."
        " Try it on another recording before you merge it; nothing was changed.",
    ]
    if not found.settings:
        return "\n".join([*head, "localization: {filter: {}}   # no step helps enough"]) + "\n"
    settings = [f"    {name}: {value:.6g}   # was {found.begin[name]:.6g}" for name, value in found.settings.items()]
    return "\n".join([*head, "localization:", "  filter:", *settings]) + "\n"


@contextmanager
def open_pool(scheduler: str) -> Iterator[Callable[[Sequence[EvaluationJob]], list[EvaluationResult | None]]]:
    """Yield a function that runs jobs in parallel processes, or on a cluster, and returns their results in order."""
    if scheduler:
        with open_cluster(scheduler) as cluster:
            yield lambda jobs: _run_on(cluster, jobs)
        return
    # at most both steps of a setting run at once
    count = min(os.cpu_count() or 1, 2 * len(PARTS))
    pool = ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield lambda jobs: [future.result() for future in _submit(pool, jobs)]
    except BaseException:
        # running jobs take seconds and are useless now. Without workers the pool's thread ends at once; it must have
        # ended before Python wakes the threads of all pools at exit
        for each in list((getattr(pool, "_processes", None) or {}).values()):
            each.terminate()
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def _submit(pool: ProcessPoolExecutor, jobs: Sequence[EvaluationJob]) -> list[Future[EvaluationResult | None]]:
    """Submit jobs and return their futures, without an interrupt.

    Submitting starts workers. One whose start is interrupted would run unknown to the pool, and one that is still
    importing would print a traceback.
    """
    with block_interrupt():
        return [pool.submit(_run, job) for job in jobs]


def _run_on(cluster: Cluster, jobs: Sequence[EvaluationJob]) -> list[EvaluationResult | None]:
    """Return the results of jobs on a cluster in order. Raises ModelServerError for one whose workers ended."""
    found: dict[EvaluationJob, EvaluationResult | None] = {}
    for job, result in cluster.run(_run, jobs):
        if isinstance(result, ModelServerError):
            raise result
        found[job] = result
    return [found[job] for job in jobs]


def _run(job: EvaluationJob) -> EvaluationResult | None:
    """Return the result of a job; None for settings that the filter rejects."""
    try:
        return evaluate(job)
    except ModelServerError:
        raise
    except ValueError:
        return None


def _has_sensor(vehicle: Vehicle, needs: str) -> bool:
    sensors = vehicle.config.sensors
    wheels = sensors.wheels
    if needs == "rolling":
        return sensors.imu is not None or wheels is not None
    if needs == "skid_steer":
        return wheels is not None and wheels.kinematics == "skid_steer"
    if needs == "wheels":
        return wheels is not None or sensors.speedometer is not None
    return getattr(sensors, needs, None) is not None


def _print_step(step: SearchStep) -> None:
    typer.echo(
        f"  {step.name}: {step.before:g} -> {step.after:g}, log-likelihood {step.score.likelihood:.3f}, "
        f"RMSE {step.score.rmse:.3f} m",
        err=True,
    )


# --- search


@dataclass(frozen=True, slots=True)
class SearchStep:
    """An accepted step."""

    name: str
    before: float
    after: float
    score: Score


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of the search: initial and changed settings with their scores, accepted steps, settings without effect."""

    begin: Settings
    first: Score
    settings: Settings
    score: Score
    steps: tuple[SearchStep, ...]
    insensitive: tuple[str, ...]


def search(
    begin: Settings,
    first: Score,
    parameters: Sequence[Parameter],
    evaluate: Callable[[Sequence[Settings]], Sequence[Score | None]],
    rounds: int = 2,
    on_step: Callable[[SearchStep], object] | None = None,
) -> SearchResult:
    """Step each parameter up and down by `FACTOR` while that helps, round after round until nothing changes.

    `begin` has the initial values of all parameters, `first` their score. `evaluate` scores settings, each given as
    changes of the initial ones, with None for settings out of range. `on_step` is called with each accepted step.
    """
    values = dict(begin)
    best = first
    steps: list[SearchStep] = []
    insensitive: list[str] = []

    def change(trial: Settings) -> dict[str, float]:
        return {name: value for name, value in trial.items() if value != begin[name]}

    for number in range(rounds):
        accepted_before = len(steps)
        for parameter in parameters:
            name = parameter.name
            if name in insensitive:
                continue
            both = [_step(parameter, values[name], begin[name], up) for up in (True, False)]
            trials = [each for each in both if each]
            scores = evaluate([change({**values, name: trial}) for trial in trials])
            if number == 0 and all(s is None or abs(s.likelihood - best.likelihood) < MIN_EFFECT for s in scores):
                insensitive.append(name)
                continue
            while (accepted := _best(best, trials, scores)) is not None:
                trial, best = accepted
                steps.append(SearchStep(name, values[name], trial, best))
                if on_step is not None:
                    on_step(steps[-1])
                farther = _step(parameter, trial, begin[name], trial > values[name])
                values[name] = trial
                trials = [farther] if farther else []
                scores = evaluate([change({**values, name: each}) for each in trials]) if trials else []
        if len(steps) == accepted_before:
            break
    return SearchResult(begin, first, change(values), best, tuple(steps), tuple(insensitive))


def _step(parameter: Parameter, value: float, begin: float, up: bool) -> float | None:
    trial = max(value, parameter.from_value) * FACTOR if up else value / FACTOR
    start = max(begin, parameter.from_value) if up else begin
    high, low = min(parameter.high, start * MAX_FACTOR), max(parameter.low, start / MAX_FACTOR)
    trial = min(max(trial, low), high)
    return None if trial == value or (trial > value) != up else trial


def _best(best: Score, trials: Sequence[float], scores: Sequence[Score | None]) -> tuple[float, Score] | None:
    """Return the trial with the largest sufficient gain without loss of accuracy or consistency; None without one."""
    good = [
        (trial, score)
        for trial, score in zip(trials, scores, strict=True)
        if score is not None
        and score.likelihood > best.likelihood + MIN_GAIN
        and score.rmse <= best.rmse * RMSE_SLACK
        and (math.isnan(best.gaps) or score.gaps <= best.gaps * GAPS_SLACK)
        and (math.isnan(best.nees) or score.nees <= max(NEES_LIMIT, best.nees))
    ]
    return max(good, key=lambda each: each[1].likelihood, default=None)


# --- evaluation


SKIP_S = 30.0
"""Seconds from the first fix that are not scored, for heading alignment; at most a quarter of the log."""

GAP_S = 30.0
GAP_STARTS = (0.2, 0.4, 0.6, 0.8)

END_S = 2.0
"""Seconds at the end of a gap that its error and consistency are taken over."""

OUTLIER_SHARE = 0.02
"""Share of fixes that are assumed to be outliers."""

OUTLIER_SIGMA = 10.0
"""Additional error of outliers, meters."""

UNKNOWN_LOG_DENSITY = math.log(OUTLIER_SHARE / (2.0 * math.pi * 100.0**2))
"""Log-likelihood of a withheld fix without an estimate: uniform within about 100 m."""


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """Result of a run. `likelihood` is the mean log density of the withheld fixes, 1/m2; `rmse` in meters.

    `gaps` are the mean errors over the last END_S of each gap, meters, and `nees` the medians of the NEES there; both
    are empty in `half`.
    """

    scored: int
    missing: int
    likelihood: float
    rmse: float
    gaps: tuple[float, ...] = ()
    nees: tuple[float, ...] = ()


class ScoredFix(NamedTuple):
    """A withheld fix beside its prediction: error (m; nan: no pose), log density with and without outliers, NEES."""

    sample: GpsSample
    error: float
    mixture: float = UNKNOWN_LOG_DENSITY
    normal: float = UNKNOWN_LOG_DENSITY
    nees: float = math.nan


@dataclass(frozen=True, slots=True)
class EvaluationJob:
    """One run: `settings` are those of localization.filter that differ from the vehicle file."""

    log: Path
    config: Path
    part: str
    settings: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class UsableFixes:
    """The good fixes of a log, with their index on the channel (`numbers`) and stated sigmas, meters."""

    samples: tuple[GpsSample, ...]
    numbers: tuple[int, ...]
    sigmas: tuple[float, ...]

    @property
    def begin(self) -> int:
        return self.samples[0].header.utime

    @property
    def seconds(self) -> float:
        return (self.samples[-1].header.utime - self.begin) * 1e-6

    @property
    def gap(self) -> float:
        """Length of a gap, seconds."""
        return min(GAP_S, 0.1 * self.seconds)

    def gap_of(self, sample: GpsSample) -> int | None:
        t = (sample.header.utime - self.begin) * 1e-6
        return next((n for n, s in enumerate(GAP_STARTS) if s * self.seconds < t <= s * self.seconds + self.gap), None)

    def withheld(self, part: str) -> list[int]:
        if part == "half":
            return list(range(1, len(self.samples), 2))
        return [n for n, sample in enumerate(self.samples) if self.gap_of(sample) is not None]


@lru_cache(maxsize=4)
def load(config: Path) -> Vehicle:
    return load_vehicle(load_config(config), str(config))


def gps_channel(vehicle: Vehicle) -> str:
    """Return the channel of the GPS receiver. Raises RecordingError where none is configured."""
    gps = vehicle.config.sensors.gps
    if gps is None:
        raise RecordingError(
            f"{vehicle.config.vehicle}: no GPS is configured (sensors.gps); tune scores settings by withheld fixes"
        )
    return f"{vehicle.config.lcm.channel_prefix}{gps.channel}"


@lru_cache(maxsize=4)
def read_fixes(log: Path, config: Path) -> UsableFixes:
    """Return the good fixes of a log. Raises RecordingError where there are too few, OSError."""
    vehicle = load(config)
    channel = gps_channel(vehicle)
    codec = vehicle.sensor_channels()[channel]
    settings = vehicle.config.localization.filter
    found: list[tuple[GpsSample, int, float]] = []
    number = -1
    with LogFile(log) as recording:
        for number, event in enumerate(event for event in recording if event.channel == channel):
            with suppress(ValueError):
                sample = codec.decode(event.data)
                if not isinstance(sample, GpsSample):
                    continue
                if not isinstance(fix := gate.evaluate_fix(sample, settings, True), str):
                    found.append((sample, number, fix.sigma))
    if len(found) < 20:
        raise RecordingError(
            f"{log}: {len(found)} of {number + 1} messages on {channel} are good fixes; at least 20 are needed to "
            "withhold some of them; record a drive of a few minutes"
        )
    return UsableFixes(*zip(*sorted(found, key=lambda each: each[0].header.utime), strict=True))


def evaluate(job: EvaluationJob) -> EvaluationResult:
    """Run the localization over a log with withheld fixes, and score it.

    Raises ValueError for settings out of range, RecordingError where there are too few fixes, OSError.
    """
    vehicle = apply_settings(load(job.config), dict(job.settings))
    known = read_fixes(job.log, job.config)
    withheld = known.withheld(job.part)
    skip = known.begin + round(1e6 * min(SKIP_S, 0.25 * known.seconds))
    gps = vehicle.config.sensors.gps
    assert gps is not None
    with LogFile(job.log) as recording:
        events = _drop_withheld(recording, gps_channel(vehicle), {known.numbers[n] for n in withheld})
        replay = OfflineRun(vehicle, events, gps.frame)
        scored = [known.samples[n] for n in withheld]
        rows: list[ScoredFix] = []
        for sample, row in zip(scored, replay.rows([s.header.utime for s in scored]), strict=True):
            if job.part == "outage" or sample.header.utime >= skip:
                rows.append(_score(sample, _error(row, sample, replay.localizer), replay.localizer))
    good = [each.error for each in rows if math.isfinite(each.error)]
    ends = _gap_ends(known, rows) if job.part == "outage" else []
    likelihoods = [median(each.normal for each in end) for end in ends] or [each.mixture for each in rows]
    return EvaluationResult(
        len(rows),
        len(rows) - len(good),
        _mean(likelihoods),
        math.sqrt(fmean(error * error for error in good)) if good else math.inf,
        tuple(fmean(errors) for end in ends if (errors := _finite(each.error for each in end))),
        tuple(median(found) for end in ends if (found := _finite(each.nees for each in end))),
    )


def apply_settings(vehicle: Vehicle, settings: Mapping[str, float]) -> Vehicle:
    """Return the vehicle with changed filter settings. Raises ValueError for one out of range."""
    localization = vehicle.config.localization
    settled = replace(localization.filter, **dict[str, Any](settings))
    return replace(vehicle, config=replace(vehicle.config, localization=replace(localization, filter=settled)))


def _drop_withheld(events: Iterable[LogEvent], channel: str, withheld: set[int]) -> Iterator[LogEvent]:
    """Return the events without the withheld fixes, which are identified by their index on the channel."""
    number = count()
    return (event for event in events if event.channel != channel or next(number) not in withheld)


def _error(row: TrackRow, sample: GpsSample, localizer: Localizer | None) -> float:
    origin = localizer.estimate(sample.header.utime).origin if localizer is not None else None
    if origin is None or not math.isfinite(row.easting):
        return math.nan
    height = sample.height_ellipsoidal if math.isfinite(sample.height_ellipsoidal) else 0.0
    try:
        east, north, _ = Geodesy(origin).utm_from_geodetic(sample.latitude_deg, sample.longitude_deg, height)
    except GeodesyError:
        return math.nan
    return math.hypot(row.easting - east, row.northing - north)


def _score(sample: GpsSample, error: float, localizer: Localizer | None) -> ScoredFix:
    """Return a withheld fix with its log densities and NEES under the filter's prediction."""
    unknown = ScoredFix(sample, error)
    if not isinstance(localizer, ModeLocalizer) or not isinstance(localizer.active, FilterLocalizer):
        return unknown
    setup, utime = localizer.active.setup, sample.header.utime
    state = localizer.active.defer_estimate(utime).state
    measurement = next((each for each in setup.measurements.get(GpsSample, ()) if isinstance(each, GpsPosition)), None)
    if not isinstance(state, Aligned) or measurement is None:
        return unknown
    state = fusion.advance(setup, state, utime)
    gnss = state.gnss
    seconds = (utime - gnss.last_fix.utime) * 1e-6 if gnss.last_fix is not None else 0.0
    nav = gnss_monitor.inflate_correlated_error(state.nav, gnss.noise_inflation, seconds, setup.layout, setup.settings)
    innovation = measurement.evaluate(create_context(setup, state._replace(nav=nav)), sample)
    if isinstance(innovation, str):
        return unknown
    S = eskf.innovation_covariance(nav.covariance, innovation.jacobian, innovation.noise)
    residual = innovation.residual
    return ScoredFix(
        sample,
        error,
        mixture_log_density(residual, S),
        normal_log_density(residual, S),
        eskf.normalized_innovation_squared(residual, S) / len(residual),
    )


def mixture_log_density(residual: Array, S: Array) -> float:
    """Return the log density of a residual (m) under its covariance S (m, m), with a share of outliers."""
    right = math.log(1.0 - OUTLIER_SHARE) + normal_log_density(residual, S)
    wrong = math.log(OUTLIER_SHARE) + normal_log_density(residual, S + np.eye(len(S)) * OUTLIER_SIGMA**2)
    return float(np.logaddexp(right, wrong))


def normal_log_density(residual: Array, S: Array) -> float:
    """Return the log density of a residual (m) under its covariance S (m, m)."""
    sign, size = np.linalg.slogdet(S)
    if sign <= 0.0:
        return -math.inf
    return -0.5 * (
        eskf.normalized_innovation_squared(residual, S) + float(size) + len(residual) * math.log(2.0 * math.pi)
    )


def _gap_ends(known: UsableFixes, rows: Iterable[ScoredFix]) -> list[list[ScoredFix]]:
    """Return the fixes of the last END_S of each gap that has some."""
    ends: dict[int, list[ScoredFix]] = {}
    for each in rows:
        gap = known.gap_of(each.sample)
        if gap is not None:
            end = known.begin + round(1e6 * (GAP_STARTS[gap] * known.seconds + known.gap))
            if each.sample.header.utime > end - END_S * 1e6:
                ends.setdefault(gap, []).append(each)
    return [ends[gap] for gap in sorted(ends)]


def _finite(values: Iterable[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]
