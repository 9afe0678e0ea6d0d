"""Consistency of the filter: errors against covariances and protection levels, over simulated drives.

    python -m benchmarks consistency
    python -m benchmarks.consistency --seeds 10 --only matched

Three kinds of drives, each with as many seeds:

matched    every sensor error is as the settings model it, and there is no other: here too large a sigma also fails.
stronger   slip, slopes and fixes whose errors are larger and correlated for longer than stated, default settings.
faults     the same, with outages and jumps of the fixes, and wheel spin.

Coverage is the share of errors within 95 % of the stated normal distribution; NEES is e' P^-1 e of east, north and
heading, with mean 3 for a true P (Bar-Shalom 5.4). Its bounds are the two-sided 99 % interval of the mean of as many
independent drives as there are seeds: samples of one drive are not independent, since the GNSS error is correlated over
a minute. A protection level may be exceeded for at most a second while the pose is valid. Beside it: accuracy, share of
time valid, error beyond the limit while valid (HMI), beyond the level and the protection level (`requirements`).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads only wait for each other

import numpy as np
from scipy.stats import chi2

from benchmarks import husky_nis
from benchmarks.requirements import HEALTHY, MILD_FAULT, Required
from benchmarks.rough_simulation import EncoderModel, GroundMotion, RoughSimulation, SideSlip, Terrain, TriadModel
from modelserver.earth.geodesy import origin_at
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.geometry import ModelBuilder
from modelserver.messages import Estimate, FixType, OrientationReference, WheelsSample
from modelserver.simulation import (
    DrivePhase,
    Event,
    GpsModel,
    ImuModel,
    Simulation,
    Timing,
    Trajectory,
    TrajectoryMotion,
    WheelsModel,
    city,
)
from modelserver.simulation.sensors import NoiseSource
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

SECONDS = 150.0
FIRST_SAMPLE, SAMPLE_PERIOD = 30.0, 10.0
"""Sampling times of the errors, seconds: the first after heading alignment."""
BOUND_PERIOD = 0.2
MAX_BREACH_S = 1.0
NORMAL_95 = 1.959964
ORIGIN = origin_at(50.27, -111.18, 700.0)
WHEELS = {"left": "Car:Left", "right": "Car:Right"}

MATCHED = FilterSettings(
    gps_latency_sigma=1e-4,
    gyro_noise=1e-3,
    gyro_bias_sigma=0.005,
    gyro_bias_walk=2e-5,
    accelerometer_noise=5e-3,
    accelerometer_bias_sigma=0.03,
    accelerometer_bias_walk=2e-4,
    wheel_scale_sigma=0.01,
    wheel_scale_walk=1e-7,
    wheel_yaw_sigma=0.01,
    wheel_yaw_walk=1e-8,
    # no slip except the random lateral speed
    slip_ratio=1e-5,
    slip_acceleration=1e-5,
    side_slip=1e-6,
    roll_point_sigma=1e-4,
    side_sigma=0.02,
    up_sigma=0.005,
    up_share=1e-4,
    stationary_sigma=1e-3,
    stationary_rate=0.01,
    stationary_force=0.05,
)
FIX_SIGMA = 0.6
"""Of a matched fix, meters: above the smallest range error of its kind."""
TRAVEL_SIGMA = 0.002


class DriveResult(NamedTuple):
    """Result of a drive: rows of error over sigma (east, north, heading) and NEES per instant, and breaches.

    `instants` is their number, `breach` the longest time for which a protection level was exceeded while the pose was
    valid, seconds, horizontal and heading. `looks` has five times a second after `FIRST_SAMPLE` whether the pose is
    valid, valid and beyond its limit, beyond the level, beyond the protection level, and its squared position error.
    """

    rows: list[tuple[float, float, float, float]]
    instants: int
    breach: tuple[float, float]
    looks: list[tuple[float, ...]]


@dataclass(frozen=True)
class DriveKind:
    """A kind of drive with its bounds: coverage, mean NEES (None: the interval for the number of seeds), bars."""

    name: str
    run: Callable[[int], DriveResult]
    coverage: tuple[float, float] | None
    nees: tuple[float, float] | None
    required: Required


class _RandomSideSlip:
    """Lateral speed, white up to a frequency of 1 / (2 `lasting`): its mean over T has variance s^2 lasting / T.

    The filter models errors of correlation time `lasting` so. Same interface as the simulator's slip angle.
    """

    def __init__(self, sigma: float, lasting: float, seed: int, count: int = 60):
        noise = NoiseSource(seed, "wandering").generator
        top = 0.5 / lasting
        amplitude = sigma * math.sqrt(2.0 / count)
        # one frequency in each of even cells: an even spectrum
        self._sines = [
            (amplitude, math.tau * top * (k + noise.uniform(0.0, 1.0)) / count, noise.uniform(-math.pi, math.pi))
            for k in range(count)
        ]

    def at(self, t: float, motion: TrajectoryMotion, higher: Vector3) -> Vector3:
        v, v1, v2 = motion.speed, motion.forward_acceleration, higher[2]
        w = w1 = w2 = 0.0
        for amplitude, omega, phase in self._sines:
            sine, cosine = amplitude * math.sin(omega * t + phase), amplitude * math.cos(omega * t + phase)
            w, w1, w2 = w + sine, w1 + omega * cosine, w2 - omega * omega * sine
        # no slip while stationary: the angle is w g with g = v^3 / (v^2 + fade)^2, smooth at v = 0
        fade = 0.09
        below = v * v + fade
        g, gv = v**3 / below**2, v * v * (3.0 * fade - v * v) / below**3
        gvv = 2.0 * v * (v**4 - 8.0 * fade * v * v + 3.0 * fade * fade) / below**4
        g1, g2 = gv * v1, gvv * v1 * v1 + gv * v2
        return (w * g, w1 * g + w * g1, w2 * g + 2.0 * w1 * g1 + w * g2)


class _TravelNoise:
    """Wheels with one scale error, and with travel noise that is redrawn in each compared period."""

    def __init__(self, settings: FilterSettings, seed: int):
        self._noise = NoiseSource(seed, "matched wheels")
        self._scale = 1.0 + self._noise.normal(settings.wheel_scale_sigma)
        self._period = settings.wheel_period
        self._last: dict[str, tuple[int, float]] = {}
        self._error: dict[str, float] = {}

    def __call__(self, events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            yield self._add_noise(event) if isinstance(event, WheelsSample) else event

    def _add_noise(self, sample: WheelsSample) -> WheelsSample:
        wheels = []
        for wheel in sample.wheels:
            utime = sample.header.utime
            before, way = self._last.get(wheel.name, (utime, wheel.travel))
            error = self._error.get(wheel.name, 0.0)
            if abs(wheel.travel - way) > 1e-5:
                share = (utime - before) * 1e-6 / self._period
                error += self._noise.normal(TRAVEL_SIGMA * math.sqrt(2.0 * share))
            self._last[wheel.name], self._error[wheel.name] = (utime, wheel.travel), error
            travel = wheel.travel * self._scale + error
            wheels.append(replace(wheel, travel=travel, travel_sigma=TRAVEL_SIGMA, speed=wheel.speed * self._scale))
        return replace(sample, wheels=tuple(wheels))


def _build_rig(turned: float) -> SensorRig:
    """Return a vehicle whose wheels roll to the left of its x axis by an angle, radians."""
    builder = ModelBuilder("car")
    car = builder.add_body("Car")
    X = Pose.from_rpy((0.0, 0.0, 0.0), 0.0, 0.0, -turned)
    car.add_frame("Rolling")
    car.add_frame("Base", X)
    car.add_frame("Imu", Pose.from_rpy((0.3, -0.3, 0.5), math.pi / 2, 0.0, -math.pi / 2))
    car.add_frame("Antenna", Pose((0.25, 0.1, 1.0)))
    car.add_frame("Left", Pose((0.0, 0.3, -0.1)))
    car.add_frame("Right", Pose((0.0, -0.3, -0.1)))
    return SensorRig(builder.build(), "Car:Base", "Car:Imu", "Car:Antenna", "", WHEELS, "differential")


def run_matched(seed: int) -> DriveResult:
    settings = MATCHED
    rig = _build_rig(NoiseSource(seed, "wheel yaw").normal(settings.wheel_yaw_sigma))
    share = settings.gps_white_share
    # stationary at first: leveling on the move assumes typical accelerations
    trajectory = Trajectory((DrivePhase(5.0), *city(seed, SECONDS - 5.0, speed=5.0)), yaw=0.7)
    motion = GroundMotion(trajectory, None, SideSlip(), seed)
    motion._slip = _RandomSideSlip(settings.side_sigma, settings.slip_time, seed)  # type: ignore[assignment]
    simulation = RoughSimulation(
        rig.model,
        "Car:Base",
        motion,  # type: ignore[arg-type]  # any MotionModel
        ORIGIN,
        rolling_frame="Car:Rolling",
        gps_frame="Car:Antenna",
        imu_frame="Car:Imu",
        wheel_frames=WHEELS,
        seed=seed,
        gps_model=GpsModel(
            correlated_sigma=FIX_SIGMA * math.sqrt(1.0 - share * share),
            white_sigma=FIX_SIGMA * share,
            time_constant=settings.gps_correlation_time,
            velocity_sigma=0.05,
            fix_type=FixType.DIFFERENTIAL,
        ),
        imu_model=ImuModel(
            timing=Timing(50.0, 0.004, 0.001),
            gyro_noise=settings.gyro_noise,
            gyro_bias_sigma=settings.gyro_bias_sigma,
            gyro_walk=settings.gyro_bias_walk,
            accelerometer_noise=settings.accelerometer_noise,
            accelerometer_bias_sigma=settings.accelerometer_bias_sigma,
            accelerometer=TriadModel(walk=settings.accelerometer_bias_walk),
            reference=OrientationReference.NONE,
        ),
        wheels_model=WheelsModel(Timing(10.0, 0.01, 0.002), scale_sigma=0.0, speed_sigma=0.01, travel_step=0.0),
    )
    return _run_drive(simulation, rig, settings, _TravelNoise(settings, seed))


def _simulate_rough(seed: int, gps: GpsModel, encoder: EncoderModel) -> DriveResult:
    rig = _build_rig(0.0)
    simulation = RoughSimulation(
        rig.model,
        "Car:Base",
        Trajectory(city(seed, SECONDS, speed=5.0), yaw=0.7),
        ORIGIN,
        gps_frame="Car:Antenna",
        imu_frame="Car:Imu",
        wheel_frames=WHEELS,
        seed=seed,
        gps_model=gps,
        imu_model=ImuModel(
            timing=Timing(50.0, 0.004, 0.001),
            accelerometer=TriadModel(scale_sigma=0.002, vibration=0.1),
            gyro=TriadModel(scale_sigma=0.002, instability=1e-4),
        ),
        wheels_model=WheelsModel(Timing(10.0, 0.01, 0.002), scale_sigma=0.02, slip=0.1, encoder=encoder),
        terrain=Terrain.hills(seed, steepness=0.06),
        # as large as in the settings, but correlated for up to half a minute instead of a second
        side_slip=SideSlip(cornering=0.006, random_sigma=0.02),
    )
    return _run_drive(simulation, rig, FilterSettings(), lambda events: events)


COLORED = GpsModel(correlated_sigma=0.7, white_sigma=0.1, time_constant=30.0, sigma_factor=0.9)
"""Fixes with errors 10 % larger than stated, with half the correlation time of the settings.

By a fifth more, and no filter without another source could hold 90 %: then 1.96 stated sigmas are 1.63 true ones.
"""


def run_stronger(seed: int) -> DriveResult:
    return _simulate_rough(seed, COLORED, EncoderModel())


def run_faults(seed: int) -> DriveResult:
    chance = NoiseSource(seed, "faults").generator
    angle = chance.uniform(-math.pi, math.pi)
    far = (5.0, 20.0, 700.0)[seed % 3]
    jumped = chance.uniform(95.0, 105.0)
    lost = chance.uniform(45.0, 55.0)
    gps = replace(
        COLORED,
        outages=((lost, lost + 30.0),),
        jumps=((jumped, jumped + 10.0, far * math.cos(angle), far * math.sin(angle)),),
    )
    return _simulate_rough(seed, gps, EncoderModel(burst_rate=0.05, burst_seconds=1.0, burst_excess=0.5))


def _run_drive(
    simulation: Simulation,
    rig: SensorRig,
    settings: FilterSettings,
    transform: Callable[[Iterable[Event]], Iterable[Event]],
) -> DriveResult:
    localizer = FilterLocalizer.start(Setup(rig, settings), ORIGIN)
    begin = simulation.start_utime
    due, look = begin + round(FIRST_SAMPLE * 1e6), begin
    rows, instants = [], 0
    breaches = (_Breach(), _Breach())
    looks: list[tuple[float, ...]] = []
    for event in transform(simulation.events(SECONDS)):
        localizer, _ = localizer.process(event)
        utime = localizer.utime
        if utime < look:
            continue
        look = utime + round(BOUND_PERIOD * 1e6)
        estimate = localizer.estimate(utime)
        good = estimate.enu is not None and not estimate.invalid
        e = _compute_error(simulation, estimate)
        if utime >= begin + round(FIRST_SAMPLE * 1e6):
            looks.append(_look(localizer, estimate, e, good))
        if not good:
            for breach in breaches:
                breach.stop()
            instants, due = (instants + 1, due + round(SAMPLE_PERIOD * 1e6)) if utime >= due else (instants, due)
            continue
        breaches[0].update(utime, math.hypot(e[0], e[1]) > estimate.horizontal_protection_level)
        breaches[1].update(utime, abs(e[2]) > estimate.heading_protection_level)
        if utime >= due:
            instants, due = instants + 1, due + round(SAMPLE_PERIOD * 1e6)
            keep = [0, 1, 5]
            P = np.array(estimate.covariance).reshape(6, 6)[np.ix_(keep, keep)]
            z = np.array(e) / np.sqrt(np.diagonal(P))
            rows.append((*z.tolist(), float(np.array(e) @ np.linalg.solve(P, np.array(e)))))
    return DriveResult(rows, instants, (breaches[0].longest, breaches[1].longest), looks)


def _look(localizer: FilterLocalizer, estimate: Estimate, error: Vector3, is_valid: bool) -> tuple[float, ...]:
    """Return a row of `DriveResult.looks`."""
    summary = localizer.summary(estimate.utime)
    sizes = (math.hypot(error[0], error[1]), abs(error[2]))
    bounds = (
        (summary.horizontal_limit, summary.heading_limit),
        (estimate.horizontal_level, estimate.heading_level),
        (estimate.horizontal_protection_level, estimate.heading_protection_level),
    )
    is_wrong, *beyond = (any(size > bound for size, bound in zip(sizes, pair, strict=True)) for pair in bounds)
    return (is_valid, is_valid and is_wrong, *beyond, sizes[0] ** 2)


def _compute_error(simulation: Simulation, estimate: Estimate) -> tuple[float, float, float]:
    """Return the errors east, north, and of heading; nan without a pose."""
    if estimate.enu is None:
        return (math.nan, math.nan, math.nan)
    true = simulation.truth(estimate.utime).enu
    turn = math.remainder(estimate.enu.rpy[2] - true.rpy[2], math.tau)
    return (estimate.enu.xyz[0] - true.xyz[0], estimate.enu.xyz[1] - true.xyz[1], turn)


class _Breach:
    """Longest uninterrupted time for which a bound is exceeded."""

    def __init__(self) -> None:
        self.since = 0
        self.longest = 0.0

    def update(self, utime: int, passed: bool) -> None:
        if not passed:
            self.since = 0
            return
        self.since = self.since or utime
        self.longest = max(self.longest, (utime - self.since) * 1e-6)

    def stop(self) -> None:
        self.since = 0


KINDS = (
    DriveKind("matched", run_matched, (0.92, 0.98), None, HEALTHY),
    DriveKind("stronger", run_stronger, (0.90, 1.0), (0.0, 6.0), HEALTHY),
    DriveKind("faults", run_faults, None, None, MILD_FAULT),
)


def nees_interval(seeds: int, dof: int = 3, risk: float = 0.01) -> tuple[float, float]:
    """Return the interval of the mean NEES of independent drives at a probability of 1 - risk."""
    n = seeds * dof
    return float(chi2.ppf(0.5 * risk, n)) / seeds, float(chi2.ppf(1.0 - 0.5 * risk, n)) / seeds


def print_line(what: str, measured: float, low: float, high: float) -> bool:
    holds = low <= measured <= high
    asked = f"{low:g} to {high:.4g}" if math.isfinite(high) else f"at least {low:g}"
    print(f"  {what:44} {measured:9.4f}   ({asked}){'' if holds else '  <-- OUT OF BOUNDS'}")
    return holds


def evaluate(kind: DriveKind, drives: list[DriveResult]) -> bool:
    """Print the results of a kind of drives; return whether they are within bounds."""
    rows = np.array([row for drive in drives for row in drive.rows])
    instants = sum(drive.instants for drive in drives)
    looks = np.array([look for drive in drives for look in drive.looks])
    valid, wrong, level, protection = looks[:, :4].mean(axis=0).tolist()
    print(f" {kind.name}: {len(drives)} drives, {len(rows)} of {instants} instants valid")
    required = kind.required
    print(f"  {'position RMSE, m':44} {math.sqrt(np.nanmean(looks[:, 4])):9.4f}")
    holds = [
        print_line("share of time valid", valid, required.valid, 1.0),
        print_line("seconds an hour beyond the limit while valid", wrong * 3600.0, 0.0, required.hmi),
        print_line("share of time beyond the level", level, 0.0, required.beyond_level),
        print_line("share of time beyond the protection level", protection, 0.0, required.beyond_protection),
    ]
    inside = np.abs(rows[:, :3]) <= NORMAL_95
    coverage = kind.coverage or (0.0, 1.0)
    holds.append(print_line("position within 95 %, each axis", float(inside[:, :2].mean()), *coverage))
    holds.append(print_line("heading within 95 %", float(inside[:, 2].mean()), *coverage))
    if kind.coverage is not None:
        nees = kind.nees or nees_interval(len(drives))
        holds.append(print_line("mean NEES of east, north, heading", float(rows[:, 3].mean()), *nees))
        print(f"    of it, (error / sigma)^2: {', '.join(f'{x:.2f}' for x in (rows[:, :3] ** 2).mean(axis=0))}")
    for k, name in enumerate(("horizontal", "heading")):
        worst = max(drive.breach[k] for drive in drives)
        holds.append(print_line(f"{name} bound passed while valid, at most, s", worst, 0.0, MAX_BREACH_S))
    return all(holds)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--only", choices=[kind.name for kind in KINDS])
    parser.add_argument("--jobs", type=int, default=min(os.cpu_count() or 1, 2))
    options = parser.parse_args([] if arguments is None else arguments)
    seeds = range(options.first, options.first + options.seeds)
    holds = True
    with ProcessPoolExecutor(options.jobs) as pool:
        for kind in KINDS:
            if options.only in (None, kind.name):
                holds &= evaluate(kind, list(pool.map(kind.run, seeds, chunksize=2)))
    if options.only is None:
        nis = husky_nis.compute_mean_nis()
        if nis is None:
            print(" recording skipped: no husky/test1.bag; set MODELSERVER_DATA to the folder of recordings")
        else:
            print(" Husky recording")
            for name, mean in nis.items():
                holds &= print_line(f"mean NIS of {name} / its degrees of freedom", mean, 0.5, 2.0)
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
