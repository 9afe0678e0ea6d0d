"""`modelserver archive`: replay many logs on a cluster into Parquet tables, report on them, compare two archives."""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import ModelServerError, RecordingError, find_nearest_names
from mstools.terminal.options import JsonOption, SchedulerOption, argument, option
from mstools.terminal.output import (
    check_writable,
    escape,
    format_count,
    format_table,
    require_extra,
    show_progress,
    to_json,
    write_file,
)

if TYPE_CHECKING:
    from mstools.archive.fleet import ArchivedDrive
    from mstools.archive.task import LogOutcome

NEEDS_ARCHIVE = "archives need Dask and Arrow"

RATE_HZ = 10.0
"""Default rate of poses: a change of validity is then known to 0.1 s."""

WORSE = 3
"""Exit code of a comparison whose second archive is worse."""

LINE_PERIOD_S = 60.0
"""Seconds between two lines of progress where there is no terminal for a bar."""

MAX_PRINTED = 10
"""Drives that a report prints: the worst ones."""

ArchiveArgument = Annotated[str, argument("ARCHIVE", "An archive: the folder or URL of archive run.")]
ConfigOption = Annotated[Path | None, option("--config -c FILE", "The vehicle file.")]

command = typer.Typer(
    help="""Replay many logs on a cluster into Parquet tables, report on them, and compare two archives.

    \b
    Examples:
      modelserver archive run logs/ -c vehicle.yaml --out archive
      modelserver archive report archive -o archive.html
      modelserver archive compare archive archive-new
    """,
    no_args_is_help=True,
    rich_markup_mode=None,
)


@command.command("run")
def run(
    logs: Annotated[
        list[str],
        argument("LOGS...", "Logs, journals, bags, MCAP files: folders, patterns, URLs, or a list (.txt) of them."),
    ],
    config: ConfigOption = None,
    out: Annotated[str, option("--out DIR", "The archive: a folder, or an fsspec URL.")] = "",
    rate: Annotated[float, option("--rate HZ", "Poses per second.")] = RATE_HZ,
    scheduler: SchedulerOption = "",
    workers: Annotated[int, option("--workers N", "Processes on this machine. Default: one per core.", min=0)] = 0,
    as_json: JsonOption = False,
) -> None:
    """Replay logs through the localization, each as a task, into the Parquet tables of an archive.

    It can be interrupted and run again: a log is replayed if its content, the vehicle file, the geometry, the rate or
    the version of ModelServer has changed, else its result stays. A log that is damaged is a row with its error and the
    part that was read; then the exit code is 1. docs/archives.md describes the tables.

    \b
    Examples:
      modelserver archive run logs/ -c vehicle.yaml --out archive
      modelserver archive run 's3://drives/2026/**/*.lcm' -c vehicle.yaml --out s3://archive --scheduler tcp://10.0.0.1:8786
    """
    if config is None or not out:
        raise typer.BadParameter("archive run needs the vehicle file and the archive: -c FILE --out DIR")
    if not (math.isfinite(rate) and 0.0 < rate <= 1000.0):
        raise typer.BadParameter(f"a rate must be above 0 and at most 1000 Hz, got {rate:g}")
    if scheduler and workers:
        raise typer.BadParameter("--workers is for this machine: the workers of a scheduler are its own")
    require_extra("archive", NEEDS_ARCHIVE)
    from modelserver.config.vehicle_file import load_config
    from modelserver.server.vehicle import load_vehicle
    from mstools.archive.cluster import hash_code, open_cluster
    from mstools.archive.logs import find_logs
    from mstools.archive.storage import Storage, digest
    from mstools.archive.task import Task, digest_settings, run_task, write_error

    vehicle = load_vehicle(load_config(config), str(config))
    if vehicle.rig is None:
        raise RecordingError(f"{config}: no localization sensor is configured (section 'sensors' is empty)")
    settings = digest_settings(vehicle, rate, hash_code())
    place = out if "://" in out else str(Path(out).absolute())
    names = find_logs(logs)
    started = printed = time.monotonic()
    outcomes: list[LogOutcome] = []
    with closing(Storage(place)) as storage:
        present = storage.prepare()
        tasks = [Task(log, vehicle, rate, settings, place, present.get(digest(log), ())) for log in names]
        with (
            open_cluster(scheduler, workers) as cluster,
            show_progress("archiving", len(tasks)) as show,
        ):
            typer.echo(f"{format_count(len(tasks), 'log')}; dashboard: {cluster.dashboard}", err=True)
            for task, found in cluster.run(run_task, tasks):
                outcome = write_error(task, str(found)) if isinstance(found, ModelServerError) else found
                outcomes.append(outcome)
                rate_now = sum(each.seconds for each in outcomes) / (time.monotonic() - started)
                label = f"archiving, {rate_now:.0f} times real time"
                show(len(outcomes), label)
                if not sys.stderr.isatty() and time.monotonic() > printed + LINE_PERIOD_S:
                    printed = time.monotonic()
                    typer.echo(f"{label}: {len(outcomes)} of {len(tasks)}", err=True)
                if outcome.error:
                    typer.echo(escape(f"modelserver: {outcome.log}: {outcome.error}"), err=True)
    report_outcomes(outcomes, time.monotonic() - started, place, as_json)
    if any(each.error for each in outcomes):
        raise typer.Exit(1)


def report_outcomes(outcomes: Sequence[LogOutcome], wall: float, place: str, as_json: bool) -> None:
    """Print what became of the logs; `wall`: duration of the run, seconds."""
    states = Counter(each.state for each in outcomes)
    seconds, cpu = sum(each.seconds for each in outcomes), sum(each.cpu for each in outcomes)
    if as_json:
        counts = {state: states[state] for state in ("written", "unchanged", "failed")}
        typer.echo(json.dumps(counts | {"seconds": seconds, "cpu_seconds": cpu, "wall_seconds": wall}))
        return
    text = ", ".join(f"{states[state]} {state}" for state in ("written", "unchanged", "failed") if states[state])
    speed = f"; {seconds / 3600.0:.2f} h in {wall:.0f} s" if seconds else ""
    typer.echo(escape(f"{place}: {text}{speed}"))


@command.command("report")
def report(
    archive: ArchiveArgument,
    output: Annotated[str, option("-o --output HTML", "Write the page here. Default: report.html in the folder.")] = "",
    worst: Annotated[int, option("--worst N", "Write the reports of the worst N drives too.", min=0)] = 0,
    drive: Annotated[list[str] | None, option("--drive LOG", "Write the report of this drive too.")] = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write one page on all drives: worst first, reasons, rejections, NIS, findings, distributions.

    A drive's own report, as that of replay, is written on demand beside the page (--worst, --drive), which links it. It
    needs the log, and the vehicle file of the run: -c FILE.

    \b
    Examples:
      modelserver archive report archive
      modelserver archive report archive -c vehicle.yaml --worst 10
    """
    if (worst or drive) and config is None:
        raise typer.BadParameter("the report of a drive needs the vehicle file: -c FILE")
    require_extra("archive", NEEDS_ARCHIVE)
    from mstools.archive.fleet import name_report, read_drives, render_page

    if not output and "://" in archive:
        raise typer.BadParameter("an archive in object storage needs a place for the page: -o HTML")
    page = Path(output or Path(archive) / "report.html")
    drives = read_drives(archive)
    check_writable(str(page))
    chosen = drives[:worst] + [find_drive(drives, name) for name in drive or ()]
    folder = page.parent / f"{page.stem}-drives"
    if chosen:
        folder.mkdir(exist_ok=True)
    for each in chosen:
        assert config is not None
        write_report(each, config, folder / name_report(each))

    def find_report(each: ArchivedDrive) -> str:
        path = folder / name_report(each)
        return f"{folder.name}/{path.name}" if path.exists() else ""

    write_file(str(page), render_page(archive, drives, find_report), replace=True)
    if as_json:
        typer.echo(json.dumps([to_json(each) | {"valid_share": each.valid_share} for each in drives], default=str))
        return
    typer.echo(escape(f"report: {page}, {format_count(len(drives), 'drive')}, the worst ones:"))
    rows = [
        (Path(each.log).name, f"{each.valid_share:.1%}", f"{each.invalid_seconds:.0f}", each.error[:60])
        for each in drives[:MAX_PRINTED]
    ]
    typer.echo(format_table(("drive", "valid", "invalid, s", "error"), rows, (1, 2)))


def find_drive(drives: Sequence[ArchivedDrive], name: str) -> ArchivedDrive:
    """Return the drive of a log, by its path or its name. Raises RecordingError."""
    names = {name, str(Path(name).absolute())}
    found = [each for each in drives if not names.isdisjoint((each.log, Path(each.log).name))]
    if len(found) == 1:
        return found[0]
    if found:
        raise RecordingError(f"{name}: {len(found)} drives have that name; give the whole path: {found[0].log}")
    near = find_nearest_names(name, [Path(each.log).name for each in drives])
    raise RecordingError(f"{name}: no drive of the archive" + (f"; did you mean {near[0]}?" if near else ""))


def write_report(drive: ArchivedDrive, config: Path, page: Path) -> None:
    """Write the replay report of a drive; one that cannot be read gets none, with a note."""
    from mstools.archive.logs import fetch
    from mstools.commands.replay import replay_offline
    from mstools.recordings.bag_log import open_lcm_log

    try:
        with fetch(drive.log) as path, open_lcm_log(path) as log:
            replay_offline(log, config, "", "", str(page), "", RATE_HZ, None, frozenset(), as_json=False)
    except (ModelServerError, OSError) as error:
        typer.echo(escape(f"modelserver: {drive.log}: no report: {error}"), err=True)


@command.command("compare")
def compare(
    before: Annotated[str, argument("BEFORE", "The archive of the one configuration or version.")],
    after: Annotated[str, argument("AFTER", "The archive of the other, over the same logs.")],
    as_json: JsonOption = False,
) -> None:
    """Compare two configurations or versions log by log: is the second one worse?

    Each figure is that of all common drives; less is better. The interval is of the difference, by resampling the
    drives. Exit code: 0 not worse, 3 worse in a figure, 1 no comparison.

    Example: modelserver archive compare archive archive-new
    """
    require_extra("archive", NEEDS_ARCHIVE)
    from mstools.archive import fleet

    found = fleet.compare(fleet.read_drives(before), fleet.read_drives(after))
    if as_json:
        typer.echo(json.dumps(to_json(found) | {"worse": found.is_worse}))
    else:
        first, second = found.only
        typer.echo(f"{format_count(found.pairs, 'drive')} in both archives; {first} and {second} in one alone")
        head = ("figure", "unit", "before", "after", "difference, interval", "drives better", "worse", "")
        rows = [
            (
                *(each.name, each.unit, f"{each.before:.3g}", f"{each.after:.3g}"),
                f"{each.low:+.3g} to {each.high:+.3g}",
                *(f"{each.better}", f"{each.worse}", each.verdict),
            )
            for each in found.figures
        ]
        typer.echo(format_table(head, rows, (2, 3, 5, 6)))
    if found.is_worse:
        raise typer.Exit(WORSE)
