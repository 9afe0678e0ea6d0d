"""Frames that programs add while the service runs: added, moved, removed, reloaded over, stored, and rejected."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support_samples import (
    GEOMETRY,
    ME,
    START,
    VEHICLE,
    start_core,
    wait_for_reload,
    write_vehicle,
)

from modelserver.config.vehicle_file import load_config
from modelserver.core import CoreState, ModelLoaded, step
from modelserver.estimation.modes import ModeLocalizer
from modelserver.messages import Lifetime, LoadModel, ReloadModel, SetFrame, SignedCommand
from modelserver.server.added_frames import MAX_FRAMES, change_frames
from modelserver.server.clock import FakeClock
from modelserver.server.persistence import AddedFramesStore, FileLock
from modelserver.server.reloading import GeometryReader, read_geometry
from modelserver.server.vehicle import load_vehicle
from modelserver.transforms.pose import Pose

MARKER = SetFrame(ME, "Camera:Marker", Pose((0.0, 0.0, 0.5)), (0.01, 0.01, 0.01))
STORED = MARKER._replace(lifetime=Lifetime.PERMANENT)


class Rig:
    """A core and a reader with a geometry file and a store, without a bus."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.store = AddedFramesStore(folder, "cart")
        self.vehicle = load_vehicle(load_config(write_vehicle(folder, VEHICLE, GEOMETRY)))
        self.start()

    def start(self) -> str:
        self.reader = GeometryReader(self.vehicle, read=read_geometry, frames=self.store)
        vehicle, problem = self.reader.restore_frames()
        self.clock = FakeClock(START)
        self.state: CoreState = vehicle.start_core(self.clock.now())
        return problem

    def send(self, request: SetFrame | ReloadModel) -> ModelLoaded:
        loaded = wait_for_reload(self.reader.begin)(LoadModel(request), self.state)(self.state)
        assert loaded is not None
        self.state, _ = step(self.state, loaded, self.clock.now())
        return loaded

    def write(self, geometry: str) -> None:
        (self.folder / "geometry.yaml").write_text(geometry)

    def height(self, frame: str = "Camera:Marker") -> float:
        return self.state.model.get_transformation(frame, "Cart:Base").position[2]


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_given_a_frame_then_it_is_there_with_its_sigma_and_localization_continues(rig: Rig) -> None:
    before = rig.state.localizer
    assert rig.send(MARKER).changes == ("frame Camera:Marker is new",)
    assert rig.height() == pytest.approx(1.6)
    found = rig.state.model.get_transformation("Camera:Marker", "Camera:Origin")
    assert found.covariance is not None
    assert found.covariance[0, 0] == pytest.approx(1e-4)
    assert isinstance(before, ModeLocalizer)
    assert isinstance(rig.state.localizer, ModeLocalizer)
    assert rig.state.localizer.active.utime == before.active.utime
    # a sample may be of it
    assert rig.state.localizer.config.setup.rig.model is rig.state.model


def test_given_a_name_again_then_the_frame_moves_and_given_a_removal_it_is_gone(rig: Rig) -> None:
    old = rig.state.model.revision
    rig.send(MARKER)
    rig.send(MARKER._replace(pose=Pose((0.0, 0.0, 0.7))))
    assert rig.height() == pytest.approx(1.8)
    rig.send(SetFrame(ME, "Camera:Marker", lifetime=Lifetime.REMOVED))
    assert rig.state.model.revision == old


def test_given_a_reload_then_added_frames_stay_and_those_that_no_longer_fit_are_left_out(rig: Rig) -> None:
    rig.send(MARKER)
    rig.write(GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.2]"))
    assert rig.send(ReloadModel(ME)).changes == ("constraint Mounted moves by 100 mm and 0 deg",)
    assert rig.height() == pytest.approx(1.7)
    rig.write(GEOMETRY.replace("      Origin:\n", "      Origin:\n      Marker: {xyz: [0, 0, 0.9]}\n"))
    dry = rig.send(ReloadModel(ME, dry_run=True))
    assert rig.height() == pytest.approx(1.7)
    done = rig.send(ReloadModel(ME))
    assert done.changes == dry.changes
    assert done.changes[-1] == (
        "not added: the geometry file has a frame 'Camera:Marker'; give the added one another name"
    )
    assert rig.height() == pytest.approx(2.0)
    rig.write(GEOMETRY)
    rig.send(ReloadModel(ME))
    assert rig.height() == pytest.approx(1.6)


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        ("Camera", "'Camera' is not of the form Body:Frame"),
        ("Camrea:Marker", "the geometry has no such body; bodies: Cart, Camera"),
        ("World:Dock", "the geometry has no such body"),
        ("Camera:Origin", "the geometry file has a frame 'Camera:Origin'"),
        ("Camera:A B", "a name has no white space"),
        ("Camera:" + "x" * 300, "at most 200 characters"),
        ("", "is not of the form Body:Frame"),
    ],
)
def test_given_a_frame_that_cannot_be_added_then_nothing_changes_and_why_is_known(
    rig: Rig, frame: str, why: str
) -> None:
    before = rig.state.model
    assert why in rig.send(MARKER._replace(frame=frame)).why
    assert rig.state.model is before


def test_given_sigmas_that_are_none_then_they_are_rejected(rig: Rig) -> None:
    for sigma in ((-1.0, 0.0, 0.0), (math.nan, 0.0, 0.0), (math.inf, 0.0, 0.0)):
        assert "a sigma is finite and not negative" in rig.send(MARKER._replace(rotation_sigma=sigma)).why


def test_given_a_frame_that_was_not_added_then_its_removal_is_rejected_with_those_that_were(rig: Rig) -> None:
    request = SetFrame(ME, "Camera:Origin", lifetime=Lifetime.REMOVED)
    assert "'Camera:Origin' is no added frame; added frames: there are none" in rig.send(request).why
    rig.send(MARKER)
    assert "added frames: Camera:Marker" in rig.send(request).why


def test_given_frames_without_end_then_a_bound_holds(rig: Rig) -> None:
    model = rig.vehicle.model
    many = tuple(MARKER._replace(frame=f"Camera:Marker{number}") for number in range(MAX_FRAMES))
    with pytest.raises(ValueError, match="1000 added frames"):
        change_frames(many, MARKER, model)
    assert len(change_frames(many, many[0], model)) == MAX_FRAMES


# --- restart ----------------------------------------------------------------------------------------------------------


def test_given_a_restart_then_permanent_frames_are_there_bit_for_bit_and_others_are_gone(rig: Rig) -> None:
    turned = STORED._replace(frame="Cart:Tool", pose=Pose.from_rpy((0.1, 1 / 3, 0.7), 0.1, 0.2, 0.3))
    rig.send(turned)
    revision = rig.state.model.revision
    rig.send(MARKER)
    assert rig.start() == ""
    assert rig.state.model.revision == revision
    rig.send(turned._replace(lifetime=Lifetime.REMOVED))
    rig.start()
    assert not rig.state.model.body("Cart").has_frame("Tool")


def test_given_a_permanent_frame_that_becomes_temporary_then_it_is_gone_after_a_restart(rig: Rig) -> None:
    rig.send(STORED)
    rig.send(MARKER)
    rig.start()
    assert not rig.state.model.body("Camera").has_frame("Marker")


BAD_POSE = '{"version": 1, "frames": [{"frame": "Camera:M", "position": [0, 0, "x"], "orientation": [1, 0, 0, 0]}]}'


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        "7",
        '{"version": 2, "frames": []}',
        '{"version": 1, "frames": [{}]}',
        "\x00",
        "[" * 10**5,
        BAD_POSE,
    ],
)
def test_given_a_damaged_file_then_the_start_goes_on_and_the_reason_is_known(rig: Rig, content: str) -> None:
    rig.store.path.write_text(content)
    assert f"the added frames in {rig.store.path} cannot be read" in rig.start()
    rig.send(STORED)
    assert rig.start() == ""
    assert rig.height() == pytest.approx(1.6)


def test_given_a_stored_frame_whose_body_is_gone_then_the_start_goes_on_without_it(rig: Rig) -> None:
    rig.send(STORED)
    text = rig.store.path.read_text()
    rig.store.path.write_text(text.replace("Camera:", "Gone:"))
    assert "frame 'Gone:Marker': the geometry has no such body" in rig.start()


def test_given_a_directory_that_another_service_holds_then_a_permanent_frame_is_rejected(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    with_lock = FileLock(tmp_path / "lock-cart")
    with_lock.acquire()
    rig.store = AddedFramesStore(tmp_path, "cart", FileLock(tmp_path / "lock-cart"))
    rig.start()
    before = rig.state.model
    assert "the permanent frames cannot be stored" in rig.send(STORED).why
    assert rig.state.model is before
    assert rig.send(MARKER).why == ""
    with_lock.release()


def test_given_no_state_directory_then_a_permanent_frame_is_rejected(rig: Rig) -> None:
    rig.reader = GeometryReader(rig.vehicle)
    assert "no state directory" in rig.send(STORED).why


# --- permission -------------------------------------------------------------------------------------------------------


def test_given_no_permission_then_a_signed_frame_is_denied_and_with_it_the_loop_is_asked() -> None:
    clock = FakeClock(START)
    _, (reply,) = step(start_core(), SignedCommand(MARKER), clock.now())
    assert "commands: {frames: true}" in reply.reply.header.message
    _, outputs = step(start_core(may_set_frames=True), SignedCommand(MARKER), clock.now())
    assert outputs == (LoadModel(MARKER),)
    _, (reply,) = step(start_core(may_set_frames=True), MARKER, clock.now())
    assert "the command is not signed" in reply.reply.header.message
