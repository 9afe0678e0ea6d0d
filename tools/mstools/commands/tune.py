"""`modelserver tune`: noise settings that fit a recording better, from fixes that were withheld."""

from __future__ import annotations

import json
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
from mstools.terminal.output import check_target, counted, safe, write_file
from mstools.terminal.progress import progress
from mstools.tuning.search import Parameter, Score, SearchResult, SearchStep, Settings, search

if TYPE_CHECKING:
    from modelserver.service.daemon import Vehicle
    from mstools.report.consistency import Consistency
    from mstools.tuning.runs import Job, Outcome, Part


@dataclass(frozen=True, slots=True)
class Tunable:
    """A setting that fixes can tell something of: what it takes, and whether --quick looks at it."""

    parameter: Parameter
    needs: str = "gps"
    quick: bool = False


TUNABLES = (
    Tunable(Parameter("gps_white_share", 0.01, 1.0), quick=True),
    Tunable(Parameter("gps_sigma_floor", 0.005, 10.0), quick=True),
    Tunable(Parameter("gps_wander_time", 5.0, 600.0), quick=True),
    Tunable(Parameter("accelerometer_noise", 1e-3, 1.0), "imu", quick=True),
    Tunable(Parameter("gyro_noise", 1e-5, 0.05), "imu"),
    Tunable(Parameter("wheel_sigma", 1e-3, 0.5), "wheels", quick=True),
    Tunable(Parameter("slip_share", 1e-3, 0.2), "wheels", quick=True),
    Tunable(Parameter("slip_turn", 0.01, 1.0), "skid_steer"),
    Tunable(Parameter("roll_point_sigma", 5e-3, 1.0), "rolling"),
    Tunable(Parameter("side_sigma", 2e-3, 0.5), "rolling"),
)
"""In the order in which they are searched."""


def command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="LCM event log of a drive with fixes.")],
    config: Annotated[Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")] = None,
    output: Annotated[
        str, typer.Option("-o", "--output", metavar="YAML", help="Write the proposal here, - for standard output.")
    ] = "",
    quick: Annotated[
        bool, typer.Option("--quick", help="One round over the fewest settings, without gaps: a first look.")
    ] = False,
    rounds: Annotated[int, typer.Option(min=1, max=5, metavar="N", help="Rounds over all settings, at most.")] = 2,
    processes: Annotated[
        int, typer.Option(min=0, max=64, metavar="N", help="Runs at once. 0: as many as there are processors.")
    ] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a proposal that exists.")] = False,
) -> None:
    """Propose noise settings of the filter from a recording; docs/tuning.md says how to tune.

    Every second fix is withheld, and all fixes in four gaps; settings are stepped by factors of two while the filter
    holds the withheld fixes more probable and is no less accurate. The same log, vehicle file and version propose the
    same. Nothing is changed: the proposal is a part of a vehicle file, to be looked at and merged.

    \b
    Examples:
      modelserver tune drive.lcm -c config/husky/vehicle.yaml --quick
      modelserver tune drive.lcm -c config/husky/vehicle.yaml -o proposal.yaml
    """
    if config is None:
        raise typer.BadParameter("tune needs the vehicle: -c FILE")
    if as_json and output == "-":
        raise typer.BadParameter("--json and -o - both write to standard output; name a file for the proposal")
    _check_output(output, (log, config), force)
    # one thread works in each process: those of the linear algebra would only cost time
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from mstools.tuning import runs as tune_runs

    vehicle = tune_runs.load(config)
    tune_runs.gps_channel(vehicle)
    fixes = tune_runs.read_fixes(log, config)
    if vehicle.config.localization.mode == "raw":
        raise RecordingError(f"{safe(str(config))}: localization.mode is raw, which has no filter to tune")
    chosen = [each.parameter for each in TUNABLES if _has(vehicle, each.needs) and (each.quick or not quick)]
    sigmas = sorted(tune_runs.stated_sigma(each, vehicle) for each in fixes.samples)
    # below what the receiver states a floor does nothing: steps upward begin there
    chosen = [
        Parameter(p.name, p.low, p.high, sigmas[len(sigmas) // 2]) if p.name == "gps_sigma_floor" else p for p in chosen
    ]
    parts: tuple[Part, ...] = ("half",) if quick else ("half", "outage")
    settings = vehicle.config.localization.filter
    begin = {each.name: float(getattr(settings, each.name)) for each in chosen}
    rounds = 1 if quick else rounds
    bound = len(parts) * (1 + rounds * len(chosen) * 2)
    with progress(f"tuning on {log.name}", bound) as show, _pool(processes, len(parts)) as runs:
        trials = Trials(runs, log, config, parts, show)
        first = trials([{}])[0]
        before = trials.outcomes({})
        if first is None or not before[0].scored or before[0].missing == before[0].scored:
            raise RecordingError(
                f"{safe(str(log))}: there was no pose at any of the withheld fixes, so nothing can be scored: see "
                f"modelserver replay {safe(str(log))} -c {safe(str(config))} --report report.html"
            )
        found = search(begin, first, chosen, trials, rounds, _told)
        after = trials.outcomes(found.settings)
    result = TuningResult(begin, first, before, found, after, trials.count)
    if as_json:
        typer.echo(json.dumps(data(result), indent=2, allow_nan=False))
    else:
        typer.echo("\n".join(lines(safe(str(log)), result)), err=output == "-")
    text = proposal(str(log), result)
    if output == "-":
        typer.echo(text, nl=False)
    elif output:
        write_file(output, text, replace=force)


@dataclass
class Trials:
    """Scores settings by runs of all parts, each once: `evaluate` of the search."""

    runs: Callable[[Sequence[Job]], list[Outcome | None]]
    log: Path
    config: Path
    parts: tuple[Part, ...]
    show: Callable[[float], None]
    count: int = 0
    known: dict[tuple[tuple[str, float], ...], list[Outcome | None]] = field(default_factory=dict)

    def __call__(self, trials: Sequence[Settings]) -> list[Score | None]:
        """Return the scores of settings; None where they are out of range."""
        from mstools.tuning.runs import Job

        keys = [tuple(sorted(each.items())) for each in trials]
        new = [key for key in dict.fromkeys(keys) if key not in self.known]
        outcomes = self.runs([Job(self.log, self.config, part, key) for key in new for part in self.parts])
        self.count += len(outcomes)
        self.show(self.count)
        for n, key in enumerate(new):
            self.known[key] = outcomes[n * len(self.parts) : (n + 1) * len(self.parts)]
        return [self._score(self.known[key]) for key in keys]

    def outcomes(self, settings: Settings) -> list[Outcome]:
        """Return what the runs of settings that have been scored came to, one for each part."""
        return [each for each in self.known[tuple(sorted(settings.items()))] if each is not None]

    def _score(self, outcomes: Sequence[Outcome | None]) -> Score | None:
        good = [each for each in outcomes if each is not None]
        if len(good) < len(self.parts):
            return None
        return Score(sum(each.likelihood for each in good) / len(good), good[0].rmse, _mean(good[-1].gaps))


@dataclass(frozen=True)
class TuningResult:
    """What was found: the values begun with, and scores and runs before and after."""

    begin: Settings
    first: Score
    before: Sequence[Outcome]
    found: SearchResult
    after: Sequence[Outcome]
    runs: int


def lines(log: str, result: TuningResult) -> list[str]:
    """Return the report, one line each."""
    found = result.found
    told = [
        f"{log}: {counted(result.before[0].scored, 'fix', 'fixes')} withheld in turn, "
        f"{counted(len(result.before[-1].gaps), 'gap')}; {counted(result.runs, 'run')}",
        f"{'':34}{'before':>10}{'after':>10}",
    ]
    rows = [
        ("RMSE at withheld fixes, m", result.first.rmse, found.score.rmse),
        ("mean error at gap ends, m", result.first.gaps, found.score.gaps),
        ("log-likelihood of a withheld fix", result.first.likelihood, found.score.likelihood),
    ]
    told += [f"{name:34}{a:10.3f}{b:10.3f}" for name, a, b in rows if math.isfinite(a)]
    later = {each.kind: each for each in result.after[0].consistency}
    for each in result.before[0].consistency:
        told.append(_nis(each, later.get(each.kind)))
    for name, value in found.settings.items():
        told.append(f"{name}: {result.begin[name]:g} -> {value:g}")
    if not found.settings:
        told.append("No step helps enough: the settings fit this recording.")
    if found.unseen:
        told.append(f"Without effect on this recording: {', '.join(found.unseen)}.")
    return told


def _nis(before: Consistency, after: Consistency | None) -> str:
    later = f"{after.mean:10.2f}" if after is not None else f"{'':10}"
    beyond = f"   beyond 95 %: {before.beyond:.1%}" + (f" -> {after.beyond:.1%}" if after is not None else "")
    return f"{'NIS, ' + before.kind:34}{before.mean:10.2f}{later}{beyond}"


def data(result: TuningResult) -> dict[str, object]:
    """Return the report for scripts; what is not known is null."""

    def side(score: Score, outcomes: Sequence[Outcome]) -> dict[str, object]:
        return {
            "likelihood": _or_none(score.likelihood),
            "rmse": _or_none(score.rmse),
            "gap_ends": list(outcomes[-1].gaps),
            "nis": {each.kind: {"mean": each.mean, "beyond": each.beyond} for each in outcomes[0].consistency},
        }

    return {
        "runs": result.runs,
        "withheld": result.before[0].scored,
        "before": side(result.first, result.before),
        "after": side(result.found.score, result.after),
        "proposal": dict(result.found.settings),
        "unseen": list(result.found.unseen),
    }


def proposal(log: str, result: TuningResult) -> str:
    """Return the settings that are proposed, as part of a vehicle file."""
    found = result.found
    head = [
        f"# Proposed by modelserver tune from {safe(log)}: log-likelihood of a withheld fix "
        f"{result.first.likelihood:.3f} -> {found.score.likelihood:.3f},",
        f"# RMSE {result.first.rmse:.3f} -> {found.score.rmse:.3f} m."
        " Try it on another recording before you merge it; nothing was changed.",
    ]
    if not found.settings:
        return "\n".join([*head, "localization: {filter: {}}   # no step helps enough"]) + "\n"
    settings = [f"    {name}: {value:.6g}   # was {result.begin[name]:.6g}" for name, value in found.settings.items()]
    return "\n".join([*head, "localization:", "  filter:", *settings]) + "\n"


# --- parts --------------------------------------------------------------------------------------------------


@contextmanager
def _pool(processes: int, parts: int) -> Iterator[Callable[[Sequence[Job]], list[Outcome | None]]]:
    """Give what runs jobs, in so many processes at once, and returns what they came to in their order."""
    # more than both steps of a setting never wait at once
    count = min(processes or os.cpu_count() or 1, 2 * parts)
    if count == 1:
        yield lambda jobs: [_run(job) for job in jobs]
        return
    pool = ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield lambda jobs: [future.result() for future in _submitted(pool, jobs)]
    except BaseException:
        # what runs takes seconds and is of no use any more; the pool forgets its workers when it shuts down
        workers = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for each in workers:
            each.terminate()
        for each in workers:
            each.join()
        raise
    pool.shutdown()


def _submitted(pool: ProcessPoolExecutor, jobs: Sequence[Job]) -> list[Future[Outcome | None]]:
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


def _run(job: Job) -> Outcome | None:
    """Return what a job came to; None for settings that the filter does not take."""
    from mstools.tuning import runs as tune_runs

    try:
        return tune_runs.run(job)
    except ModelServerError:
        raise
    except ValueError:
        return None


def _has(vehicle: Vehicle, needs: str) -> bool:
    sensors = vehicle.config.sensors
    wheels = sensors.wheels
    if needs == "rolling":
        return sensors.imu is not None or wheels is not None
    if needs == "skid_steer":
        return wheels is not None and wheels.kinematics == "skid_steer"
    return getattr(sensors, needs) is not None


def _told(step: SearchStep) -> None:
    typer.echo(
        f"  {step.name}: {step.before:g} -> {step.after:g}, log-likelihood {step.score.likelihood:.3f}, "
        f"RMSE {step.score.rmse:.3f} m",
        err=True,
    )


def _check_output(output: str, inputs: Sequence[Path], force: bool) -> None:
    if not output or output == "-":
        return
    if os.path.realpath(output) in {os.path.realpath(each) for each in inputs}:
        raise typer.BadParameter("LOG, --config and --output must be different files")
    if not force and os.path.isfile(output):
        # said before the work, for that takes a while; the writing looks again
        raise ModelServerError(f"{safe(output)} exists already; give --force to replace it, or another name")
    check_target(output)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
