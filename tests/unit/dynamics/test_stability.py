from __future__ import annotations

import math

import numpy as np
import pytest
from support_dynamics import cart_with_mast

from modelserver.dynamics import assess_stability, compute_tip_over
from modelserver.errors import MalformedRequestError
from modelserver.transforms import Pose

M, G, H = 100.0, 9.80665, 0.6
CONTACTS = {
    "front left": np.array([0.5, 0.4, 0.0]),
    "front right": np.array([0.5, -0.4, 0.0]),
    "rear left": np.array([-0.5, 0.4, 0.0]),
    "rear right": np.array([-0.5, -0.4, 0.0]),
}
CENTER = np.array([0.1, 0.0, H])
WEIGHT = np.array([0.0, 0.0, -M * G])
NONE = np.zeros(3)
Y = np.array([0.0, 1.0, 0.0])


FRAMES = [f"Cart:{name.replace(' ', '_')}" for name in CONTACTS]


def test_given_vehicle_at_rest_then_margin_and_loads_are_those_of_a_hand_calculation():
    found = compute_tip_over(CONTACTS, CENTER, WEIGHT, NONE)
    # it tips to the side first: half the track over the height
    assert found.margin == pytest.approx(math.atan2(0.4, H))
    assert found.measure == pytest.approx(M * G * math.atan2(0.4, H))
    assert set(found.edge) in ({"front left", "rear left"}, {"front right", "rear right"})
    assert math.isnan(found.sigma)
    # the center is 0.1 m ahead of the middle of 1 m: 60 % on the front wheels
    assert found.loads["front left"] == pytest.approx(0.3 * M * G)
    assert found.loads["rear right"] == pytest.approx(0.2 * M * G)


def test_given_turn_to_the_right_then_the_left_edge_is_weak_and_loaded():
    a = 3.0  # m/s2 to the right: the inertial force is to the left
    found = compute_tip_over(CONTACTS, CENTER, WEIGHT + M * a * Y, NONE)
    assert found.margin == pytest.approx(math.atan2(0.4, H) - math.atan2(a, G))
    assert set(found.edge) == {"front left", "rear left"}
    shift = M * a * H / 0.8
    left = found.loads["front left"] + found.loads["rear left"]
    assert left == pytest.approx(M * G / 2 + shift)


def test_given_limit_of_tipping_then_margin_is_zero_and_two_wheels_carry_all():
    found = compute_tip_over(CONTACTS, CENTER, WEIGHT + M * G * 0.4 / H * Y, NONE)
    assert found.margin == pytest.approx(0.0, abs=1e-12)
    beyond = compute_tip_over(CONTACTS, CENTER, WEIGHT + 1.01 * M * G * 0.4 / H * Y, NONE)
    assert beyond.margin < 0.0
    assert all(map(math.isnan, beyond.loads.values()))


def test_given_moment_then_it_tips_as_the_same_force_beside_the_center_does():
    # at the limit both lines of action pass through the edge
    moment = np.cross([0.0, 0.4, 0.0], WEIGHT)
    found = compute_tip_over(CONTACTS, CENTER, WEIGHT, moment)
    assert found.margin == pytest.approx(0.0, abs=1e-12)
    aside = compute_tip_over(CONTACTS, CENTER, WEIGHT, 0.5 * moment).loads
    assert aside["front left"] == pytest.approx(
        compute_tip_over(CONTACTS, CENTER + 0.2 * Y, WEIGHT, NONE).loads["front left"]
    )


def test_given_contact_inside_the_polygon_then_it_carries_but_is_no_corner():
    inside = compute_tip_over(CONTACTS | {"middle": np.zeros(3)}, CENTER, WEIGHT, NONE)
    assert inside.margin == pytest.approx(math.atan2(0.4, H))
    assert sum(inside.loads.values()) == pytest.approx(M * G)
    assert inside.loads["middle"] == pytest.approx(M * G / 5)


def test_given_load_over_one_corner_then_the_opposite_wheel_lifts_and_the_others_balance():
    center = np.array([0.3, 0.25, H])
    loads = compute_tip_over(CONTACTS, center, WEIGHT, NONE).loads
    assert loads["rear right"] == 0.0
    assert sum(loads.values()) == pytest.approx(M * G)
    assert sum(load * CONTACTS[name] for name, load in loads.items())[:2] == pytest.approx(M * G * center[:2])


def test_given_slope_then_the_polygon_may_have_any_axes():
    tilt = Pose.from_rpy((3.0, -2.0, 1.0), roll=0.2)
    turned = {name: tilt.transform(at) for name, at in CONTACTS.items()}
    found = compute_tip_over(turned, tilt.transform(CENTER), WEIGHT, NONE)
    assert found.margin == pytest.approx(math.atan2(0.4, H) - 0.2)


def test_given_uncertain_center_then_sigma_is_first_order():
    P = np.diag([0.02, 0.01, 0.03]) ** 2
    found = compute_tip_over(CONTACTS, CENTER, WEIGHT, NONE, P, np.zeros((3, 3)))
    # theta = atan(y / h)
    square = 0.4**2 + H**2
    assert found.sigma == pytest.approx(math.hypot(H / square * 0.01, 0.4 / square * 0.03), rel=1e-5)


@pytest.mark.parametrize(
    "contacts", [{}, {"a": [0, 0, 0], "b": [1, 0, 0]}, {"a": [0, 0, 0], "b": [1, 0, 0], "c": [2, 0, 0]}]
)
def test_given_contacts_on_a_line_then_the_error_states_what_is_needed(contacts):
    with pytest.raises(MalformedRequestError, match="three that are not on a line"):
        compute_tip_over({name: np.array(at, dtype=float) for name, at in contacts.items()}, CENTER, WEIGHT, NONE)


def test_given_no_gravity_then_the_error_states_so():
    with pytest.raises(MalformedRequestError, match="needs gravity"):
        compute_tip_over(CONTACTS, CENTER, NONE, NONE)


class TestVehicle:
    @pytest.fixture(autouse=True)
    def _pinocchio(self):
        pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")

    def test_given_mast_aside_and_tilt_then_static_margin_is_that_of_a_hand_calculation(self):
        dynamics = cart_with_mast().dynamics()
        q = {"Slide": 0.5, "Cart:Origin.rx": -0.1}
        found = assess_stability(dynamics, q, FRAMES)
        # 20 % of the mass moves by 0.5 m: the center is 0.1 m to the left, 0.6 m up; it leans 0.1 rad to the left
        assert found.center.position == pytest.approx([0.0, 0.1, 0.6])
        assert found.static.margin == pytest.approx(math.atan2(0.3, 0.6) - 0.1)
        assert found.static.edge == ("Cart:front_left", "Cart:rear_left")
        assert found.dynamic is None

    def test_given_accelerations_of_base_and_mast_then_both_count(self):
        dynamics = cart_with_mast().dynamics()
        a = {"Cart:Origin.y": -2.0, "Slide": -3.0}
        found = assess_stability(dynamics, {}, FRAMES, {}, a)
        assert found.dynamic is not None
        # about the ground: 80 kg at 0.5 m with 2 m/s2, 20 kg at 1 m with 5 m/s2
        moment = 80 * 0.5 * 2.0 + 20 * 1.0 * 5.0
        left = sum(load for name, load in found.dynamic.loads.items() if name.endswith("left"))
        assert left == pytest.approx(100 * G / 2 + moment / 0.8)
        assert found.dynamic.margin < found.static.margin

    def test_given_sigmas_then_they_widen_the_margin(self):
        dynamics = cart_with_mast().dynamics()
        assert math.isnan(assess_stability(dynamics, {}, FRAMES, sigma={"Slide": math.nan}).static.sigma)
        assert assess_stability(dynamics, {}, FRAMES, sigma={}).static.sigma == 0.0  # all frames are at an origin
        from modelserver.dynamics import MassUncertainty

        dynamics = cart_with_mast().dynamics(uncertainty=MassUncertainty(unstated_is_exact=True))
        square = 0.4**2 + H**2
        found = assess_stability(dynamics, {}, FRAMES, sigma={"Slide": 0.01})
        assert found.static.sigma == pytest.approx(H / square * 0.2 * 0.01, rel=1e-5)
        tilted = assess_stability(dynamics, {}, FRAMES, sigma={}, tilt_covariance=np.diag([0.02, 0, 0]) ** 2)
        assert tilted.static.sigma == pytest.approx(0.02, rel=1e-5)

    def test_given_payload_then_the_margin_falls(self):
        model = cart_with_mast()
        before = assess_stability(model.dynamics(), {}, FRAMES).static.margin
        after = assess_stability(model.dynamics(payload={"Mast:Foot": 50.0}), {"Slide": 0.3}, FRAMES).static.margin
        assert after < before
