"""Messages that differ in the last bits, by more, or not only in numbers."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support_journal import SMALL, JournalRig

from modelserver.messages import PoseAnswer
from modelserver.server.journal import verify as journal_verify
from modelserver.server.journal.verify import (
    Deviation,
    ReplayLoop,
    VerificationResult,
    compute_deviation,
    diff_messages,
    verify,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.codec import decode, encode
from modelserver.wire.journal import JournalRecord

TURNED = 3e-10


def pose(x: float = 1.0, yaw: float = 0.5, bound: float = 2.0, epoch: int = 0) -> bytes:
    X = Pose.from_rpy((x, 2.0, 3.0), 0.0, 0.0, yaw)
    return encode(
        PoseAnswer(Transformation("Cart:Base", "World:UTM", X, pose_epoch=epoch), horizontal_protection_level=bound)
    )


def vector(x: float = 1.0, yaw: float = 0.5) -> bytes:
    X = Pose.from_rpy((x, 2.0, 3.0), 0.0, 0.0, yaw)
    return encode(PoseAnswer(Transformation("Cart:Base", "World:UTM", X)), "pose_vector_t")


@pytest.mark.parametrize("make", [pose, vector])
def test_given_a_small_pose_difference_then_meters_and_radians_are_distinguished(make: object) -> None:
    was, moved, turned = make(), make(x=1.0 + 4e-10), make(yaw=0.5 + TURNED)  # type: ignore[operator]
    off = compute_deviation(was, moved)
    assert off is not None
    assert math.isclose(off.meters, 4e-10, rel_tol=1e-5)
    assert (off.radians, off.share, off.is_tolerable) == (0.0, 0.0, True)
    off = compute_deviation(was, turned)
    assert off is not None
    # never less than the angle between the two
    assert off.meters == 0.0
    assert TURNED * 0.99 < off.radians < 3.0 * TURNED
    far = compute_deviation(was, make(x=1.0 + 2e-9))  # type: ignore[operator]
    assert far is not None
    assert not far.is_tolerable


def test_given_other_numbers_then_they_count_by_their_share() -> None:
    off = compute_deviation(pose(bound=2000.0), pose(bound=2000.0 + 1e-6))
    assert off is not None
    assert math.isclose(off.share, 5e-10, rel_tol=1e-3)
    assert off.is_tolerable


@pytest.mark.parametrize(
    ("was", "now"),
    [
        (pose(), pose(epoch=1)),
        (pose(bound=math.nan), pose(bound=1.0)),
        (pose(bound=math.inf), pose(bound=1.0)),
        (pose(), vector()),
        (pose(), pose()[:-3]),
        (b"", b"x"),
    ],
    ids=["count", "nan", "infinite", "type", "cut off", "no message"],
)
def test_given_more_than_numbers_that_differ_then_there_is_no_deviation(was: bytes, now: bytes) -> None:
    assert compute_deviation(was, now) is None


def test_given_two_messages_then_the_fields_that_differ_are_named() -> None:
    found = diff_messages(pose(), pose(x=4.0, epoch=3))
    assert found is not None
    assert [each.name for each in found] == ["h_transform[0][3]", "pose_epoch"]
    assert diff_messages(pose(), vector()) is None


def test_given_two_deviations_then_the_maximum_is_elementwise() -> None:
    assert Deviation(1.0, 0.0, 3.0).elementwise_max(Deviation(0.5, 2.0, 4.0)) == Deviation(1.0, 2.0, 4.0)


def shift(data: bytes, meters: float) -> bytes:
    answer = decode("pose_transform_t", data)
    t = answer.transformation
    moved = Transformation(
        t.frame_of_interest, t.frame_of_reference, Pose._of((t.pose.xyz[0] + meters, *t.pose.xyz[1:]), t.pose.wxyz),
        t.covariance, t.utime, t.invalid_reasons, t.pose_epoch, t.origin_id, t.model_revision,
    )  # fmt: skip
    return encode(answer._replace(transformation=moved))


@pytest.mark.parametrize(
    ("meters", "result"), [(5e-10, VerificationResult.WITHIN_TOLERANCE), (5e-9, VerificationResult.DIFFERS)]
)
def test_given_a_replay_that_sums_in_another_order_then_the_result_is_within_tolerance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meters: float, result: VerificationResult
) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(1.0)
    files = rig.finish()

    class Shifting(ReplayLoop):
        def handle(self, record: JournalRecord) -> list[tuple[str, bytes]]:
            return [
                (channel, shift(data, meters) if channel == "POSE_ODOM" else data)
                for channel, data in super().handle(record)
            ]

    monkeypatch.setattr(journal_verify, "ReplayLoop", Shifting)
    found = verify(files)
    assert found.result is result
    if result is VerificationResult.WITHIN_TOLERANCE:
        assert found.within_tolerance["POSE_ODOM"] == len(rig.bus.get_published("POSE_ODOM"))
        assert "POSE_ODOM" not in found.reproduced
        assert found.reproduced["POSE"] > 40
        assert math.isclose(found.max_deviation.meters, meters, rel_tol=1e-3)
        assert found.max_deviation_channels[0] == "POSE_ODOM"
    else:
        assert found.difference is not None
        assert found.difference.channel == "POSE_ODOM"
