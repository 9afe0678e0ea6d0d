"""Cost of the filter: an IMU sample through the core relative to a bare predict, a replay, memory over a day.

The day is driven in circles, at low rates so that it takes minutes: growth depends on samples and seconds.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from filterpy.kalman import KalmanFilter

from benchmarks.protocols import data_directory
from benchmarks.support import print_verdict
from modelserver import core
from modelserver.config.vehicle_file import load_config
from modelserver.core import Instant
from modelserver.earth.geodesy import Geodesy, origin_at
from modelserver.estimation.modes import ModeLocalizer
from modelserver.messages import FixType, GpsSample, ImuSample, Sample, SensorHeader, WheelSample, WheelsSample
from modelserver.server.vehicle import Vehicle, load_vehicle
from mstools.recordings.bag_log import import_bag

ROOT = Path(__file__).resolve().parent.parent
HUSKY = ROOT / "config" / "husky" / "vehicle.yaml"
START = 1_750_000_000_000_000
MAX_PREDICTS = 12.0
MIN_REAL_TIME = 100.0
MAX_GROWTH_MB = 16.0
RATES = (10.0, 50.0)
"""Poses per second: the required rate, and the default of `replay`."""


def simulate_circular_drive(
    seconds: float, imu_hz: float, wheels_hz: float, gps_hz: float, seed: int = 1
) -> Iterator[Sample]:
    """Yield a Husky's samples on circles of 20 m at 1 m/s, after 5 stationary seconds, in order of time."""
    rng = random.Random(seed)
    geodesy = Geodesy(origin_at(42.0, -71.0, 20.0))
    radius, stand = 20.0, 5.0
    every_wheels, every_gps = round(imu_hz / wheels_hz), round(imu_hz / gps_hz)
    for n in range(round(seconds * imu_hz)):
        t = n / imu_hz
        utime = START + round(t * 1e6)
        way = max(t - stand, 0.0)
        turn = 1.0 / radius if t > stand else 0.0
        # the Husky's IMU is mounted with x to the right, y up, z to the rear
        rate = (rng.gauss(0, 0.002), turn + rng.gauss(0, 0.002), rng.gauss(0, 0.002))
        force = (-turn + rng.gauss(0, 0.02), 9.8 + rng.gauss(0, 0.02), rng.gauss(0, 0.02))
        yield ImuSample(SensorHeader(utime, "imu", n + 1), rate, force)
        if n % every_wheels == 0:
            wheels = tuple(
                WheelSample(name, way * (1.0 - side * 0.2775 / radius), 0.005)
                for name, side in (("left", 1.0), ("right", -1.0))
            )
            yield WheelsSample(SensorHeader(utime, "wheels", n + 1), wheels)
        if n % every_gps == 0:
            angle = way / radius
            east, north = radius * math.sin(angle), radius * (1.0 - math.cos(angle))
            latitude, longitude, height = geodesy.geodetic_from_enu(
                (east + rng.gauss(0, 0.1), north + rng.gauss(0, 0.1), rng.gauss(0, 0.2))
            )
            covariance = (0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0)
            yield GpsSample(
                SensorHeader(utime, "gps", n + 1),
                FixType.DIFFERENTIAL,
                latitude,
                longitude,
                height,
                position_covariance=covariance,
            )


def instant_at(utime: int) -> Instant:
    return Instant(utime * 1000, utime)


def measure_event_cost(vehicle: Vehicle) -> float:
    """Return the median over rounds of an IMU event's mean cost relative to a bare predict of the same size."""
    state = vehicle.start_core(instant_at(START))
    samples = list(simulate_circular_drive(90.0, 100.0, 10.0, 2.5))
    warm = 60 * 113
    for sample in samples[:warm]:
        state, _ = core.step(state, sample, instant_at(sample.header.utime))
    assert isinstance(state.localizer, ModeLocalizer)
    n = state.localizer.config.setup.layout.size
    bare = KalmanFilter(n, 1)
    bare.x, F, Q, P = np.zeros(n), np.eye(n), np.eye(n) * 1e-6, np.eye(n)
    ratios, costs = [], []
    for begin in range(warm, len(samples) - 300, 300):
        events, spent = 0, 0.0
        for sample in samples[begin : begin + 300]:
            now = instant_at(sample.header.utime)
            start = time.perf_counter()
            state, _ = core.step(state, sample, now)
            if isinstance(sample, ImuSample):
                spent += time.perf_counter() - start
                events += 1
        start = time.perf_counter()
        for _ in range(300):
            bare.P = P
            bare.predict(F=F, Q=Q)
        floor = (time.perf_counter() - start) / 300
        ratios.append(spent / events / floor)
        costs.append(spent / events * 1e6)
    print(f"  an IMU event {statistics.median(costs):.0f} us, {n} states")
    return statistics.median(ratios)


def measure_replay_factor(rate_hz: float) -> float | None:
    """Return the real-time factor of `modelserver replay --poses` on the Husky recording; the best of three.

    As the command reports it: without the interpreter's start, including reading the log and writing poses at
    `rate_hz`.
    """
    bag = data_directory() / "husky" / "test1.bag"
    if not bag.is_file():
        return None
    factors = []
    with tempfile.TemporaryDirectory() as directory:
        log = Path(directory) / "husky.lcm"
        import_bag(bag, log)
        run = "from mstools.cli import main; main()"
        options = ["--poses", str(Path(directory) / "poses.csv"), "--rate", f"{rate_hz:g}", "--json"]
        command = [sys.executable, "-c", run, "replay", str(log), "-c", str(HUSKY), *options]
        for _ in range(3):
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            factors.append(float(json.loads(done.stdout)["real_time_factor"]))
    return max(factors)


def get_resident_mb() -> float:
    """Return the resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def measure_growth(vehicle: Vehicle, hours: float) -> float:
    """Return the growth of memory between the first and the last hour of a drive, MB."""
    state = vehicle.start_core(instant_at(START))
    first = 0.0
    for sample in simulate_circular_drive(hours * 3600.0, 10.0, 2.0, 0.5):
        state, _ = core.step(state, sample, instant_at(sample.header.utime))
        if not first and sample.header.utime > START + 3_600_000_000:
            first = get_resident_mb()
    return get_resident_mb() - first


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.filter_cost", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--hours", type=float, default=24.0, help="of the simulated drive")
    options = parser.parse_args(arguments or [])
    vehicle = load_vehicle(load_config(HUSKY))
    holds = print_verdict(
        "an inertial event through core.step to filterpy's predict", measure_event_cost(vehicle), MAX_PREDICTS, "x"
    )
    for rate in RATES:
        factor = measure_replay_factor(rate)
        if factor is None:
            print("  replay skipped: no husky/test1.bag; set MODELSERVER_DATA to the folder of recordings")
            break
        print(f"  replay of the Husky recording, poses at {rate:g} Hz: {factor:.0f} times real time")
        holds &= print_verdict("seconds to replay 100 s", 100.0 / factor, 100.0 / MIN_REAL_TIME, "s")
    grown = measure_growth(vehicle, options.hours)
    holds &= print_verdict(f"memory grown over {options.hours:g} simulated hours", grown, MAX_GROWTH_MB, "MB")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
