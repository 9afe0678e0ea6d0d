from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lcm
import pytest
from support_bags import START_NS, Ros

from modelserver.errors import RecordingError
from modelserver.extras import make_install_command
from modelserver.formats import load_model
from modelserver.messages import Direction, FixType, ImuSample, OrientationReference, WheelsSample, YawSource
from modelserver.transforms import Pose
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent, LogFile
from mstools import cli
from mstools.recordings.bag_log import import_bag
from mstools.recordings.bags import DEFAULT_OPTIONS, Altitude, BagOptions, ImuOrientation, TopicKind
from mstools.recordings.log_platform import LogPlatform

TYPE_NAMES = {"GPS": "gps_t", "IMU": "imu_t", "WHEELS": "wheels_t", "JOINTS": "joints_t"}


@pytest.fixture(scope="module")
def ros() -> Ros:
    return Ros()


def events(path: Path) -> list[LogEvent]:
    with LogFile(path) as log:
        found = list(log)
    assert log.damage == []
    return found


def import_text(
    tmp_path: Path, ros: Ros, messages: list[tuple[str, int, Any]], options: BagOptions = DEFAULT_OPTIONS
) -> list[Any]:
    """Return the samples that messages become, in the log's order."""
    bag = ros.write(tmp_path / "a.bag", messages)
    import_bag(bag, tmp_path / "a.lcm", options)
    return [decode(TYPE_NAMES[event.channel], event.data) for event in events(tmp_path / "a.lcm")]


def one(tmp_path: Path, ros: Ros, message: Any, options: BagOptions = DEFAULT_OPTIONS) -> Any:
    (sample,) = import_text(tmp_path, ros, [("/topic", START_NS + 5_000_000, message)], options)
    return sample


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Run the command line; return its exit code, standard output and error."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(each) for each in arguments])
    out, err = capsys.readouterr()
    return int(end.value.code or 0), out, err


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda data: data[:9] + b"\xff" * 5 + b"\0" * 3 + data[17:], "cannot be read on opening it"),
        (lambda data: data[:10], "cannot be read on opening it"),
        (lambda data: data[: len(data) // 2], "cannot be read"),
        (lambda data: data.replace(b"3 linear_acceleration\n", b"3 linear_accelerated_\n"), "otherwise than ROS does"),
    ],
    ids=["length beyond memory", "shorter than its end", "half", "field of another name"],
)
def test_given_a_damaged_mcap_file_of_ros_then_the_file_and_the_damage_are_named(
    tmp_path: Path, damage: Callable[[bytes], bytes], why: str
) -> None:
    ros = Ros(2)
    bag = ros.write(tmp_path / "bag", [("/imu", START_NS + n, ros.imu(START_NS + n)) for n in range(5)], in_mcap=True)
    (whole,) = bag.glob("*.mcap")
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damage(whole.read_bytes()))
    assert path.read_bytes() != whole.read_bytes()
    with pytest.raises(RecordingError, match=why):
        import_bag(path, tmp_path / "out.lcm")
    assert not (tmp_path / "out.lcm").exists()


# --- times, order, channels ---------------------------------------------------------------------------------


def test_given_mixed_topics_when_imported_then_events_are_in_receive_order(tmp_path: Path, ros: Ros) -> None:
    late = START_NS + 30_000_000
    ros.write(
        tmp_path / "a.bag",
        [
            ("/fix", START_NS + 10_000_000, ros.fix(START_NS + 9_000_000)),
            ("/imu", late, ros.imu(START_NS + 8_000_123)),  # measured before the fix, received after it
            ("/odom", late + 1_000_000, ros.odom(START_NS + 30_500_000)),
            ("/imu", late + 2_000_000, ros.imu(START_NS + 20_000_000)),
        ],
    )
    report = import_bag(tmp_path / "a.bag", tmp_path / "a.lcm")
    found = events(tmp_path / "a.lcm")
    assert [each.channel for each in found] == ["GPS", "IMU", "WHEELS", "IMU"]
    assert [each.utime - START_NS // 1000 for each in found] == [10_000, 30_000, 31_000, 32_000]
    headers = [decode(TYPE_NAMES[each.channel], each.data).header for each in found]
    assert [each.utime - START_NS // 1000 for each in headers] == [9_000, 8_000, 30_500, 20_000]
    assert [each.host_utime for each in headers] == [each.utime for each in found]
    assert [each.seq for each in headers] == [0, 0, 0, 1]
    assert [each.source for each in headers] == ["gps", "imu", "wheels", "imu"]
    assert {each.topic: (each.channel, each.written) for each in report.topics} == {
        "/fix": ("GPS", 1),
        "/imu": ("IMU", 2),
        "/odom": ("WHEELS", 1),
    }


def test_given_a_log_when_read_by_lcm_itself_then_it_is_an_ordinary_one(tmp_path: Path, ros: Ros) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix()), ("/imu", START_NS + 1, ros.imu())])
    import_bag(bag, tmp_path / "a.lcm", prefix="NORTH_")
    assert [each.channel for each in lcm.EventLog(str(tmp_path / "a.lcm"))] == ["NORTH_GPS", "NORTH_IMU"]


def test_given_a_message_without_stamp_when_imported_then_its_receive_time_is_used_and_reported(
    tmp_path: Path, ros: Ros
) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix(0))])
    report = import_bag(bag, tmp_path / "a.lcm")
    (event,) = events(tmp_path / "a.lcm")
    assert decode("gps_t", event.data).header.utime == START_NS // 1000
    assert "1 messages without a stamp" in report.to_text()


def test_given_a_bag_of_ros_2_when_imported_then_it_reads_alike(tmp_path: Path) -> None:
    ros = Ros(2)
    bag = ros.write(tmp_path / "two", [("/fix", START_NS, ros.fix()), ("/odom", START_NS + 1000, ros.odom(speed=1.0))])
    import_bag(bag, tmp_path / "a.lcm")
    gps, wheels = (decode(TYPE_NAMES[each.channel], each.data) for each in events(tmp_path / "a.lcm"))
    assert gps.latitude_deg == 42.0
    assert [each.speed for each in wheels.wheels] == [1.0, 1.0]


@pytest.mark.parametrize("in_mcap", [True, False])
@pytest.mark.parametrize("given", ["file", "folder"])
def test_given_a_recording_of_ros_2_without_its_metadata_then_it_reads_alike_as_file_and_as_folder(
    tmp_path: Path, given: str, in_mcap: bool
) -> None:
    ros = Ros(2)
    messages = [("/fix", START_NS, ros.fix()), ("/odom", START_NS + 1000, ros.odom(speed=1.0))]
    bag = ros.write(tmp_path / "two", messages, in_mcap=in_mcap)
    (bag / "metadata.yaml").unlink()
    (file,) = bag.iterdir()
    import_bag(file if given == "file" else bag, tmp_path / "a.lcm")
    gps, wheels = (decode(TYPE_NAMES[each.channel], each.data) for each in events(tmp_path / "a.lcm"))
    assert gps.latitude_deg == 42.0
    assert [each.speed for each in wheels.wheels] == [1.0, 1.0]


def test_given_a_folder_without_a_recording_then_it_is_reported(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(RecordingError, match=r"no metadata\.yaml, no \.mcap and no \.db3 file in it"):
        import_bag(tmp_path, tmp_path / "a.lcm")


# --- which topics -------------------------------------------------------------------------------------------


def test_given_two_inertial_units_when_imported_then_the_busier_is_taken_and_the_other_reported(
    tmp_path: Path, ros: Ros
) -> None:
    bag = ros.write(
        tmp_path / "a.bag",
        [
            ("/one", START_NS, ros.imu()),
            ("/two", START_NS + 1000, ros.imu()),
            ("/two", START_NS + 2000, ros.imu()),
            ("/chatter", START_NS + 5000, ros.text("hello")),
        ],
    )
    by_topic = {each.topic: each for each in import_bag(bag, tmp_path / "a.lcm").topics}
    assert by_topic["/two"].written == 2
    assert "--topic imu=/one" in by_topic["/one"].skipped
    assert by_topic["/chatter"].skipped == "unsupported type"
    chosen = import_bag(bag, tmp_path / "b.lcm", kinds={"/one": TopicKind.IMU})
    assert {each.topic: each.written for each in chosen.topics} == {"/one": 1, "/two": 0, "/chatter": 0}


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        ({"/fixx": TopicKind.GPS}, "no topic '/fixx'. Nearest: /fix"),
        ({"/fix": TopicKind.IMU}, "topic /fix is of type sensor_msgs/msg/NavSatFix, which is no imu"),
        ({"/fix": TopicKind.GPS, "/fix2": TopicKind.GPS}, "two topics for gps"),
    ],
)
def test_given_a_wrong_topic_when_imported_then_the_error_helps(
    tmp_path: Path, ros: Ros, kinds: dict[str, TopicKind], words: str
) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix()), ("/fix2", START_NS, ros.fix())])
    with pytest.raises(RecordingError, match=words):
        import_bag(bag, tmp_path / "a.lcm", kinds=kinds)
    assert not (tmp_path / "a.lcm").exists()


# --- fixes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("status", "place", "fix_type"),
    [
        (-1, (42.0, -71.0, 5.0), FixType.NONE),
        (0, (42.0, -71.0, 5.0), FixType.FIX_3D),
        (0, (42.0, -71.0, math.nan), FixType.FIX_2D),
        (1, (42.0, -71.0, 5.0), FixType.DIFFERENTIAL),
        (2, (42.0, -71.0, 5.0), FixType.DIFFERENTIAL),
        (1, (math.nan, -71.0, 5.0), FixType.NONE),
        (7, (42.0, -71.0, 5.0), FixType.NONE),
    ],
)
def test_given_a_status_when_imported_then_the_fix_type_claims_no_more(
    tmp_path: Path, ros: Ros, status: int, place: tuple[float, float, float], fix_type: FixType
) -> None:
    assert one(tmp_path, ros, ros.fix(status=status, position=place)).fix_type is fix_type


def test_given_altitudes_when_imported_then_they_stand_where_the_option_reports(tmp_path: Path, ros: Ros) -> None:
    fix = ros.fix(position=(42.0, -71.0, 7.0))
    plain = one(tmp_path, ros, fix)
    assert plain.height_ellipsoidal == 7.0
    assert math.isnan(plain.height_msl)
    (tmp_path / "a.lcm").unlink()
    (tmp_path / "a.bag").unlink()
    msl = one(tmp_path, ros, fix, BagOptions(altitude=Altitude.MSL, undulation=-28.0))
    assert (msl.height_ellipsoidal, msl.height_msl, msl.undulation) == (-21.0, 7.0, -28.0)


@pytest.mark.parametrize(
    ("covariance", "kind", "known"),
    [((1, 0, 0, 0, 1, 0, 0, 0, 4), 2, True), ((1, 0, 0, 0, 1, 0, 0, 0, 4), 0, False), ((0,) * 9, 2, False)],
)
def test_given_a_covariance_when_imported_then_only_a_known_one_is_retained(
    tmp_path: Path, ros: Ros, covariance: tuple[float, ...], kind: int, known: bool
) -> None:
    sample = one(tmp_path, ros, ros.fix(covariance=covariance, covariance_type=kind))
    assert sample.position_covariance == (tuple(map(float, covariance)) if known else None)


# --- inertial -----------------------------------------------------------------------------------------------


def test_given_an_inertial_sample_when_imported_then_rates_and_force_are_retained(tmp_path: Path, ros: Ros) -> None:
    sample: ImuSample = one(tmp_path, ros, ros.imu(rate=(1, 2, 3), force=(4, 5, 6)))
    assert sample.angular_velocity == (1.0, 2.0, 3.0)
    assert sample.specific_force == (4.0, 5.0, 6.0)
    assert sample.magnetic_field is None
    assert sample.orientation is None
    assert sample.orientation_reference is OrientationReference.NONE


def test_given_the_mark_minus_one_when_imported_then_the_quantity_is_absent(tmp_path: Path, ros: Ros) -> None:
    options = BagOptions(imu_orientation=ImuOrientation.ENU)
    sample: ImuSample = one(tmp_path, ros, ros.imu(first_covariances=(-1, -1, -1)), options)
    assert sample.angular_velocity is None
    assert sample.specific_force is None
    assert sample.orientation is None
    assert sample.angular_velocity_covariance is None


def test_given_a_reference_when_imported_then_the_orientation_comes_with_it(tmp_path: Path, ros: Ros) -> None:
    options = BagOptions(imu_orientation=ImuOrientation.NED)
    sample: ImuSample = one(tmp_path, ros, ros.imu(wxyz=(0.6, 0.8, 0, 0)), options)
    assert sample.orientation == (0.6, 0.8, 0.0, 0.0)
    assert sample.orientation_reference is OrientationReference.NED
    assert sample.yaw_source is YawSource.NONE


@pytest.mark.parametrize("wxyz", [(0, 0, 0, 0), (math.nan, 0, 0, 0), (2, 0, 0, 0)])
def test_given_no_unit_quaternion_when_imported_then_it_is_no_orientation(
    tmp_path: Path, ros: Ros, wxyz: tuple[float, ...]
) -> None:
    assert one(tmp_path, ros, ros.imu(wxyz=wxyz), BagOptions(imu_orientation=ImuOrientation.ENU)).orientation is None


@pytest.mark.parametrize(
    ("force", "wxyz", "option", "words"),
    [
        ((0, 0, 9.8), (1, 0, 0, 0), ImuOrientation.NONE, "by gravity it is enu"),
        ((0, 0, -9.8), (1, 0, 0, 0), ImuOrientation.NONE, "by gravity it is ned"),
        ((0, 0, -9.8), (1, 0, 0, 0), ImuOrientation.ENU, "does not look like enu"),
        ((0, 0, 1.0), (1, 0, 0, 0), ImuOrientation.NONE, r"specific force is 1\.00 m/s2, not 9\.81"),
    ],
)
def test_given_doubtful_units_when_imported_then_the_report_reports_it(
    tmp_path: Path,
    ros: Ros,
    force: tuple[float, ...],
    wxyz: tuple[float, ...],
    option: ImuOrientation,
    words: str,
) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/imu", START_NS, ros.imu(force=force, wxyz=wxyz))])
    report = import_bag(bag, tmp_path / "a.lcm", BagOptions(imu_orientation=option))
    assert re.search(words, report.to_text())


# --- wheels -------------------------------------------------------------------------------------------------


def test_given_a_twist_when_imported_then_two_wheels_roll_as_points_of_the_base_move(tmp_path: Path, ros: Ros) -> None:
    sample: WheelsSample = one(
        tmp_path, ros, ros.odom(speed=1.0, turn=0.5, variances=(0.04, 0.09)), BagOptions(track_width=2.0)
    )
    left, right = sample.wheels
    assert (left.name, right.name) == ("left", "right")
    assert (left.speed, right.speed) == (0.5, 1.5)
    assert left.speed_sigma == pytest.approx(math.sqrt(0.04 + 0.09))
    assert left.direction is right.direction is Direction.FORWARD
    assert (left.travel, right.travel) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("speed", "direction"),
    [(1e-15, Direction.STOPPED), (-0.5, Direction.BACKWARD), (math.nan, Direction.UNKNOWN)],
)
def test_given_a_speed_when_imported_then_the_direction_is_its_sign(
    tmp_path: Path, ros: Ros, speed: float, direction: Direction
) -> None:
    assert one(tmp_path, ros, ros.odom(speed=speed)).wheels[0].direction is direction


def test_given_a_circle_when_imported_then_the_travels_are_those_of_two_arcs(tmp_path: Path, ros: Ros) -> None:
    radius, steps = 5.0, 100
    messages = []
    for n in range(steps + 1):
        angle = 2 * math.pi * n / steps
        place = (radius * math.sin(angle), radius * (1 - math.cos(angle)), 0.0)
        # the published twist lags: it must not spoil the travel
        messages.append(("/odom", START_NS + n * 10**8, ros.odom(START_NS + n * 10**8, place, angle, speed=0.0)))
    last: WheelsSample = import_text(tmp_path, ros, messages, BagOptions(track_width=1.0))[-1]
    left, right = last.wheels
    assert right.travel - left.travel == pytest.approx(2 * math.pi * 1.0, abs=1e-9)
    assert (left.travel + right.travel) / 2 == pytest.approx(2 * math.pi * radius, rel=1e-3)


def test_given_driving_backwards_when_imported_then_the_travel_falls(tmp_path: Path, ros: Ros) -> None:
    messages = [
        ("/odom", START_NS + n * 10**8, ros.odom(START_NS + n * 10**8, (-0.1 * n, 0.0, 0.0), speed=-1.0))
        for n in range(11)
    ]
    last: WheelsSample = import_text(tmp_path, ros, messages)[-1]
    assert [each.travel for each in last.wheels] == pytest.approx([-1.0, -1.0])


def test_given_an_odometry_set_again_when_imported_then_the_travel_does_not_jump(tmp_path: Path, ros: Ros) -> None:
    messages = []
    for n in range(11):
        x = 100.0 + 0.1 * n if n < 5 else 0.1 * n
        messages.append(("/odom", START_NS + n * 10**8, ros.odom(START_NS + n * 10**8, (x, 0.0, 0.0), speed=1.0)))
    bag = ros.write(tmp_path / "a.bag", messages)
    report = import_bag(bag, tmp_path / "a.lcm")
    last = decode("wheels_t", events(tmp_path / "a.lcm")[-1].data)
    assert last.wheels[0].travel == pytest.approx(1.0)
    assert "jumped 1 times" in report.to_text()


def test_given_sideways_motion_when_imported_then_the_report_reports_what_is_lost(tmp_path: Path, ros: Ros) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/odom", START_NS, ros.odom(sideways=0.4))])
    assert "sideways at up to 0.40 m/s" in import_bag(bag, tmp_path / "a.lcm").to_text()


def test_given_joints_when_imported_then_missing_arrays_are_nan(tmp_path: Path, ros: Ros) -> None:
    sample = one(tmp_path, ros, ros.joints(START_NS, ["pan", "tilt"], [0.1, 0.2], []))
    assert [(each.name, each.position) for each in sample.joints] == [("pan", 0.1), ("tilt", 0.2)]
    assert all(math.isnan(each.rate) for each in sample.joints)


# --- bad input ----------------------------------------------------------------------------------------------


def bad_bags(ros: Ros, tmp_path: Path) -> dict[str, bytes]:
    whole = ros.write(
        tmp_path / "whole.bag", [("/fix", START_NS + n * 10**8, ros.fix(START_NS + n * 10**8)) for n in range(200)]
    ).read_bytes()
    return {
        "empty": b"",
        "junk": bytes(range(256)) * 50,
        "head": whole[:13],
        "half": whole[: len(whole) // 2],
        "short": whole[:-40],
        "spoilt": whole[: len(whole) // 2] + b"\xff" * 600 + whole[len(whole) // 2 + 600 :],
    }


@pytest.mark.parametrize("name", ["empty", "junk", "head", "half", "short", "spoilt"])
def test_given_a_bad_bag_when_imported_then_one_clear_error_and_no_file(
    tmp_path: Path, ros: Ros, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    bad = tmp_path / "in" / "bad.bag"
    bad.parent.mkdir()
    (tmp_path / "out").mkdir()
    bad.write_bytes(bad_bags(ros, tmp_path)[name])
    code, out, err = run(capsys, "import-bag", bad, tmp_path / "out" / "a.lcm")
    assert code == 1
    assert out == ""
    assert err.count("\n") == 1
    assert "bad.bag" in err
    assert list((tmp_path / "out").iterdir()) == []


def test_given_a_bag_without_messages_when_imported_then_an_error(tmp_path: Path, ros: Ros) -> None:
    with pytest.raises(RecordingError, match="no messages of"):
        import_bag(ros.write(tmp_path / "a.bag", []), tmp_path / "a.lcm")


@pytest.mark.parametrize("name", ["nothing.bag", ".", "nothing"])
def test_given_no_bag_when_imported_then_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    code, _, err = run(capsys, "import-bag", tmp_path / name, tmp_path / "a.lcm")
    assert (code, err.count("\n")) == (1, 1)


def test_given_an_existing_log_when_imported_then_only_force_replaces_it(tmp_path: Path, ros: Ros) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix())])
    log = tmp_path / "a.lcm"
    log.write_text("precious")
    with pytest.raises(RecordingError, match="already exists; --force"):
        import_bag(bag, log)
    assert log.read_text() == "precious"
    import_bag(bag, log, force=True)
    assert len(events(log)) == 1
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.bag", "a.lcm"]


def test_given_a_bad_bag_and_force_when_imported_then_the_old_log_stays(tmp_path: Path, ros: Ros) -> None:
    bag = tmp_path / "bad.bag"
    bag.write_bytes(bad_bags(ros, tmp_path)["half"])
    log = tmp_path / "a.lcm"
    log.write_text("precious")
    with pytest.raises(RecordingError):
        import_bag(bag, log, force=True)
    assert log.read_text() == "precious"


def test_given_no_rosbags_when_imported_then_the_pip_command_is_reported(
    tmp_path: Path, ros: Ros, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix())])
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    code, _, err = run(capsys, "import-bag", bag, tmp_path / "a.lcm")
    assert code == 1
    assert make_install_command("bags") in err
    assert err.count("\n") == 1


# --- choice of topics ---------------------------------------------------------------------------------------


def test_given_busier_outputs_of_estimators_then_the_sensors_are_taken_and_the_reason_is_shown(
    tmp_path: Path, ros: Ros, capsys: pytest.CaptureFixture[str]
) -> None:
    busy = [(name, START_NS + n, make()) for n in range(3) for name, make in (("/gps/filtered", ros.fix),)]
    busy += [(name, START_NS + n, ros.odom()) for n in range(3) for name in ("/odometry/filtered", "/odometry/gps")]
    bag = ros.write(tmp_path / "a.bag", [*busy, ("/fix", START_NS, ros.fix()), ("/wheel/odom", START_NS, ros.odom())])
    code, out, err = run(capsys, "import-bag", bag)
    assert (code, err) == (0, "")
    lines = dict(line.split(" -> ") for line in out.splitlines())
    assert lines["  /fix (sensor_msgs/msg/NavSatFix)"] == "gps, the busiest that no estimator makes"
    assert lines["  /wheel/odom (nav_msgs/msg/Odometry)"] == "wheels, the busiest that no estimator makes"
    assert (
        "estimator's output (filtered); --topic gps=/gps/filtered"
        in lines["  /gps/filtered (sensor_msgs/msg/NavSatFix)"]
    )
    assert "estimator's output (gps)" in lines["  /odometry/gps (nav_msgs/msg/Odometry)"]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.bag"]


def test_given_only_the_output_of_an_estimator_then_it_is_taken_with_a_note(tmp_path: Path, ros: Ros) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/odometry/filtered", START_NS, ros.odom())])
    (report,) = import_bag(bag, tmp_path / "a.lcm").topics
    assert (report.written, report.chosen) == (1, "the only one")
    assert "looks like an estimator's output (filtered)" in report.notes[0]


# --- frames -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [1, 2])
def test_given_tf_then_rigid_frames_are_constraints_and_moving_ones_joints(tmp_path: Path, version: int) -> None:
    """What the geometry and the log answer is what the bag's transforms are, at each time."""
    ros = Ros(version)
    half = math.sqrt(0.5)
    fixed = {"gps_link": ((0.1, 0.0, 0.9), (1.0, 0.0, 0.0, 0.0)), "mast": ((0.3, 0.0, 1.0), (half, 0.0, 0.0, half))}
    messages = [("/tf_static", START_NS, ros.transforms(START_NS, "base_link", fixed))]
    turns = [0.1 * n for n in range(5)]
    for n, turn in enumerate(turns):
        stamp, wxyz = START_NS + n * 10**8, (math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0)
        messages.append(("/tf", stamp, ros.transforms(stamp, "mast", {"camera": ((0.0, 0.0, 0.2), wxyz)})))
        messages.append(
            ("/tf", stamp, ros.transforms(stamp, "odom", {"base_link": ((float(n), 0.0, 0.0), (1, 0, 0, 0))}))
        )
        messages.append(("/imu", stamp, ros.imu(stamp)))
    bag = ros.write(tmp_path / ("a.bag" if version == 1 else "a"), messages)
    import_bag(bag, tmp_path / "a.lcm", geometry=tmp_path / "robot.yaml")
    model = load_model(tmp_path / "robot.yaml")
    assert model.root.name == "base_link"
    assert sorted(model.get_body_list()) == ["base_link", "camera", "gps_link", "mast"]
    assert model.get_transformation("gps_link", "base_link").pose.xyz == (0.1, 0.0, 0.9)
    assert list(model.joints) == ["mast_to_camera"]
    log = LogPlatform(tmp_path / "a.lcm", "", model)
    for n, turn in enumerate(turns):
        answer = log.get_pose("camera", "mast", at=START_NS // 1000 + n * 100_000)
        expected = Pose((0.0, 0.0, 0.2), (math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0))
        assert answer.transformation.pose.is_close(expected, 1e-9, 1e-9)


def test_given_no_transforms_of_the_vehicle_then_geometry_is_an_error_and_nothing_is_written(
    tmp_path: Path, ros: Ros
) -> None:
    messages = [("/fix", START_NS, ros.fix())]
    messages.append(("/tf", START_NS, ros.transforms(START_NS, "map", {"odom": ((0, 0, 0), (1, 0, 0, 0))})))
    bag = ros.write(tmp_path / "a.bag", messages)
    with pytest.raises(RecordingError, match="no transforms between frames of the vehicle"):
        import_bag(bag, tmp_path / "a.lcm", geometry=tmp_path / "robot.yaml")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.bag"]


# --- the command --------------------------------------------------------------------------------------------


def test_given_json_when_imported_then_the_report_is_for_scripts(
    tmp_path: Path, ros: Ros, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix()), ("/fix", START_NS + 10**9, ros.fix())])
    code, out, err = run(capsys, "import-bag", bag, tmp_path / "a.lcm", "--json", "--topic", "gps=/fix")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["seconds"] == 1.0
    assert report["topics"][0]["written"] == 2


@pytest.mark.parametrize(
    "options",
    [
        ["--topic", "fix"],
        ["--topic", "radar=/fix"],
        ["--track-width", "0"],
        ["--track-width", "nan"],
        ["--undulation", "-28"],
        ["--prefix", "a/b"],
        ["--altitude", "up"],
    ],
)
def test_given_wrong_options_when_imported_then_usage(
    tmp_path: Path, ros: Ros, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    bag = ros.write(tmp_path / "a.bag", [("/fix", START_NS, ros.fix())])
    code, _, _ = run(capsys, "import-bag", bag, tmp_path / "a.lcm", *options)
    assert code == 2
    assert not (tmp_path / "a.lcm").exists()
