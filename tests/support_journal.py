"""A service with a journal on a fake bus and a fake clock: no thread, and the disk is the test's folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from support_samples import FORWARD, GEOMETRY, VEHICLE, drive, write_vehicle
from support_signing import ALLOWED, KEY, envelope, write_test_key

from modelserver.config import load_config
from modelserver.messages import CHANNEL_OF
from modelserver.service.clock import FakeClock
from modelserver.service.daemon import load_vehicle
from modelserver.service.fake_bus import FakeBus
from modelserver.service.hooks import Hooks
from modelserver.service.journal import build as journal_build
from modelserver.service.journal.queue import JournalQueue
from modelserver.service.journal.ring import Ring, segments
from modelserver.service.journal.writer import JournalWriter, Origins
from modelserver.service.loop import Loop, LoopSettings
from modelserver.signing import Key
from modelserver.wire.codec import encode

START = 1_700_000_000_000_000

OPEN = VEHICLE + (
    f"localization: {{mode_channel: LOCALIZATION_MODE, {FORWARD}}}\n"
    f"{ALLOWED}"
    "limits: {history_s: 20, parked_requests: 4, queued_requests: 4}\n"
)
"""A vehicle of which everything may be asked."""

SMALL = OPEN.replace("{mode_channel", "{mode: raw, mode_channel")
"""The same in raw mode, whose state is small: for many segments."""


class Kept:
    """A loop of a small vehicle and the journal of it, in `folder`/journal."""

    def __init__(
        self,
        folder: Path,
        vehicle: str = OPEN,
        geometry: str = GEOMETRY,
        most_bytes: int = 1 << 30,
        segment_bytes: int = 1 << 20,
        clock: FakeClock | None = None,
        run: str = "one",
        facts: dict[str, Any] | None = None,
        ring: Callable[..., Ring] = Ring,
        second_writer: Literal["", "ignore", "use"] = "",
        key: Key | None = None,
    ):
        path = write_vehicle(folder, vehicle, geometry)
        write_test_key(folder)
        self.orders = 0
        self.folder, self.directory = folder, folder / "journal"
        self.vehicle = load_vehicle(load_config(path), str(path))
        self.clock = clock or FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.queue = JournalQueue()
        self.ring = ring(self.directory, most_bytes, segment_bytes)
        known = {**journal_build.facts(), "run": run, **(facts or {})}
        files = [(str(path), path.read_bytes())]
        origins = Origins(known, files, self.vehicle.config)
        self.writer = JournalWriter(self.queue, self.ring, origins, self.clock, pause=lambda: None, key=key)
        self.loop = Loop(
            self.bus,
            self.clock,
            self.vehicle.core(self.clock.now()),
            LoopSettings(
                20_000_000,
                self.vehicle.sensor_channels(),
                queued_requests=4,
                requests_per_pass=2,
                second_writer=second_writer,
            ),
            Hooks(
                on_load=lambda wish, state: self.vehicle.reloaded(wish, state, str(path)),
                snapshot=self.vehicle.snapshot,
                channels=lambda state: self.vehicle.sensor_channels(state.model),
                gate=self.vehicle.gate(self.clock.monotonic_ns(), str(path)),
                journal=self.queue,
            ),
        )

    def turns(self, count: int = 1) -> None:
        """Let the loop turn, and the writer after each."""
        for _ in range(count):
            self.loop.turn()
            self.writer.work()

    def drive(self, seconds: float = 6.0) -> None:
        """Hear a drive that begins now, each sample as it is measured."""
        for sample in drive(seconds, self.clock.utime()):
            ahead = (sample.header.utime - self.clock.utime()) * 1e-6
            while ahead > 0:
                self.turns()
                ahead = (sample.header.utime - self.clock.utime()) * 1e-6
            self.send(sample)

    def send(self, value: Any, channel: str = "") -> None:
        """Put a message on the bus."""
        kinds = {"GpsSample": "GPS", "ImuSample": "IMU", "SwitchMode": "LOCALIZATION_MODE", "JointsSample": "JOINTS"}
        self.bus.publish(channel or CHANNEL_OF.get(type(value)) or kinds[type(value).__name__], encode(value))

    def order(self, value: Any, key: Key = KEY, late: float = 0.0) -> None:
        """Put a signed command on the bus, stamped `late` seconds ago."""
        self.orders += 1
        utime = self.clock.utime() - round(late * 1e6)
        self.bus.publish("MODELSERVER_SIGNED", encode(envelope(value, utime, key, counter=self.orders)))

    def finish(self) -> list[Path]:
        """End the service; return the segments."""
        self.writer.finish()
        return self.segments

    @property
    def segments(self) -> list[Path]:
        return segments(self.directory)
