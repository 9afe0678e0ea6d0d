"""Reloading the geometry while running: localization, published messages, log."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support_samples import (
    GEOMETRY,
    ME,
    START,
    VEHICLE,
    ScriptedLocalizer,
    cart,
    drive,
    imu,
    start_core,
    wait_for_reload,
    write_vehicle,
)

from modelserver.config.vehicle_file import load_config
from modelserver.core import CoreState, step
from modelserver.errors import Status
from modelserver.estimation.modes import ModeLocalizer
from modelserver.formats.yaml_geometry import decode_snapshot
from modelserver.geometry import Model
from modelserver.messages import (
    GetExplanation,
    GetTransformation,
    JointSample,
    JointsSample,
    LoadModel,
    PublishSnapshot,
    ReloadModel,
    ReloadReply,
    RequestHeader,
    SensorHeader,
    SignedCommand,
    SnapshotPart,
)
from modelserver.server import reloading
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.loop import MAX_RELOADS, Hooks, Loop, LoopSettings
from modelserver.server.reloading import GeometryReader, PollReload, read_geometry
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.wire.codec import PART_BYTES, SnapshotAssembler, decode, encode

S = 1_000_000
FULL, RAW = VEHICLE, VEHICLE + "localization: {mode: raw}\n"
HIGHER_CAMERA = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.2]")
MOVED_ANTENNA = GEOMETRY.replace("[-0.4, 0.2, 1.2]", "[-0.4, 0.2, 1.5]")
NODDING = GEOMETRY.replace("xyz: [0, 0, 0.1]", "xyz: [0, 0, 0.1], joint: {type: revolute, axis: [0, 1, 0]}")


def load(folder: Path, text: str = VEHICLE, geometry: str = GEOMETRY) -> Vehicle:
    return load_vehicle(load_config(write_vehicle(folder, text, geometry)))


# --- localization ---------------------------------------------------------------------------------------------------


def drive_to(vehicle: Vehicle, seconds: float = 8.0) -> ModeLocalizer:
    localizer = vehicle.start_core(FakeClock(START).now()).localizer
    assert isinstance(localizer, ModeLocalizer)
    for sample in drive(seconds):
        localizer, _ = localizer.process(sample)
    return localizer


def remade(folder: Path, text: str, geometry: str) -> tuple[ModeLocalizer, ModeLocalizer]:
    """A localizer after a drive, and the one after a reload."""
    before = drive_to(load(folder, text))
    makings = load(folder, text, geometry).make_localizer_setup()
    assert makings is not None
    return before, before.reconfigure(makings)


@pytest.mark.parametrize("text", [FULL, RAW], ids=["filter", "raw"])
def test_given_that_nothing_moved_that_localization_rests_on_then_it_goes_on_as_if_nothing_were(
    tmp_path: Path, text: str
) -> None:
    before, after = remade(tmp_path, text, HIGHER_CAMERA)
    utime = before.utime
    assert after.utime == utime
    assert after.config is not before.config
    for at in (utime, utime + 100_000):
        now, was = after.estimate(at), before.estimate(at)
        assert (now.odom, now.utm, now.covariance) == (was.odom, was.utm, was.covariance)
        assert (now.invalid, now.quality, now.pose_epoch) == (was.invalid, was.quality, was.pose_epoch)
    for sample in drive(0.5, utime + 20_000):
        before, after = before.process(sample)[0], after.process(sample)[0]
    assert after.estimate(after.utime).utm == before.estimate(before.utime).utm


@pytest.mark.parametrize("text", [FULL, RAW], ids=["filter", "raw"])
def test_given_an_antenna_that_moved_then_a_new_epoch_begins_and_odom_makes_no_step(tmp_path: Path, text: str) -> None:
    before, after = remade(tmp_path, text, MOVED_ANTENNA)
    utime = before.utime
    was, now = before.estimate(utime), after.estimate(utime)
    assert was.utm is not None
    assert now.pose_epoch == was.pose_epoch + 1
    assert now.origin == was.origin
    last = was.odom
    for sample in drive(1.0, utime + 20_000):
        after, _ = after.process(sample)
        odom = after.estimate(after.utime).odom
        meters, radians = last.distance(odom)
        assert meters < 0.15  # 2 m/s at 50 Hz are 0.04 m
        assert radians < 0.05
        last = odom


@pytest.mark.parametrize("text", [FULL, RAW], ids=["filter", "raw"])
def test_given_no_sample_yet_then_it_restarts_without_an_epoch(tmp_path: Path, text: str) -> None:
    vehicle = load(tmp_path, text)
    localizer = vehicle.start_core(FakeClock(START).now()).localizer
    makings = load(tmp_path, text, MOVED_ANTENNA).make_localizer_setup()
    assert isinstance(localizer, ModeLocalizer)
    assert makings is not None
    after = localizer.reconfigure(makings)
    assert (after.utime, after.epochs, after.config) == (0, 0, makings)
    assert type(after.active) is type(localizer.active)


@pytest.mark.parametrize("text", [FULL, RAW], ids=["filter", "raw"])
def test_given_an_antenna_that_moved_then_what_odom_had_drifted_goes_on_growing(tmp_path: Path, text: str) -> None:
    before, after = remade(tmp_path, text, MOVED_ANTENNA)
    utime = before.utime
    was = before.estimate(utime).odom_covariance
    assert was is not None
    for sample in drive(1.0, utime + 20_000):
        after, _ = after.process(sample)
    now = after.estimate(after.utime).odom_covariance
    assert now is not None
    for place in (0, 7, 14, 35):
        assert now[place] > was[place]


def test_given_two_reloads_in_sequence_in_raw_mode_then_odom_stays_where_it_was(tmp_path: Path) -> None:
    before, after = remade(tmp_path, RAW, MOVED_ANTENNA)
    makings = load(tmp_path, RAW, GEOMETRY).make_localizer_setup()
    assert makings is not None
    twice = after.reconfigure(makings)
    assert before.estimate(before.utime).odom.distance(twice.estimate(before.utime).odom)[0] < 0.1
    assert twice.drift == after.drift != ()


def test_given_inertial_samples_alone_then_the_reasons_against_a_pose_name_no_step_of_the_clock(tmp_path: Path) -> None:
    state = load(tmp_path).start_core(FakeClock(START).now())
    for number in range(20):
        state, _ = step(state, imu(START + number * 10_000), FakeClock(START + number * 10_000).now())
    error = state.view.no_pose_error()
    assert "no usable GPS fix yet" in str(error)
    assert "clock" not in str(error)


def read_again(vehicle: Vehicle, file: str = "") -> Callable[[LoadModel, CoreState], PollReload]:
    return wait_for_reload(GeometryReader(vehicle, file, read_geometry).begin)


# --- the daemon's reading -------------------------------------------------------------------------------------------


def test_given_a_file_that_suits_then_model_and_localizer_come_together(tmp_path: Path) -> None:
    vehicle = load(tmp_path)
    state = vehicle.start_core(FakeClock(START).now())
    (tmp_path / "geometry.yaml").write_text(HIGHER_CAMERA)
    found = read_again(vehicle)(LoadModel(), state)(state)
    assert found is not None
    assert found.why == ""
    assert found.model is not None
    assert found.model.revision != state.model.revision
    assert isinstance(found.localizer, ModeLocalizer)
    assert found.localizer.config.setup.rig.model is found.model


@pytest.mark.parametrize(
    ("geometry", "why"),
    [
        (GEOMETRY.replace("Base:", "Bsae:"), "Cart:Bsae"),
        (GEOMETRY.replace("Antenna:", "Aerial:"), "sensors.gps.frame"),
        (GEOMETRY.replace("to: Camera", "to: Camrea"), "Camrea"),
        (GEOMETRY[:200], "geometry.yaml"),
        (GEOMETRY[: GEOMETRY.rindex("from:")].rpartition("\n")[0].rpartition("\n")[0] + "\n", "still being written"),
        ("", "geometry.yaml"),
        (None, "geometry.yaml cannot be read"),
        ("\x00\x01", "geometry.yaml"),
    ],
)
def test_given_a_file_that_is_wrong_or_does_not_suit_then_nothing_comes_but_why(
    tmp_path: Path, geometry: str | None, why: str
) -> None:
    vehicle = load(tmp_path)
    state = vehicle.start_core(FakeClock(START).now())
    path = tmp_path / "geometry.yaml"
    path.unlink() if geometry is None else path.write_text(geometry)
    found = read_again(vehicle, str(tmp_path / "vehicle.yaml"))(LoadModel(), state)(state)
    assert found is not None
    assert (found.model, found.localizer) == (None, None)
    assert why in found.why


@pytest.fixture
def read_in_process(tmp_path: Path) -> GeometryReader:
    return GeometryReader(load(tmp_path), str(tmp_path / "vehicle.yaml"))


def test_given_a_process_of_its_own_then_it_reads_what_this_one_would(
    tmp_path: Path, read_in_process: GeometryReader
) -> None:
    vehicle = load(tmp_path)
    state = vehicle.start_core(FakeClock(START).now())
    begin = wait_for_reload(read_in_process.begin)
    (tmp_path / "geometry.yaml").write_text(HIGHER_CAMERA)
    found, expected = (each(LoadModel(), state)(state) for each in (begin, read_again(vehicle)))
    assert found is not None
    assert expected is not None
    assert expected.model is not None
    assert found.model is not None
    assert (found.model.bodies, found.model.constraints) == (expected.model.bodies, expected.model.constraints)
    assert found.model.revision == expected.model.revision
    assert isinstance(found.localizer, ModeLocalizer)
    assert found.localizer.config.setup.rig.model is found.model
    assert found.changes == ("constraint Mounted moves by 100 mm and 0 deg",)
    assert read_in_process.encode_snapshot(found.model) == vehicle.encode_snapshot(found.model)
    (tmp_path / "geometry.yaml").write_text(GEOMETRY.replace("to: Camera", "to: Camrea"))
    found = begin(LoadModel(), state)(state)
    assert found is not None
    assert "Camrea" in found.why


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("import os; os.kill(os.getpid(), 9)", "ended early (SIGKILL)"),
        ("raise MemoryError", "ended early (code 1)"),
        ("print('noise')", "internal error while reading it"),
        ("import time; time.sleep(60)", "reading it took more than 0 s"),
    ],
)
def test_given_a_process_that_fails_then_the_old_model_stays_and_the_reason_is_known(
    script: str, why: str, tmp_path: Path, read_in_process: GeometryReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reloading, "_MAIN", script)
    if "sleep" in script:
        monkeypatch.setattr(reloading, "LIMIT_S", 0.3)
    state = load(tmp_path).start_core(FakeClock(START).now())
    found = wait_for_reload(read_in_process.begin)(LoadModel(), state)(state)
    assert found is not None
    assert (found.model, why in found.why) == (None, True)


# --- the loop -------------------------------------------------------------------------------------------------------


class Rig:
    """A loop with a geometry file."""

    def __init__(self, folder: Path, text: str = VEHICLE, geometry: str = GEOMETRY):
        self.folder, self.clock = folder, FakeClock(START)
        self.bus = FakeBus(self.clock)
        self.vehicle = load(folder, text, geometry)
        self.reader = GeometryReader(self.vehicle, read=read_geometry)
        self.loop = Loop(
            self.bus,
            self.clock,
            self.vehicle.start_core(self.clock.now()),
            LoopSettings(20_000_000, self.vehicle.sensor_channels()),
            Hooks(
                on_load=wait_for_reload(self.reader.begin),
                snapshot=self.reader.encode_snapshot,
                channels=lambda state: self.vehicle.sensor_channels(state.model),
            ),
        )

    def write(self, geometry: str) -> None:
        (self.folder / "geometry.yaml").write_text(geometry)

    def turns(self, count: int = 2) -> None:
        for _ in range(count):
            self.loop.run_once()

    @property
    def parts(self) -> list[SnapshotPart]:
        return [decode("model_snapshot_t", data) for data in self.bus.get_published("MODEL_SNAPSHOT")]


def test_given_the_signal_then_the_next_pass_reads_the_file_and_sends_it_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    rig = Rig(tmp_path)
    rig.turns()
    old = rig.loop.state.model.revision
    assert [part.model_revision for part in rig.parts] == [old]
    rig.write(HIGHER_CAMERA)
    rig.loop.reload()
    assert rig.loop.state.model.revision == old
    rig.turns()
    new = rig.loop.state.model.revision
    assert new != old
    assert [part.model_revision for part in rig.parts] == [old, new]
    assert caplog.messages[-1] == f"the geometry was changed: revision {new}, before {old}"
    content = SnapshotAssembler().add(rig.parts[-1])
    assert content is not None
    snapshot = decode_snapshot(content)
    assert (snapshot.model.revision, snapshot.vehicle, snapshot.base_frame) == (new, "cart", "Cart:Base")


def test_given_the_signal_and_an_invalid_file_then_the_old_model_answers_and_the_log_has_the_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig(tmp_path)
    rig.turns()
    before = rig.loop.state.view
    rig.write(GEOMETRY.replace("Camera:Origin", "Camrea:Origin"))
    rig.loop.reload()
    rig.turns()
    assert rig.loop.state.model is before.model
    assert len(rig.parts) == 1
    assert dict(rig.loop.state.rejected) == {("PLATFORM_RELOAD_MODEL", "rejected"): 1}
    assert before.model.revision in caplog.messages[-1]
    assert "Camrea" in caplog.messages[-1]


def reply_to(rig: Rig, request: Any) -> ReloadReply:
    rig.loop.execute(SignedCommand(request), rig.clock.now())
    rig.turns()
    (data,) = rig.bus.get_published("REPLY_TEST")
    reply: ReloadReply = decode("reload_model_reply_t", data)
    return reply


@pytest.mark.parametrize("dry_run", [False, True])
def test_given_a_permitted_client_then_the_reply_lists_the_changes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, dry_run: bool
) -> None:
    caplog.set_level("INFO")
    rig = Rig(tmp_path, VEHICLE + "commands: {reload: true, key_file: k}\n")
    old = rig.loop.state.model.revision
    rig.write(HIGHER_CAMERA)
    reply = reply_to(rig, ReloadModel(ME, dry_run))
    assert reply.header.status is Status.OK
    assert reply.changes == ("constraint Mounted moves by 100 mm and 0 deg",)
    assert (rig.loop.state.model.revision == old) is dry_run
    assert bool(caplog.messages) is not dry_run


def test_given_a_client_that_may_not_then_the_file_is_not_even_read(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    (tmp_path / "geometry.yaml").unlink()
    reply = reply_to(rig, ReloadModel(ME))
    assert reply.header.status is Status.FORBIDDEN


def test_given_the_first_joint_with_a_reload_then_joints_are_received_from_then_on(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    joints_message = encode(JointsSample(SensorHeader(START, "arm"), (JointSample("Mounted", 0.25),)))
    rig.bus.publish("JOINTS", joints_message)
    rig.turns()
    assert "sensor:arm" not in rig.loop.state.traffic
    rig.write(NODDING)
    rig.loop.reload()
    rig.turns()
    rig.loop.reload()
    rig.turns()
    rig.bus.publish("JOINTS", joints_message)
    rig.turns()
    # received once, though the geometry was read twice
    assert rig.loop.state.traffic["sensor:arm"].count == 1
    assert "Mounted" in rig.loop.state.view.joints.tracks
    rig.bus.publish("PLATFORM_GET_EXPLANATION", encode(GetExplanation(ME, "Camera:Origin", "Cart:Base")))
    rig.turns()
    (data,) = rig.bus.get_published("REPLY_TEST")
    edges = decode("get_explanation_reply_t", data).answer.edges
    assert [(each.name, each.coordinates) for each in edges if each.kind == "joint"] == [("Mounted", (0.25,))]
    # published again with each snapshot
    assert not rig.bus.get_published("JOINTS_HELD")
    rig.clock.advance(6.0)
    rig.turns()
    (data,) = rig.bus.get_published("JOINTS_HELD")
    held = decode("joints_t", data)
    assert (held.header.utime, held.header.source) == (START, "arm")
    assert held.header.host_utime >= START + 6_000_000
    assert [(each.name, each.position) for each in held.joints] == [("Mounted", 0.25)]


@pytest.mark.parametrize("fail", [RuntimeError("odd"), OSError("disk")])
def test_given_a_reading_that_breaks_then_the_loop_goes_on_and_counts_it(tmp_path: Path, fail: Exception) -> None:
    rig = Rig(tmp_path)

    def fail_to_load(command: LoadModel, state: CoreState) -> PollReload:
        raise fail

    rig.loop._hooks = replace(rig.loop._hooks, on_load=fail_to_load)
    rig.loop.reload()
    rig.turns()
    rig.bus.sensors.put("IMU", encode(imu(START)))
    rig.turns()
    assert rig.loop.state.handler_errors == 1
    assert rig.loop.state.traffic["sensor:imu"].count == 1


def test_given_reloads_while_one_is_in_progress_then_they_follow_in_turn_and_the_old_model_serves(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path, VEHICLE + "commands: {reload: true, key_file: k}\n")
    old = rig.loop.state.model.revision
    may_end, started = threading.Event(), []

    def begin(command: LoadModel, state: CoreState) -> PollReload:
        started.append(command)
        poll = wait_for_reload(rig.reader.begin)(command, state)
        return lambda state: poll(state) if may_end.is_set() else None

    rig.loop._hooks = replace(rig.loop._hooks, on_load=begin)
    rig.write(HIGHER_CAMERA)
    for n in range(MAX_RELOADS + 2):
        request = ReloadModel(RequestHeader(n, "REPLY_TEST"), dry_run=n > 0)
        rig.loop.execute(SignedCommand(request), rig.clock.now())
    rig.turns(5)
    assert len(started) == 1
    rig.bus.publish("PLATFORM_GET_TRANSFORMATION", encode(GetTransformation(ME, "Camera:Origin", "Cart:Base")))
    rig.turns()
    *_, data = rig.bus.get_published("REPLY_TEST")
    assert decode("get_transformation_reply_t", data).header.model_revision == old
    rejected, *_ = rig.bus.get_published("REPLY_TEST")
    header = decode("reload_model_reply_t", rejected).header
    assert (header.request_id, header.status) == (MAX_RELOADS + 1, Status.REJECTED)
    assert "reloads are waiting" in header.message
    may_end.set()
    rig.turns(2 * MAX_RELOADS)
    replies = [decode("reload_model_reply_t", data) for data in rig.bus.get_published("REPLY_TEST")[2:]]
    assert [each.header.request_id for each in replies] == list(range(MAX_RELOADS + 1))
    assert [bool(each.changes) for each in replies] == [True] + [False] * MAX_RELOADS
    assert rig.loop.state.model.revision != old


def test_given_a_loop_without_a_file_then_a_reload_is_rejected_with_the_reason() -> None:
    clock = FakeClock(START)
    bus = FakeBus(clock)
    loop = Loop(bus, clock, start_core(ScriptedLocalizer(), may_reload=True), LoopSettings(20_000_000))
    loop.execute(SignedCommand(ReloadModel(ME)), clock.now())
    loop.run_once()
    loop.run_once()
    reply = decode("reload_model_reply_t", bus.get_published("REPLY_TEST")[0])
    assert reply.header.status is Status.REJECTED
    assert "no geometry file" in reply.header.message


# --- the broadcast --------------------------------------------------------------------------------------------------


def counting(size: int) -> tuple[Callable[[Model], bytes], list[int]]:
    calls: list[int] = []

    def write(model: Model) -> bytes:
        calls.append(len(calls))
        return bytes(size)

    return write, calls


def make_loop(write: Callable[[Model], bytes]) -> tuple[Loop, FakeBus]:
    clock = FakeClock(START)
    bus = FakeBus(clock)
    return Loop(bus, clock, start_core(), LoopSettings(20_000_000), Hooks(snapshot=write)), bus


def publish_snapshot(loop: Loop, bus: FakeBus, utime: int) -> list[SnapshotPart]:
    bus.published.clear()
    loop.send((PublishSnapshot(utime),))
    return [decode("model_snapshot_t", data) for data in bus.get_published("MODEL_SNAPSHOT")]


@pytest.mark.parametrize("size", [1, PART_BYTES, PART_BYTES + 1, 5 * PART_BYTES])
def test_given_snapshots_of_one_model_then_its_bytes_are_written_once_and_parts_carry_their_instant(size: int) -> None:
    write, calls = counting(size)
    loop, bus = make_loop(write)
    first, second = publish_snapshot(loop, bus, START), publish_snapshot(loop, bus, START + S)
    assert len(calls) == 1
    assert {part.utime for part in first} == {START}
    assert second == [replace(part, utime=START + S) for part in first]
    assert b"".join(part.data for part in second) == bytes(size)
    revision = loop.state.model.revision
    assert {(part.parts, part.model_revision) for part in first} == {(-(-size // PART_BYTES), revision)}


def test_given_another_model_then_its_bytes_are_encoded_again() -> None:
    write, calls = counting(10)
    loop, bus = make_loop(write)
    publish_snapshot(loop, bus, START)
    # compared by identity, which is cheap: the current model or another one
    loop.state = loop.state._replace(view=loop.state.view._replace(model=cart()))
    publish_snapshot(loop, bus, START)
    assert len(calls) == 2
