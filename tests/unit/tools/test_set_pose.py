"""`modelserver set-pose`: what the options state becomes the pose, and slips of usage are named; the daemon is in the
scenario tests."""

from __future__ import annotations

import math
from typing import Any

import lcm
import numpy as np
import pytest
from support_lcm import reserved_url
from support_samples import GEODESY, ORIGIN

from modelserver.errors import ModelServerError
from modelserver.messages import Decision, PoseAnswer, PublishDecisions, Verdict
from modelserver.transforms import Pose, Transformation
from modelserver.wire.codec import encode
from mstools.cli import main
from mstools.commands.control import SetPoseListener, describe_set_pose, to_covariance, to_pose

CURRENT = Pose.from_rpy((100.0, 50.0, 5.0), 0.1, -0.2, 1.0)
UTM = (ORIGIN.easting + 30.0, ORIGIN.northing + 40.0, ORIGIN.height + 2.0)


# --- the pose ------------------------------------------------------------------------------------------------------


def place(current: Pose = CURRENT, **options: Any) -> Pose:
    names = ("xyz", "latlon", "height", "yaw", "heading")
    return to_pose(GEODESY, current, *(options.get(name) for name in names))


def test_given_coordinates_and_yaw_then_roll_and_pitch_stay() -> None:
    pose = place(xyz=(30.0, 40.0, 2.0), yaw=math.degrees(0.5))
    np.testing.assert_allclose(pose.position, (30.0, 40.0, 2.0), atol=1e-6)
    np.testing.assert_allclose(pose.rpy, (0.1, -0.2, 0.5), atol=1e-12)


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 200.0, 359.0])
def test_given_latitude_longitude_and_heading_then_the_pose_is_that_of_the_tangent_plane(heading_deg: float) -> None:
    """Against the service's own conversion of a pose in World:ENU, at the origin, where both have the same vertical."""
    latitude, longitude, height = GEODESY.geodetic_from_enu((0.0, 0.0, 1.0))
    found = place(Pose(), latlon=(latitude, longitude), height=height, heading=heading_deg)
    wanted = GEODESY.pose_in_utm(Pose.from_rpy((0.0, 0.0, 1.0), yaw=math.pi / 2 - math.radians(heading_deg)))
    assert found.is_close(wanted, 1e-4, 1e-8)
    # the convergence is more than nothing: a heading is no yaw
    assert abs(GEODESY.convergence(latitude, longitude)) > math.radians(0.05)


def test_given_no_height_then_the_height_of_the_pose_in_force_stays() -> None:
    latitude, longitude, _ = GEODESY.geodetic_from_enu((10.0, 20.0, 0.0))
    assert place(latlon=(latitude, longitude), yaw=0.0).position[2] == pytest.approx(5.0)


def test_given_a_position_beyond_reach_then_the_origin_and_the_form_are_named() -> None:
    with pytest.raises(ModelServerError, match=r"km from the origin .*zone 12 north.*--xyz takes meters from the orig"):
        place(xyz=UTM, yaw=0.0)
    with pytest.raises(ModelServerError, match="pinned UTM zone"):
        place(latlon=(50.0, 9.0), height=0.0, yaw=0.0)


def test_given_sigmas_then_the_covariance_has_their_squares_in_meters_and_radians() -> None:
    np.testing.assert_allclose(
        to_covariance(0.5, 2.0), np.diag([0.25] * 3 + [math.radians(2.0) ** 2] * 3), rtol=0, atol=1e-15
    )


# --- usage ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--yaw 0", "give one position, --xyz, --latlon; got none"),
        ("--xyz 0 0 0", "give one orientation, --yaw, --heading; got none"),
        ("--xyz 0 0 0 --latlon 1 2 --yaw 0", "got --xyz and --latlon"),
        ("--xyz 0 0 0 --yaw 0 --heading 90", "got --yaw and --heading"),
        ("--xyz 0 0 0 --yaw 0 --height 3", "--height"),
        ("--xyz 0 0 nan --yaw 0", "finite"),
        ("--xyz 0 0 0 --yaw 0 --sigma 0", "--sigma"),
        ("--xyz 0 0 0 --yaw 0 --sigma-deg -1", "--sigma-deg"),
    ],
)
def test_given_a_slip_of_usage_then_it_is_named_before_the_bus_is_joined(
    capsys: pytest.CaptureFixture[str], arguments: str, words: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["set-pose", *arguments.split(), "--url", "no bus at all"])
    assert ended.value.code == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_given_nobody_then_one_line_reports_what_to_look_at(capsys: pytest.CaptureFixture[str]) -> None:
    with reserved_url() as url:
        with pytest.raises(SystemExit) as ended:
            main(
                ["set-pose", "--xyz", "0", "0", "0", "--yaw", "0", "--url", url, "--prefix", "V1_", "--timeout", "0.05"]
            )
        assert ended.value.code == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert "no V1_POSE within 0.05 s" in err
        assert len(err.splitlines()) == 1


def test_given_messages_of_another_type_then_they_are_passed_over() -> None:
    decisions = encode(PublishDecisions(9, (USED, USED._replace(utime=6, source="vo"))))
    with reserved_url() as url:
        bus, listener = lcm.LCM(url), SetPoseListener(lcm.LCM(url), "V1_")
        for channel, data in (
            ("V1_POSE", b"none"),
            ("V1_POSE", decisions),
            ("V1_LOCALIZATION_DECISIONS", b"none"),
            ("V1_LOCALIZATION_DECISIONS", decisions),
            ("V1_POSE", encode(PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose())))),
        ):
            bus.publish(channel, data)
        assert listener.listen(30.0, lambda: listener.pose is not None)
    assert listener.decisions.get(5) == USED
    assert listener.decisions.get(6) is None


# --- the report ----------------------------------------------------------------------------------------------------

USED = Decision(5, "operator", 1, "absolute_pose", Verdict.USED, "", (0.0,) * 6, statistic=3.25, limit=22.5)


def result(decision: Decision | None, reasons: int = 0) -> str:
    request = Transformation("Cart:Base", "World:UTM", Pose((30.0, 40.0, 2.0)))
    after = PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose((30.5, 40.0, 2.0)), None, 9, reasons))
    return describe_set_pose(request, (1.0, 5.0), decision, after)


@pytest.mark.parametrize(
    ("shown", "line"),
    [
        (result(USED), "decision: used (chi-square 3.2 of 22.5 allowed, 6 numbers)"),
        (
            result(Decision(5, "operator", 1, "absolute_pose", Verdict.RESET, "position and heading were set")),
            "decision: set: position and heading were set",
        ),
        (
            result(Decision(5, "operator", 1, "absolute_pose", Verdict.REJECTED, "evil\x1b[2J")),
            r"decision: rejected: evil\x1b[2J",
        ),
        (
            result(None),
            "decision: accepted for localization; no decision on it was received (publish.decisions: false?)",
        ),
    ],
)
def test_given_a_result_then_people_see_where_it_is_and_the_decision(shown: str, line: str) -> None:
    lines = shown.splitlines()
    assert lines[0].startswith("Cart:Base in World:UTM: position (30.000, 40.000, 2.000) m")
    assert lines[1] == "  sigma 1 m, 5 deg"
    assert lines[2] == line
    assert lines[3].endswith("; valid")
