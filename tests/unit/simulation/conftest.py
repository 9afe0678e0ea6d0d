"""A vehicle with tilted sensors far from its base frame, for the tests of simulation options."""

from __future__ import annotations

import math

import pytest

from benchmarks.rough_simulation import (
    RoughSimulation,
    Terrain,
    Wave,
    make_noise_free_gps,
    make_noise_free_imu,
    make_noise_free_wheels,
)
from modelserver.earth.geodesy import origin_at
from modelserver.geometry import Model, ModelBuilder
from modelserver.simulation import Simulation, Trajectory, figure_eight
from modelserver.transforms.pose import Pose

WHEELS = {"front_left": "Car:FL", "front_right": "Car:FR", "rear_left": "Car:RL", "rear_right": "Car:RR"}


@pytest.fixture(scope="session")
def origin():
    return origin_at(50.27, -111.18, 700.0)


@pytest.fixture(scope="session")
def car() -> Model:
    builder = ModelBuilder("car")
    body = builder.add_body("Car")
    body.add_frame("CG", Pose((0.9, 0.0, 0.6))).add_frame("RearAxle")
    for name, x, y in (("FL", 1.6, 0.6), ("FR", 1.6, -0.6), ("RL", 0.0, 0.6), ("RR", 0.0, -0.6)):
        body.add_frame(name, Pose((x, y, -0.1)))
    body.add_frame("Antenna", Pose((0.3, -0.4, 1.8))).add_frame("Second", Pose((0.2, 0.6, 1.7)))
    body.add_frame("Imu", Pose.from_rpy((1.1, 0.3, 1.2), math.pi, 0.1, 0.7))
    body.add_frame("Camera", Pose.from_rpy((1.5, 0.1, 0.9), -0.2, 0.1, 0.05))
    return builder.build()


@pytest.fixture(scope="session")
def eight() -> Trajectory:
    return Trajectory(
        figure_eight(speed=3.0, radius=6.0, stationary=2.0, stop=1.0, reverse=3.0), start=(20.0, -10.0), yaw=0.4
    )


@pytest.fixture(scope="session")
def hills() -> Terrain:
    return Terrain(0.05, -0.08, (Wave(0.6, 25.0, 0.3, 1.0), Wave(0.3, 14.0, 2.0), Wave(1.0, 60.0, -1.2, 0.5)))


@pytest.fixture
def simulate(car, origin, eight):
    """A simulation without noise whose settings can be exchanged; a sensor is there when its model is named."""

    def make(trajectory: Trajectory | None = None, **more) -> Simulation:
        settings = {
            "gps_frame": "Car:Antenna" if "gps_model" in more else None,
            "imu_frame": "Car:Imu" if "imu_model" in more else None,
            "wheel_frames": WHEELS if "wheels_model" in more else None,
            "rolling_frame": "Car:RearAxle",
        }
        return RoughSimulation(car, "Car:CG", trajectory or eight, origin, **(settings | more))

    return make


@pytest.fixture
def quiet() -> dict[str, object]:
    """The three sensors without noise."""
    return {
        "gps_model": make_noise_free_gps(),
        "imu_model": make_noise_free_imu(),
        "wheels_model": make_noise_free_wheels(),
    }
