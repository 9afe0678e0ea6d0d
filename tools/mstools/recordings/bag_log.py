"""Conversion of a ROS bag, or an exported MCAP file, to an LCM event log of this project's types."""

from __future__ import annotations

import shutil
import statistics
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import lcm

from modelserver.errors import RecordingError, find_nearest_names, quote
from modelserver.formats import save_model
from modelserver.messages import JointsSample, SensorHeader
from modelserver.server.journal.writer import list_segments
from modelserver.server.recordings import LARGEST_DELAY_S, LOOKED_AT, StampAxis
from modelserver.wire import codec
from mstools.recordings.bags import (
    CONVERTERS,
    DEFAULT_OPTIONS,
    ROS_TYPES,
    TF_TYPES,
    Bag,
    BagOptions,
    TfTree,
    Topic,
    TopicKind,
    is_lcm_mcap,
    open_bag,
    open_mcap,
    read_stamp,
)
from mstools.terminal.output import check_writable, escape, show_progress, write_beside, write_file

BAG_BEGINNINGS: Final = (b"#ROSBAG V", b"\x89MCAP0\r\n")
BEGINNING: Final = 16
"""Bytes read of a file to recognize it: more than each of these, and those of an LCM log."""

BAG_SUFFIXES: Final = (".bag", ".mcap")


@contextmanager
def open_lcm_log(path: Path) -> Iterator[Path]:
    """Give the LCM log of a recording: itself, or a temporary one for a journal, a bag or an MCAP file.

    Raises RecordingError for what is no recording, OSError.
    """
    if path.is_file() and not _is_bag(path):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="modelserver-") as folder:
        log = Path(folder) / f"{path.stem}.lcm"
        if path.is_dir() and (segments := list_segments(path)):
            with log.open("wb") as out:
                for each in segments:
                    with each.open("rb") as file:
                        shutil.copyfileobj(file, out)
        else:
            import_bag(path, log)
        yield log


def _is_bag(path: Path) -> bool:
    with path.open("rb") as file:
        return path.suffix in BAG_SUFFIXES or file.read(BEGINNING).startswith(BAG_BEGINNINGS)


@dataclass(slots=True)
class TopicReport:
    """Result of one topic: the number of written messages and why it was chosen, or why it was skipped."""

    topic: str
    type_name: str
    kind: str = ""
    chosen: str = ""
    channel: str = ""
    written: int = 0
    skipped: str = ""
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class ImportReport:
    """Result of an import, or without a log of the choice of topics; `geometry` is the geometry file written."""

    log: str
    topics: list[TopicReport]
    seconds: float = 0.0
    geometry: str = ""

    def to_text(self) -> str:
        total = sum(each.written for each in self.topics)
        lines = [f"{self.log}: {total} messages, {self.seconds:.1f} s"] if self.log else []
        for each in self.topics:
            what = f"{each.channel or each.kind}, {each.chosen}" if each.chosen else f"skipped: {each.skipped}"
            if each.channel:
                what += f": {each.written} messages"
            lines.append(escape(f"  {each.topic} ({each.type_name}) -> {what}"))
            lines.extend(escape(f"    note: {note}") for note in each.notes)
        if self.geometry:
            lines.append(escape(f"written: {self.geometry}"))
        return "\n".join(lines)


def import_bag(
    bag_path: Path,
    log_path: Path,
    options: BagOptions = DEFAULT_OPTIONS,
    kinds: Mapping[str, TopicKind] | None = None,
    prefix: str = "",
    force: bool = False,
    geometry: Path | None = None,
) -> ImportReport:
    """Write the log of a bag atomically, and the `geometry` of its tf; see `command`. `kinds`: of topics by name.

    Raises RecordingError for a bag that cannot be read or has nothing to convert, or a log that exists; OSError.
    """
    if log_path.exists() and not force:
        raise RecordingError(f"{log_path}: already exists; --force replaces it")
    check_writable(str(log_path))
    with write_beside(log_path) as part:
        if is_lcm_mcap(bag_path):
            reports, seconds = _copy_messages(bag_path, part, prefix, bool(kinds))
        else:
            with open_bag(bag_path) as bag:
                has_tf = geometry is not None
                chosen, of_topic = choose_topics(bag.topics, dict(kinds or {}), str(bag_path), has_tf=has_tf)
                tree = _read_tf(bag, of_topic) if has_tf else TfTree()
                text = save_model(tree.build_model(bag_path.stem), "yaml").text if has_tf else ""
                seconds = _write(bag, part, chosen, of_topic, options, prefix, tree)
                reports = list(of_topic.values())
            if geometry is not None:
                write_file(str(geometry), text, replace=force)
    return ImportReport(str(log_path), reports, seconds, "" if geometry is None else str(geometry))


def _read_tf(bag: Bag, reports: Mapping[str, TopicReport]) -> TfTree:
    """Return the frames of a bag, and note those with two parents at their topic."""
    tree = TfTree()
    of_tf = {name for name, each in reports.items() if each.kind == TF}
    for name, _, message in bag.messages(of_tf):
        tree.add(message)
        reports[name].written += 1
    if tree.conflicts:
        note = f"frames with two parents, of which the last counts: {', '.join(tree.conflicts)}"
        for name in of_tf:
            reports[name].notes.append(note)
    return tree


def _copy_messages(mcap_path: Path, path: Path, prefix: str, has_kinds: bool) -> tuple[list[TopicReport], float]:
    """Write the LCM messages of an MCAP file; return the reports and the seconds between the first and the last."""
    with open_mcap(mcap_path) as mcap:
        reports = {
            name: TopicReport(f"/lcm/{name}", type_name, chosen="as it is", channel=f"{prefix}{name}")
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
        total = sum(count for _, count in mcap.channels.values())
        with (
            closing(lcm.EventLog(str(path), "w", overwrite=True)) as out,
            show_progress(f"importing {mcap_path.name}", total) as show,
        ):
            for number, (utime, channel, data) in enumerate(mcap.read(), 1):
                report = reports[channel]
                out.write_event(utime, report.channel, data)
                report.written += 1
                first, last = first or utime, utime
                if number % 512 == 0:
                    show(number)
    return list(reports.values()), (last - first) * 1e-6


TF: Final = "tf"
"""Kind of the topics of transforms, which become geometry and joints."""


def choose_topics(
    topics: Iterable[Topic], kinds: dict[str, TopicKind], bag: str, *, has_tf: bool = False
) -> tuple[dict[str, TopicKind], dict[str, TopicReport]]:
    """Return the type of each chosen topic, and the initial report of every topic.

    Topics in `kinds` come first; for the other types the busiest matching topic is chosen, before it those that do not
    look like the output of an estimator. `has_tf`: whether transforms are read too. Raises RecordingError if a named
    topic is missing or of another type, or there is nothing to convert.
    """
    known = {each.name: each for each in topics}
    chosen: dict[str, TopicKind] = {}
    reports = {name: TopicReport(name, each.type_name) for name, each in known.items()}
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
        reports[name].kind, reports[name].chosen = kind, "as --topic gives it"
    taken = {kind: name for name, kind in chosen.items()}
    for each in sorted(known.values(), key=lambda each: (bool(each.estimator), -each.count, each.name)):
        found, report = ROS_TYPES.get(each.type_name), reports[each.name]
        if each.name in chosen:
            continue
        if each.type_name in TF_TYPES:
            report.kind = TF
            report.chosen, report.skipped = ("geometry", "") if has_tf else ("", "--geometry FILE takes its frames")
        elif found is None:
            report.skipped = "unsupported type"
        elif each.count == 0:
            report.skipped = "no messages"
        elif taken.setdefault(found, each.name) != each.name:
            why = f"; this looks like an estimator's output ({each.estimator})" if each.estimator else ""
            report.skipped = f"{taken[found]} is the {found} source{why}; --topic {found}={each.name} selects this one"
        else:
            chosen[each.name] = found
            several = sum(ROS_TYPES.get(other.type_name) is found and other.count > 0 for other in known.values()) > 1
            report.kind, report.chosen = found, "the busiest that no estimator makes" if several else "the only one"
            if each.estimator:
                report.chosen = "the busiest" if several else "the only one"
                looks = f"this looks like an estimator's output ({each.estimator}), whose errors last"
                report.notes.append(f"{looks}: record the sensor itself")
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
    tree: TfTree,
) -> float:
    """Write the messages of the chosen topics and the joints of `tree`; return the seconds from first to last."""
    converters = {name: CONVERTERS[kind](options) for name, kind in chosen.items()}
    unstamped = dict.fromkeys(chosen, 0)
    offsets: dict[str, list[float]] = {name: [] for name in chosen}
    moving = {name for name, each in reports.items() if each.kind == TF} if tree.has_joints else set()
    total = sum(each.count for each in bag.topics if each.name in chosen or each.name in moving)
    for name, kind in chosen.items():
        reports[name].channel = f"{prefix}{kind.upper()}"
    first = last = done = num_joints = 0
    with (
        closing(lcm.EventLog(str(path), "w", overwrite=True)) as out,
        show_progress(f"importing {path.name}", total) as show,
    ):
        for name, received_ns, message in bag.messages(chosen.keys() | moving):
            report = reports[name]
            arrived = received_ns // 1000
            if name in moving:
                for stamp, joints in tree.read_joints(message):
                    header = SensorHeader(stamp or arrived, TF, num_joints, arrived)
                    out.write_event(arrived, f"{prefix}JOINTS", codec.encode(JointsSample(header, joints)))
                    num_joints += 1
                continue
            utime = read_stamp(message)
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
