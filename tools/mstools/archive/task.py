"""One log of an archive as a task: it is read, replayed through the localization, and its result written as Parquet.

    log -> LogFile -> OfflineRun -> poses, decisions, samples -> DriveReplay -> TableWriter -> Storage.commit

A log is streamed: what is in memory is the localization's state, rows of a row group, and the samples of a window of
`WINDOW_S`, over which findings and metrics are computed as a replay's report does. The result depends on the task's
values and the log's bytes alone, so that it is the same on each worker, and once more the same after an interruption.
"""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from modelserver.errors import ModelServerError, RecordingError
from modelserver.estimation.history import Localizer
from modelserver.formats import save_model
from modelserver.messages import Decision, Event, Invalid, Verdict
from modelserver.server.recordings import OfflineRun, TrackRow, relax_garbage_collector
from modelserver.server.vehicle import Vehicle
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools.archive.logs import fetch, identify
from mstools.archive.storage import UNREAD, Storage, digest
from mstools.archive.tables import SCHEMA_VERSION, ArchiveError, TableWriter
from mstools.recordings.bag_log import open_lcm_log
from mstools.report.findings import collect_findings, has_nis, is_position_reset
from mstools.report.replay_data import ReplayCollector, count_reasons, integrate_distance

WINDOW_S: Final = 600.0
"""Length of the windows of findings and metrics, seconds: ten minutes have turns and stops enough for the findings, and
their samples are some 100 MB at 200 Hz."""

MAX_ERRORS: Final = 10
"""Errors of a log that its row has."""


@dataclass(frozen=True)
class Task:
    """A log to archive in `out`. `settings`: digest of vehicle file, geometry, rate and code.

    `present`: names of its results there.
    """

    log: str
    vehicle: Vehicle
    rate: float
    settings: str
    out: str
    present: tuple[str, ...] = ()


class LogOutcome(NamedTuple):
    """What became of a log. `state`: written, unchanged or failed, with its `error`; `size` in bytes.

    `seconds` of the log, `cpu` of processor time for them.
    """

    log: str
    state: str
    size: int = 0
    seconds: float = 0.0
    cpu: float = 0.0
    error: str = ""


def digest_settings(vehicle: Vehicle, rate: float, code: str) -> str:
    """Return a digest of all that the results of a vehicle depend on, wherever its files are."""
    config = replace(vehicle.config, geometry="", state_directory="")
    return digest(repr(config), save_model(vehicle.model, "yaml").text, repr(rate), code, str(SCHEMA_VERSION))


def name_result(log: str, key: str) -> str:
    return f"{digest(log)}-{key}"


def run_task(task: Task) -> LogOutcome:
    """Write the result of a log unless it is there; a log that cannot be read is a row with its error.

    Raises ArchiveError where the archive cannot be written.
    """
    started = time.process_time()
    try:
        content = identify(task.log)
        name = name_result(task.log, digest(content, task.settings))
        if name in task.present:
            return LogOutcome(task.log, "unchanged")
        relax_garbage_collector()
        with fetch(task.log) as path, Storage(task.out).draft(name, task.present) as folder:
            found = _write(task, folder, path, content)
    except OSError as error:
        return write_error(task, f"cannot be read: {error.strerror or error}")
    return found._replace(cpu=time.process_time() - started)


def write_error(task: Task, error: str) -> LogOutcome:
    """Write the row of a log that could not be read, or whose workers ended. Raises ArchiveError."""
    name = name_result(task.log, UNREAD)
    with Storage(task.out).draft(name, task.present) as folder, TableWriter(folder, task.log) as tables:
        tables.add_drive("", task.vehicle.config.vehicle, 0, 0.0, 0.0, 0, 0, 0, 0, 0, error)
    return LogOutcome(task.log, "failed", error=error)


def _write(task: Task, folder: Path, path: Path, content: str) -> LogOutcome:
    errors: list[str] = []
    size = 0
    with TableWriter(folder, task.log) as tables:
        replay = DriveReplay(task.vehicle, task.rate, tables)
        try:
            with open_lcm_log(path) as found, LogFile(found) as log:
                size = log.size
                try:
                    replay.run(log)
                finally:
                    errors += [str(each) for each in log.damage]
        except ArchiveError:
            raise
        except ModelServerError as error:
            errors.append(str(error).removeprefix(f"{path}: ").replace(str(path), task.log))
        replay.write_drive(content, size, "; ".join(errors[:MAX_ERRORS]))
    return LogOutcome(
        task.log, "failed" if errors else "written", size, replay.seconds, error="; ".join(errors[:MAX_ERRORS])
    )


class DriveReplay:
    """Replays a log and writes the rows of its poses, decisions, events, metrics and rejections."""

    def __init__(self, vehicle: Vehicle, rate: float, tables: TableWriter):
        self._vehicle, self._rate, self._tables = vehicle, rate, tables
        self._run: OfflineRun | None = None
        self._channels: set[str] = set()
        self._rejected: Mapping[tuple[str, str], int] = {}
        self._invalid: tuple[int, Invalid] | None = None
        self._distance = 0.0
        self._poses = self._valid = self._begin = 0
        self._open_window(0)

    @property
    def seconds(self) -> float:
        """The time between first and last event."""
        return 0.0 if self._run is None else max(self._run.last_utime - self._run.first_utime, 0) * 1e-6

    def run(self, log: LogFile) -> None:
        """Replay a log to its end. Raises RecordingError, OSError, ArchiveError."""
        vehicle = self._vehicle
        run = self._run = OfflineRun(vehicle, self._watch(log), vehicle.config.base_frame)
        run.on_decision, run.on_sample = self._on_decision, self._on_sample
        last = 0
        try:
            for row in run.rows(None, self._rate):
                if not self._begin:
                    self._begin = row.utime
                if row.utime >= self._begin + WINDOW_S * 1e6:
                    self._close_window(row.utime)
                    self._open_window(row.utime)
                self._add_pose(row)
                last = row.utime
        finally:
            if last:
                self._close_window(run.last_utime)
                self._end_invalid(run.last_utime)
        if not run.samples:
            names = ", ".join(sorted(run.unconfigured_channels)[:20])
            raise RecordingError(f"no message on the vehicle's channels; the log has: {names}")

    def write_drive(self, content: str, size: int, error: str) -> None:
        run = self._run
        counts = (0, 0) if run is None else (run.events, run.samples)
        self._tables.add_drive(
            content,
            self._vehicle.config.vehicle,
            0 if run is None else run.first_utime,
            *(self.seconds, self._distance, *counts, self._poses, self._valid, size, error),
        )

    def _watch(self, log: LogFile) -> Iterator[LogEvent]:
        for event in log:
            self._channels.add(event.channel)
            yield event

    def _on_sample(self, sample: Event, localizer: Localizer) -> None:
        self._collector.on_sample(sample, localizer)

    def _on_decision(self, decision: Decision) -> None:
        self._collector.on_decision(decision)
        verdict = decision.verdict.name.lower()
        self._tables.add(
            "decisions",
            decision.utime,
            *(decision.source, decision.kind, verdict, decision.reason, decision.statistic, decision.dof),
        )
        if decision.verdict is Verdict.RESET:
            self._add_event(decision.utime, 0.0, "reset", "", f"{decision.kind}: {decision.reason}")

    def _add_pose(self, row: TrackRow) -> None:
        self._poses += 1
        self._valid += row.valid
        self._flags[row.invalid if not row.valid else 0] += 1
        if math.isfinite(row.levels[0]):
            self._levels.append(row.levels[0])
        invalid = Invalid(row.invalid) if not row.valid else None
        if self._invalid is not None and invalid != self._invalid[1]:
            self._end_invalid(row.utime)
        if invalid is not None and self._invalid is None:
            self._invalid = (row.utime, invalid)
        self._tables.add(
            "poses",
            row.utime,
            *(row.easting, row.northing, row.up, *row.rotation, row.valid, row.invalid),
            *(*row.bounds, *row.sigmas, *row.place, *row.levels),
        )

    def _end_invalid(self, utime: int) -> None:
        if self._invalid is not None:
            begin, flags = self._invalid
            names = " ".join(str(flag.name) for flag in Invalid if flag in flags)
            self._add_event(begin, (utime - begin) * 1e-6, "invalid", "", names)
        self._invalid = None

    def _add_event(self, utime: int, seconds: float, kind: str, level: str, text: str) -> None:
        self._tables.add("events", utime, seconds, kind, level, text)

    # --- windows

    def _open_window(self, begin: int) -> None:
        self._begin = begin
        self._collector = ReplayCollector(self._vehicle)
        self._flags: Counter[int] = Counter()
        self._levels: list[float] = []

    def _close_window(self, end: int) -> None:
        """Write the metrics, rejections and findings of the window."""
        run, begin = self._run, self._begin
        assert run is not None
        new = {key: count - self._rejected.get(key, 0) for key, count in run.rejected.items()}
        rejected = {key: count for key, count in sorted(new.items()) if count}
        self._rejected = dict(run.rejected)
        data = self._collector.finish("", begin, end, rejected, self._channels, run.axis)
        self._channels = set()
        distance = integrate_distance(data.snapshots)
        self._distance += distance
        period = 1.0 / self._rate
        reasons = {str(flag.name): count for flag, count in count_reasons(self._flags).items()}
        verdicts = Counter(f"{each.kind} {each.verdict.name.lower()}" for each in data.decisions)
        nis: defaultdict[str, float] = defaultdict(float)
        dof: Counter[str] = Counter()
        for each in data.decisions:
            if each.verdict is not Verdict.RESET and has_nis(each):
                nis[each.kind] += each.statistic
                dof[each.kind] += each.dof
        metrics: list[tuple[str, str, float]] = [
            ("distance", "", distance),
            ("resets", "", float(sum(map(is_position_reset, data.decisions)))),
            ("valid_seconds", "", self._flags[0] * period),
            *(("invalid_seconds", name, count * period) for name, count in sorted(reasons.items())),
            *([("horizontal_level", "median", median(self._levels))] if self._levels else []),
            *(("samples", each.name, float(len(each.times))) for each in data.sensors),
            *(("verdicts", name, float(count)) for name, count in sorted(verdicts.items())),
            *(("nis_sum", kind, value) for kind, value in sorted(nis.items())),
            *(("nis_dof", kind, float(count)) for kind, count in sorted(dof.items())),
        ]
        seconds = max(end - begin, 0) * 1e-6
        for metric in metrics:
            self._tables.add("metrics", begin, seconds, *metric)
        for (source, reason), count in rejected.items():
            self._tables.add("rejections", begin, source, reason, count)
        for found in collect_findings(data):
            self._add_event(begin, seconds, "finding", found.level, f"{found.title}: {found.observation}")
