"""Dynamics of a geometry with its joints as they are set: center of mass, support polygon, tip-over margin, loads.

`Balancer` computes, `BalancePanel` shows the numbers in the tab Joints and draws below
/world/vehicle/dynamics: a ball at the center of mass in the ellipsoid of its uncertainty, the line from there along
gravity to the plane of the contacts, the support polygon with the edge about which the vehicle would tip first, and
beside each contact a column of the height of its load: all of the weight has that of the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import viser

from modelserver.dynamics import CenterOfMass, MassUncertainty, assess_stability, find_contacts
from modelserver.dynamics.stability import DynamicsSettings, SupportPolygon
from modelserver.errors import ModelServerError
from modelserver.geometry.model import Model
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array
from mstools.recordings.pose_signals import CHI_SQUARE_3, compute_ellipsoid
from mstools.view.page import escape_markdown, format_table
from mstools.view.scene import INVALID_COLOR, Rgb

NODE: Final = "/world/vehicle/dynamics"
CONTACTS: Final = "*Contact"
"""Pattern of the contacts where a vehicle file states none: that of `modelserver new` and the Raptor."""

MAX_TILT_DEG: Final = 60.0
CONFIDENCE: Final = 95
"""Of the drawn ellipsoid, percent."""

BALL_SCALE: Final = 0.02
"""Radius of the ball at the center of mass, as a part of the size of the vehicle: less than half of a frame's axis."""

COLUMN_SCALE: Final = 0.02
"""Radius of a column, likewise."""

COLUMN_DISTANCE: Final = 0.12
"""Distance of a column from its contact, away from the others, likewise: beside the wheel."""

CENTER_COLOR: Final[Rgb] = (150, 60, 200)
EDGE_COLOR: Final[Rgb] = (0, 130, 110)
WEAK_COLOR: Final[Rgb] = (213, 94, 0)


class Balance(NamedTuple):
    """Where the mass is, and how the vehicle stands; all in the base frame.

    `down` is the direction of gravity. `contacts` are points by name, `corners` the names of those around the support
    polygon; both are empty, and `margin` None, without contacts. `loads` are in newtons.
    """

    center: CenterOfMass
    down: Array
    weight: float
    notes: tuple[str, ...]
    contacts: Mapping[str, Array]
    corners: tuple[str, ...] = ()
    normal: Array | None = None
    margin: float | None = None
    sigma: float = math.nan
    edge: tuple[str, str] = ("", "")
    loads: Mapping[str, float] = {}

    @property
    def foot(self) -> Array | None:
        """The point below the center of mass, along gravity, on the plane of the contacts; None where there is none."""
        if self.normal is None or abs(slope := float(self.down @ self.normal)) < 1e-3:
            return None
        mean = np.mean(list(self.contacts.values()), axis=0)
        found: Array = self.center.position + self.down * (((mean - self.center.position) @ self.normal) / slope)
        return found


class Balancer:
    """Computes the balance of a model. Raises ModelServerError as `Dynamics` does, where the extra is missing too."""

    def __init__(self, model: Model, base_frame: str, settings: DynamicsSettings):
        uncertainty = MassUncertainty(settings.mass_sigma, settings.center_sigma, unstated_is_exact=True)
        # what was left out is named in the notes
        self._dynamics = model.dynamics(
            "floating", base_frame, allow_massless=True, cut_loops=True, uncertainty=uncertainty
        )

    def compute(self, joints: Mapping[str, float], roll: float, pitch: float, contacts: Sequence[str]) -> Balance:
        """Return the balance with joints at positions by coordinate, tilted by roll and pitch, radians.

        `contacts` are frames at the contacts with the ground. Raises ModelServerError.
        """
        dynamics, root = self._dynamics, self._dynamics.tree.root
        q_tilt = so3.from_rpy(roll, pitch, 0.0)
        tilt = dict(zip((f"{root}.{name}" for name in ("rx", "ry", "rz")), so3.logarithm(q_tilt), strict=True))
        known = set(dynamics.coordinates)
        q = tilt | {name: position for name, position in joints.items() if name in known}
        sigma = dynamics.stated_sigmas
        center = dynamics.center_of_mass(q, frame=root, sigma=sigma)
        down = np.array(so3.rotate_back(q_tilt, (0.0, 0.0, -1.0)))
        notes = [
            f"{what}: {', '.join(found)}"
            for what, found in (("without mass", dynamics.massless), ("loops cut at", dynamics.cut))
            if found
        ]
        weight = dynamics.mass * dynamics.gravitational_acceleration
        if not contacts:
            return Balance(center, down, weight, tuple(notes), {})
        found = assess_stability(dynamics, q, contacts, sigma=sigma).static
        X_WR, *placed = dynamics.frame_poses(q, (root, *contacts))
        points = {name: (X_WR.inverse() @ X).position for name, X in zip(contacts, placed, strict=True)}
        polygon = SupportPolygon.of(points, center.position)
        corners = tuple(polygon.names[number] for number in polygon.corners)
        margin = (found.margin, found.sigma, found.edge, found.loads)
        return Balance(center, down, weight, tuple(notes), points, corners, polygon.axes[2], *margin)


class BalanceScene:
    """Draws a balance."""

    def __init__(self, scene: viser.SceneApi):
        self._scene = scene
        self._columns: dict[str, tuple[Any, Any]] = {}
        self._root = scene.add_frame(NODE, show_axes=False, visible=False)
        self._ball = scene.add_icosphere(f"{NODE}/center", 1.0, CENTER_COLOR)
        self._label = scene.add_label(f"{NODE}/mass", "", anchor="bottom-center")
        self._ellipsoid = scene.add_icosphere(f"{NODE}/uncertainty", 1.0, CENTER_COLOR, opacity=0.3)
        self._lines = {
            name: scene.add_line_segments(
                f"{NODE}/{name}", np.zeros((0, 2, 3), np.float32), color, thickness=width, thickness_units="screen"
            )
            for name, color, width in (
                ("plumb", CENTER_COLOR, 2.0),
                ("edges", EDGE_COLOR, 3.0),
                ("weak", WEAK_COLOR, 6.0),
            )
        }

    def hide(self) -> None:
        self._root.visible = False

    def show(self, balance: Balance, size: float) -> None:
        """Draw a balance of a vehicle of a size, meters."""
        self._root.visible = True
        center = balance.center
        self._ball.position, self._ball.scale = center.position, BALL_SCALE * size
        # the body hides the ball, but no label
        self._label.position, self._label.text = center.position, f"{center.mass:.0f} kg"
        self._ellipsoid.visible = center.covariance is not None and bool(np.isfinite(center.covariance).all())
        if center.covariance is not None and self._ellipsoid.visible:
            self._ellipsoid.scale, axes = compute_ellipsoid(center.covariance, CHI_SQUARE_3[CONFIDENCE])
            self._ellipsoid.position, self._ellipsoid.wxyz = center.position, axes.wxyz
        foot = balance.foot
        corners = list(zip(balance.corners, (*balance.corners[1:], *balance.corners[:1]), strict=True))
        is_tipping = balance.margin is not None and balance.margin < 0.0
        self._lines["weak"].colors = np.array(INVALID_COLOR if is_tipping else WEAK_COLOR, np.uint8)
        self._draw("plumb", [] if foot is None else [(center.position, foot)])
        for name, is_weak in (("edges", False), ("weak", True)):
            chosen = [each for each in corners if (set(each) == set(balance.edge)) == is_weak]
            self._draw(name, [(balance.contacts[first], balance.contacts[second]) for first, second in chosen])
        self._show_columns(balance, size)

    def _draw(self, name: str, segments: Sequence[tuple[Array, Array]]) -> None:
        self._lines[name].visible = bool(segments)
        if segments:
            self._lines[name].points = np.array(segments, np.float32)

    def _show_columns(self, balance: Balance, size: float) -> None:
        for name in self._columns.keys() - balance.loads.keys():
            for node in self._columns.pop(name):
                node.remove()
        if balance.normal is None:
            return
        mean = np.mean(list(balance.contacts.values()), axis=0)
        upright = so3.exponential(so3.to_vector3(_find_turn(balance.normal)))
        for number, (name, load) in enumerate(balance.loads.items()):
            if name not in self._columns:
                node = f"{NODE}/loads/{len(self._columns)} {number}"
                column = self._scene.add_cylinder(node, 1.0, 1.0, color=EDGE_COLOR)
                self._columns[name] = column, self._scene.add_label(f"{node} N", "", anchor="bottom-center")
            column, label = self._columns[name]
            away = balance.contacts[name] - mean
            foot = balance.contacts[name] + away * (COLUMN_DISTANCE * size / max(float(np.linalg.norm(away)), 1e-9))
            height = size * load / balance.weight if math.isfinite(load) else 0.0
            column.visible = height > 0.0
            column.scale = (COLUMN_SCALE * size, COLUMN_SCALE * size, max(height, 1e-6))
            column.position, column.wxyz = foot + balance.normal * height / 2.0, upright
            label.position = foot + balance.normal * height
            label.text = f"{load:.0f} N" if math.isfinite(load) else "tips"


def _find_turn(normal: Array) -> Array:
    """Return the shortest rotation vector from z to a unit vector."""
    axis = np.cross((0.0, 0.0, 1.0), normal)
    length = float(np.linalg.norm(axis))
    angle = math.atan2(length, float(normal[2]))
    return axis * (angle / length) if length > 1e-12 else np.array((angle, 0.0, 0.0))


class BalancePanel:
    """The numbers, with what the vehicle stands on; computes and draws what changed."""

    def __init__(self, gui: viser.GuiApi, scene: viser.SceneApi, settings: DynamicsSettings | None):
        self._settings = settings or DynamicsSettings()
        self._scene = BalanceScene(scene)
        self._model: tuple[Model, str] | None = None
        self._balancer: Balancer | None = None
        self._shown: tuple[object, ...] = ()
        with gui.add_folder("Dynamics", expand_by_default=settings is not None):
            self._is_on = gui.add_checkbox("Center of mass and loads", settings is not None)
            stated = settings.contacts if settings is not None else ()
            self._contacts = gui.add_text(
                "Contacts", ", ".join(stated) or CONTACTS, hint="Frames at the ground, or patterns, with commas"
            )
            self._roll, self._pitch = (
                gui.add_slider(f"Tilt: {name} (deg)", -MAX_TILT_DEG, MAX_TILT_DEG, 0.5, 0.0)
                for name in ("roll", "pitch")
            )
            self._text = gui.add_markdown("")

    def set_model(self, model: Model, base_frame: str) -> None:
        """Show the balance of another model."""
        self._model, self._balancer, self._shown = (model, base_frame), None, ()

    def update(self, joints: Mapping[str, float], size: float) -> None:
        """Compute and draw again what changed; `size` is that of the vehicle, meters."""
        is_on, names = self._is_on.value, self._contacts.value
        state = (is_on, names, self._roll.value, self._pitch.value, dict(joints))
        if state == self._shown or self._model is None:
            return
        self._shown = state
        if not is_on:
            self._scene.hide()
            self._text.content = ""
            return
        try:
            balance = self._compute(joints, names)
        except ModelServerError as error:
            self._scene.hide()
            self._text.content = escape_markdown(str(error))
            return
        self._scene.show(balance, size)
        self._text.content = format_balance(balance, self._settings.margin_limit)

    def _compute(self, joints: Mapping[str, float], names: str) -> Balance:
        assert self._model is not None
        model, base_frame = self._model
        if self._balancer is None:
            self._balancer = Balancer(model, base_frame, self._settings)
        patterns = [each.strip() for each in names.split(",") if each.strip()]
        contacts = find_contacts(model, patterns)
        roll, pitch = (math.radians(each.value) for each in (self._roll, self._pitch))
        try:
            return self._balancer.compute(joints, roll, pitch, () if contacts == (CONTACTS,) else contacts)
        except ModelServerError as error:
            # the center is known without contacts; what else is wrong is raised again
            plain = self._balancer.compute(joints, roll, pitch, ())
            return plain._replace(notes=(*plain.notes, str(error)))


def format_balance(balance: Balance, limit: float) -> str:
    """Return the numbers of a balance as Markdown; `limit` is the margin below which the service warns, radians."""
    center = balance.center
    x, y, z = (center.position + 0.0).tolist()
    lines = [f"Mass **{center.mass:.1f} kg**, center of mass **{x:.3f}, {y:.3f}, {z:.3f} m** in the base frame"]
    if center.covariance is not None and np.isfinite(center.covariance).all():
        sigma = np.sqrt(np.maximum(np.diag(center.covariance), 0.0)).tolist()
        lines[0] += f", sigma {', '.join(f'{each:.3f}' for each in sigma)} m"
    if balance.margin is None:
        lines.append("No contacts with the ground: name three frames or more for tip-over margin and loads.")
    else:
        sigma_text = "" if math.isnan(balance.sigma) else f" &plusmn; {math.degrees(balance.sigma):.1f}"
        edge = escape_markdown(" and ".join(balance.edge))
        state = " - **it tips**" if balance.margin < 0.0 else " - close to tipping" if balance.margin < limit else ""
        lines.append(f"Tip-over margin **{math.degrees(balance.margin):.1f}{sigma_text} deg** about {edge}{state}")
        rows = [
            (
                name,
                "-" if math.isnan(load) else f"{load:.0f}",
                "-" if math.isnan(load) else f"{load / balance.weight:.1%}",
            )
            for name, load in balance.loads.items()
        ]
        lines.append(format_table(("contact", "N", "of weight"), rows))
    lines += map(escape_markdown, balance.notes)
    return "\n\n".join(lines)
