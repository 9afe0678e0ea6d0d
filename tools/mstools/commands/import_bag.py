"""`modelserver import-bag`: a ROS bag becomes an LCM event log of this project's types."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import lcm
import typer

from modelserver.errors import RecordingError, nearest_names, shown
from modelserver.messages import MAX_CHANNEL_LENGTH, SensorHeader
from modelserver.wire import codec
from mstools.recordings.bag_messages import (
    DEFAULTS,
    ROS_TYPES,
    Altitude,
    Converter,
    ImuOrientation,
    Options,
    TopicKind,
    converter,
)
from mstools.recordings.bag_reader import Bag, Topic, open_bag
from mstools.terminal.output import check_target, safe
from mstools.terminal.progress import progress


def command(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="ROS 1 file, or folder of a ROS 2 recording.")],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="LCM event log to write.")],
    topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TOPIC=KIND",
            help="What a topic becomes: gps, imu, wheels or joints. Without, the busiest topic of each type is taken.",
        ),
    ] = None,
    altitude: Annotated[
        Altitude, typer.Option(help="What the altitudes of fixes are measured from. ROS prescribes the ellipsoid.")
    ] = Altitude.ELLIPSOIDAL,
    undulation: Annotated[
        float, typer.Option(help="Geoid's height above the ellipsoid, metres; with --altitude msl.")
    ] = math.nan,
    imu_orientation: Annotated[
        ImuOrientation,
        typer.Option(help="What the unit's own orientation is measured against; a bag does not say. none: leave out."),
    ] = ImuOrientation.NONE,
    track_width: Annotated[
        float, typer.Option(help="Distance of the two virtual wheels that odometry becomes, metres.")
    ] = 0.555,
    prefix: Annotated[str, typer.Option(help="Put before each channel's name.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace LOG if there is one.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Turn a ROS bag into an LCM log of this project's types.

    NavSatFix becomes GPS, Imu IMU, Odometry WHEELS, JointState JOINTS. A message's stamp is taken for the
    instant of measurement; the log's own times are those at which the recorder received it. What a bag
    leaves open is asked for by options; docs/recordings.md says why.

    \b
    Example:
      modelserver import-bag drive.bag drive.lcm
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --poses poses.csv
    """
    if not (math.isfinite(track_width) and 0.0 < track_width < 100.0):
        raise typer.BadParameter(f"a track width is above 0 and below 100 m, got {track_width:g}")
    if math.isfinite(undulation) and altitude is not Altitude.MSL:
        raise typer.BadParameter("--undulation goes with --altitude msl")
    if any(not (c.isascii() and (c.isalnum() or c == "_")) for c in prefix) or len(prefix) > MAX_CHANNEL_LENGTH - 16:
        raise typer.BadParameter(f"a prefix has letters, digits and underscores, got {shown(prefix)}")
    check_target(str(log))
    options = Options(altitude, undulation, imu_orientation, track_width)
    report = import_bag(bag, log, options, _kinds(topic or ()), prefix, force)
    typer.echo(json.dumps(dataclasses.asdict(report), indent=2) if as_json else report.text())


def _kinds(pairs: Iterable[str]) -> dict[str, TopicKind]:
    wanted: dict[str, TopicKind] = {}
    for pair in pairs:
        name, _, kind = pair.rpartition("=")
        if not name or kind not in list(TopicKind):
            raise typer.BadParameter(f"--topic takes TOPIC=gps, imu, wheels or joints, got {shown(pair)}")
        wanted[name] = TopicKind(kind)
    return wanted


@dataclass(slots=True)
class TopicReport:
    """What became of one topic: how many messages were written, or why none was."""

    topic: str
    type_name: str
    channel: str = ""
    written: int = 0
    skipped: str = ""
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Report:
    """What an import did."""

    log: str
    topics: list[TopicReport]
    seconds: float = 0.0

    def text(self) -> str:
        """Return the report for a person."""
        total = sum(each.written for each in self.topics)
        lines = [f"{self.log}: {total} messages, {self.seconds:.1f} s"]
        for each in self.topics:
            what = f"{each.channel}: {each.written} messages" if each.channel else f"skipped: {each.skipped}"
            lines.append(safe(f"  {each.topic} ({each.type_name}) -> {what}"))
            lines.extend(safe(f"    note: {note}") for note in each.notes)
        return "\n".join(lines)


def import_bag(
    bag_path: Path,
    log_path: Path,
    options: Options = DEFAULTS,
    kinds: Mapping[str, TopicKind] | None = None,
    prefix: str = "",
    force: bool = False,
) -> Report:
    """Write the log of a bag; see `command`. `kinds` says what topics become, by name.

    The log appears when it is whole: it is written under another name beside, and renamed. Raises
    RecordingError for a bag that cannot be read or holds nothing of use, or a log that exists; OSError.
    """
    if log_path.exists() and not force:
        raise RecordingError(f"{log_path}: exists already; --force replaces it")
    if log_path.is_dir():
        raise RecordingError(f"{log_path}: is a folder; name a file in it")
    if not log_path.parent.is_dir():
        raise RecordingError(f"{log_path}: there is no folder {log_path.parent}")
    with open_bag(bag_path) as bag:
        chosen, reports = choose_topics(bag.topics, dict(kinds or {}), str(bag_path))
        part = log_path.with_name(f".{log_path.name}.{os.getpid()}.part")
        try:
            seconds = _write(bag, part, chosen, reports, options, prefix)
            os.replace(part, log_path)
        finally:
            part.unlink(missing_ok=True)
    return Report(str(log_path), list(reports.values()), seconds)


def choose_topics(
    topics: Iterable[Topic], kinds: dict[str, TopicKind], bag: str
) -> tuple[dict[str, TopicKind], dict[str, TopicReport]]:
    """Return what each chosen topic becomes, and the beginning of the report on every topic.

    Topics named in `kinds` go first; for the other kinds the busiest topic of the right type is taken.
    Raises RecordingError where a named topic is missing or of another type, or nothing is left to convert.
    """
    known = {each.name: each for each in topics}
    chosen: dict[str, TopicKind] = {}
    for name, kind in kinds.items():
        if name not in known:
            near = nearest_names(name, known)
            offer = f"Nearest: {', '.join(near)}" if near else f"It has: {', '.join(known) or 'no topics'}"
            raise RecordingError(f"{bag}: no topic {shown(name)}. {offer}")
        if ROS_TYPES.get(known[name].type_name) is not kind:
            raise RecordingError(f"{bag}: topic {name} is of type {known[name].type_name}, which is no {kind}")
        if kind in chosen.values():
            raise RecordingError(f"{bag}: two topics are to be {kind}; one source goes into a log")
        chosen[name] = kind
    reports = {name: TopicReport(name, each.type_name) for name, each in known.items()}
    for each in sorted(known.values(), key=lambda each: (-each.count, each.name)):
        found = ROS_TYPES.get(each.type_name)
        if each.name in chosen:
            continue
        if found is None:
            reports[each.name].skipped = "nothing in this project takes this type"
        elif each.count == 0:
            reports[each.name].skipped = "no messages"
        elif found in chosen.values():
            taken = next(name for name, kind in chosen.items() if kind is found)
            reports[each.name].skipped = f"{taken} is the {found} source; --topic {each.name}={found} takes this one"
        else:
            chosen[each.name] = found
    if not chosen:
        types = ", ".join(name.replace("/msg/", "/") for name in ROS_TYPES)
        raise RecordingError(f"{bag}: holds no messages of {types}")
    return chosen, reports


def _write(
    bag: Bag,
    path: Path,
    chosen: Mapping[str, TopicKind],
    reports: Mapping[str, TopicReport],
    options: Options,
    prefix: str,
) -> float:
    """Write the messages of the chosen topics; return the seconds between the first and the last."""
    converters: dict[str, Converter] = {name: converter(kind, options) for name, kind in chosen.items()}
    unstamped = dict.fromkeys(chosen, 0)
    total = sum(each.count for each in bag.topics if each.name in chosen)
    for name, kind in chosen.items():
        reports[name].channel = f"{prefix}{kind.upper()}"
    first = last = 0
    done = 0
    out = lcm.EventLog(str(path), "w", overwrite=True)
    try:
        with progress(f"importing {path.name.strip('.')}", total) as show:
            for received in bag.messages(set(chosen)):
                report = reports[received.topic]
                arrived = received.received_ns // 1000
                stamp = received.message.header.stamp
                utime = int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000
                if utime <= 0:
                    utime = arrived
                    unstamped[received.topic] += 1
                header = SensorHeader(utime, chosen[received.topic].value, report.written, arrived)
                sample = converters[received.topic].convert(header, received.message)
                out.write_event(arrived, report.channel, codec.encode(sample))
                report.written += 1
                first, last = first or arrived, arrived
                done += 1
                if done % 512 == 0:
                    show(done)
    finally:
        out.close()
    if not done:
        raise RecordingError("the bag holds no messages")
    for name, each in converters.items():
        reports[name].notes += each.notes()
        if unstamped[name]:
            reports[name].notes.append(f"{unstamped[name]} messages without a stamp took the time they were received")
    return (last - first) * 1e-6
