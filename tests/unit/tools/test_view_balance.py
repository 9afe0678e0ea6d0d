"""Dynamics in the viewer: what is computed for joints and tilt as they are set, and what is drawn of it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")
pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")

from modelserver.dynamics.stability import DynamicsSettings
from modelserver.transforms import so3
from mstools.view.balance import NODE, Balance, Balancer, _find_turn, format_balance
from mstools.view.page import Page, open_page
from mstools.view.sources import open_geometry
from mstools.view.viewer import Viewer

CART = """\
modelserver: geometry/1
bodies:
  Cart:
    inertia: {mass: 80, center: [0, 0, 0.5], moments: [5, 9, 10]}
    frames:
      Origin: {}
      FrontLeftContact: {xyz: [0.6, 0.4, 0]}
      FrontRightContact: {xyz: [0.6, -0.4, 0]}
      RearLeftContact: {xyz: [-0.6, 0.4, 0]}
      RearRightContact: {xyz: [-0.6, -0.4, 0]}
  Mast:
    inertia: {mass: 20, moments: [1, 1, 1]}
    frames: {Foot: {}}
constraints:
  Slide:
    from: Cart:Origin
    to: Mast:Foot
    xyz: [0, 0, 1.0]
    joint: {type: prismatic, axis: [0, 1, 0], limits: [-3, 3], sigma: 0.01}
"""
VEHICLE = """\
vehicle: Cart
geometry: cart.yaml
base_frame: Cart:Origin
"""


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    (tmp_path / "cart.yaml").write_text(CART)
    return tmp_path / "cart.yaml"


@pytest.fixture
def page() -> Iterator[Page]:
    opened = open_page(port=0)
    yield opened
    opened.close()


def compute(path: Path, joints: dict[str, float], roll: float = 0.0, contacts: Any = None) -> Balance:
    model = open_geometry(path, {}).drive.model
    assert model is not None
    frames = [each.full_name for body in model.bodies for each in body if each.name.endswith("Contact")]
    balancer = Balancer(model, "Cart:Origin", DynamicsSettings())
    return balancer.compute(joints, roll, 0.0, frames if contacts is None else contacts)


def test_given_a_mast_moved_aside_and_a_tilt_then_the_balance_is_that_of_a_hand_calculation(cart: Path) -> None:
    # 20 % of the mass moves by 1 m: the center is 0.2 m to the left, 0.6 m up
    found = compute(cart, {"Slide": 1.0})
    assert found.center.position == pytest.approx([0.0, 0.2, 0.6])
    assert found.margin == pytest.approx(math.atan2(0.2, 0.6))
    assert set(found.edge) == {"Cart:FrontLeftContact", "Cart:RearLeftContact"}
    assert sum(found.loads.values()) == pytest.approx(found.weight)
    # the left contacts have 0.6 / 0.8 of the weight
    assert found.loads["Cart:FrontLeftContact"] == pytest.approx(found.weight * 0.75 / 2.0)
    assert found.foot == pytest.approx([0.0, 0.2, 0.0])
    assert found.sigma > 0.0
    # the roll lifts the left side: gravity meets the plane further right
    tilted = compute(cart, {"Slide": 1.0}, roll=0.1)
    assert tilted.margin == pytest.approx(math.atan2(0.2, 0.6) + 0.1)
    assert tilted.foot == pytest.approx([0.0, 0.2 - 0.6 * math.tan(0.1), 0.0])
    assert compute(cart, {"Slide": 3.0}).margin == pytest.approx(math.atan2(-0.2, 0.6))


def test_given_no_contacts_or_bodies_without_mass_then_the_text_states_so(cart: Path) -> None:
    found = compute(cart, {}, contacts=())
    assert (found.margin, found.foot) == (None, None)
    assert "name three frames" in format_balance(found, 0.1)
    cart.write_text(CART.replace("    inertia: {mass: 20, moments: [1, 1, 1]}\n", ""))
    assert "without mass: Mast" in format_balance(compute(cart, {}), 0.1)
    assert "close to tipping" in format_balance(compute(cart, {}), 1.0)


def draw(page: Page, path: Path) -> Viewer:
    viewer = Viewer(page, open_geometry(path, {}))
    viewer.draw(0.0, 0.0)
    return viewer


def get_node(page: Page, name: str) -> Any:
    return page.server.scene.get_handle_by_name(f"{NODE}/{name}")


def test_given_joints_that_are_moved_then_ball_polygon_columns_and_numbers_follow(page: Page, cart: Path) -> None:
    (cart.parent / "vehicle.yaml").write_text(f"{VEHICLE}dynamics: {{contacts: []}}\n")
    viewer = draw(page, cart.parent / "vehicle.yaml")
    panel, source = viewer._balance, viewer._source
    assert panel is not None
    assert source.set_joints is not None
    assert tuple(get_node(page, "center").position) == pytest.approx((0.0, 0.0, 0.6))
    assert get_node(page, "edges").points.shape == (3, 2, 3)
    source.set_joints({"Slide": 1.0})
    viewer.draw(0.1, 0.1)
    assert tuple(get_node(page, "center").position) == pytest.approx((0.0, 0.2, 0.6))
    weak = get_node(page, "weak").points
    assert weak[0, :, 1] == pytest.approx([0.4, 0.4])
    assert "Tip-over margin **18.4" in panel._text.content
    columns = panel._scene._columns.values()
    size = viewer._scene.size
    assert sorted(column.scale[2] for column, _ in columns) == pytest.approx(
        [0.125 * size] * 2 + [0.375 * size] * 2, rel=1e-3
    )
    assert "368 N" in {label.text for _, label in columns}
    # beyond the wheels it tips, and no load is known
    source.set_joints({"Slide": 3.0})
    viewer.draw(0.2, 0.1)
    assert "it tips" in panel._text.content
    assert not any(column.visible for column, _ in panel._scene._columns.values())


def test_given_no_section_in_the_vehicle_file_then_nothing_is_computed_until_asked_for(page: Page, cart: Path) -> None:
    with patch("mstools.view.balance.Balancer", side_effect=AssertionError):
        viewer = draw(page, cart)
    panel = viewer._balance
    assert panel is not None
    assert not page.server.scene.get_handle_by_name(NODE).visible  # type: ignore[union-attr]
    panel._is_on.value = True
    viewer.draw(0.1, 0.1)
    assert "Mass **100.0 kg**" in panel._text.content
    panel._contacts.value = "Cart:Nose, Cart:Origin"
    viewer.draw(0.2, 0.1)
    # the center is shown nevertheless
    assert "has no frame 'Nose'" in panel._text.content
    assert "Mass **100.0 kg**" in panel._text.content
    panel._is_on.value = False
    viewer.draw(0.3, 0.1)
    assert panel._text.content == ""


def test_given_a_geometry_without_mass_then_the_panel_states_the_fix(page: Page, cart: Path) -> None:
    cart.write_text("\n".join(line for line in CART.splitlines() if "inertia" not in line))
    viewer = draw(page, cart)
    panel = viewer._balance
    assert panel is not None
    panel._is_on.value = True
    viewer.draw(0.1, 0.1)
    assert "no body has a mass" in panel._text.content


def test_given_contacts_on_any_plane_then_columns_stand_upright_on_it() -> None:
    for normal in np.random.default_rng(1).normal(size=(20, 3)):
        unit = normal / np.linalg.norm(normal)
        turned = so3.rotate(so3.exponential(so3.to_vector3(_find_turn(unit))), (0.0, 0.0, 1.0))
        assert turned == pytest.approx(unit)
    assert _find_turn(np.array((0.0, 0.0, -1.0))) == pytest.approx([math.pi, 0.0, 0.0])
