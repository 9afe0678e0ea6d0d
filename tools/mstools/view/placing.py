"""The editor's resolver: place what is selected by a frame with which it coincides, or by distances from others."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import viser

from modelserver.geometry.parts import Sigma
from modelserver.geometry.placement import (
    DistanceFit,
    Placement,
    list_measured_points,
    locate_by_distances,
    place_constraint,
    place_frame,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from mstools.edit.document import SAME_RADIANS, EditSession, GeometryDocument, GeometryItem, ItemKind
from mstools.edit.yaml_text import EditError
from mstools.view.item_fields import ChangeItem, find_part, list_frames
from mstools.view.number_fields import NumberFields
from mstools.view.panels import escape_markdown, format_table

MAX_DISTANCES: Final = 6
NO_FRAME: Final = "-"
DIGITS: Final = 6
"""Decimals of what is computed: micrometers, and millionths of a degree."""


class PlacePanel:
    """Two folders: frames that coincide, and distances."""

    def __init__(
        self,
        gui: viser.GuiApi,
        session: EditSession,
        change: ChangeItem,
        actions: queue.SimpleQueue[Callable[[], None]],
    ):
        self._session = session
        self._change = change
        self._item: GeometryItem | None = None
        with gui.add_folder("Frames that coincide"):
            self._hint = gui.add_markdown("")
            self._frame: Any = gui.add_dropdown("Frame", (NO_FRAME,))
            self._target: Any = gui.add_dropdown("is at", (NO_FRAME,))
            self._position_only: Any = gui.add_checkbox("Position only", False)
            coincide = gui.add_button("Place there")
        with gui.add_folder("Distances from frames"):
            self._rows: list[tuple[Any, NumberFields]] = []
            for number in range(1, MAX_DISTANCES + 1):
                frame = gui.add_dropdown(f"From {number}", (NO_FRAME,))
                self._rows.append((frame, NumberFields(gui, (f"distance {number} (m)",), (0.0,), actions)))
            self._sigma = NumberFields(gui, ("sigma (m)",), (0.002,), actions)
            self._mirrored: Any = gui.add_checkbox("On the other side", False, hint="Three distances fit two positions")
            by_distances = gui.add_button("Place by distances")
            self._result = gui.add_markdown("")
        coincide.on_click(lambda _: actions.put(self._coincide))
        by_distances.on_click(lambda _: actions.put(self._measure))

    def show(self, item: GeometryItem) -> None:
        """Offer the frames for an item."""
        if item != self._item:
            self._result.content = ""
        self._item = item
        frames = (NO_FRAME, *list_frames(self._session.document))
        is_constraint = item.kind is ItemKind.CONSTRAINT
        self._frame.visible = is_constraint
        self._hint.content = {
            ItemKind.CONSTRAINT: "Moves the constraint so that two frames, one on each side, are the same place.",
            ItemKind.FRAME: "Moves the frame on its body to where another frame is.",
        }.get(item.kind, "Select a frame or a constraint.")
        for dropdown in (self._frame, self._target, *(frame for frame, _ in self._rows)):
            chosen = dropdown.value
            dropdown.options = frames
            dropdown.value = chosen if chosen in frames else NO_FRAME

    def _coincide(self) -> None:
        item, target = self._item, self._target.value
        if item is None:
            return
        position_only = self._position_only.value

        def change(document: GeometryDocument) -> GeometryDocument:
            model = self._session.model
            if model is None or self._session.has_errors:
                raise EditError("fix the errors first; a pose is computed from a geometry without any")
            if target == NO_FRAME:
                raise EditError("choose the frame with which it coincides")
            if item.kind is ItemKind.FRAME:
                found = place_frame(model, item.name, target, position_only)
            elif item.kind is ItemKind.CONSTRAINT:
                if self._frame.value == NO_FRAME:
                    raise EditError("choose the two frames that coincide")
                found = place_constraint(model, item.name, self._frame.value, target, position_only)
            else:
                raise EditError("select a frame or a constraint")
            part = find_part(model, item)
            assert part is not None
            return _write(document, item, found, part.pose)

        self._change(change, None)

    def _measure(self) -> None:
        """Place a frame by its distances from others."""
        item = self._item
        if item is None:
            return

        def change(document: GeometryDocument) -> GeometryDocument:
            model = self._session.model
            if model is None or self._session.has_errors:
                raise EditError("fix the errors first; a position is computed from a geometry without any")
            if item.kind is not ItemKind.FRAME:
                raise EditError("select the frame to which the distances were measured")
            given = [(frame.value, distance.value[0]) for frame, distance in self._rows if frame.value != NO_FRAME]
            points, P = list_measured_points(model, item.name, [name for name, _ in given])
            distances = np.array([distance for _, distance in given], float)
            (sigma_m,) = self._sigma.value
            sigmas = np.full(len(given), sigma_m)
            start = model.frame(item.name).pose
            fit = locate_by_distances(points, distances, sigmas, start.xyz, P)
            if self._mirrored.value:
                if fit.mirrored is None:
                    raise EditError("the distances fit on one side only")
                fit = locate_by_distances(points, distances, sigmas, fit.mirrored, P)
            self._result.content = _describe(fit, [name for name, _ in given], sigma_m)
            old = model.frame(item.name).sigma or Sigma()
            sigma = Sigma(so3.to_vector3(np.sqrt(np.diag(fit.covariance))), old.rotation)
            return _write(document, item, Placement(Pose(fit.position, start.wxyz), sigma), start)

        self._change(change, None)


def _write(document: GeometryDocument, item: GeometryItem, found: Placement, old: Pose) -> GeometryDocument:
    """Write a placement; a rotation that is the old one stays as it is written."""
    degrees = np.degrees(found.pose.rpy)
    is_turned = old.distance(found.pose)[1] > SAME_RADIANS
    placed = document.set_pose(item, _round(found.pose.xyz), _round(degrees) if is_turned else so3.to_vector3(degrees))
    if found.sigma is None:
        return placed
    return placed.set_sigma(item, _round(found.sigma.position), _round(np.degrees(found.sigma.rotation)))


def _round(values: Any) -> Vector3:
    x, y, z = (round(float(each), DIGITS) + 0.0 for each in values)
    return (x, y, z)


def _describe(fit: DistanceFit, frames: list[str], sigma: float) -> str:
    deviations = np.sqrt(np.diag(fit.covariance)).tolist()
    rows = [
        (frame, f"{1000.0 * residual:+.1f} mm", "too large" if abs(residual) > 3.0 * sigma else "")
        for frame, residual in zip(frames, fit.residuals.tolist(), strict=True)
    ]
    parts = [format_table(("from", "residual", ""), rows)]
    parts.append("Sigma x, y, z: " + ", ".join(f"{1000.0 * each:.1f} mm" for each in deviations))
    if fit.mirrored is not None:
        place = ", ".join(f"{each:.4f}" for each in fit.mirrored)
        parts.append(escape_markdown(f"They fit at {place} m too, on the other side of the plane of the frames."))
    return "\n\n".join(parts)
