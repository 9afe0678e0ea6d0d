"""Cost of the journal for the loop: per sample and tick, and while a segment is closed and the next one opened."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.support import RAPTOR, print_verdict, ratio
from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.messages import GpsSample, ImuSample, Sample, WheelsSample
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.journal import JournalQueue
from modelserver.server.journal import encoding as journal_state
from modelserver.server.journal.writer import JournalWriter, Ring, pause
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.wire.codec import encode
from mstools.launch.drive import make_simulation

START = 1_700_000_000_000_000
ROUNDS, SAMPLES = 40, 200
CHANNELS = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
STATES = 40


class LoopBench:
    """The Raptor's loop on a fake bus, fed with a drive."""

    def __init__(self, vehicle: Vehicle, journal: JournalQueue):
        self.clock = FakeClock(START, 10**9)
        self.bus = FakeBus(self.clock)
        settings = LoopSettings(10_000_000, vehicle.sensor_channels())
        state = vehicle.start_core(self.clock.now())
        self.loop = Loop(
            self.bus, self.clock, state, settings, Hooks(snapshot=vehicle.encode_snapshot, journal=journal)
        )

    def feed(self, samples: list[tuple[str, bytes, int]]) -> float:
        """Process samples and due ticks; return seconds per sample."""
        begin = time.perf_counter()
        for channel, data, utime in samples:
            self.clock.advance((utime - self.clock.utime()) * 1e-6)
            self.bus.sensors.put(channel, data)
            self.loop.run_once()
        took = time.perf_counter() - begin
        self.bus.published.clear()
        return took / len(samples)


def simulate_samples(config: VehicleConfig) -> Iterator[tuple[str, bytes, int]]:
    """Yield the drive's samples as messages."""
    run = make_simulation(config, START, 300.0, sensors=(GpsSample, ImuSample, WheelsSample))
    for event in run.events(300.0):
        sample: Sample = getattr(event, "sample", event)
        yield CHANNELS[type(sample)], encode(sample), sample.header.utime


class PauseProbe:
    """Replaces the writer's pause: records the longest time for which its thread held the interpreter, seconds."""

    def __init__(self) -> None:
        self.longest: list[float] = []
        self._since = time.thread_time()

    def begin(self) -> None:
        """Start another round."""
        self.longest.append(0.0)
        self._since = time.thread_time()

    def __call__(self) -> None:
        """Pause."""
        self.longest[-1] = max(self.longest[-1], time.thread_time() - self._since)
        pause()
        self._since = time.thread_time()


def main() -> int:
    config = load_config(RAPTOR / "vehicle.yaml")
    config = replace(config, publish=replace(config.publish, rate_hz=100.0))
    vehicle = load_vehicle(config)
    with tempfile.TemporaryDirectory() as folder:
        queue = JournalQueue()
        with_it, without = LoopBench(vehicle, queue), LoopBench(vehicle, JournalQueue())
        ring = Ring(Path(folder) / "journal", 1 << 30, 16 << 20)
        write = JournalWriter(queue, ring, config, {"run": "bench"}, with_it.clock)
        samples = simulate_samples(config)
        costs: dict[str, list[float]] = {"with": [], "without": [], "thread": []}
        for number in range(ROUNDS):
            portion = [next(samples) for _ in range(SAMPLES)]
            # the first one has cold caches
            order = [("with", with_it), ("without", without)]
            for name, bench in order if number % 2 else reversed(order):
                costs[name].append(bench.feed(portion))
            records, begin = len(queue), time.perf_counter()
            write.run_once()
            costs["thread"].append((time.perf_counter() - begin) / max(records, 1))
        # the first rounds have no pose yet
        costs = {name: values[ROUNDS // 4 :] for name, values in costs.items()}
        medians = {name: statistics.median(values) * 1e6 for name, values in costs.items()}
        print(
            f"  a sample with its ticks: {medians['with']:.1f} us with a journal, {medians['without']:.1f} us without"
        )
        print(f"  the thread takes {medians['thread']:.1f} us for a record")
        holds = print_verdict(
            "a sample with a journal, to one without", ratio(costs["with"], costs["without"]), 1.10, ""
        )
        chunks = PauseProbe()
        for _ in range(STATES):
            chunks.begin()
            run = journal_state.RunState(config, journal_state.detach(with_it.loop.state))
            size = len(journal_state.encode_run(run, chunks))
            chunks()
        write.finish()
    label = f"longest hold of the interpreter for a state of {size >> 10} KiB, median"
    held = print_verdict(label, statistics.median(chunks.longest) * 1e3, 3.0, "ms")
    print(f"  the longest of all {STATES}: {max(chunks.longest) * 1e3:.2f} ms")
    return 0 if holds and held else 1
