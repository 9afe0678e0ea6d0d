"""Archiving of many logs: one and two workers, what a log of two hours needs, and what a million hours would cost.

    python -m benchmarks archive_scaling
    python -m benchmarks archive_scaling --logs 20 --rounds 1 --hours 0

Logs are simulated drives of the Raptor, each of its own seed: IMU 25 Hz, wheels 10 Hz, fixes 4 Hz. Runs with one and
two workers alternate, each into an empty archive; a run includes the start of its cluster. The memory of a worker
(resident set size, the largest of samples) is that while it archives one log of `--hours` with an IMU of 200 Hz.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

import lcm
import psutil

from benchmarks.support import RAPTOR, ROOT
from modelserver.config.vehicle_file import load_config
from modelserver.earth.geodesy import origin_at
from modelserver.messages import GpsSample, ImuSample, Sample, WheelsSample
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import ImuModel, Simulation, Timing, Trajectory, figure_eight
from modelserver.wire.codec import encode

CONFIG: Final = RAPTOR / "vehicle.yaml"
EFFICIENCY: Final = 0.85
"""Least rate of two workers over twice that of one."""
MEMORY_MB: Final = 500.0
MILLION: Final = 1e6


def simulate(seconds: float, seed: int, imu_hz: float = 25.0) -> Iterator[Sample]:
    config = load_config(CONFIG)
    sensors = config.sensors
    assert sensors.gps is not None
    assert sensors.imu is not None
    assert sensors.wheels is not None
    laps = math.ceil(seconds / 30.0)
    drive = Simulation(
        load_vehicle(config, str(CONFIG)).model,
        config.base_frame,
        Trajectory(figure_eight(speed=3.0, radius=8.0, stationary=4.0, ramp=2.0, laps=laps)),
        origin_at(50.27, -111.18, 700.0),
        gps_frame=sensors.gps.frame,
        imu_frame=sensors.imu.frame,
        wheel_frames=sensors.wheels.frames,
        rolling_frame=config.rolling_frame,
        seed=seed,
        imu_model=ImuModel(Timing(imu_hz)),
    )
    return iter(drive.events(seconds))


def write_log(path: Path, samples: Iterator[Sample]) -> None:
    channels = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
    with closing(lcm.EventLog(str(path), "w", overwrite=True)) as log:
        for each in samples:
            log.write_event(each.header.host_utime, channels[type(each)], encode(each))


def archive(logs: Path, out: Path, workers: int) -> tuple[dict[str, float], float]:
    """Archive logs; return the figures of the run, and the largest memory of one of its processes, MB."""
    program = "from mstools.cli import main; main()"
    words = ["archive", "run", str(logs), "-c", str(CONFIG), "--out", str(out), "--workers", str(workers), "--json"]
    child = subprocess.Popen(
        [sys.executable, "-c", program, *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT
    )
    resident = 0.0
    while child.poll() is None:
        time.sleep(0.5)
        try:
            for each in psutil.Process(child.pid).children(recursive=True):
                resident = max(resident, each.memory_info().rss / 1e6)
        except psutil.NoSuchProcess:
            continue
    assert child.stdout is not None
    return json.loads(child.stdout.read()), resident


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks archive_scaling", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=5.0, help="of each log")
    parser.add_argument("--rounds", type=int, default=1, help="runs with one and with two workers")
    parser.add_argument("--hours", type=float, default=2.0, help="of the log whose memory is measured; 0: none")
    options = parser.parse_args(arguments or [])
    holds = True
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder) / "logs"
        logs.mkdir()
        for number in range(options.logs):
            write_log(logs / f"drive{number:04}.lcm", simulate(options.minutes * 60.0, number))
        print("  workers    wall, s   h of log   times real time   processor, s   archive, MB per h", flush=True)
        rates: dict[int, list[float]] = {1: [], 2: []}
        for turn in range(options.rounds):
            for workers in (1, 2):
                out = Path(folder) / f"archive-{turn}-{workers}"
                found, _ = archive(logs, out, workers)
                hours = found["seconds"] / 3600.0
                size = sum(path.stat().st_size for path in out.rglob("*.parquet")) / 1e6
                rates[workers].append(found["seconds"] / found["wall_seconds"])
                print(
                    f"  {workers:7}{found['wall_seconds']:11.1f}{hours:11.2f}{rates[workers][-1]:18.0f}"
                    f"{found['cpu_seconds']:15.1f}{size / hours:20.2f}",
                    flush=True,
                )
        share = max(b / (2.0 * a) for a, b in zip(rates[1], rates[2], strict=True))
        holds = share >= EFFICIENCY
        print(
            f"  two workers: {share:.2f} of twice one (at least {EFFICIENCY}){'' if holds else '  <-- OUT OF BOUNDS'}"
        )
        cpu = found["cpu_seconds"] / hours
        print(
            f"  10^6 h at these unit costs: {cpu * MILLION / 3600.0:,.0f} h of processor, "
            f"{size / hours * MILLION / 1e6:.2f} TB"
        )
        if options.hours:
            long = Path(folder) / "long.lcm"
            write_log(long, simulate(options.hours * 3600.0, 0, imu_hz=200.0))
            found, resident = archive(long, Path(folder) / "archive-long", 1)
            good = resident <= MEMORY_MB
            holds &= good
            print(
                f"  a log of {options.hours:g} h with 200 Hz, {long.stat().st_size / 1e6:.0f} MB: {resident:.0f} MB "
                f"a worker (at most {MEMORY_MB:.0f}), {found['wall_seconds']:.0f} s"
                + ("" if good else "  <-- OUT OF BOUNDS")
            )
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
