from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice

import pytest
from support_cart import GEODESY
from support_dynamics import cart_with_mast

from modelserver.simulation.timing import Run
from modelserver.simulation.trajectory import DrivePhase, Trajectory, TrajectoryMotion
from modelserver.simulation.wheel_loads import MAX_SLIP_FACTOR, WheelLoads
from modelserver.simulation.wheels import WheelsModel, simulate_wheels

pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")

WHEELS = {name: f"Cart:{name}" for name in ("front_left", "front_right", "rear_left", "rear_right")}
WEIGHT = 100.0 * 9.80665
SIDES = (("left", 0.4), ("right", -0.4))
HEIGHT, TRACK, BASE = 0.6, 0.8, 1.0


def motion(speed: float = 0.0, yaw_rate: float = 0.0, braking: float = 0.0) -> TrajectoryMotion:
    """Return the motion of a vehicle that drives east, and turns to the left."""
    return TrajectoryMotion(
        position=(0.0, 0.0, 0.0),
        velocity=(speed, 0.0, 0.0),
        acceleration=(-braking, speed * yaw_rate, 0.0),
        yaw=0.0,
        yaw_rate=yaw_rate,
        yaw_acceleration=0.0,
        speed=speed,
        forward_acceleration=-braking,
        distance=0.0,
        curvature=yaw_rate / speed if speed else 0.0,
    )


@pytest.fixture
def loads() -> WheelLoads:
    return WheelLoads(cart_with_mast().dynamics("fixed"), WHEELS)


def test_given_vehicle_at_rest_then_wheels_share_the_weight(loads: WheelLoads) -> None:
    assert loads.compute(motion()) == pytest.approx(dict.fromkeys(WHEELS, WEIGHT / 4))
    assert loads.compute_slip_factors(motion()) == pytest.approx(dict.fromkeys(WHEELS, 1.0))


def test_given_turn_and_braking_then_loads_move_out_and_ahead(loads: WheelLoads) -> None:
    found = loads.compute(motion(speed=2.0, yaw_rate=1.0, braking=1.0))
    assert sum(found.values()) == pytest.approx(WEIGHT)
    right, front = (sum(load for name, load in found.items() if word in name) for word in ("right", "front"))
    assert right == pytest.approx(WEIGHT / 2 + 100.0 * 2.0 * HEIGHT / TRACK)
    assert front == pytest.approx(WEIGHT / 2 + 100.0 * 1.0 * HEIGHT / BASE)
    factors = loads.compute_slip_factors(motion(speed=2.0, yaw_rate=1.0))
    assert factors["front_left"] > 1.0 > factors["front_right"]


def test_given_limit_of_tipping_then_lifted_wheels_spin_at_the_most(loads: WheelLoads) -> None:
    tips = 9.80665 * TRACK / 2 / HEIGHT
    factors = loads.compute_slip_factors(motion(speed=1.0, yaw_rate=0.999 * tips))
    assert factors["front_left"] == MAX_SLIP_FACTOR
    assert all(math.isnan(load) for load in loads.compute(motion(speed=1.0, yaw_rate=1.01 * tips)).values())


def test_given_mast_aside_then_its_side_carries_more() -> None:
    found = WheelLoads(cart_with_mast().dynamics("fixed"), WHEELS, {"Slide": 0.5}).compute(motion())
    assert found["front_left"] == pytest.approx(WEIGHT / 4 * (1.0 + 0.1 / (TRACK / 2)))


def test_given_simulated_drive_then_the_inner_wheels_slip_more(loads: WheelLoads) -> None:
    phases = (DrivePhase(3.0, speed=3.0, curvature=0.3), DrivePhase(3.0), DrivePhase(1.0, speed=0.0))
    contacts = {f"{end}_{side}": (x, y, 0.0) for end, x in (("front", 0.5), ("rear", -0.5)) for side, y in SIDES}
    exact = WheelsModel.noise_free()
    travels = []
    for model in (exact, replace(exact, slip=0.2), replace(exact, slip=0.2, loads=loads)):
        run = Run(Trajectory(phases), GEODESY, 1_700_000_000_000_000, 1)
        samples = list(islice(simulate_wheels(model, run, contacts), 110))
        travels.append({each.name: each.travel for each in samples[-1].wheels})
    bare, even, loaded = travels
    excess = {name: (even[name] / bare[name], loaded[name] / bare[name]) for name in WHEELS}
    assert all(without > 1.0 for without, _ in excess.values())
    assert excess["rear_left"][1] > excess["rear_left"][0]
    assert excess["rear_right"][1] < excess["rear_right"][0]
