"""`modelserver replay`: a recorded log onto the bus, or straight through the localization."""

from __future__ import annotations

import gc
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from modelserver.errors import RecordingError, nearest_names, shown
from modelserver.messages import Decision, Invalid, Verdict
from modelserver.regular_files import FileTooLargeError, read_regular
from modelserver.wire.eventlog import LogEvent, LogFile
from modelserver.wire.kinds import is_of_service
from mstools.commands.asking import JsonOption, UrlOption
from mstools.terminal.output import check_target, counted, safe, written_whole
from mstools.terminal.progress import progress

if TYPE_CHECKING:
    from modelserver.service.offline import OfflineRun, TrackRow
    from mstools.report.data import Collector

RATE_HZ = 50.0
"""Poses a second where none is asked for."""

TIMES_LIMIT = 64 << 20
"""Largest file of times, bytes."""


def command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="LCM event log; with --verify a journal, or its folder.")],
    config: Annotated[Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")] = None,
    poses: Annotated[
        str, typer.Option(metavar="CSV", help="Work offline, and write the poses here; - is standard output.")
    ] = "",
    decisions: Annotated[
        str,
        typer.Option(metavar="JSONL", help="Offline: write what became of each measurement here, a JSON a line."),
    ] = "",
    report: Annotated[
        str, typer.Option(metavar="HTML", help="Work offline, and draw what became of everything, for a browser.")
    ] = "",
    frame: Annotated[
        str, typer.Option(metavar="BODY:FRAME", help="Frame whose pose is written. Default: the base frame.")
    ] = "",
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Poses a second. Default: 50.")] = None,
    at_times: Annotated[
        Path | None, typer.Option("--at-times", metavar="FILE", help="Poses at these times: a utime a line, rising.")
    ] = None,
    speed: Annotated[
        str, typer.Option(metavar="N", help="Times as fast as recorded; max: as fast as possible. On the bus only.")
    ] = "1",
    restamp: Annotated[
        bool, typer.Option("--restamp", help="Move the stamps of samples to now, as if the sensors spoke now.")
    ] = False,
    channel: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this channel; may be given again.")
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Onto the bus, send recorded poses, requests and replies too.")
    ] = False,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="LOG is a journal: run it again and compare all that was said, bit for bit."),
    ] = False,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --verify: the vehicle's key file, to check the seals.")
    ] = None,
    url: UrlOption = "",
    as_json: JsonOption = False,
) -> None:
    """Feed a recorded log to the bus, or straight through the localization.

    Onto the bus, messages go out at the pace of their arrival, unchanged; a daemon that publishes by timer takes
    samples of another day for stale, so give it --restamp, or publish.mode: event in its vehicle file. What a daemon
    has said (poses, health, replies) is left out, unless --all or --channel asks for it. Offline, with
    --poses, the daemon's core takes them as fast as it can, and the pose of one frame in World:UTM is written for
    even or listed times, each from nothing but what had arrived before it; docs/recordings.md says exactly what that
    means. --report draws the same run: track, innovations, biases, gaps, validity, and what looks wrong.
    A log that breaks off in its last event is used up to there; for other damage the exit code is 1.
    With --verify a service's journal is run again, and the first message that is not reproduced is named. Exit code 0:
    all is reproduced bit for bit, and authentic where --key is given; 3: reproduced, but --key does not prove that it
    is authentic; 4: the same to within 1e-9 m and rad, as with another numpy; 1: it differs, or is damaged, incomplete
    or forged.
    Files named by --poses, --decisions and --report that exist are replaced, without --force.

    \b
    Examples:
      modelserver replay drive.lcm --restamp
      modelserver replay drive.lcm --speed 2
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --poses poses.csv --frame Antenna:PhaseCentre --rate 10
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --report drive.html
      modelserver replay --verify /var/lib/modelserver/journal-Husky --key /etc/modelserver/commands.key
    """
    if verify:
        if any(
            (config, poses, decisions, report, frame, rate, at_times, channel, everything, url, restamp, speed != "1")
        ):
            raise typer.BadParameter(
                "--verify takes --json and --key beside it: all else that it needs is in the journal"
            )
        from mstools.commands.replay_verify import verified

        verified(log, as_json, key)
        return
    if key is not None:
        raise typer.BadParameter("--key goes with --verify")
    channels = frozenset(channel or ())
    if poses or report:
        if config is None:
            raise typer.BadParameter(f"{'--poses' if poses else '--report'} needs the vehicle: -c FILE")
        if rate is not None and not (math.isfinite(rate) and 0.0 < rate <= 10_000.0):
            raise typer.BadParameter(f"a rate is above 0 and at most 10000 Hz, got {rate:g}")
        if rate is not None and at_times is not None:
            raise typer.BadParameter("--rate and --at-times are two ways to say when; give one of them")
        if speed != "1" or restamp or url or everything:
            raise typer.BadParameter(
                "--speed, --restamp, --all and --url are for the bus; --poses and --report work offline"
            )
        if not poses and (frame or at_times is not None or rate is not None):
            raise typer.BadParameter("--frame, --rate and --at-times go with --poses CSV")
        if (poses, decisions, report).count("-") > 1:
            raise typer.BadParameter("only one of --poses, --decisions and --report can go to standard output")
        offline(log, config, poses, decisions, report, frame, rate or RATE_HZ, at_times, channels, as_json)
    else:
        if frame or decisions or at_times is not None or rate is not None:
            raise typer.BadParameter(
                "--frame, --rate and --at-times go with --poses CSV, --decisions with that or --report"
            )
        factor = _speed(speed)
        if restamp and factor != 1.0:
            raise typer.BadParameter("--restamp goes with --speed 1: stamps must not run faster than the clock")
        to_bus(log, config, factor, None if everything else channels, url, as_json, restamp)


def to_bus(
    log: Path,
    config: Path | None,
    speed: float,
    channels: frozenset[str] | None,
    url: str,
    as_json: bool,
    restamp: bool = False,
) -> None:
    """Send a log on the bus."""
    from modelserver.config import load_config
    from modelserver.service.clock import SystemClock
    from modelserver.service.playback import Player
    from modelserver.wire.provider import open_lcm, resolve_url

    if not url and config is not None:
        url = load_config(config).lcm.url
    with LogFile(log) as recording:
        bus = open_lcm(resolve_url(url))
        player = Player(bus.publish, speed, SystemClock(), time.sleep, restamp)
        try:
            with progress(f"replaying {log.name}", recording.size) as show:
                shown_at = 0.0

                def seen(event: LogEvent) -> None:
                    nonlocal shown_at
                    if (now := time.monotonic()) > shown_at + 0.1:
                        shown_at = now
                        show(event.end)

                if channels is None:
                    player.play(recording, seen)
                elif channels:
                    player.play(_only(recording, channels), seen)
                else:
                    player.play(_inputs(recording), seen)
        finally:
            report = {"sent": player.sent, "seconds": player.span, "most_late": player.late}
            words = (
                f"{log}: {player.sent} messages sent, {player.span:.1f} s of the log, at most {player.late:.3f} s late"
            )
            typer.echo(json.dumps(report) if as_json else words)
        _report_damage(recording)


def offline(
    log: Path,
    config: Path,
    poses: str,
    decisions: str,
    report: str,
    frame: str,
    rate: float,
    at_times: Path | None,
    channels: frozenset[str],
    as_json: bool,
) -> None:
    """Write the poses of a frame, the decisions and the report of a log; each where it is named."""
    # one thread works: those of the linear algebra would only cost time
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # loaded here, with what it needs, as it is long: the speed that is told is that of the replay
    from modelserver.config import load_config
    from modelserver.service.daemon import load_vehicle
    from modelserver.service.offline import CSV_HEADER, OfflineRun

    vehicle = load_vehicle(load_config(config), str(config))
    if vehicle.rig is None:
        raise RecordingError(f"{config}: names nothing under sensors to localize by, so there is no pose to write")
    times = None if at_times is None else read_times(at_times)
    geometry = Path(vehicle.config.geometry)
    inputs = [log, config, geometry, *([] if at_times is None else [at_times])]
    taken: dict[str, str] = {}
    for target, what in ((poses, "poses"), (decisions, "decisions"), (report, "report")):
        if target:
            _check_output(target, inputs)
            check_target(target)
            place = os.path.realpath(target)
            if target != "-" and place in taken:
                raise RecordingError(f"{target}: the {taken[place]} go there; name another file for the {what}")
            taken[place] = what
    if not poses:
        times = []
    with LogFile(log) as recording:
        run = OfflineRun(vehicle, _only(recording, channels), frame or vehicle.config.base_frame)
        collector = None
        if report:
            from mstools.report.data import Collector

            collector = Collector(vehicle)
            run.on_taken = collector.on_taken
        # what is loaded stays, and what is made is held in long tuples: looking for circles in it costs a sixth
        gc.collect()
        gc.freeze()
        gc.set_threshold(50_000, 20, 100)
        started = time.monotonic()
        poses_told = PoseCounts()
        refused: Counter[tuple[str, str, str]] = Counter()
        with (
            _output(poses) if poses else nullcontext() as out,
            _output(decisions) if decisions else nullcontext() as ledger,
            progress(f"replaying {log.name}", recording.size) as show,
        ):
            listeners: list[Callable[[Decision], object]] = [partial(_count_refused, refused)]
            if ledger is not None:
                listeners.append(partial(_write_decision, ledger))
            if collector is not None:
                listeners.append(collector.on_decision)
            met: set[str] = set()
            run.log = _shown(run.log, show, met)
            run.on_decision = partial(_tell, listeners)
            if out is not None:
                out.write(CSV_HEADER + "\n")
            for row in run.rows(times, rate):
                if out is not None:
                    out.write(row.csv() + "\n")
                poses_told.count(row)
        wall = time.monotonic() - started
        on_stderr = "-" in (poses, decisions, report)
        _print_counts(run, poses_told if poses else None, refused, wall, as_json, on_stderr)
        if times:
            _warn_of_times(times, run, at_times)
        if not run.samples:
            heard = _listed(
                name for name, each in vehicle.sensor_channels().items() if each.type_name != "localization_mode_t"
            )
            raise RecordingError(f"{log}: nothing on the vehicle's channels ({heard}); it has: {_listed(run.unheard)}")
        if collector is not None:
            _write_report(collector, run, log, report, met, quiet=as_json)
        _report_damage(recording)


def _shown(events: Iterable[LogEvent], show: Callable[[float], object], channels: set[str]) -> Iterator[LogEvent]:
    """Yield events, show now and then how far they have come, and note their channels."""
    for number, event in enumerate(events):
        channels.add(event.channel)
        if number % 1024 == 0:
            show(event.end)
        yield event


def _tell(listeners: Iterable[Callable[[Decision], object]], decision: Decision) -> None:
    for each in listeners:
        each(decision)


@dataclass
class PoseCounts:
    """How many poses were written, how many are valid, and for how many each reason holds not to be."""

    written: int = 0
    valid: int = 0
    reasons: Counter[Invalid] = field(default_factory=Counter)

    def count(self, row: TrackRow) -> None:
        """Count one."""
        self.written += 1
        self.valid += row.valid
        if not row.valid:
            self.reasons.update(flag for flag in Invalid if row.invalid & flag)

    def words(self, frame: str) -> str:
        """Return it in words."""
        told = f"{counted(self.written, 'pose')} of {frame}, {self.valid} valid"
        if self.valid == self.written:
            return told
        mostly = "".join(f", mostly {flag.name}" for flag, _ in self.reasons.most_common(1))
        return f"{told} (not valid: {self.written - self.valid}{mostly})"


def _count_refused(refused: Counter[tuple[str, str, str]], decision: Decision) -> None:
    if decision.verdict is Verdict.REJECTED:
        refused[f"sensor:{decision.source}", decision.reason or "rejected", decision.kind] += 1


def _print_counts(
    run: OfflineRun,
    poses: PoseCounts | None,
    refused: Counter[tuple[str, str, str]],
    wall: float,
    as_json: bool,
    on_stderr: bool,
) -> None:
    span = (run.last_utime - run.first_utime) * 1e-6
    kinds = {
        (source, reason): {kind: n for (s, r, kind), n in sorted(refused.items()) if (s, r) == (source, reason)}
        for source, reason in run.rejected
    }
    counts = {
        "poses": poses.written if poses else 0,
        "valid": poses.valid if poses else 0,
        "invalid_reasons": {str(flag.name): n for flag, n in poses.reasons.most_common()} if poses else {},
        "events": run.events,
        "samples": run.samples,
        "seconds": span,
        "wall_seconds": wall,
        "real_time_factor": span / wall if wall > 0 else math.nan,
        "rejected": [
            {"source": s, "reason": r, "count": n, "kinds": kinds[s, r]} for (s, r), n in sorted(run.rejected.items())
        ],
    }
    told = f"{poses.words(run.frame)}, from " if poses else ""
    lines = [
        f"{told}{run.samples} of {run.events} messages; "
        f"{span:.1f} s in {wall:.2f} s: {counts['real_time_factor']:.0f} times real time"
    ]
    for (source, reason), count in sorted(run.rejected.items()):
        of = ", ".join(kind if n == count else f"{n} {kind}" for kind, n in kinds[source, reason].items())
        lines.append(safe(f"  not used: {count} of {source}, {reason}{f' ({of})' if of else ''}"))
    typer.echo(json.dumps(counts) if as_json else "\n".join(lines), err=on_stderr)


UNITS = (("seconds", 1_000_000.0), ("milliseconds", 1_000.0), ("nanoseconds", 0.001))
"""What times may be in by mistake, and what makes microseconds of it."""


def _warn_of_times(times: list[int], run: OfflineRun, path: Path | None) -> None:
    """Say that no time lies within the log, where that is so, and what the times may be."""
    if any(run.first_utime <= each <= run.last_utime for each in times):
        return
    hint = f"the log lasts from {run.first_utime} to {run.last_utime}, in microseconds since 1970"
    for unit, factor in UNITS:
        if any(run.first_utime <= each * factor <= run.last_utime + 1e6 for each in times):
            hint += f"; these look like {unit}"
            break
    typer.echo(f"modelserver: {path}: none of {counted(len(times), 'time')} lies within the log: {hint}", err=True)


def _write_report(
    collector: Collector, run: OfflineRun, log: Path, report: str, channels: set[str], quiet: bool
) -> None:
    """Write the page, and print the headlines of what it found."""
    from mstools.report import replay_report
    from mstools.report.findings import findings

    replayed = collector.replayed(log.name, run.first_utime, run.last_utime, run.rejected, channels)
    with _output(report) as out:
        out.write(replay_report.page(replayed))
    if not quiet:
        typer.echo("\n".join(replay_report.summary(findings(replayed), report)), err=report == "-")


def read_times(path: Path) -> list[int]:
    """Return the times that a file lists: one utime a line, rising; empty lines and # comments are passed over.

    Raises RecordingError with the line for anything else, OSError.
    """
    try:
        content = read_regular(path, TIMES_LIMIT)
    except FileTooLargeError:
        raise RecordingError(f"{path}: larger than {TIMES_LIMIT >> 20} MiB: is this the file of times?") from None
    times: list[int] = []
    for number, line in enumerate(content.decode("utf-8", errors="replace").split("\n"), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        if not (text.isascii() and text.isdigit()) or not 0 < (utime := int(text[:20])) < 1 << 61:
            raise RecordingError(f"{path}:{number}: {shown(text, 40)} is no time in microseconds since 1970")
        if times and utime < times[-1]:
            raise RecordingError(f"{path}:{number}: {utime} is before {times[-1]}, the time above it; sort the file")
        times.append(utime)
    if not times:
        raise RecordingError(f"{path}: lists no times")
    return times


def _only(recording: LogFile, channels: frozenset[str]) -> Iterator[LogEvent]:
    """Yield the events of some channels, or of all. Raises RecordingError at the end where there were none."""
    met: dict[str, None] = {}
    found = not channels
    for event in recording:
        met[event.channel] = None
        if not channels or event.channel in channels:
            found = True
            yield event
    if not found:
        raise RecordingError(f"{recording.path}: nothing on {_listed(channels)}. {_offer(channels, met)}")


def _offer(wanted: Iterable[str], met: Iterable[str]) -> str:
    near = [name for each in sorted(wanted) for name in nearest_names(each, met)]
    return f"Nearest: {', '.join(near)}" if near else f"It has: {_listed(met)}"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


def _output(path: str) -> AbstractContextManager[TextIO]:
    if path == "-":
        return nullcontext(typer.get_text_stream("stdout"))
    return written_whole(path, replace=True)


def _check_output(path: str, inputs: Iterable[Path]) -> None:
    """Raise RecordingError where the output would go over a file that it is made from."""
    target = Path(path)
    for each in inputs:
        if path != "-" and target.exists() and each.exists() and target.samefile(each):
            raise RecordingError(f"{path}: is read by this command; name another file to write")


def _write_decision(ledger: TextIO, decision: Decision) -> None:
    """Write a decision as a line of JSON, which has no nan: null stands for it."""
    values = decision._asdict() | {"verdict": decision.verdict.name.lower()}
    ledger.write(json.dumps({key: _json(value) for key, value in values.items()}, allow_nan=False) + "\n")


def _json(value: object) -> object:
    if isinstance(value, tuple):
        return [_json(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _inputs(recording: Iterable[LogEvent]) -> Iterator[LogEvent]:
    """Yield all but what a daemon has said and was asked: beside a running one that would be heard twice."""
    return (event for event in recording if not is_of_service(event.data))


def _report_damage(recording: LogFile) -> None:
    for each in recording.damage[:20]:
        typer.echo(safe(f"modelserver: {recording.path}: {each}"), err=True)
    if len(recording.damage) > 20:
        typer.echo(f"modelserver: {recording.path}: {len(recording.damage) - 20} more damaged places", err=True)
    if recording.torn:
        raise typer.Exit(1)


def _speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise typer.BadParameter(f"a speed is a number above 0, or max, got {shown(text, 20)}", param_hint="--speed")
    return value
