"""A service with a journal on a fake bus and a fake clock, without threads, writing to the folder of the test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from support_samples import FORWARD, GEOMETRY, VEHICLE, drive, wait_for_reload, write_vehicle
from support_signing import ALLOWED, KEY, envelope, write_test_key

from modelserver.config.vehicle_file import LimitsConfig, load_config
from modelserver.messages import CHANNEL_OF
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.journal import JournalQueue
from modelserver.server.journal import writer as environment
from modelserver.server.journal.writer import JournalWriter, Ring, list_segments
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.reloading import GeometryReader, read_geometry
from modelserver.server.vehicle import load_vehicle
from modelserver.signing import Key
from modelserver.wire.codec import encode

START = 1_700_000_000_000_000

OPEN = VEHICLE + (
    f"localization: {{mode_channel: LOCALIZATION_MODE, {FORWARD}}}\n"
    f"{ALLOWED}"
    "limits: {history_s: 20, waiting_requests: 4, queued_requests: 4}\n"
)
"""A vehicle that allows all requests."""

SMALL = OPEN.replace("{mode_channel", "{mode: raw, mode_channel")
"""The same in raw mode, which has a small state: for many segments."""


class JournalRig:
    """A loop of a small vehicle with its journal in `folder`/journal."""

    def __init__(
        self,
        folder: Path,
        vehicle: str = OPEN,
        geometry: str = GEOMETRY,
        max_bytes: int = 1 << 30,
        segment_bytes: int = 1 << 20,
        clock: FakeClock | None = None,
        run: str = "one",
        facts: dict[str, Any] | None = None,
        ring: Callable[..., Ring] = Ring,
        publisher_conflict: Literal["", "ignore", "use"] = "",
        key: Key | None = None,
    ):
        path = write_vehicle(folder, vehicle, geometry)
        write_test_key(folder)
        self.commands = 0
        self.folder, self.directory = folder, folder / "journal"
        self.vehicle = load_vehicle(load_config(path), str(path))
        self.clock = clock or FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.queue = JournalQueue()
        self.ring = ring(self.directory, max_bytes, segment_bytes)
        known = {**environment.collect_facts(), "run": run, **(facts or {})}
        self.writer = JournalWriter(
            self.queue, self.ring, self.vehicle.config, known, self.clock, pause=lambda: None, key=key
        )
        reader = GeometryReader(self.vehicle, str(path), read_geometry)
        self.loop = Loop(
            self.bus,
            self.clock,
            self.vehicle.start_core(self.clock.now()),
            LoopSettings(
                20_000_000,
                self.vehicle.sensor_channels(),
                limits=LimitsConfig(requests_per_pass=2, queued_requests=4),
                publisher_conflict=publisher_conflict,
            ),
            Hooks(
                on_load=wait_for_reload(reader.begin),
                snapshot=reader.encode_snapshot,
                channels=lambda state: self.vehicle.sensor_channels(state.model),
                verifier=self.vehicle.make_command_verifier(self.clock.monotonic_ns(), str(path)),
                journal=self.queue,
            ),
        )

    def run_cycles(self, count: int = 1) -> None:
        """Run the loop and the writer for some cycles."""
        for _ in range(count):
            self.loop.run_once()
            self.writer.run_once()

    def drive(self, seconds: float = 6.0) -> None:
        """Receive the samples of a drive that begins now, each as it is measured."""
        for sample in drive(seconds, self.clock.utime()):
            while sample.header.utime > self.clock.utime():
                self.run_cycles()
            self.send(sample)

    def send(self, value: Any, channel: str = "") -> None:
        """Publish a message."""
        kinds = {"GpsSample": "GPS", "ImuSample": "IMU", "SwitchMode": "LOCALIZATION_MODE", "JointsSample": "JOINTS"}
        self.bus.publish(channel or CHANNEL_OF.get(type(value)) or kinds[type(value).__name__], encode(value))

    def send_command(self, value: Any, key: Key = KEY, age: float = 0.0) -> None:
        """Publish a signed command, stamped `age` seconds ago."""
        self.commands += 1
        utime = self.clock.utime() - round(age * 1e6)
        self.bus.publish("MODELSERVER_SIGNED", encode(envelope(value, utime, key, counter=self.commands)))

    def finish(self) -> list[Path]:
        """Stop the service; return the segments."""
        self.writer.finish()
        return self.segments

    @property
    def segments(self) -> list[Path]:
        return list_segments(self.directory)
