"""The camera of the scene: it fits what is drawn, and has views from the front, the side and above.

A direction of view and points p_i that are to be seen give the camera's distance d from their center c. With b the unit
vector from the center to the camera, r and u those to the right and up in the picture, and half angles of view h and v,
a point is seen where

    |r (p_i - c)| <= (d - b (p_i - c)) tan h      and      |u (p_i - c)| <= (d - b (p_i - c)) tan v

so that d is the greatest of b (p_i - c) + |r (p_i - c)| / tan h and the same with u and v.

A model that is loaded is fitted again where its size changed, for each browser whose camera nobody moved since.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import viser

from modelserver.transforms.so3 import Array, Vector3
from mstools.view.page import Actions

FIELD_OF_VIEW: Final = math.radians(45.0)
"""Vertical: that of a usual lens; a wider one distorts what is at the side."""

ASPECT: Final = 1.2
"""Width by height of the scene before a browser has stated its own: what the panel leaves of a usual window."""

MARGIN: Final = 1.12
"""Distance of the camera relative to the least one, so that nothing touches the border."""

MIN_DISTANCE: Final = 0.2
"""Least distance of the camera, meters: a model that is a point has axes of 25 mm."""

GROWTH: Final = 1.2
"""A loaded model that is larger or smaller by more than this is fitted again; an edit is not."""

MOVED: Final = 0.03
"""A camera farther than this from where it was set, relative to its distance, was moved by a person."""

VIEWS: Final[dict[str, Vector3]] = {
    "Front": (1.0, 0.0, 0.0),
    "Side": (0.0, -1.0, 0.0),
    # almost: exactly above, no direction would be up in the picture; so it is ahead
    "Above": (-1e-3, 0.0, 1.0),
    "Oblique": (1.2, 1.6, 1.1),
}
"""Directions from the vehicle to the camera, x ahead, y left: in the side view it drives to the right."""

KEYS: Final = {"Fit": "F", "Front": "1", "Side": "2", "Above": "3", "Oblique": "4"}
"""Keys of the views; the page itself moves the camera by W, A, S, D, Q, E and the arrows."""


class CameraPose(NamedTuple):
    """Where a camera is and what it looks at, in the scene, meters."""

    position: Array
    look_at: Array

    def is_near(self, other: CameraPose) -> bool:
        distance = MOVED * float(np.linalg.norm(self.position - self.look_at))
        return all(float(np.linalg.norm(a - b)) <= distance for a, b in zip(self, other, strict=True))


def fit_camera(points: Array, direction: Array, fov: float, aspect: float) -> CameraPose:
    """Return the pose of a camera that sees all points (n, 3) from a direction (3), with z up in the picture.

    Straight from above or below, x is up. `fov` is the vertical angle of view in radians, `aspect` the width of the
    picture by its height.
    """
    back = direction / np.linalg.norm(direction)
    right = np.cross((0.0, 0.0, 1.0), back)
    right = right / np.linalg.norm(right) if right.any() else np.array((0.0, -1.0, 0.0))
    axes = np.stack([right, np.cross(back, right), back])
    # the middle along each axis of the picture: that of the points would be where most of them are
    seen = points @ axes.T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    x, y, z = (seen - middle).T
    tangent = math.tan(fov / 2.0)
    distance = float(max((z + np.abs(x) / (tangent * aspect)).max(), (z + np.abs(y) / tangent).max()))
    center = middle @ axes
    return CameraPose(center + max(MARGIN * distance, MIN_DISTANCE) * back, center)


def project(points: Array, camera: Any) -> tuple[Array, Array]:
    """Return where a browser's camera sees points (n, 3) of the scene: pixels (n, 2) from the upper left, and depths.

    A point behind the camera has a depth that is not positive, and no pixel.
    """
    forward = camera.look_at - camera.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right = right / np.linalg.norm(right)
    offsets = points - camera.position
    depths = offsets @ forward
    focal = 0.5 * camera.image_height / math.tan(0.5 * camera.fov)
    seen = np.where(depths > 0.0, depths, math.nan)
    x = 0.5 * camera.image_width + focal * (offsets @ right) / seen
    y = 0.5 * camera.image_height - focal * (offsets @ np.cross(right, forward)) / seen
    return np.column_stack([x, y]), depths


def choose_labels(pixels: Array, depths: Array, widths: Array, height: float) -> npt.NDArray[np.bool_]:
    """Return which labels are shown so that none covers another: the nearest first. Sizes are in pixels."""
    shown = np.zeros(len(pixels), bool)
    for number in np.argsort(depths):
        if not np.isfinite(pixels[number]).all():
            continue
        dx, dy = np.abs(pixels[shown] - pixels[number]).T
        shown[number] = not np.any((dx < 0.5 * (widths[shown] + widths[number])) & (dy < height))
    return shown


class ViewCamera:
    """The cameras of all browsers.

    Parameters
    ----------
    list_points : returns the points (n, 3) that are to be seen, in the scene
    get_heading : returns the yaw of the vehicle in the scene, radians
    """

    def __init__(self, server: viser.ViserServer, list_points: Callable[[], Array], get_heading: Callable[[], float]):
        self._server = server
        self._list_points = list_points
        self._get_heading = get_heading
        self._set: dict[int, CameraPose] = {}
        self._fitted = 0.0
        initial = server.initial_camera
        initial.fov, initial.position, initial.look_at = FIELD_OF_VIEW, (3.0, 3.0, 3.0), (0.0, 0.0, 0.0)
        self._initial = [CameraPose(initial.position, initial.look_at)]

    def add_controls(self, gui: viser.GuiApi, actions: Actions) -> None:
        """Add the buttons of the views, and their keys."""
        buttons = gui.add_button_group("View", tuple(KEYS), hint=f"Keys: {', '.join(map(' '.join, KEYS.items()))}")
        buttons.on_click(lambda event: actions.put(partial(self.show, event.client, str(event.target.value))))
        for view, key in KEYS.items():
            command: Any = gui.add_command(f"View: {view}", hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(lambda event, view=view: actions.put(partial(self.show, event.client, view)))

    def show(self, client: viser.ClientHandle | None, view: str) -> None:
        """Show a browser one of `VIEWS`, or what is there from where its camera is."""
        if client is None:
            return
        direction = client.camera.position - client.camera.look_at
        if view in VIEWS:
            direction = self._turn(VIEWS[view])
        self._fit(client, direction)

    def update(self, is_loaded: bool) -> None:
        """Fit the cameras of browsers that came since; with `is_loaded`, those of all to a model of another size."""
        if is_loaded:
            self._fit_loaded()
        clients = self._server.get_clients()
        for number in self._set.keys() - clients.keys():
            del self._set[number]
        for number in clients.keys() - self._set.keys():
            client = clients[number]
            self._set[number] = at = _get_pose(client)
            # a browser that was connected before, or whose link states a place, has another one
            if self._fitted and any(at.is_near(each) for each in self._initial):
                self._fit(client, at.position - at.look_at)

    def find_latest(self) -> Any:
        """Return the camera that was moved last, None without a browser."""
        cameras = [client.camera for client in self._server.get_clients().values()]
        return max(cameras, key=lambda each: each.update_timestamp, default=None)

    def move(self, offset: Array) -> None:
        """Move all cameras, so that the picture stays where the whole scene moves."""
        for number, client in self._server.get_clients().items():
            # what it looks at moves with it
            client.camera.position = client.camera.position + offset
            if number in self._set:
                self._set[number] = CameraPose(*(each + offset for each in self._set[number]))

    def _fit_loaded(self) -> None:
        points = self._list_points()
        if not len(points):
            return
        size = max(float(np.ptp(points, axis=0).max()), MIN_DISTANCE)
        if self._fitted / GROWTH <= size <= self._fitted * GROWTH:
            return
        self._fitted = size
        direction = self._turn(VIEWS["Oblique"])
        found = fit_camera(points, direction, FIELD_OF_VIEW, ASPECT)
        self._server.initial_camera.position, self._server.initial_camera.look_at = found
        self._initial.append(found)
        for number, client in self._server.get_clients().items():
            if number in self._set and self._set[number].is_near(_get_pose(client)):
                self._fit(client, direction)

    def _turn(self, direction: Vector3) -> Array:
        """Return a direction that is given in the vehicle, level in the scene."""
        c, s = math.cos(self._get_heading()), math.sin(self._get_heading())
        x, y, z = direction
        return np.array((c * x - s * y, s * x + c * y, z))

    def _fit(self, client: viser.ClientHandle, direction: Array) -> None:
        camera, points = client.camera, self._list_points()
        if not len(points):
            return
        found = fit_camera(points, direction, camera.fov, camera.aspect)
        camera.position, camera.look_at = found
        self._set[client.client_id] = found


def _get_pose(client: viser.ClientHandle) -> CameraPose:
    return CameraPose(client.camera.position.copy(), client.camera.look_at.copy())
