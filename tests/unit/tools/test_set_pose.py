"""`modelserver set-pose`: what the options state becomes the pose, and slips of usage are named; the daemon is in the
scenario tests."""

from __future__ import annotations

import json
import math

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
from mstools.commands.control import (
    PoseTarget,
    SetPoseListener,
    SetPoseResult,
    describe_set_pose,
    set_pose_as_data,
    to_covariance,
    to_pose,
)

CURRENT = Pose.from_rpy((100.0, 50.0, 5.0), 0.1, -0.2, 1.0)
UTM = (ORIGIN.easting + 30.0, ORIGIN.northing + 40.0, ORIGIN.height + 2.0)


# --- the pose ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [PoseTarget(utm=UTM, yaw=0.5), PoseTarget(xyz=(30.0, 40.0, 2.0), yaw=0.5)])
def test_given_grid_coordinates_and_yaw_then_roll_and_pitch_stay(target: PoseTarget) -> None:
    pose = to_pose(target, GEODESY, CURRENT)
    np.testing.assert_allclose(pose.position, (30.0, 40.0, 2.0), atol=1e-6)
    np.testing.assert_allclose(pose.rpy, (0.1, -0.2, 0.5), atol=1e-12)


def test_given_an_orientation_in_full_then_it_is_taken_as_it_is() -> None:
    assert to_pose(PoseTarget(xyz=(1.0, 2.0, 3.0), rpy=(0.3, 0.2, -2.0)), GEODESY, CURRENT) == Pose.from_rpy(
        (1.0, 2.0, 3.0), 0.3, 0.2, -2.0
    )
    quaternion = (0.5, 0.5, -0.5, 0.5)
    assert to_pose(PoseTarget(xyz=(1.0, 2.0, 3.0), quaternion=quaternion), GEODESY, CURRENT).wxyz == quaternion


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 200.0, 359.0])
def test_given_latitude_longitude_and_heading_then_the_pose_is_that_of_the_tangent_plane(heading_deg: float) -> None:
    """Against the service's own conversion of a pose in World:ENU, at the origin, where both have the same vertical."""
    latitude, longitude, height = GEODESY.geodetic_from_enu((0.0, 0.0, 1.0))
    heading = math.radians(heading_deg)
    found = to_pose(PoseTarget(geodetic=(latitude, longitude, height), heading=heading), GEODESY, Pose())
    wanted = GEODESY.pose_in_utm(Pose.from_rpy((0.0, 0.0, 1.0), yaw=math.pi / 2 - heading))
    assert found.is_close(wanted, 1e-4, 1e-8)
    # the convergence is more than nothing: a heading is no yaw
    assert abs(GEODESY.convergence(latitude, longitude)) > math.radians(0.05)


def test_given_no_height_then_the_height_of_the_pose_in_force_stays() -> None:
    latitude, longitude, _ = GEODESY.geodetic_from_enu((10.0, 20.0, 0.0))
    pose = to_pose(PoseTarget(geodetic=(latitude, longitude, None), yaw=0.0), GEODESY, CURRENT)
    assert pose.position[2] == pytest.approx(5.0)


def test_given_a_position_beyond_reach_then_the_origin_and_the_two_forms_are_named() -> None:
    with pytest.raises(ModelServerError, match=r"km from the origin .*zone 12 north.*--xyz meters from the origin"):
        to_pose(PoseTarget(xyz=UTM, yaw=0.0), GEODESY, CURRENT)
    with pytest.raises(ModelServerError, match="--utm takes absolute coordinates"):
        to_pose(PoseTarget(utm=(30.0, 40.0, 2.0), yaw=0.0), GEODESY, CURRENT)
    with pytest.raises(ModelServerError, match="pinned UTM zone"):
        to_pose(PoseTarget(geodetic=(50.0, 9.0, 0.0), yaw=0.0), GEODESY, CURRENT)


def test_given_sigmas_then_the_covariance_has_their_squares_in_meters_and_radians() -> None:
    np.testing.assert_allclose(
        to_covariance(0.5, 2.0), np.diag([0.25] * 3 + [math.radians(2.0) ** 2] * 3), rtol=0, atol=1e-15
    )


# --- usage ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--yaw 0", "give one position, --utm, --xyz, --latlon; got none"),
        ("--xyz 0 0 0", "give one orientation, --yaw, --heading, --rpy, --quaternion; got none"),
        ("--xyz 0 0 0 --utm 1 2 3 --yaw 0", "got --utm and --xyz"),
        ("--xyz 0 0 0 --yaw 0 --heading 90", "got --yaw and --heading"),
        ("--xyz 0 0 0 --yaw 0 --height 3", "--height"),
        ("--xyz 0 0 nan --yaw 0", "finite"),
        ("--xyz 0 0 0 --quaternion 0 0 0 0", "--quaternion"),
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


def result(decision: Decision | None, has_decisions: bool = True, reasons: int = 0) -> SetPoseResult:
    request = Transformation("Cart:Base", "World:UTM", Pose((30.0, 40.0, 2.0)))
    after = PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose((30.5, 40.0, 2.0)), None, 9, reasons))
    return SetPoseResult(request, GEODESY, (1.0, 5.0), decision, has_decisions, after)


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
        (result(None), "decision: accepted for localization; no decision on it was received"),
        (
            result(None, has_decisions=False),
            "decision: accepted for localization; LOCALIZATION_DECISIONS is silent (publish.decisions: false?)",
        ),
    ],
)
def test_given_a_result_then_people_see_where_it_is_and_the_decision(shown: SetPoseResult, line: str) -> None:
    lines = describe_set_pose(shown).splitlines()
    assert lines[0].startswith("Cart:Base in World:UTM: position (30.000, 40.000, 2.000) m")
    assert f"easting {UTM[0]:.3f} m, northing {UTM[1]:.3f} m, height {UTM[2]:.3f} m, zone 12 north" in lines[1]
    assert lines[2] == "  sigma 1 m, 5 deg"
    assert lines[3] == line
    assert lines[4].endswith("; valid")


def test_given_a_result_then_scripts_get_si_units_and_null_for_what_is_not_known() -> None:
    found = json.loads(json.dumps(set_pose_as_data(result(USED, reasons=1)), allow_nan=False))
    assert found["state_vector"] == [30.0, 40.0, 2.0, 1.0, 0.0, 0.0, 0.0]
    assert found["sigma"] == pytest.approx([1.0] * 3 + [math.radians(5.0)] * 3)
    assert found["decision"] == {"utime": 5, "verdict": "used", "reason": "", "statistic": 3.25, "limit": 22.5}
    assert found["pose_after"]["valid"] is False
    found = json.loads(json.dumps(set_pose_as_data(result(None)), allow_nan=False))
    assert found["decision"] is None
