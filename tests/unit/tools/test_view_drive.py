"""The drive that the viewer shows: what it stores of messages, and its pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from modelserver.earth.geodesy import geodesy_of, origin_at
from modelserver.formats.yaml_geometry import ModelSnapshot, encode_snapshot
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType
from modelserver.geometry.model import Model
from modelserver.messages import (
    VALID,
    Decision,
    FixType,
    GpsSample,
    Invalid,
    JointSample,
    JointsSample,
    Mode,
    NavigationState,
    Phase,
    PoseAnswer,
    PublishDecisions,
    SensorHeader,
    SnapshotPart,
    Verdict,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.codec import encode
from modelserver.wire.eventlog import encode_event
from mstools.recordings import drive as drive_module
from mstools.recordings.drive import Drive, EventKind, FixColor, Table
from mstools.view.sources import open_log

START = 1_700_000_000_000_000
ORIGIN = origin_at(50.27, -111.18, 770.0)


def make_pose(
    seconds: float,
    x: float,
    *,
    yaw: float = 0.0,
    invalid: Invalid = VALID,
    epoch: int = 0,
    covariance: bool = True,
) -> bytes:
    transformation = Transformation(
        "Cart:Base",
        "World:UTM",
        Pose.from_rpy((x, 0.0, 0.0), yaw=yaw),
        np.diag([4.0, 1.0, 9.0, 0.01, 0.01, 0.04]) if covariance else None,
        utime=START + round(seconds * 1e6),
        invalid_reasons=invalid,
        pose_epoch=epoch,
        origin_id=ORIGIN.origin_id,
    )
    return encode(PoseAnswer(transformation, ORIGIN, horizontal_protection_level=3.0, heading_protection_level=0.1))


def feed_poses(drive: Drive, poses: Iterable[bytes]) -> None:
    for data in poses:
        drive.feed("POSE", data, START)


def make_fix(seconds: float, x: float, source: str = "gps") -> bytes:
    geodesy = geodesy_of(ORIGIN)
    easting, northing, height = ORIGIN.initial_utm
    latitude, longitude, up = geodesy.geodetic_from_utm(easting + x, northing, height)
    utime = START + round(seconds * 1e6)
    return encode(
        GpsSample(
            SensorHeader(utime, source, 0, utime),
            FixType.FIX_3D,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_ellipsoidal=up,
        )
    )


def make_decision(seconds: float, verdict: Verdict, source: str = "gps", reason: str = "") -> bytes:
    utime = START + round(seconds * 1e6)
    decision = Decision(utime, source, 0, "gps_position", verdict, reason, (), (), (), math.nan, math.nan)
    return encode(PublishDecisions(utime, (decision,)))


def make_joints(seconds: float, source: str = "axis", **positions: float) -> bytes:
    utime = START + round(seconds * 1e6)
    samples = tuple(JointSample(name, position) for name, position in positions.items())
    return encode(JointsSample(SensorHeader(utime, source, 0, utime), samples))


@pytest.fixture
def model() -> Model:
    builder = ModelBuilder("cart")
    builder.add_body("Cart").add_frame("Base")
    builder.add_body("Mast").add_frame("Origin")
    builder.add_constraint("Pan", "Cart:Base", "Mast:Origin", joint=Joint(JointType.REVOLUTE, axis=(0.0, 0.0, 1.0)))
    return builder.build()


def test_given_two_poses_then_one_in_between_is_interpolated() -> None:
    drive = Drive()
    feed_poses(drive, [make_pose(0.0, 0.0), make_pose(1.0, 10.0, yaw=0.2)])
    picture = drive.get_picture(START + 500_000)
    assert picture.pose is not None
    assert picture.pose.is_close(Pose.from_rpy((5.0, 0.0, 0.0), yaw=0.1), 1e-9, 1e-9)
    assert picture.covariance is not None
    np.testing.assert_allclose(picture.covariance, np.diag([4.0, 1.0, 9.0]))
    assert (picture.horizontal_protection_level, picture.heading_protection_level) == (3.0, 0.1)


def test_given_a_reset_between_two_poses_then_nothing_is_interpolated_and_the_track_begins_after_it() -> None:
    drive = Drive()
    feed_poses(
        drive,
        [make_pose(0.0, 0.0), make_pose(0.5, 1.0), make_pose(1.0, 100.0, epoch=1), make_pose(2.0, 101.0, epoch=1)],
    )
    picture = drive.get_picture(START + 900_000)
    assert picture.pose is not None
    assert picture.pose.xyz[0] == 1.0
    assert drive.get_track(START + 900_000)[1][:, 0].tolist() == [0.0, 1.0]
    assert drive.get_track(START + 2_000_000)[1][:, 0].tolist() == [100.0, 101.0]
    assert [event.kind for event in drive.events] == [EventKind.RESET]


def test_given_a_gap_longer_than_a_second_then_the_last_pose_is_held() -> None:
    drive = Drive()
    feed_poses(drive, [make_pose(0.0, 0.0), make_pose(5.0, 10.0)])
    picture = drive.get_picture(START + 2_500_000)
    assert picture.pose is not None
    assert picture.pose.xyz[0] == 0.0


def test_given_poses_at_100_hz_then_no_more_are_stored_than_a_screen_shows() -> None:
    drive = Drive()
    feed_poses(drive, [make_pose(0.01 * n, 0.01 * n) for n in range(300)])
    assert drive.poses.count == 100
    assert drive.channels["POSE"].count == 300


def test_given_a_time_before_the_first_pose_then_there_is_none() -> None:
    drive = Drive()
    assert drive.get_picture().pose is None
    feed_poses(drive, [make_pose(1.0, 0.0)])
    assert drive.get_picture(START).pose is None


def test_given_a_pose_without_covariance_then_the_picture_has_none() -> None:
    drive = Drive()
    feed_poses(drive, [make_pose(0.0, 0.0, covariance=False)])
    picture = drive.get_picture()
    assert picture.covariance is None


def test_given_a_pose_that_becomes_invalid_and_valid_then_both_are_events_in_words() -> None:
    drive = Drive()
    poses = [make_pose(0.0, 0.0), make_pose(1.0, 0.0, invalid=Invalid.STALE_GPS), make_pose(2.0, 0.0)]
    feed_poses(drive, poses)
    assert [(event.kind, event.text) for event in drive.events] == [
        (EventKind.INVALID, Invalid.STALE_GPS.explain()),
        (EventKind.VALID, "the pose is valid"),
    ]


def test_given_fixes_then_they_have_their_place_and_the_color_of_their_decision() -> None:
    drive = Drive()
    # the first one comes before the origin is known
    drive.feed("GPS", make_fix(0.0, 1.0), START)
    feed_poses(drive, [make_pose(0.1, 0.0)])
    drive.feed("GPS", make_fix(1.0, 2.0), START)
    drive.feed("ROVER", make_fix(0.5, 3.0, "second receiver"), START)
    drive.feed("LOCALIZATION_DECISIONS", make_decision(1.0, Verdict.REJECTED, reason="gate"), START)
    drive.feed("LOCALIZATION_DECISIONS", make_decision(0.5, Verdict.USED, "second receiver"), START)
    places, colors = drive.get_fixes(START + 2_000_000)
    np.testing.assert_allclose(places, [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]], atol=1e-6)
    assert list(colors) == [FixColor.NO_DECISION, FixColor.REJECTED, FixColor.USED]
    assert len(drive.get_fixes(START + 600_000)[0]) == 2
    assert drive.events[-1].text == "rejected gps_position of gps: gate"


def test_given_one_rejection_after_another_then_they_are_one_event_with_a_count() -> None:
    drive = Drive()
    for n in range(5):
        drive.feed("LOCALIZATION_DECISIONS", make_decision(0.5 * n, Verdict.REJECTED), START)
    drive.feed("LOCALIZATION_DECISIONS", make_decision(60.0, Verdict.REJECTED), START)
    assert [event.count for event in drive.events] == [5, 1]


def test_given_a_snapshot_then_its_joints_are_stored(model: Model) -> None:
    drive = Drive("v_")
    drive.feed("v_JOINTS", make_joints(0.0, Pan=1.0), START)
    whole = encode_snapshot(ModelSnapshot("cart", model, "Cart:Base", "Cart:Base", 60.0, "v_JOINTS"))
    drive.feed("v_MODEL_SNAPSHOT", encode(SnapshotPart(START, model.revision, 0, 1, whole)), START)
    drive.feed("v_JOINTS", make_joints(1.0, Pan=0.5, Unknown=2.0), START)
    drive.feed("v_JOINTS", make_joints(1.01, Pan=0.6), START)
    drive.feed("v_JOINTS", make_joints(1.01, "second driver", Pan=0.7), START)
    drive.feed("JOINTS", make_joints(2.0, Pan=9.0), START)
    assert drive.model is not None
    assert drive.model.revision == model.revision
    assert drive.base_frame == "Cart:Base"
    # before the geometry nothing is known of a joint; of one source only the first within a picture is stored
    assert drive.get_picture(START + 1_000_000).joints == {"Pan": 0.5}
    assert drive.get_picture().joints == {"Pan": 0.7}
    assert "JOINTS" not in drive.channels


def test_given_malformed_messages_then_they_are_counted_and_the_rest_is_shown() -> None:
    drive = Drive()
    for channel in ("POSE", "JOINTS", "LOCALIZATION_DECISIONS", "MODEL_SNAPSHOT", "DRIVER_HEALTH"):
        for data in (b"", b"\0" * 8, b"\xff" * 200, make_pose(0.0, 1.0)[:70]):
            drive.feed(channel, data, START)
    assert drive.damaged > 10
    feed_poses(drive, [make_pose(1.0, 2.0)])
    picture = drive.get_picture()
    assert picture.pose is not None
    assert picture.pose.xyz[0] == 2.0


@pytest.mark.parametrize("wrong_s", [3600.0, -3600.0, 1e12, -1e12])
def test_given_one_wrong_stamp_then_the_picture_follows_the_others(wrong_s: float) -> None:
    drive = Drive()
    poses = [make_pose(0.1 * n, 0.1 * n) for n in range(50)]
    wrong = START + round(wrong_s * 1e6)
    poses.insert(25, poses[24][:8] + wrong.to_bytes(8, "big", signed=True) + poses[24][16:])
    feed_poses(drive, poses)
    assert drive.end == START + 4_900_000
    picture = drive.get_picture()
    assert picture.pose is not None
    assert picture.pose.xyz[0] == pytest.approx(4.9)
    assert 48 <= drive.poses.count <= 50


def test_given_a_clock_that_is_set_back_then_the_drive_continues_from_there() -> None:
    drive = Drive()
    feed_poses(drive, [make_pose(0.1 * n, 0.1 * n) for n in range(100)])
    feed_poses(drive, [make_pose(3.0 + 0.1 * n, 50.0 + 0.1 * n) for n in range(20)])
    assert drive.end == START + 4_900_000
    assert np.all(np.diff(drive.poses.utimes) > 0)
    picture = drive.get_picture()
    assert picture.pose is not None
    assert picture.pose.xyz[0] == pytest.approx(51.9)


def test_given_mutated_messages_then_nothing_is_raised_and_every_time_has_a_picture(model: Model) -> None:
    generator = np.random.default_rng(7)
    whole = encode_snapshot(ModelSnapshot("cart", model, "Cart:Base", "Cart:Base", 60.0, "JOINTS"))
    good = [
        ("MODEL_SNAPSHOT", encode(SnapshotPart(START, model.revision, 0, 1, whole))),
        ("POSE", make_pose(1.0, 2.0)),
        ("JOINTS", make_joints(1.0, Pan=0.5)),
        ("GPS", make_fix(1.0, 3.0)),
        ("LOCALIZATION_DECISIONS", make_decision(1.0, Verdict.USED)),
    ]
    drive = Drive()
    for channel, data in good:
        drive.feed(channel, data, START)
    for n in range(2000):
        channel, data = good[int(generator.integers(len(good)))]
        mutated = bytearray(data)
        for _ in range(int(generator.integers(1, 6))):
            mutated[int(generator.integers(len(mutated)))] = int(generator.integers(256))
        drive.feed(channel, bytes(mutated[: int(generator.integers(8, len(mutated) + 1))]), START + n)
    assert drive.damaged > 100
    for utime in (0, START, drive.end):
        drive.get_picture(utime)
        drive.get_track(utime, 10.0)
        drive.get_fixes(utime)


def test_given_more_rows_than_the_limit_then_all_the_time_remains_with_the_last_row(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(drive_module, "MAX_ROWS", 3000)
    table = Table(1)
    for n in range(100_000):
        table.append(10 * n + 10, n)
        assert table.last == 10 * n + 10
        assert table.rows[-1, 0] == n
    assert 1500 <= table.count <= 3000
    assert table.utimes[0] == 10
    assert np.all(table.utimes == 10 * table.rows[:, 0] + 10)
    # as dense at its begin as at its end
    steps = np.diff(table.utimes)[:-1]
    assert steps.max() <= 2 * steps.min()


def test_given_a_log_with_two_geometries_then_each_time_has_its_own(model: Model) -> None:
    builder = ModelBuilder()
    builder.add_body("Other").add_frame("Frame")
    other = builder.build()
    drive = Drive()
    for seconds, each, base in ((1, model, "Cart:Base"), (3, other, "Other:Frame"), (6, other, "Other:Frame")):
        whole = encode_snapshot(ModelSnapshot("cart", each, base, base, 60.0, "JOINTS"))
        drive.feed("MODEL_SNAPSHOT", encode(SnapshotPart(START + seconds * 10**6, each.revision, 0, 1, whole)), START)
    shown = [drive.get_geometry(START + seconds * 10**6) for seconds in (0, 2, 3, 9)]
    assert [each.revision for each, _ in shown if each is not None] == [model.revision] * 2 + [other.revision] * 2
    assert [base for _, base in shown] == ["Cart:Base"] * 2 + ["Other:Frame"] * 2
    assert drive.get_geometry() == (drive.model, "Other:Frame")
    assert [event.kind for event in drive.events] == [EventKind.GEOMETRY]


def test_given_a_service_that_stops_then_that_is_reported_after_some_seconds() -> None:
    drive = Drive("v_")
    assert "no message of a service yet" in drive.find_silence(START)
    drive.feed("v_POSE", make_pose(0.0, 1.0), START)
    # requests are no sign of a service
    drive.feed("v_PLATFORM_GET_TRANSFORM", make_pose(0.0, 1.0), START + 60_000_000)
    assert drive.find_silence(START + 1_000_000) == ""
    assert "no message of the service for 60 s" in drive.find_silence(START + 60_000_000)
    drive.feed("v_MODELSERVER_HEALTH", make_pose(0.0, 1.0), START + 60_000_000)
    assert drive.find_silence(START + 60_000_000) == ""


def test_given_messages_of_a_channel_then_its_mean_rate_is_that_of_all() -> None:
    drive = Drive()
    for n in range(11):
        drive.feed("OTHER", b"", START + n * (100_000 if n < 10 else 200_000))
    assert drive.channels["OTHER"].mean_rate == pytest.approx(5.0)


def test_given_states_of_the_filter_then_the_course_of_one_is_that_before_the_time() -> None:
    drive = Drive()
    for n in range(100):
        utime = START + n * 1_000_000
        state = NavigationState(
            *(utime, Mode.FULL, Phase.ALIGNED, False, VALID, 0, *ORIGIN.initial_utm, Pose.identity()),
            *((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (), ("east", "wheel_scale"), (1.0, 0.5 * n), (4.0, 0.0, 0.0, 9.0)),
        )
        drive.feed("LOCALIZATION_STATE", encode(state), utime)
    times, values, sigmas = drive.get_state_course("wheel_scale", START + 70_000_000, 30.0)
    assert times == pytest.approx(np.arange(-29.0, 1.0))
    assert values == pytest.approx(0.5 * np.arange(41.0, 71.0))
    assert sigmas == pytest.approx(np.full(30, 3.0))
    assert all(not len(each) for each in drive.get_state_course("unknown", START + 70_000_000))


def test_given_a_truncated_log_then_it_opens_and_its_damage_is_known(tmp_path: Path, model: Model) -> None:
    whole = encode_snapshot(ModelSnapshot("cart", model, "Cart:Base", "Cart:Base", 60.0, "JOINTS"))
    messages = [(b"MODEL_SNAPSHOT", encode(SnapshotPart(START, model.revision, 0, 1, whole)))]
    messages += [(b"POSE", make_pose(0.1 * n, 0.1 * n)) for n in range(20)]
    events = [encode_event(n, START + n, *each) for n, each in enumerate(messages)]
    path = tmp_path / "drive.lcm"
    path.write_bytes(b"".join(events)[:-10])
    source = open_log(path)
    assert source.drive.end == START + 1_800_000
    assert [each.partition(" after")[0] for each in source.notes] == ["the log is truncated"]


def test_given_a_log_whose_stamps_are_off_then_the_amount_is_reported(tmp_path: Path, model: Model) -> None:
    path = tmp_path / "drive.lcm"
    whole = encode_snapshot(ModelSnapshot("cart", model, "Cart:Base", "Cart:Base", 60.0, "JOINTS"))
    snapshot = encode(SnapshotPart(START, model.revision, 0, 1, whole))
    fixes = (GpsSample(SensorHeader(START + n, "gps"), FixType.FIX_3D, 50.0, -111.0) for n in range(5))
    events = [encode_event(n, START + 7_200_000_000 + n, b"GPS", encode(fix)) for n, fix in enumerate(fixes)]
    events.append(encode_event(5, START + 7_200_000_005, b"MODEL_SNAPSHOT", snapshot))
    path.write_bytes(b"".join(events))
    source = open_log(path)
    assert source.notes[:1] == (
        "all stamps are 7,200.0 s (2 h: a time zone?) behind their receipt: the axis of the stamps is used",
    )
