"""`modelserver replay`: replay a log on the bus, or offline through the localization."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from modelserver.errors import RecordingError, find_nearest_names, quote
from modelserver.files import FileTooLargeError, read_regular
from modelserver.messages import Decision, Invalid, Verdict
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.codec import is_of_service
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools.terminal.options import ChannelsOption, JsonOption, UrlOption, argument, complete_frame, list_given, option
from mstools.terminal.output import (
    check_writable,
    escape,
    format_count,
    guess_time_unit,
    open_atomic,
    read_with_progress,
    require_extra,
    show_progress,
    to_json,
    write_beside,
)

if TYPE_CHECKING:
    from modelserver.server.journal.verify import Difference, VerificationReport
    from modelserver.server.recordings import OfflineRun, TrackRow

RATE_HZ = 50.0
"""Default rate of poses."""

TIMES_LIMIT = 64 << 20
"""Largest size of a file of times, bytes."""


def command(
    ctx: typer.Context,
    log: Annotated[Path, argument("LOG", "LCM event log; with --verify a journal, or its folder.")],
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file.")] = None,
    poses: Annotated[
        str, option("--poses CSV", "Replay offline, and write the poses here; - is standard output.")
    ] = "",
    decisions: Annotated[
        str,
        option("--decisions JSONL", "Offline: write the decision on each measurement here, one JSON object per line."),
    ] = "",
    out: Annotated[
        Path | None,
        option("--log OUT", "Offline: write an LCM log of its messages and of all that the service publishes."),
    ] = None,
    report: Annotated[str, option("--report HTML", "Replay offline, and write a report for a browser.")] = "",
    frame: Annotated[
        str, option("--frame BODY:FRAME", "Frame of the poses. Default: the base frame.", autocompletion=complete_frame)
    ] = "",
    rate: Annotated[float | None, option("--rate HZ", "Poses per second. Default: 50.")] = None,
    at_times: Annotated[
        Path | None, option("--at-times FILE", "Poses at these times: one utime per line, ascending.")
    ] = None,
    speed: Annotated[str, option("--speed N", "Speed factor; max: as fast as possible. On the bus only.")] = "1",
    restamp: Annotated[
        bool, option("--restamp", "Shift the stamps of samples to now, as if the sensors were live.")
    ] = False,
    channel: ChannelsOption = None,
    everything: Annotated[
        bool, option("--all", "On the bus, also publish recorded poses, requests and replies.")
    ] = False,
    verify: Annotated[
        bool, option("--verify", "LOG is a journal: replay it and compare all published messages bit for bit.")
    ] = False,
    key: Annotated[
        Path | None, option("--key FILE", "With --verify: the vehicle's key file, to verify the seals.")
    ] = None,
    url: UrlOption = "",
    as_json: JsonOption = False,
) -> None:
    """Replay a log on the bus, or offline through the localization.

    On the bus, messages are published unchanged at the pace of their recording; a daemon in timer mode rejects samples
    of another day as stale, so use --restamp, or publish.mode: event in its vehicle file. Messages of a daemon (poses,
    health, replies) are left out unless --all or --channel selects them.

    Offline, with --poses, the daemon's core processes the log as fast as possible, and writes the pose of one frame in
    World:UTM at a fixed rate or at listed times, each from the samples that had arrived before it; see
    docs/recordings.md. --log writes the log as it would be with the service running: for view, export, query --log and
    status. --report writes a report of the same run: track, innovations, biases, gaps, validity, findings.
    A log with an incomplete last event is used up to there; for other damage the exit code is 1. Existing files of
    --poses, --decisions, --report and --log are replaced.

    With --verify a journal is replayed, and the first message that is not reproduced is printed. Exit code 0:
    reproduced bit for bit, and authentic where --key is given; 3: reproduced, but --key does not prove authenticity; 1:
    different, damaged, incomplete or forged.

    \b
    Examples:
      modelserver replay drive.lcm --restamp
      modelserver replay drive.lcm --speed 2
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --poses poses.csv --frame Antenna:PhaseCenter --rate 10
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --report drive.html
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --log localized.lcm
      modelserver replay --verify /var/lib/modelserver/journal-Husky --key /etc/modelserver/commands.key
    """
    _check_options(list_given(ctx))
    channels = frozenset(channel or ())
    if verify:
        run_verification(log, as_json, key)
    elif out is not None and config is not None:
        localize(log, config, out, as_json)
    elif (poses or report) and config is not None:
        if rate is not None and not (math.isfinite(rate) and 0.0 < rate <= 10_000.0):
            raise typer.BadParameter(f"a rate must be above 0 and at most 10000 Hz, got {rate:g}")
        if (poses, decisions, report).count("-") > 1:
            raise typer.BadParameter("only one of --poses, --decisions and --report can be standard output")
        replay_offline(log, config, poses, decisions, report, frame, rate or RATE_HZ, at_times, channels, as_json)
    else:
        factor = _parse_speed(speed)
        if restamp and factor != 1.0:
            raise typer.BadParameter("--restamp needs --speed 1: stamps must not run faster than the clock")
        replay_to_bus(log, config, factor, None if everything else channels, url, as_json, restamp)


def _check_options(options: dict[str, str]) -> None:
    """Raise typer.BadParameter, a usage error, where options do not go together; they are by parameter."""
    given = options.keys() - {"log", "as_json"}
    of_poses, offline = given & {"frame", "rate", "at_times"}, given & {"out", "poses", "report"}
    rules: list[tuple[object, str]] = [
        (
            "verify" in given and given - {"verify", "key"},
            "--verify accepts only --json and --key: everything else is in the journal",
        ),
        ("key" in given and "verify" not in given, "--key needs --verify"),
        ("out" in given and given - {"out", "config"}, "--log goes with -c and --json alone: run twice for more"),
        (
            offline and given & {"speed", "restamp", "everything", "url"},
            "--speed, --restamp, --all and --url are for the bus; --poses and --report are offline",
        ),
        (
            "config" in given and not offline,
            "-c is for an offline replay: give --poses CSV, --report HTML or --log OUT too",
        ),
        (of_poses and "poses" not in given, "--frame, --rate and --at-times need --poses CSV"),
        ("decisions" in given and not offline, "--decisions needs --poses CSV or --report"),
        (of_poses >= {"rate", "at_times"}, "--rate and --at-times exclude each other"),
    ]
    for is_broken, text in rules:
        if is_broken:
            raise typer.BadParameter(text)
    if offline and "config" not in given:
        raise typer.BadParameter(f"{options[min(offline)]} needs the vehicle file: -c FILE")


def localize(log: Path, config: Path, out: Path, as_json: bool) -> None:
    """Write a log with the service's messages, whole or not at all."""
    _check_outputs({"log": str(out)}, [log, config])
    with write_beside(out) as draft:
        counts = write_localized(log, config, draft)
    if as_json:
        typer.echo(json.dumps(counts))
        return
    typer.echo(escape(f"{out}: {format_count(sum(counts.values()), 'message')}"))
    for name, count in sorted(counts.items()):
        typer.echo(escape(f"  {name} {count}"))


def write_localized(log: Path, config: Path, out: Path) -> Counter[str]:
    """Write the log with the service's messages; return the number of messages by channel.

    Notes of the log go to stderr. Raises ConfigError, GeometryError, RecordingError, OSError.
    """
    import lcm

    from modelserver.config.vehicle_file import load_config
    from modelserver.server.recordings import StampAxis, serve
    from modelserver.server.vehicle import load_vehicle

    vehicle = load_vehicle(load_config(config), str(config))
    axis = StampAxis()
    counts: Counter[str] = Counter()
    with (
        closing(lcm.EventLog(str(out), "w", overwrite=True)) as writer,
        read_with_progress("localizing", log) as (recording, events),
    ):
        for event in serve(vehicle, events, axis):
            writer.write_event(event.utime, event.channel, event.data)
            counts[event.channel] += 1
    for note in (*axis.describe(), *map(str, recording.damage)):
        typer.echo(escape(f"modelserver: {log}: {note}"), err=True)
    return counts


@contextmanager
def open_localized(log: Path, config: Path | None) -> Iterator[Path]:
    """Give the log itself, or with a vehicle file a temporary one with what the service makes of it."""
    if config is None:
        yield log
        return
    with tempfile.TemporaryDirectory(prefix="modelserver-") as folder:
        out = Path(folder) / log.name
        write_localized(log, config, out)
        yield out


def replay_to_bus(
    log: Path,
    config: Path | None,
    speed: float,
    channels: frozenset[str] | None,
    url: str,
    as_json: bool,
    restamp: bool = False,
) -> None:
    """Publish a log on the bus: some channels, with an empty set all but a daemon's, with None all."""
    from modelserver.config.vehicle_file import load_config
    from modelserver.server.clock import Clock
    from modelserver.server.recordings import Player
    from modelserver.wire.provider import open_lcm, resolve_url

    if not url and config is not None:
        url = load_config(config).lcm.url
    player = Player(open_lcm(resolve_url(url)).publish, speed, Clock(), time.sleep, restamp)
    with read_with_progress("replaying", log) as (recording, tracked):
        events: Iterable[LogEvent] = tracked
        if channels is not None:
            events = _filter_channels(tracked, log, channels) if channels else _exclude_service_messages(tracked)
        try:
            with closing(tracked):
                player.play(events)
        finally:
            report = {"sent": player.sent, "seconds": player.duration, "max_delay": player.max_delay}
            words = (
                f"{log}: {player.sent} messages sent, {player.duration:.1f} s of the log, "
                f"largest delay {player.max_delay:.3f} s"
            )
            typer.echo(json.dumps(report) if as_json else words)
        _report_damage(recording)


def replay_offline(
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
    """Write the poses of a frame, the decisions and the report of a log to the given files."""
    # imported before the clock starts: the printed speed is that of the replay
    from modelserver.config.vehicle_file import load_config
    from modelserver.server.recordings import CSV_HEADER, OfflineRun, relax_garbage_collector
    from modelserver.server.vehicle import load_vehicle

    vehicle = load_vehicle(load_config(config), str(config))
    if vehicle.rig is None:
        raise RecordingError(
            f"{config}: no localization sensor is configured (section 'sensors' is empty), so there is no pose"
        )
    prefix = vehicle.config.lcm.channel_prefix
    times = None if at_times is None else read_times(at_times)
    inputs = [log, config, Path(vehicle.config.geometry), *([] if at_times is None else [at_times])]
    if report:
        from mstools.report.charts import NEEDS_PLOTLY

        require_extra("report", NEEDS_PLOTLY)
    _check_outputs({"poses": poses, "decisions": decisions, "report": report}, inputs)
    seen: set[str] = set()
    with read_with_progress("replaying", log) as (recording, tracked):
        events = _filter_channels(tracked, log, channels, seen)
        run = OfflineRun(vehicle, events, frame or vehicle.config.base_frame)
        collector = None
        if report:
            from mstools.report.replay_data import ReplayCollector

            collector = ReplayCollector(vehicle)
            run.on_sample = collector.on_sample
        relax_garbage_collector()
        started = time.monotonic()
        counts = ReplayCounts()
        with (
            _open_output(poses) if poses else nullcontext() as out,
            _open_output(decisions) if decisions else nullcontext() as ledger,
            closing(tracked),
        ):

            def on_decision(decision: Decision) -> None:
                counts.count_decision(decision)
                if ledger is not None:
                    values = to_json(decision) | {"verdict": decision.verdict.name.lower()}
                    ledger.write(json.dumps(values, allow_nan=False) + "\n")
                if collector is not None:
                    collector.on_decision(decision)

            run.on_decision = on_decision
            if out is not None:
                out.write(CSV_HEADER + "\n")
            # without a file of poses none is asked for
            for row in run.rows(times if poses else [], rate):
                if out is not None:
                    out.write(row.to_csv() + "\n")
                counts.count_pose(row)
        wall = time.monotonic() - started
        text = counts.to_text(run, wall, bool(poses))
        on_stderr = "-" in (poses, decisions, report)
        typer.echo(json.dumps(counts.as_data(run, wall)) if as_json else text, err=on_stderr)
        sensors = {each.name for each in CHANNELS if each.use is ChannelUse.SENSOR}
        if ignored := sorted(name for name in run.unconfigured_channels if name[len(prefix) :] in sensors):
            typer.echo(f"not used, since {config} has no sensor on it: {_join_sorted(ignored)}", err=True)
        for sentence in run.axis.describe():
            typer.echo(f"{log}: {sentence}", err=True)
        if times and poses:
            _warn_of_times(times, run, at_times)
        if not run.samples:
            configured = _join_sorted(
                name for name, each in vehicle.sensor_channels().items() if each.type_name != "localization_mode_t"
            )
            raise RecordingError(
                f"{log}: no message on the vehicle's channels ({configured}); "
                f"the log has: {_join_sorted(run.unconfigured_channels)}"
            )
        if collector is not None:
            from mstools.report import replay_report

            replayed = collector.finish(
                log.name, run.first_utime, run.last_utime, run.rejected, channels & seen or seen, run.axis
            )
            with _open_output(report) as out:
                out.write(replay_report.render_page(replayed))
            if not as_json:
                typer.echo("\n".join(replay_report.format_summary(replayed, report)), err=report == "-")
        _report_damage(recording)


@dataclass
class ReplayCounts:
    """Number of poses, of valid ones, of invalid ones by the bits of their reasons; rejected measurements by kind."""

    written: int = 0
    valid: int = 0
    invalid: Counter[int] = field(default_factory=Counter)
    rejected: defaultdict[tuple[str, str], Counter[str]] = field(default_factory=lambda: defaultdict(Counter))

    def count_pose(self, row: TrackRow) -> None:
        self.written += 1
        self.valid += row.valid
        if not row.valid:
            self.invalid[row.invalid] += 1

    def count_decision(self, decision: Decision) -> None:
        if decision.verdict is Verdict.REJECTED:
            self.rejected[f"sensor:{decision.source}", decision.reason or "rejected"][decision.kind] += 1

    def count_reasons(self) -> list[tuple[Invalid, int]]:
        """Return the number of poses with each invalid reason, the most frequent one first."""
        from mstools.report.replay_data import count_reasons

        return count_reasons(self.invalid).most_common()

    def as_data(self, run: OfflineRun, wall: float) -> dict[str, Any]:
        """Return the counts as JSON data; `wall`: duration of the run, seconds."""
        span = (run.last_utime - run.first_utime) * 1e-6
        return {
            "poses": self.written,
            "valid": self.valid,
            "invalid_reasons": {str(flag.name): n for flag, n in self.count_reasons()},
            "events": run.events,
            "samples": run.samples,
            "seconds": span,
            "wall_seconds": wall,
            "real_time_factor": span / wall if wall > 0 else math.nan,
            "rejected": [
                {
                    "source": source,
                    "reason": reason,
                    "count": n,
                    "kinds": dict(sorted(self.rejected[source, reason].items())),
                }
                for (source, reason), n in sorted(run.rejected.items())
            ],
        }

    def to_text(self, run: OfflineRun, wall: float, has_poses: bool) -> str:
        data, head = self.as_data(run, wall), ""
        if has_poses:
            head = f"{format_count(self.written, 'pose')} of {run.frame}, {self.valid} valid"
            if self.valid < self.written:
                mostly = "".join(f", mostly {flag.name}" for flag, _ in self.count_reasons()[:1])
                head += f" (not valid: {self.written - self.valid}{mostly})"
            head += ", from "
        lines = [
            f"{head}{run.samples} of {run.events} messages; "
            f"{data['seconds']:.1f} s in {wall:.2f} s: {data['real_time_factor']:.0f} times real time"
        ]
        for each in data["rejected"]:
            of = ", ".join(kind if n == each["count"] else f"{n} {kind}" for kind, n in each["kinds"].items())
            what = f"{each['count']} of {each['source']}, {each['reason']}{f' ({of})' if of else ''}"
            lines.append(escape(f"  not used: {what}"))
        return "\n".join(lines)


def _warn_of_times(times: list[int], run: OfflineRun, path: Path | None) -> None:
    """Warn if no time lies within the log, with the unit that the times may have."""
    if any(run.first_utime <= each <= run.last_utime for each in times):
        return
    hint = f"the log lasts from {run.first_utime} to {run.last_utime}, in microseconds since 1970"
    if unit := guess_time_unit(times, run.first_utime, run.last_utime):
        hint += f"; these look like {unit}"
    typer.echo(f"modelserver: {path}: none of {format_count(len(times), 'time')} lies within the log: {hint}", err=True)


def read_times(path: Path) -> list[int]:
    """Read a file of times: one utime per line, ascending, with empty lines and # comments.

    Raises RecordingError with the line of an error, OSError.
    """
    try:
        content = read_regular(path, TIMES_LIMIT)
    except FileTooLargeError:
        raise RecordingError(f"{path}: larger than {TIMES_LIMIT >> 20} MiB: is it the file of times?") from None
    times: list[int] = []
    for number, line in enumerate(content.decode("utf-8", errors="replace").split("\n"), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        if not (text.isascii() and text.isdigit()) or not 0 < (utime := int(text[:20])) < 1 << 61:
            raise RecordingError(f"{path}:{number}: {quote(text, 40)} is not a time in microseconds since 1970")
        if times and utime < times[-1]:
            raise RecordingError(f"{path}:{number}: {utime} is before {times[-1]} in the previous line; sort the file")
        times.append(utime)
    if not times:
        raise RecordingError(f"{path}: has no times")
    return times


def _filter_channels(
    events: Iterable[LogEvent], log: Path, channels: frozenset[str], seen: set[str] | None = None
) -> Iterator[LogEvent]:
    """Yield the events of some channels, or of all, and collect their channels in `seen`.

    Raises RecordingError at the end if there were none.
    """
    seen = set() if seen is None else seen
    for event in events:
        seen.add(event.channel)
        if not channels or event.channel in channels:
            yield event
    if channels and channels.isdisjoint(seen):
        near = [name for each in sorted(channels) for name in find_nearest_names(each, seen)]
        hint = f"Nearest: {', '.join(near)}" if near else f"The log has: {_join_sorted(seen)}"
        raise RecordingError(f"{log}: no message on {_join_sorted(channels)}. {hint}")


def _join_sorted(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


def _open_output(path: str) -> AbstractContextManager[TextIO]:
    if path == "-":
        return nullcontext(typer.get_text_stream("stdout"))
    return open_atomic(path, replace=True)


def _check_outputs(targets: dict[str, str], inputs: Iterable[Path]) -> None:
    """Raise RecordingError or ModelServerError for an output that is an input or another output, or not writable."""
    taken: dict[str, str] = {}
    for what, path in targets.items():
        if not path:
            continue
        target = Path(path)
        for each in inputs:
            if path != "-" and target.exists() and each.exists() and target.samefile(each):
                raise RecordingError(f"{path}: is an input of this command; give another file")
        check_writable(path)
        place = os.path.realpath(path)
        if path != "-" and place in taken:
            raise RecordingError(f"{path}: already the file of the {taken[place]}; give another one for the {what}")
        taken[place] = what


def _exclude_service_messages(recording: Iterable[LogEvent]) -> Iterator[LogEvent]:
    """Yield all events but a daemon's messages and requests, which a running daemon publishes itself."""
    return (event for event in recording if not is_of_service(event.data))


def _report_damage(recording: LogFile) -> None:
    for each in recording.damage[:20]:
        typer.echo(escape(f"modelserver: {recording.path}: {each}"), err=True)
    if len(recording.damage) > 20:
        typer.echo(f"modelserver: {recording.path}: {len(recording.damage) - 20} more damaged locations", err=True)
    if recording.is_corrupt:
        raise typer.Exit(1)


def _parse_speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise typer.BadParameter(f"a speed is a number above 0 or max, got {quote(text, 20)}", param_hint="--speed")
    return value


MAX_FIELDS = 12
"""Printed differing fields of a message."""

MAX_FINDINGS = 20


def run_verification(journal: Path, as_json: bool, key: Path | None = None) -> None:
    """Verify a journal and print the result; the exit code is the `VerificationResult`.

    `key`: the vehicle's key file. Without one authenticity is not verified, and a journal that is reproduced bit for
    bit exits with 0.
    """
    from modelserver.key_files import read_keys
    from modelserver.server.journal.verify import VerificationResult, files_of, verify

    keys = () if key is None else read_keys(key)
    files = files_of(journal)
    with show_progress(f"verifying {journal.name}", sum(path.stat().st_size for path in files)) as show:
        found = verify(files, show, keys, journal if journal.is_dir() else None)
    if as_json:
        typer.echo(json.dumps(_as_json(found)))
    else:
        for line in format_result(found, bool(keys)):
            typer.echo(escape(line))
        for finding in found.findings[:MAX_FINDINGS]:
            typer.echo(escape(f"modelserver: {finding}"), err=True)
        if len(found.findings) > MAX_FINDINGS:
            typer.echo(f"modelserver: {len(found.findings) - MAX_FINDINGS} more findings (--json has all)", err=True)
        if found.environment_differences:
            typer.echo(escape(f"modelserver: bits may differ: {'; '.join(found.environment_differences)}"), err=True)
    if found.result is not VerificationResult.REPRODUCED or keys:
        raise typer.Exit(found.result)


def format_result(found: VerificationReport, keyed: bool = False) -> list[str]:
    """Format the result; `keyed`: whether it was verified with a key."""
    span = (found.last_utime - found.first_utime) * 1e-6
    text = [
        f"{format_count(found.segments, 'segment')} of {format_count(found.runs, 'run')}, {found.seconds:.1f} of "
        f"{span:.1f} s ({_format_time(found.first_utime)} to {_format_time(found.last_utime)}), {found.handled} "
        "records replayed"
    ]
    exact, poses = sum(found.reproduced.values()), found.reproduced_poses
    if exact:
        text.append(f"{poses} poses and {exact - poses} other messages are reproduced bit for bit:")
        text += [f"  {name:24} {count:9}" for name, count in sorted(found.reproduced.items()) if count]
    else:
        text.append("nothing is reproduced: it has no sent messages, or no state to start from")
    if found.skipped:
        skipped = format_count(sum(found.skipped.values()), "message")
        text.append(f"not verified: {skipped}, which depend on a state before the journal")
    if found.unverifiable:
        text.append(f"not verified: {found.unverifiable} replies, which may need poses from before the first segment")
    if found.difference is not None:
        text += _format_difference(found.difference)
    text.append(_format_verdict(found, keyed))
    return text


def _format_verdict(found: VerificationReport, keyed: bool) -> str:
    if not found.is_reproduced:
        return "NOT PROVED: see the problems above"
    words = "reproduced bit for bit"
    if found.is_authentic:
        return f"authentic: {words}, sealed with the vehicle's key"
    if not keyed:
        return f"{words}; not proved authentic (--key FILE checks the seals, where the vehicle has a key file)"
    why = "segments may be missing at the end"
    if found.unsealed:
        why = f"{format_count(found.unsealed, 'segment')} of {found.segments} not closed, or not sealed with a key"
    return f"{words}; not proved authentic: {why}"


def _format_time(utime: int) -> str:
    return datetime.fromtimestamp(utime * 1e-6, UTC).strftime("%Y-%m-%d %H:%M:%S") if utime else "-"


def _format_difference(first: Difference) -> list[str]:
    place = f"{first.segment} at byte {first.at}, utime {first.utime} ({_format_time(first.utime)})"
    head = f"NOT REPRODUCED: a message on {first.channel}"
    if first.replayed is None:
        return [f"{head} was published, and is not published now: {place}"]
    if first.recorded is None:
        return [f"{head} is published now, and was not published then: {place}"]
    text = [f"NOT REPRODUCED: {first.channel} differs: {place}"]
    fields = find_differences(first.recorded, first.replayed)
    text += [f"  {name}: was {was}, is {now}" for name, was, now in fields[:MAX_FIELDS]]
    if len(fields) > MAX_FIELDS:
        text.append(f"  and {len(fields) - MAX_FIELDS} more fields")
    return text


def find_differences(was: bytes, now: bytes) -> list[tuple[str, str, str]]:
    """Return name and both values of the fields that differ; for a message that cannot be decoded its length."""
    from modelserver.server.journal.verify import diff_messages

    found = diff_messages(was, now)
    if found is None:
        return [("type or content", f"{len(was)} bytes {was[:12].hex()}", f"{len(now)} bytes {now[:12].hex()}")]
    return [(each.name, _format_value(each.recorded), _format_value(each.replayed)) for each in found] or [
        ("bits", "nan or zero", "another nan or zero")
    ]


def _format_value(value: Any) -> str:
    return f"{len(value)} items" if isinstance(value, (list, tuple)) else repr(value)


def _as_json(found: VerificationReport) -> dict[str, Any]:
    first, fields = found.difference, []
    if first is not None and first.recorded is not None and first.replayed is not None:
        fields = find_differences(first.recorded, first.replayed)
    return {
        "result": found.result.name.lower(),
        "proved": found.is_reproduced,
        "authentic": found.is_authentic,
        "genuine_segments": found.genuine,
        "segments": found.segments,
        "runs": found.runs,
        "seconds": found.seconds,
        "span": (found.last_utime - found.first_utime) * 1e-6,
        "records": found.handled,
        "poses": found.reproduced_poses,
        "exact": dict(sorted(found.reproduced.items())),
        "skipped": sum(found.skipped.values()),
        "old_replies": found.unverifiable,
        "lost": found.lost,
        "findings": [{"segment": str(e.segment), "text": e.text, "damage": e.is_damage} for e in found.findings],
        "other": found.environment_differences,
        "difference": first
        and {
            "segment": str(first.segment),
            "byte": first.at,
            "utime": first.utime,
            "channel": first.channel,
            "fields": [{"field": name, "was": was, "is": now} for name, was, now in fields],
        },
    }
