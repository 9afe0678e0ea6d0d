"""A cart for the unit tests of the filter: a rig with everything on it, any state, and simulated drives."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from modelserver.earth.geodesy import Geodesy, LocalFrame, origin_at
from modelserver.estimation.filter.eskf import NavState
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.measurements.gnss import LATENCY
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.sensor_rig import Kinematics, Mounts, SensorRig
from modelserver.geometry import Model, ModelBuilder
from modelserver.simulation import (
    START_UTIME,
    Event,
    GpsModel,
    ImuModel,
    Simulation,
    Timing,
    Trajectory,
    WheelsModel,
    figure_eight,
)
from modelserver.transforms import Pose, so3

BASE, IMU, ANTENNA, SECOND, CAMERA = (f"Cart:{name}" for name in ("Base", "Imu", "Antenna", "Second", "Camera"))
WHEELS = {name: f"Cart:{name}" for name in ("FL", "FR", "RL", "RR")}
STEERED = frozenset(("FL", "FR"))
ORIGIN = origin_at(50.27, -111.1, 700.0)
GEODESY = Geodesy(ORIGIN)
SITE = LocalFrame.at(50.2705, -111.1004, 702.0)
"""Some fifty meters from the origin: N's axes are not World:ENU's."""


@lru_cache
def model() -> Model:
    builder = ModelBuilder("cart")
    body = builder.add_body("Cart").add_frame("Base")
    body.add_frame("Imu", Pose.from_rpy((0.3, -0.1, 0.4), math.pi, 0.1, 0.5))
    body.add_frame("Antenna", Pose((-0.4, 0.25, 1.2)))
    body.add_frame("Second", Pose((0.6, 0.35, 1.1)))
    body.add_frame("Camera", Pose.from_rpy((0.5, 0.1, 0.8), 0.2, -0.3, 0.4))
    for name, x, y in (("FL", 1.2, 0.5), ("FR", 1.2, -0.5), ("RL", 0.0, 0.5), ("RR", 0.0, -0.5)):
        body.add_frame(name, Pose((x, y, -0.3)))
    return builder.build()


MOUNTS = Mounts.from_model(model(), BASE, ANTENNA, IMU)


def rig(
    kinematics: Kinematics = "differential",
    wheels: tuple[str, ...] = ("RL", "RR"),
    *,
    imu: bool = True,
    gps: bool = True,
) -> SensorRig:
    return SensorRig(
        model(),
        BASE,
        IMU if imu else "",
        ANTENNA if gps else "",
        SECOND if gps else "",
        {name: WHEELS[name] for name in wheels},
        kinematics,
    )


def some_nav(setup: Setup, seed: int, *, extras: bool = True) -> NavState:
    """A random state; its additional states are 0 without `extras`, and the latency of fixes is always 0."""
    rng = np.random.default_rng(seed)
    names = setup.layout.extra_names
    values = rng.uniform(-0.1, 0.1, len(names)) if extras else np.zeros(len(names))

    def three(size: float) -> tuple[float, float, float]:
        a, b, c = rng.uniform(-size, size, 3).tolist()
        return a, b, c

    roll, pitch, _ = three(0.4)
    return NavState(
        START_UTIME,
        three(40.0),
        three(6.0),
        so3.from_rpy(roll, pitch, three(3.0)[0]),
        three(0.05),
        three(0.2),
        tuple(0.0 if name == LATENCY else float(value) for name, value in zip(names, values, strict=True)),
        np.diag(rng.uniform(0.01, 0.02, setup.layout.size)),
        rate=three(0.5),
        force=(0.3, -0.2, 9.7),
    )


def drive(seconds: float, seed: int = 3, imu_hz: float = 25.0, **given: object) -> tuple[Simulation, list[Event]]:
    """A figure eight after three stationary seconds, and the samples of its first seconds."""
    options = {
        "gps_frame": ANTENNA,
        "imu_frame": IMU,
        "wheel_frames": {name: WHEELS[name] for name in ("RL", "RR")},
        "imu_model": ImuModel(Timing(imu_hz, latency=0.004)),
        "gps_model": GpsModel(Timing(5.0, latency=0.05)),
        "wheels_model": WheelsModel(Timing(10.0, latency=0.01)),
        "seed": seed,
        "trajectory": Trajectory(figure_eight(3.0, 8.0, stationary=3.0, ramp=2.0, laps=3), yaw=0.7),
        **given,
    }
    trajectory = options.pop("trajectory")
    simulation = Simulation(model(), BASE, trajectory, ORIGIN, **options)  # type: ignore[arg-type]
    return simulation, list(simulation.events(seconds))


def localizer(settings: FilterSettings | None = None, the_rig: SensorRig | None = None) -> FilterLocalizer:
    return FilterLocalizer.start(Setup(the_rig or rig(), settings), ORIGIN)


def process_all(localizer: FilterLocalizer, samples: list[Event]) -> FilterLocalizer:
    for sample in samples:
        localizer, _ = localizer.process(sample)
    return localizer


def same(a: object, b: object) -> bool:
    """Return whether two values are the same to the last bit, arrays by their bytes."""
    if callable(a) and callable(b):
        # values that are computed when they are called
        return same(a(), b())
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple) and isinstance(b, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (math.isnan(a) and math.isnan(b))
    if hasattr(a, "keys") and hasattr(b, "keys"):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a.keys())  # type: ignore[index]  # noqa: SIM118
    return type(a) is type(b) and bool(a == b)
