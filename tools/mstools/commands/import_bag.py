"""`modelserver import-bag`: convert a ROS bag to an LCM event log of this project's types."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import statistics
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import lcm
import typer

from modelserver.errors import RecordingError, find_nearest_names, quote
from modelserver.files.regular import check_links
from modelserver.messages import MAX_CHANNEL_LENGTH, SensorHeader
from modelserver.server.stamp_axis import LARGEST_DELAY_S, LOOKED_AT, StampAxis
from modelserver.wire import codec
from mstools.recordings.bags import (
    CONVERTERS,
    DEFAULT_OPTIONS,
    ROS_TYPES,
    Altitude,
    Bag,
    BagOptions,
    ImuOrientation,
    Topic,
    TopicKind,
    is_lcm_mcap,
    open_bag,
    open_mcap,
)
from mstools.terminal.options import JsonOption, argument, option
from mstools.terminal.output import check_writable, escape
from mstools.terminal.progress import show_progress


def command(
    bag: Annotated[Path, argument("BAG", "ROS 1 file, folder of a ROS 2 recording, or MCAP file of export.")],
    log: Annotated[Path, argument("LOG", "LCM event log to write.")],
    topic: Annotated[
        list[str] | None,
        option(
            "--topic TOPIC=KIND",
            "Type of a topic: gps, imu, wheels or joints. Default: the busiest topic of each type.",
        ),
    ] = None,
    altitude: Annotated[
        Altitude, option("--altitude", "Reference of the fixes' altitudes. ROS prescribes the ellipsoid.")
    ] = Altitude.ELLIPSOIDAL,
    undulation: Annotated[
        float, option("--undulation", "Geoid's height above the ellipsoid, meters; with --altitude msl.")
    ] = math.nan,
    imu_orientation: Annotated[
        ImuOrientation,
        option("--imu-orientation", "Reference of the IMU's orientation, which a bag does not state. none: drop it."),
    ] = ImuOrientation.NONE,
    track_width: Annotated[
        float, option("--track-width", "Distance of the two virtual wheels from odometry, meters.")
    ] = 0.555,
    prefix: Annotated[str, option("--prefix", "Prefix of the channels.")] = "",
    force: Annotated[bool, option("--force", "Replace LOG if it exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Convert a ROS bag to an LCM log of this project's types, or an exported MCAP file back to its log.

    NavSatFix becomes GPS, Imu IMU, Odometry WHEELS, JointState JOINTS. A message's stamp is used as the time of
    measurement; the times of the log are the recorder's receive times. Options give what a bag does not state;
    docs/recordings.md explains them.

    \b
    Example:
      modelserver import-bag drive.bag drive.lcm
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --poses poses.csv
    """
    if not 0.0 < track_width < 100.0:
        raise typer.BadParameter(f"a track width must be above 0 and below 100 m, got {track_width:g}")
    if math.isfinite(undulation) and altitude is not Altitude.MSL:
        raise typer.BadParameter("--undulation goes with --altitude msl")
    if any(not (c.isascii() and (c.isalnum() or c == "_")) for c in prefix) or len(prefix) > MAX_CHANNEL_LENGTH - 16:
        raise typer.BadParameter(f"a prefix consists of letters, digits and underscores, got {quote(prefix)}")
    check_writable(str(log))
    options = BagOptions(altitude, undulation, imu_orientation, track_width)
    kinds: dict[str, TopicKind] = {}
    for pair in topic or ():
        name, _, kind = pair.rpartition("=")
        if not name or kind not in list(TopicKind):
            raise typer.BadParameter(f"--topic takes TOPIC=gps, imu, wheels or joints, got {quote(pair)}")
        kinds[name] = TopicKind(kind)
    report = import_bag(bag, log, options, kinds, prefix, force)
    typer.echo(json.dumps(dataclasses.asdict(report), indent=2) if as_json else report.to_text())


@dataclass(slots=True)
class TopicReport:
    """Result of one topic: the number of written messages, or why it was skipped."""

    topic: str
    type_name: str
    channel: str = ""
    written: int = 0
    skipped: str = ""
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class ImportReport:
    """Result of an import."""

    log: str
    topics: list[TopicReport]
    seconds: float = 0.0

    def to_text(self) -> str:
        """Format the report."""
        total = sum(each.written for each in self.topics)
        lines = [f"{self.log}: {total} messages, {self.seconds:.1f} s"]
        for each in self.topics:
            what = f"{each.channel}: {each.written} messages" if each.channel else f"skipped: {each.skipped}"
            lines.append(escape(f"  {each.topic} ({each.type_name}) -> {what}"))
            lines.extend(escape(f"    note: {note}") for note in each.notes)
        return "\n".join(lines)


def import_bag(
    bag_path: Path,
    log_path: Path,
    options: BagOptions = DEFAULT_OPTIONS,
    kinds: Mapping[str, TopicKind] | None = None,
    prefix: str = "",
    force: bool = False,
) -> ImportReport:
    """Write the log of a bag atomically; see `command`. `kinds`: the type of topics by name.

    Raises RecordingError for a bag that cannot be read or has nothing to convert, or a log that exists; OSError.
    """
    if log_path.exists() and not force:
        raise RecordingError(f"{log_path}: already exists; --force replaces it")
    if log_path.is_dir():
        raise RecordingError(f"{log_path}: is a folder; give a file in it")
    if not log_path.parent.is_dir():
        raise RecordingError(f"{log_path}: missing folder {log_path.parent}")
    check_links(log_path)
    with tempfile.TemporaryDirectory(prefix=f".{log_path.name}.", dir=log_path.parent) as draft:
        part = Path(draft) / log_path.name
        if is_lcm_mcap(bag_path):
            reports, seconds = _copy_messages(bag_path, part, prefix, bool(kinds))
        else:
            with open_bag(bag_path) as bag:
                chosen, of_topic = choose_topics(bag.topics, dict(kinds or {}), str(bag_path))
                seconds = _write(bag, part, chosen, of_topic, options, prefix)
                reports = list(of_topic.values())
        os.replace(part, log_path)
    return ImportReport(str(log_path), reports, seconds)


def _copy_messages(mcap_path: Path, path: Path, prefix: str, has_kinds: bool) -> tuple[list[TopicReport], float]:
    """Write the LCM messages of an MCAP file; return the reports and the seconds between the first and the last."""
    with open_mcap(mcap_path) as mcap:
        reports = {
            name: TopicReport(f"/lcm/{name}", type_name, f"{prefix}{name}")
            for name, (type_name, _) in mcap.channels.items()
        }
        if not reports:
            raise RecordingError(
                f"{mcap_path}: no LCM messages (/lcm/...), and none of ROS 2; modelserver export writes those of LCM "
                "without --no-raw"
            )
        if has_kinds:
            raise RecordingError(f"{mcap_path}: --topic goes with a ROS bag; this file has the messages as they were")
        first = last = 0
        out = lcm.EventLog(str(path), "w", overwrite=True)
        try:
            with show_progress(
                f"importing {mcap_path.name}", sum(count for _, count in mcap.channels.values())
            ) as show:
                for number, (utime, channel, data) in enumerate(mcap.read(), 1):
                    report = reports[channel]
                    out.write_event(utime, report.channel, data)
                    report.written += 1
                    first, last = first or utime, utime
                    if number % 512 == 0:
                        show(number)
        finally:
            out.close()
    return list(reports.values()), (last - first) * 1e-6


def choose_topics(
    topics: Iterable[Topic], kinds: dict[str, TopicKind], bag: str
) -> tuple[dict[str, TopicKind], dict[str, TopicReport]]:
    """Return the type of each chosen topic, and the initial report of every topic.

    Topics in `kinds` come first; for the other types the busiest matching topic is chosen.
    Raises RecordingError if a named topic is missing or of another type, or there is nothing to convert.
    """
    known = {each.name: each for each in topics}
    chosen: dict[str, TopicKind] = {}
    for name, kind in kinds.items():
        if name not in known:
            near = find_nearest_names(name, known)
            offer = f"Nearest: {', '.join(near)}" if near else f"It has: {', '.join(known) or 'no topics'}"
            raise RecordingError(f"{bag}: no topic {quote(name)}. {offer}")
        if ROS_TYPES.get(known[name].type_name) is not kind:
            raise RecordingError(f"{bag}: topic {name} is of type {known[name].type_name}, which is no {kind}")
        if kind in chosen.values():
            raise RecordingError(f"{bag}: two topics for {kind}; a log has one source of each type")
        chosen[name] = kind
    reports = {name: TopicReport(name, each.type_name) for name, each in known.items()}
    taken = {kind: name for name, kind in chosen.items()}
    for each in sorted(known.values(), key=lambda each: (-each.count, each.name)):
        found = ROS_TYPES.get(each.type_name)
        if each.name in chosen:
            continue
        if found is None:
            reports[each.name].skipped = "unsupported type"
        elif each.count == 0:
            reports[each.name].skipped = "no messages"
        elif taken.setdefault(found, each.name) != each.name:
            other = f"{taken[found]} is the {found} source"
            reports[each.name].skipped = f"{other}; --topic {each.name}={found} selects this one"
        else:
            chosen[each.name] = found
    if not chosen:
        types = ", ".join(name.replace("/msg/", "/") for name in ROS_TYPES)
        raise RecordingError(f"{bag}: no messages of {types}")
    return chosen, reports


def _write(
    bag: Bag,
    path: Path,
    chosen: Mapping[str, TopicKind],
    reports: Mapping[str, TopicReport],
    options: BagOptions,
    prefix: str,
) -> float:
    """Write the messages of the chosen topics; return the seconds between the first and the last."""
    converters = {name: CONVERTERS[kind](options) for name, kind in chosen.items()}
    unstamped = dict.fromkeys(chosen, 0)
    offsets: dict[str, list[float]] = {name: [] for name in chosen}
    total = sum(each.count for each in bag.topics if each.name in chosen)
    for name, kind in chosen.items():
        reports[name].channel = f"{prefix}{kind.upper()}"
    first = last = done = 0
    out = lcm.EventLog(str(path), "w", overwrite=True)
    try:
        with show_progress(f"importing {path.name}", total) as show:
            for name, received_ns, message in bag.messages(set(chosen)):
                report = reports[name]
                arrived = received_ns // 1000
                stamp = message.header.stamp
                utime = int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000
                if utime <= 0:
                    utime = arrived
                    unstamped[name] += 1
                elif len(offsets[name]) < LOOKED_AT:
                    offsets[name].append((utime - arrived) * 1e-6)
                header = SensorHeader(utime, chosen[name].value, report.written, arrived)
                try:
                    sample = converters[name].convert(header, message)
                except AttributeError as error:
                    raise RecordingError(
                        f"topic {name}: {error}: the file defines {report.type_name} otherwise than ROS does: "
                        "it is damaged, or this is another type of that name"
                    ) from None
                out.write_event(arrived, report.channel, codec.encode(sample))
                report.written += 1
                first, last = first or arrived, arrived
                done += 1
                if done % 512 == 0:
                    show(done)
    finally:
        out.close()
    if not done:
        raise RecordingError("the bag has no messages")
    axis = StampAxis({name: statistics.median(values) for name, values in offsets.items() if values}, last * 1e-6)
    for name, each in converters.items():
        reports[name].notes += each.notes()
        offset = axis.by_channel.get(name, 0.0)
        if abs(offset) > LARGEST_DELAY_S:
            whose = "all stamps are" if axis.common else "the stamps of this source alone are"
            reports[name].notes.append(f"{whose} {axis.format(offset)} their receipt")
        if unstamped[name]:
            reports[name].notes.append(f"{unstamped[name]} messages without a stamp got their receive time")
    return (last - first) * 1e-6
