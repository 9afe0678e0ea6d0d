"""`modelserver export`: what an MCAP file has of a log, read by Foxglove's own reader."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support_recordings import write_log
from support_view import START, record_drive

pytest.importorskip("foxglove", reason="the extra foxglove is not installed: pip install -e '.[foxglove]'")

import foxglove
import trimesh
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import mslcm
from modelserver.formats import load_model, parse_model
from modelserver.formats.yaml_geometry import ModelSnapshot, encode_snapshot
from modelserver.messages import Invalid
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import decode, encode, split_snapshot
from modelserver.wire.eventlog import LogFile
from mstools.cli import main
from mstools.foxglove.layout import make_layout
from mstools.foxglove.primitives import CONFIDENCE
from mstools.foxglove.writer import MODEL_TOPIC, FoxgloveWriter
from mstools.meshes import MeshFolders
from mstools.recordings.drive import HORIZONTAL, INVALID, QUATERNION, Drive
from mstools.recordings.log_platform import LogPlatform
from mstools.recordings.pose_signals import CHI_SQUARE_3, compute_headings, compute_sigmas

SECONDS = 12.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("export"), SECONDS)


@pytest.fixture(scope="module")
def mcap(log: Path) -> Path:
    out = log.with_suffix(".mcap")
    with pytest.raises(SystemExit) as ended:
        main(["export", str(log), str(out)])
    assert not ended.value.code
    return out


def read(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield the log time, microseconds, and the message of a topic; bytes for those of LCM."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages(topics=[topic]):
            content: Any = message.data
            if channel.message_encoding == "json":
                content = json.loads(message.data, parse_constant=pytest.fail)
            elif channel.message_encoding == "protobuf":
                decoder = DecoderFactory().decoder_for("protobuf", schema)
                assert decoder is not None
                content = decoder(message.data)
            yield message.log_time // 1000, content


def read_log(log: Path, channel: str, type_name: str) -> list[Any]:
    """Return the messages of a channel of a log."""
    with LogFile(log) as events:
        return [decode(type_name, event.data) for event in events if event.channel == channel]


def read_drive(log: Path) -> Drive:
    drive = Drive()
    with LogFile(log) as events:
        for event in events:
            drive.feed(event.channel, event.data, event.utime)
    return drive


def utime_of(stamp: Any) -> int:
    return int(stamp.seconds) * 1_000_000 + int(stamp.nanos) // 1000


def pose_of(transform: Any) -> Pose:
    p, q = transform.translation, transform.rotation
    return Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))


@pytest.mark.slow
def test_given_a_log_then_the_frames_are_where_a_query_of_the_log_places_them(log: Path, mcap: Path) -> None:
    platform = LogPlatform(log)
    world: dict[int, Pose] = {}
    laser: dict[int, Pose] = {}
    frames: dict[str, Pose] = {}
    for now, message in read(mcap, "/tf"):
        for transform in message.transforms:
            if transform.parent_frame_id == "utm":
                assert transform.child_frame_id == "Raptor:CG"
                world[utime_of(transform.timestamp)] = pose_of(transform)
                continue
            assert transform.parent_frame_id == "Raptor:CG"
            frames[transform.child_frame_id] = pose_of(transform)
            if transform.child_frame_id == "FrontSICKLaser:Scan":
                laser[now] = pose_of(transform)
    assert len(world) == len(list(read(mcap, "/pose")))
    # the history of a client begins with the first known pose
    for utime in list(world)[250::67]:
        assert world[utime].is_close(platform.get_pose("Raptor:CG", "World:UTM", at=utime).transformation.pose)
    fixed = platform.get_pose("Digiclops:ImagePlane", "Raptor:CG").transformation.pose
    assert frames["Digiclops:ImagePlane"].is_close(fixed)
    # the laser nods, and each message has the angle of that time
    pitches = [float(pose.rpy[1]) for pose in laser.values()]
    assert np.ptp(pitches) > 0.7
    assert len(frames) > 40


def test_given_a_log_then_fixes_health_and_events_are_in_their_schemas(log: Path, mcap: Path) -> None:
    fixes = read_log(log, "GPS", "gps_t")
    exported = [message for _, message in read(mcap, f"/fix/{fixes[0].header.source}")]
    assert [(each.latitude, each.longitude) for each in exported] == [(f.latitude_deg, f.longitude_deg) for f in fixes]
    assert [utime_of(each.timestamp) for each in exported] == [each.header.utime for each in fixes]
    places = [message for _, message in read(mcap, "/pose/fix")]
    assert 0.8 * 5 * SECONDS <= len(places) <= 5 * SECONDS + 1
    assert places[-1].latitude == pytest.approx(fixes[-1].latitude_deg, abs=1e-4)
    poses = {each.transformation.utime: each.geodetic for each in read_log(log, "POSE", "pose_transform_t")}
    expected = [poses[utime_of(each.timestamp)].heading_deg for each in places]
    assert [math.degrees(each.heading) for each in places] == pytest.approx(expected)
    reports = [message for _, message in read(mcap, "/diagnostics")]
    pose = reports[-1]["status"][0]
    assert (pose["name"], pose["level"], pose["message"]) == ("pose", 0, "the pose is valid")
    assert reports[0]["status"][0]["level"] == 1
    texts = [message.message for _, message in read(mcap, "/events")]
    assert "the pose is valid" in texts


def test_given_a_log_then_each_pose_is_in_it_with_its_whole_covariance(log: Path, mcap: Path) -> None:
    poses = read_log(log, "POSE", "pose_transform_t")
    exported = [message for _, message in read(mcap, "/pose")]
    assert [utime_of(each.timestamp) for each in exported] == [each.transformation.utime for each in poses]
    known = 0
    for message, answer in zip(exported, poses, strict=True):
        found = answer.transformation
        p, q = message.pose.position, message.pose.orientation
        assert Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z)) == found.pose
        assert (message.frame_id, message.body_frame_id) == ("utm", "Raptor:CG")
        expected = [] if found.covariance is None else found.covariance.ravel().tolist()
        assert list(message.pose_covariance) == expected
        known += found.covariance is not None
    assert known > 100


def test_given_a_log_then_ellipsoid_and_disc_are_those_of_the_covariance_and_the_level(log: Path, mcap: Path) -> None:
    poses = {each.transformation.utime: each for each in read_log(log, "POSE", "pose_transform_t")}
    entities = [message.entities[0] for _, message in read(mcap, "/uncertainty")]
    assert {(each.id, each.frame_id) for each in entities} == {("uncertainty", "utm")}
    assert [utime_of(each.timestamp) for each in entities] == read_drive(log).poses.utimes.tolist()
    drawn = [each for each in entities if each.spheres]
    assert len(drawn) > 100
    for each in drawn[::20]:
        answer = poses[utime_of(each.timestamp)]
        sphere, place = each.spheres[0], answer.transformation.pose.xyz
        q, size = sphere.pose.orientation, sphere.size
        R = Pose((0.0, 0.0, 0.0), (q.w, q.x, q.y, q.z)).matrix[:3, :3]
        half = np.diag([size.x, size.y, size.z]) / 2.0
        covariance = R @ half @ half @ R.T / CHI_SQUARE_3[CONFIDENCE]
        assert covariance == pytest.approx(answer.transformation.covariance[:3, :3], abs=1e-9)
        disc = each.cylinders[0]
        assert (disc.size.x, disc.size.y) == pytest.approx((2.0 * answer.horizontal_protection_level,) * 2)
        for pose in (sphere.pose, disc.pose):
            assert (pose.position.x, pose.position.y, pose.position.z) == place
        assert disc.pose.orientation.w == 1.0
    assert not entities[0].spheres
    assert not entities[0].cylinders


def test_given_a_log_then_the_signals_to_plot_are_those_of_the_viewer(log: Path, mcap: Path) -> None:
    drive = read_drive(log)
    states = [message for _, message in read(mcap, "/state")]
    rows = drive.poses.rows
    assert len(states) == len(rows)
    for name, expected in (
        ("heading_deg", compute_headings(rows[:, QUATERNION])),
        ("horizontal_sigma", compute_sigmas(rows)),
        ("horizontal_protection_level", rows[:, HORIZONTAL]),
    ):
        found = [math.nan if each[name] is None else each[name] for each in states]
        assert found == pytest.approx(expected, nan_ok=True)
    assert [each["valid"] for each in states] == [flags == 0 for flags in rows[:, INVALID]]
    assert states[0]["reason"] == Invalid(int(rows[0, INVALID])).explain() != ""
    assert states[-1]["reason"] == ""
    times = [each["timestamp"]["sec"] * 1_000_000 + each["timestamp"]["nsec"] // 1000 for each in states]
    assert times == drive.poses.utimes.tolist()
    # of odometry, 0.2 s before
    utimes, places = drive.odometry.utimes, drive.odometry.rows[:, :2]
    last = drive.odometry.find(times[-1])
    first = int(np.searchsorted(utimes, utimes[last] - 200_000))
    way = float(np.linalg.norm(places[last] - places[first]))
    assert states[-1]["speed"] == pytest.approx(way / (utimes[last] - utimes[first]) * 1e6)
    assert states[-1]["speed"] > 0.5


def test_given_a_log_then_its_innovations_are_normalized_by_source_and_kind(log: Path, mcap: Path) -> None:
    decisions = [
        each for message in read_log(log, "LOCALIZATION_DECISIONS", "decisions_t") for each in message.decisions
    ]
    expected = [
        (each.source, each.kind, each.statistic / each.dof, each.verdict.name.lower())
        for each in decisions
        if each.verdict.name != "RESET" and each.dof and math.isfinite(each.statistic)
    ]
    found = [each for _, message in read(mcap, "/nis") for each in message["measurements"]]
    assert [(each["source"], each["kind"], each["value"], each["verdict"]) for each in found] == expected
    assert {each["label"] for each in found} >= {"gps gps_position", "wheels wheel_speed"}
    assert all(each["value"] <= each["gate"] for each in found if each["verdict"] == "used")


def test_given_a_log_then_its_messages_are_in_it_as_json(log: Path, mcap: Path) -> None:
    with LogFile(log) as events:
        counts: dict[str, int] = {}
        for event in events:
            counts[event.channel] = counts.get(event.channel, 0) + 1
    for channel, count in counts.items():
        decoded = list(read(mcap, f"/decoded/{channel}"))
        # its parts are bytes
        assert len(decoded) == (0 if channel == "MODEL_SNAPSHOT" else count)
    poses = read_log(log, "POSE", "pose_transform_t")
    first, *_, last = [message for _, message in read(mcap, "/decoded/POSE")]
    assert last["h_transform"] == pytest.approx(poses[-1].transformation.pose.matrix.ravel())
    assert last["covariance"] == poses[-1].transformation.covariance.ravel().tolist()
    assert first["covariance"][0] is None
    assert (last["frame_of_interest"], last["pose_valid"]) == ("Raptor:CG", True)


def test_given_a_log_then_the_shapes_of_the_bodies_are_in_it_once(log: Path, mcap: Path) -> None:
    ((_, scene),) = read(mcap, MODEL_TOPIC)
    model = read_drive(log).model
    assert model is not None
    bodies = {each.id: each for each in scene.entities}
    shapes = [shape for body in model.bodies for shape in body.visuals]
    drawn = sum(len(each.cubes) + len(each.cylinders) + len(each.spheres) for each in scene.entities)
    # a box for each body without shapes
    assert drawn == len(shapes) + sum(not body.visuals for body in model.bodies if body.name in bodies)
    assert all(each.frame_locked for each in scene.entities)
    frames = {transform.child_frame_id for _, message in read(mcap, "/tf") for transform in message.transforms}
    assert {each.frame_id for each in scene.entities} <= frames
    assert len(scene.deletions) == 1


def test_given_a_log_then_its_messages_are_in_it_bit_for_bit_with_their_definition(log: Path, mcap: Path) -> None:
    with LogFile(log) as events:
        expected = [(event.utime, event.data) for event in events if event.channel == "WHEELS"]
    assert list(read(mcap, "/lcm/WHEELS")) == expected
    with mcap.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {each.name: each for each in summary.schemas.values()}
    assert b"struct wheels_t" in schemas["mslcm.wheels_t"].data


def find_topics(path: Path) -> dict[str, str]:
    """Return the names of the schemas by topic."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {each.topic: summary.schemas[each.schema_id].name for each in summary.channels.values()}


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["export", *map(str, arguments)])
    return int(ended.value.code or 0)


def test_given_no_copies_of_messages_then_the_file_is_without_them(log: Path, tmp_path: Path, mcap: Path) -> None:
    out = tmp_path / "small.mcap"
    assert run(log, out, "--no-raw", "--no-decoded") == 0
    assert not [topic for topic in find_topics(out) if topic.startswith(("/lcm/", "/decoded/"))]
    assert len(list(read(out, "/pose"))) == len(list(read(mcap, "/pose")))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.write_bytes(b"no log at all"), "not an LCM event log"),
        (lambda path: write_log(path, [(1, "POSE", b"damaged")]), "no complete geometry on MODEL_SNAPSHOT"),
    ],
)
def test_given_a_log_that_cannot_be_exported_then_nothing_is_written_and_the_reason_is_shown(
    make: Callable[[Path], object], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = tmp_path / "drive.lcm", tmp_path / "drive.mcap"
    make(log)
    assert run(log, out) == 1
    assert reason in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["drive.lcm"]


def test_given_a_file_that_exists_then_it_stays_unless_forced(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "drive.mcap"
    out.write_text("mine")
    assert run(log, out) == 1
    assert "--force" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert run(log, out, "--force") == 0
    assert out.stat().st_size > 1000


def run_import(mcap: Path, out: Path, *options: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["import-bag", str(mcap), str(out), *options])
    return int(ended.value.code or 0)


def test_given_an_exported_file_then_import_bag_makes_the_log_again(log: Path, mcap: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.lcm"
    assert run_import(mcap, again) == 0
    with LogFile(log) as first, LogFile(again) as second:
        assert [(e.utime, e.channel, e.data) for e in second] == [(e.utime, e.channel, e.data) for e in first]


def test_given_a_file_without_lcm_messages_or_a_damaged_one_then_import_bag_ends_with_the_reason(
    log: Path, mcap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, cut, out = tmp_path / "plain.mcap", tmp_path / "cut.mcap", tmp_path / "out.lcm"
    with pytest.raises(SystemExit):
        main(["export", str(log), str(plain), "--no-raw"])
    assert run_import(plain, out) != 0
    assert "without --no-raw" in capsys.readouterr().err
    cut.write_bytes(mcap.read_bytes()[:20_000])
    assert run_import(cut, out) != 0
    assert "cut.mcap: the MCAP file" in capsys.readouterr().err
    assert run_import(mcap, out, "--topic", "gps=/lcm/GPS") != 0
    assert "--topic goes with a ROS bag" in capsys.readouterr().err
    assert not out.exists()


# --- layout


def list_configs(content: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield type and configuration of the panels of a layout."""
    if content["type"] == "panel":
        yield content["panelType"], content["config"]
    for each in content.get("items", content.get("tabs", [])):
        yield from list_configs(each["content"])


def list_paths(value: Any) -> Iterator[str]:
    """Yield the topics and message paths in a configuration."""
    if isinstance(value, str):
        if value.startswith("/"):
            yield value
    elif isinstance(value, dict):
        yield from (key for key in value if key.startswith("/"))
        for each in value.values():
            yield from list_paths(each)
    elif isinstance(value, list):
        for each in value:
            yield from list_paths(each)


def select(message: Any, path: str) -> list[Any]:
    """Return what a message path of Foxglove selects of a message in JSON: names, [:], and {name=="text"}."""
    found = [message]
    for step in re.findall(r"\.\w+|\[:\]|{.*?}", path):
        if step == "[:]":
            found = [each for values in found for each in values]
        elif step.startswith("{"):
            name, text = step[1:-1].split("==")
            found = [each for each in found if each[name] == json.loads(text)]
        else:
            found = [each[step[1:]] for each in found]
    return found


SCHEMAS = {
    "/model": "foxglove.SceneUpdate",
    "/uncertainty": "foxglove.SceneUpdate",
    "/pose": "foxglove.Odometry",
    "/pose/fix": "foxglove.LocationFix",
    "/fix/gps": "foxglove.LocationFix",
    "/events": "foxglove.Log",
    "/diagnostics": "diagnostic_msgs/DiagnosticArray",
    "/state": "modelserver.State",
    "/nis": "modelserver.Nis",
}


def test_given_a_layout_then_the_file_has_each_of_its_topics_and_fields(log: Path, tmp_path: Path) -> None:
    out, file = tmp_path / "drive.mcap", tmp_path / "layout.json"
    assert run(log, out, "--no-raw", "--no-decoded", "--layout", file) == 0
    layout = json.loads(file.read_text())
    panels = list(list_configs(layout["content"]))
    kinds = {kind for kind, _ in panels}
    assert kinds >= {"ThreeDee", "Map", "Plot", "Indicator", "StateTransitions", "RawMessages", "Log"}
    topics = find_topics(out)
    paths = {path for _, config in panels for path in list_paths(config)}
    named = {re.split(r"[.\[{]", path)[0] for path in paths}
    assert {topic: topics.get(topic) for topic in named} == SCHEMAS
    for path in paths:
        topic = re.split(r"[.\[{]", path)[0]
        if path != topic:
            values = [value for _, message in read(out, topic) for value in select(message, path[len(topic) :])]
            assert [each for each in values if each is not None], path
    frames = {transform.child_frame_id for _, message in read(out, "/tf") for transform in message.transforms}
    scene = next(config for kind, config in panels if kind == "ThreeDee")
    assert (scene["fixedFrame"], scene["scene"]["meshUpAxis"]) == ("utm", "z_up")
    assert scene["followTf"] in frames
    labels = {each["label"] for _, message in read(out, "/nis") for each in message["measurements"]}
    assert len([path for path in paths if path.startswith("/nis")]) == len(labels)


def test_given_only_a_layout_then_it_is_written_without_what_a_drive_has(tmp_path: Path) -> None:
    file = tmp_path / "layout.json"
    assert run("--layout", file) == 0
    panels = list(list_configs(json.loads(file.read_text())["content"]))
    assert "followTf" not in next(config for kind, config in panels if kind == "ThreeDee")
    paths = {path for _, config in panels for path in list_paths(config)}
    assert "/nis.measurements" in paths
    assert file.read_text() == make_layout("").to_json() + "\n"
    assert run("--layout", file) == 1
    assert run("--layout", file, "--force", "-c", "config/husky/vehicle.yaml") == 0
    assert '"followTf":"' in file.read_text()


def test_given_a_layout_at_the_place_of_the_log_then_nothing_is_written(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(log, tmp_path / "drive.mcap", "--layout", log, "--force") == 2
    assert "another file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# --- meshes


GEOMETRY = """
<robot name="cart">
  <link name="Cart"><visual>
    <origin xyz="0.5 0 0.25" rpy="0 0 1.5707963267948966"/>
    <geometry><mesh filename="hull.stl" scale="1 2 3"/></geometry>
  </visual></link>
  <link name="Mast"><visual><geometry><mesh filename="missing.stl"/></geometry></visual></link>
  <joint name="mount" type="fixed"><parent link="Cart"/><child link="Mast"/><origin xyz="1 0.5 0.25"/></joint>
</robot>
"""


def draw(folder: Path, out: Path) -> tuple[Any, FoxgloveWriter]:
    """Return the shapes of `GEOMETRY` in a folder as they are exported, and the writer."""
    file = folder / "cart.urdf"
    file.write_text(GEOMETRY)
    context = foxglove.Context()
    with foxglove.open_mcap(out, context=context):
        writer = FoxgloveWriter(context, model=load_model(file), meshes=MeshFolders(folder, environment={}))
        writer.feed("ANY", bytes(16), 1)
    ((_, scene),) = read(out, MODEL_TOPIC)
    return scene, writer


def test_given_meshes_then_they_are_in_the_file_as_they_stand_in_the_geometry(tmp_path: Path) -> None:
    hull = trimesh.creation.box((1.0, 0.5, 0.25))
    hull.apply_translation((0.1, 0.2, 0.3))
    hull.export(tmp_path / "hull.stl")
    scene, writer = draw(tmp_path, tmp_path / "drive.mcap")
    cart, mast = ({each.id: each for each in scene.entities}[name] for name in ("Cart", "Mast"))
    (model,) = cart.models
    assert (model.media_type, model.url, model.override_color) == ("model/gltf-binary", "", False)
    loaded = trimesh.load_scene(trimesh.util.wrap_as_stream(model.data), file_type="glb")
    # Foxglove turns y up to z up, then scales, then places (studio, ModelCache.ts and RenderableModels.ts)
    p, q, scale = model.pose.position, model.pose.orientation, model.scale
    place = Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z)).matrix
    turned = Pose.from_rpy((0.0, 0.0, 0.0), roll=math.pi / 2.0).matrix
    drawn = trimesh.transform_points(
        loaded.to_geometry().vertices, place @ np.diag([scale.x, scale.y, scale.z, 1.0]) @ turned
    )
    X = Pose.from_rpy((0.5, 0.0, 0.25), yaw=math.pi / 2.0).matrix @ np.diag([1.0, 2.0, 3.0, 1.0])
    expected = trimesh.transform_points(hull.vertices, X)
    assert drawn.min(axis=0) == pytest.approx(expected.min(axis=0), abs=1e-6)
    assert drawn.max(axis=0) == pytest.approx(expected.max(axis=0), abs=1e-6)
    # one that is not found is a box of the body's frames
    assert not mast.models
    (box,) = mast.cubes
    assert (box.size.x, box.size.y, box.size.z) == (0.04, 0.04, 0.04)
    assert box.color.a == pytest.approx(0.2)
    ((reason, files),) = writer.unread.items()
    assert files == ["missing.stl"]
    assert "--package-path" in reason


def test_given_a_geometry_file_then_its_meshes_are_found_and_those_missing_are_named(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, geometry, packages = tmp_path / "drive.mcap", tmp_path / "cart.urdf", tmp_path / "packages"
    geometry.write_text(GEOMETRY.replace("hull.stl", "package://robot/hull.stl"))
    (packages / "robot").mkdir(parents=True)
    trimesh.creation.box().export(packages / "robot" / "hull.stl")
    assert run(log, out, "--model", geometry) == 0
    errors = capsys.readouterr().err
    assert "1 mesh not drawn: package robot not found" in errors
    assert f"1 mesh not drawn: not found in {tmp_path}; correct the path" in errors
    assert run(log, out, "--model", geometry, "--package-path", packages, "--force") == 0
    assert "robot" not in capsys.readouterr().err
    ((_, scene),) = read(out, MODEL_TOPIC)
    assert [len(each.models) for each in scene.entities] == [1, 0]


def test_given_another_geometry_then_its_shapes_replace_those_before(tmp_path: Path) -> None:
    out = tmp_path / "drive.mcap"
    context = foxglove.Context()
    with foxglove.open_mcap(out, context=context):
        writer = FoxgloveWriter(context)
        for number, name in enumerate(("First", "Second"), 1):
            visual = "<visual><geometry><sphere radius='1'/></geometry></visual>"
            urdf = f"<robot name='r'><link name='{name}'>{visual}</link></robot>"
            model = parse_model(urdf.encode(), "robot.urdf")
            snapshot = ModelSnapshot("", model, f"{name}:Origin", f"{name}:Origin", 10.0, "JOINTS")
            utime = START + number * 1_000_000
            for part in split_snapshot(encode_snapshot(snapshot), model.revision, utime):
                for _ in range(3):
                    writer.feed("MODEL_SNAPSHOT", encode(part), utime)
    scenes = [message for _, message in read(out, MODEL_TOPIC)]
    assert [[each.id for each in scene.entities] for scene in scenes] == [["First"], ["Second"]]
    (deletion,) = scenes[1].deletions
    # of all that are earlier
    assert deletion.type == 1
    assert utime_of(scenes[0].entities[0].timestamp) < utime_of(deletion.timestamp)
    assert writer.skipped == 0


def test_given_a_client_that_comes_later_then_the_shapes_are_logged_again(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "drive.mcap"
    context = foxglove.Context()
    with LogFile(log) as events, foxglove.open_mcap(out, context=context):
        writer = FoxgloveWriter(context)
        for number, event in enumerate(events):
            if number == 1000:
                writer.refresh()
            writer.feed(event.channel, event.data, event.utime)
    first, second = (message for _, message in read(out, MODEL_TOPIC))
    assert [each.id for each in first.entities] == [each.id for each in second.entities]


# --- hostile messages


def test_given_damaged_messages_then_they_are_counted_and_the_rest_is_exported(log: Path, tmp_path: Path) -> None:
    shuffled = random.Random(46)
    with LogFile(log) as events:
        recorded = [(event.channel, event.data, event.utime) for event in events]
    snapshots = [each for each in recorded if each[0] == "MODEL_SNAPSHOT"]
    geometry = [each for each in snapshots if each[2] == snapshots[0][2]]
    damaged = []
    for channel, data, utime in shuffled.sample(recorded, 600):
        changed = bytearray(data)
        for _ in range(shuffled.randint(1, 4)):
            # behind the fingerprint, so that they are read
            changed[shuffled.randrange(8, len(changed))] = shuffled.randrange(256)
        damaged.append((channel, bytes(changed[: shuffled.randint(8, len(changed))]), utime))
        damaged.append((channel, bytes(changed), utime))
    # also one in which the validity changes, which is an event
    poses = [each for each in recorded if each[0] == "POSE"]
    late = [*geometry, *poses[:1], *poses[-1:]]
    odd_times = [(*each[:2], utime) for utime in (-1, 1 << 52, 1 << 62, -(1 << 63), (1 << 63) - 1) for each in late]
    context = foxglove.Context()
    out = tmp_path / "damaged.mcap"
    with foxglove.open_mcap(out, context=context):
        writer = FoxgloveWriter(context)
        for event in odd_times:
            writer.feed(*event)
        assert writer.skipped == len(odd_times)
        for event in (*geometry, *damaged, *recorded[-500:]):
            writer.feed(*event)
    assert 600 <= writer.skipped - len(odd_times) <= 1200
    assert len(list(read(out, MODEL_TOPIC))) == 1
    for topic in find_topics(out):
        assert list(read(out, topic))
    poses = [each for each in recorded[-500:] if each[0] == "POSE"]
    assert len([now for now, _ in read(out, "/pose") if now >= recorded[-500][2]]) >= len(poses)


def test_given_numbers_that_no_filter_makes_then_the_file_is_one_that_its_readers_read(
    log: Path, tmp_path: Path
) -> None:
    with LogFile(log) as events:
        recorded = [event.data for event in events if event.channel == "POSE"][-1]
    context = foxglove.Context()
    out = tmp_path / "extreme.mcap"
    with foxglove.open_mcap(out, context=context):
        writer = FoxgloveWriter(context)
        for number, value in enumerate((1e308, -1e308, math.inf, math.nan, -1.0, 5e-324), 1):
            message = mslcm.pose_transform_t.decode(recorded)
            message.utime += number * 1_000_000
            message.covariance = [value] * 36
            message.horizontal_protection_level = message.heading_protection_level = value
            writer.feed("POSE", message.encode(), message.utime)
    assert writer.skipped == 0
    states = [message for _, message in read(out, "/state")]
    assert len(states) == len(list(read(out, "/uncertainty"))) == 6
    assert [each["horizontal_protection_level"] for each in states] == [1e308, -1e308, None, None, -1.0, 5e-324]
    # of an infinite or unknown covariance nothing is drawn
    spheres = [len(message.entities[0].spheres) for _, message in read(out, "/uncertainty")]
    assert spheres == [1, 1, 0, 0, 1, 1]
