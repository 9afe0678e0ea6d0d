"""The Raptor with its front laser nodding, in a turn: where camera and laser are, at every instant asked."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support_moving import NOD, NOD_RATE, T0, UTM, S, estimate, vehicle

from modelserver.estimation.history import History
from modelserver.formats import load_model
from modelserver.joints import JointHistory
from modelserver.messages import Estimate, JointSample, JointsSample, SensorHeader, TimeQuery
from modelserver.query.view import PlatformView
from modelserver.transforms.pose import Pose

RAPTOR = load_model(Path(__file__).parents[3] / "config" / "raptor" / "geometry.yaml")
CG, AXIS = "Raptor:CG", "FrontNoddingSICKAxis"
SECONDS = 4.0


def angle(seconds: float) -> float:
    """The nodding, sinusoidal with a peak of 30 degrees a second, within the axis's limits."""
    return NOD * math.sin(NOD_RATE * seconds)


def truth(frame: str, seconds: float) -> Pose:
    route = RAPTOR.get_kinematic_path(frame, CG)
    return vehicle(seconds) @ route.compute_pose([(angle(seconds),) for _ in route.joints])


@pytest.fixture(scope="module")
def platform() -> PlatformView:
    joints, history = JointHistory(RAPTOR.joints.values(), 60.0), History(60.0)
    for n in range(int(SECONDS * 50) + 1):
        sample = JointsSample(SensorHeader(T0 + n * 20_000, "axis"), (JointSample(AXIS, angle(n / 50)),))
        joints, rejected = joints.update(sample, sample.header.utime)
        assert rejected == ()
    for n in range(int(SECONDS * 100) + 1):
        history = history.append(estimate(n / 100))

    class TrueEstimates:
        """A localizer with exact estimates."""

        utime = history.last

        def estimate(self, utime: int) -> Estimate:
            return estimate((utime - T0) / S)

    return PlatformView(RAPTOR, CG, TrueEstimates(), history, joints=joints)  # type: ignore[arg-type]


@pytest.mark.parametrize("frame", ["Digiclops:ImagePlane", "FrontSICKLaser:Scan"])
def test_given_poses_at_100_hz_and_joints_at_50_hz_then_each_instant_is_right_to_1_mm_and_a_fiftieth_degree(
    platform: PlatformView, frame: str
) -> None:
    worst = (0.0, 0.0)
    for n in range(0, int(SECONDS * S), 3_701):
        found = platform.transformation(frame, UTM, TimeQuery(T0 + n), T0 + int(SECONDS * S)).transformation
        assert found.is_valid
        meters, radians = found.pose.distance(truth(frame, n / S))
        worst = (max(worst[0], meters), max(worst[1], radians))
    assert worst[0] < 1e-3
    assert worst[1] < math.radians(0.02)


def test_given_the_nodding_then_the_laser_turns_and_what_stands_on_the_plate_does_not(platform: PlatformView) -> None:
    def pitch(frame: str, at: float) -> float:
        pose = platform.transformation(frame, CG, TimeQuery(T0 + round(at * S))).transformation
        return float(pose.rpy[1])

    quarter = math.pi / 2.0 / NOD_RATE
    assert pitch("FrontSICKLaser:Scan", 0.0) - pitch("FrontSICKLaser:Scan", quarter) == pytest.approx(NOD, abs=1e-3)
    assert pitch("Digiclops:ImagePlane", 0.0) == pitch("Digiclops:ImagePlane", quarter)
