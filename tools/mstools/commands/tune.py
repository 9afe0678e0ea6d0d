"""`modelserver tune`: noise settings that fit a recording better, from fixes that were withheld."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import ModelServerError, RecordingError
from modelserver.messages import FixType, GpsSample
from mstools.terminal.options import argument, option
from mstools.terminal.output import check_outputs, escape, format_count, show_progress, write_file
from mstools.tuning import (
    EvaluationJob,
    EvaluationResult,
    Parameter,
    Part,
    Score,
    SearchResult,
    SearchStep,
    Settings,
    evaluate,
    gps_channel,
    load,
    read_fixes,
    search,
    stated_sigma,
)

if TYPE_CHECKING:
    from modelserver.server.vehicle import Vehicle


@dataclass(frozen=True, slots=True)
class Tunable:
    """A setting that withheld fixes can tune: the sensor or type of fix it needs, and whether --quick includes it."""

    parameter: Parameter
    needs: str = "gps"
    quick: bool = False


TUNABLES = (
    Tunable(Parameter("gps_white_share", 0.01, 1.0), quick=True),
    Tunable(Parameter("gps_sigma_floor", 0.005, 10.0), quick=True),
    Tunable(Parameter("gps_correlation_time", 5.0, 600.0), quick=True),
    Tunable(Parameter("uere", 0.1, 20.0), FixType.FIX_3D.name, quick=True),
    Tunable(Parameter("uere_differential", 0.05, 5.0), FixType.DIFFERENTIAL.name, quick=True),
    Tunable(Parameter("uere_rtk_float", 0.02, 2.0), FixType.RTK_FLOAT.name, quick=True),
    Tunable(Parameter("uere_rtk_fixed", 0.005, 0.5), FixType.RTK_FIXED.name, quick=True),
    Tunable(Parameter("accelerometer_noise", 1e-3, 1.0), "imu", quick=True),
    Tunable(Parameter("gyro_noise", 1e-5, 0.05), "imu"),
    Tunable(Parameter("wheel_sigma", 1e-3, 0.5), "wheels", quick=True),
    Tunable(Parameter("slip_ratio", 1e-3, 0.2), "wheels", quick=True),
    Tunable(Parameter("slip_turn", 0.01, 1.0), "skid_steer"),
    Tunable(Parameter("roll_point_sigma", 5e-3, 1.0), "rolling"),
    Tunable(Parameter("side_sigma", 2e-3, 0.5), "rolling"),
)
"""In search order."""


PARTS: tuple[Part, ...] = ("half", "outage")

ROUNDS = 2
"""Rounds over all settings, at most: a second one follows what the first one changed."""


def command(
    log: Annotated[Path, argument("LOG", "LCM event log of a drive with fixes.")],
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file.")] = None,
    output: Annotated[str, option("-o --output YAML", "Write the proposal here, - for standard output.")] = "",
    quick: Annotated[bool, option("--quick", "One round over few settings: a first look.")] = False,
    force: Annotated[bool, option("--force", "Replace an existing file.")] = False,
) -> None:
    """Tune the filter's noise settings on a recording; docs/tuning.md explains how.

    Every second fix is withheld, and all fixes in four gaps. A search changes each setting by factors of two while the
    likelihood of the withheld fixes increases, the accuracy does not decrease, and the covariance covers the errors at
    the ends of the gaps. It is deterministic for a log, a vehicle file and a version. Nothing is changed: the proposal
    is part of a vehicle file, to be reviewed and merged.

    \b
    Examples:
      modelserver tune drive.lcm -c config/husky/vehicle.yaml --quick
      modelserver tune drive.lcm -c config/husky/vehicle.yaml -o proposal.yaml
    """
    if config is None:
        raise typer.BadParameter("tune needs the vehicle file: -c FILE")
    check_outputs((log, config), "", output, force)
    vehicle = load(config)
    gps_channel(vehicle)
    fixes = read_fixes(log, config)
    if vehicle.config.localization.mode == "raw":
        raise RecordingError(f"{escape(str(config))}: localization.mode is raw, without a filter to tune")
    chosen = choose_parameters(vehicle, fixes.samples, quick=quick)
    sigmas = sorted(stated_sigma(each, vehicle) for each in fixes.samples)
    for number, each in enumerate(chosen):
        # a floor below the receiver's sigma has no effect: steps upward start there
        if each.name == "gps_sigma_floor":
            chosen[number] = Parameter(each.name, each.low, each.high, sigmas[len(sigmas) // 2])
    settings = vehicle.config.localization.filter
    begin = {each.name: float(getattr(settings, each.name)) for each in chosen}
    rounds = 1 if quick else ROUNDS
    bound = len(PARTS) * (1 + rounds * len(chosen) * 2)
    with show_progress(f"tuning on {log.name}", bound) as show, _open_pool() as runs:
        trials = Trials(runs, log, config, show)
        first = trials([{}])[0]
        before = trials.outcomes({})
        if first is None or not before[0].scored or before[0].missing == before[0].scored:
            raise RecordingError(
                f"{escape(str(log))}: no pose at any withheld fix, so there is no score: see "
                f"modelserver replay {escape(str(log))} -c {escape(str(config))} --report report.html"
            )
        found = search(begin, first, chosen, trials, rounds, _print_step)
    result = TuningResult(begin, first, before[0].scored, len(before[1].gaps), found, trials.count)
    typer.echo("\n".join(format_result(escape(str(log)), result)), err=output == "-")
    write_file(output, format_proposal(str(log), result), replace=force)


def choose_parameters(vehicle: Vehicle, fixes: Sequence[GpsSample], *, quick: bool) -> list[Parameter]:
    """Return the parameters that the sensors of a vehicle and its fixes can tune."""
    # the range error of a plain fix is also that of one with two dimensions or without a type
    types = {max(each.fix_type, FixType.FIX_3D).name for each in fixes}
    return [
        each.parameter
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
        likelihood = sum(each.likelihood for each in good) / len(good)
        return Score(likelihood, good[0].rmse, _mean(good[-1].gaps), _mean(good[-1].nees))


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


@dataclass(frozen=True)
class TuningResult:
    """Initial settings and score, numbers of withheld fixes and gaps, what the search found, and number of runs."""

    begin: Settings
    first: Score
    withheld: int
    gaps: int
    found: SearchResult
    runs: int


def format_result(log: str, result: TuningResult) -> list[str]:
    found = result.found
    text = [
        f"{log}: {format_count(result.withheld, 'fix', 'fixes')} withheld in turn, "
        f"{format_count(result.gaps, 'gap')}; {format_count(result.runs, 'run')}",
        f"{'':34}{'before':>10}{'after':>10}",
    ]
    rows = [
        ("RMSE at withheld fixes, m", result.first.rmse, found.score.rmse),
        ("mean error at gap ends, m", result.first.gaps, found.score.gaps),
        ("NEES at gap ends", result.first.nees, found.score.nees),
        ("log-likelihood of a withheld fix", result.first.likelihood, found.score.likelihood),
    ]
    text += [f"{name:34}{a:10.3f}{b:10.3f}" for name, a, b in rows if math.isfinite(a)]
    text += [f"{name}: {result.begin[name]:g} -> {value:g}" for name, value in found.settings.items()]
    if not found.settings:
        text.append("No step helps enough: the settings fit this recording.")
    if found.insensitive:
        text.append(f"Without effect on this recording: {', '.join(found.insensitive)}.")
    return text


def format_proposal(log: str, result: TuningResult) -> str:
    """Format the proposed settings as part of a vehicle file."""
    first, found = result.first, result.found
    likelihood = f"{first.likelihood:.3f} -> {found.score.likelihood:.3f}"
    head = [
        f"# Proposed by modelserver tune from {escape(log)}: log-likelihood of a withheld fix {likelihood},",
        f"# RMSE {first.rmse:.3f} -> {found.score.rmse:.3f} m."
        " Try it on another recording before you merge it; nothing was changed.",
    ]
    if not found.settings:
        return "\n".join([*head, "localization: {filter: {}}   # no step helps enough"]) + "\n"
    settings = [f"    {name}: {value:.6g}   # was {result.begin[name]:.6g}" for name, value in found.settings.items()]
    return "\n".join([*head, "localization:", "  filter:", *settings]) + "\n"


@contextmanager
def _open_pool() -> Iterator[Callable[[Sequence[EvaluationJob]], list[EvaluationResult | None]]]:
    """Yield a function that runs jobs in parallel processes, and returns their results in order."""
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
    """Submit jobs and return their futures. SIGINT is blocked meanwhile, and delivered afterwards.

    Submitting starts workers. One whose start is interrupted would run unknown to the pool, and one that is still
    importing would print a traceback: Ctrl-C reaches all processes of a terminal. Workers inherit the mask and keep
    it, so only the process that started them ends by Ctrl-C, and ends them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return [pool.submit(_run, job) for job in jobs]
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
