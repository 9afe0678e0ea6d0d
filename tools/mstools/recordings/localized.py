"""A log as it would be if the service had run meanwhile, for commands that show what the service publishes."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lcm
import typer

from modelserver.config.vehicle_file import load_config
from modelserver.server.offline import serve
from modelserver.server.recordings import StampAxis
from modelserver.server.vehicle import load_vehicle
from mstools.terminal.output import escape, read_with_progress


def write_localized(log: Path, config: Path, out: Path) -> Counter[str]:
    """Write the log with the service's messages; return the number of messages by channel.

    Notes of the log go to stderr. Raises ConfigError, GeometryError, RecordingError, OSError.
    """
    vehicle = load_vehicle(load_config(config), str(config))
    axis = StampAxis()
    counts: Counter[str] = Counter()
    writer = lcm.EventLog(str(out), "w", overwrite=True)
    try:
        with read_with_progress("localizing", log) as (recording, events):
            for event in serve(vehicle, events, axis):
                writer.write_event(event.utime, event.channel, event.data)
                counts[event.channel] += 1
    finally:
        writer.close()
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
