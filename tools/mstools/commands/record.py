"""`modelserver record`: record the bus as an LCM event log, with the types of its messages checked."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import typer

from modelserver.errors import ModelServerError, WireError, find_nearest_names
from modelserver.files import check_links
from modelserver.wire.codec import decode, type_name_of
from modelserver.wire.eventlog import encode_event
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.recordings.drive import ChannelCount, follow_bus
from mstools.terminal.options import ChannelsOption, JsonOption, PrefixOption, UrlOption, argument, option
from mstools.terminal.output import catch_signals, check_writable, escape, format_count, format_table

PARTS = 8
"""Parts in which a recording with a limit and no size of its parts is split: an eighth is deleted at a time."""

MIN_MB = 1.0
"""Smallest size of a part, megabytes."""

STATUS_S = 1.0
"""Seconds between updates of the status line."""


def command(
    log: Annotated[Path, argument("LOG", "LCM event log to write, e.g. drive.lcm.")],
    seconds: Annotated[float, option("--seconds N", "Stop after this time. Default: at Ctrl-C.", min=0.1)] = math.inf,
    channel: ChannelsOption = None,
    split_mb: Annotated[
        float, option("--split-mb N", "Begin a new file at this size: drive-0000.lcm, ...", min=MIN_MB)
    ] = math.inf,
    max_mb: Annotated[
        float, option("--max-mb N", "Delete the oldest files beyond this size in all.", min=PARTS * MIN_MB)
    ] = math.inf,
    force: Annotated[bool, option("--force", "Replace LOG if it exists.")] = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    as_json: JsonOption = False,
) -> None:
    """Record the messages on the bus as an LCM event log, until Ctrl-C.

    All channels are recorded, of foreign types too. Messages of this project's types are decoded: those that cannot be
    are recorded and counted. The files can be read by replay, view, report and lcm-logplayer. Exit code 1 if nothing
    was received, or the disk is full.

    \b
    Examples:
      modelserver record drive.lcm
      modelserver record /data/drive.lcm --split-mb 500 --max-mb 20000
    """
    if math.isfinite(max_mb) and not math.isfinite(split_mb):
        split_mb = max_mb / PARTS
    if split_mb > max_mb / 2.0:
        raise typer.BadParameter("is at most half of --max-mb", param_hint="--split-mb")
    check_links(log)
    recorder = Recorder(log, split_mb * 1e6, max_mb * 1e6, frozenset(channel or ()))
    recorder.check_target(force)
    bus = open_lcm(resolve_url(url))
    shows_status = sys.stderr.isatty() and not as_json
    started_at = shown_at = time.monotonic()
    try:
        with catch_signals() as stop:

            def is_stopped() -> bool:
                nonlocal shown_at
                now = time.monotonic()
                if shows_status and now > shown_at + STATUS_S:
                    shown_at = now
                    typer.echo(f"\r{recorder.describe(now - started_at)}\x1b[K", nl=False, err=True)
                return stop.is_set() or now >= started_at + seconds

            follow_bus(bus, prefix, recorder.feed, is_stopped)
    finally:
        recorder.close()
        if shows_status:
            typer.echo("", err=True)
    if as_json:
        typer.echo(json.dumps(recorder.as_data()))
    else:
        typer.echo(escape(recorder.describe(time.monotonic() - started_at)))
        typer.echo(recorder.format_channels())
    if missing := [each for each in channel or () if each not in recorder.channels]:
        near = find_nearest_names(missing[0], recorder.others)
        hint = f"; did you mean {near[0]}?" if near else ""
        typer.echo(escape(f"modelserver: note: nothing was received on {', '.join(missing)}{hint}"), err=True)
    if not recorder.count:
        raise ModelServerError(
            f"nothing was received at {resolve_url(url)}: is anything published on this bus ($LCM_DEFAULT_URL)? "
            "modelserver doctor looks"
        )


@dataclass(slots=True)
class RecordedChannel(ChannelCount):
    """What was recorded of a channel; `damaged`: messages of a known type that cannot be decoded."""

    type_name: str = ""
    damaged: int = 0


@dataclass(slots=True)
class Recorder:
    """Writes messages into the file `path`, or with a finite `split_bytes` into parts of it, of which the newest stay.

    selected: the channels that are recorded, empty for all; `others` are those that were received beside them.
    """

    path: Path
    split_bytes: float
    max_bytes: float
    selected: frozenset[str] = frozenset()
    channels: dict[str, RecordedChannel] = field(default_factory=dict)
    others: set[str] = field(default_factory=set)
    count: int = 0
    written: int = 0
    parts: list[tuple[Path, int]] = field(default_factory=list)
    """The files that are there, with their sizes."""
    deleted: int = 0
    _number: int = 0
    _file: BinaryIO | None = None
    _size: int = 0

    @property
    def is_split(self) -> bool:
        return math.isfinite(self.split_bytes)

    def check_target(self, force: bool) -> None:
        """Raise ModelServerError where the file, or a part of it, exists, unless `force` replaces it."""
        if not self.is_split:
            check_writable(str(self.path), force)
            return
        existing = sorted(self.path.parent.glob(f"{self.path.stem}-[0-9][0-9][0-9][0-9]{self.path.suffix}"))
        if existing and not force:
            raise ModelServerError(f"{existing[0]} exists; give another name, or --force to replace it")
        for each in existing:
            each.unlink()
        check_writable(str(self._name_part(0)), force)

    def feed(self, channel: str, data: bytes, now: int) -> None:
        """Write a message received at `now`. Raises ModelServerError where the disk does not take it."""
        if self.selected and channel not in self.selected:
            self.others.add(channel)
            return
        type_name = type_name_of(data)
        found = self.channels.setdefault(channel, RecordedChannel(type_name=type_name))
        found.add(now)
        if type_name:
            try:
                decode(type_name, data)
            except WireError:
                found.damaged += 1
        event = encode_event(self.count, now, channel.encode(), data)
        try:
            if self._file is None or self._size + len(event) > self.split_bytes:
                self._file = self._begin_part()
            self._file.write(event)
        except OSError as error:
            raise ModelServerError(f"{self.path}: {error.strerror or error}; recorded until then") from None
        self.count += 1
        self._size += len(event)
        self.written += len(event)

    def _name_part(self, number: int) -> Path:
        return self.path.with_stem(f"{self.path.stem}-{number:04d}") if self.is_split else self.path

    def _begin_part(self) -> BinaryIO:
        self.close()
        path = self._name_part(self._number)
        self._number += 1
        while self.parts and sum(size for _, size in self.parts) + self.split_bytes > self.max_bytes:
            oldest, _ = self.parts.pop(0)
            oldest.unlink(missing_ok=True)
            self.deleted += 1
        self._size = 0
        return path.open("wb")

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self.parts.append((self._name_part(self._number - 1), self._size))
            self._file = None

    def describe(self, seconds: float) -> str:
        files = ""
        if self.is_split:
            files = f", {format_count(self._number, 'file')}" + (f", {self.deleted} deleted" if self.deleted else "")
        return (
            f"{self.path}: {seconds:.0f} s, {format_count(self.count, 'message')}, {self.written / 1e6:.1f} MB{files}"
        )

    def format_channels(self) -> str:
        rows = [
            (
                name,
                each.type_name or "foreign",
                str(each.count),
                "-" if math.isnan(each.mean_rate) else f"{each.mean_rate:.1f}",
                str(each.damaged) if each.damaged else "",
            )
            for name, each in sorted(self.channels.items())
        ]
        return format_table(("channel", "type", "messages", "Hz", "damaged"), rows, numbers=(2, 3, 4))

    def as_data(self) -> dict[str, Any]:
        """Return the counts as JSON data."""
        return {
            "files": [str(path) for path, _ in self.parts],
            "deleted": self.deleted,
            "messages": self.count,
            "bytes": self.written,
            "channels": {
                name: {"type": each.type_name, "messages": each.count, "damaged": each.damaged}
                for name, each in sorted(self.channels.items())
            },
        }
