"""Messages that differ in their last bits, by more, or by more than numbers."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from support_journal import SMALL, Kept

from modelserver.messages import PoseAnswer
from modelserver.service.journal import verify as journal_verify
from modelserver.service.journal.comparison import Deviation, changes, deviation
from modelserver.service.journal.rerun import Rerun
from modelserver.service.journal.verify import VerificationResult, verify
from modelserver.spatial.pose import Pose
from modelserver.spatial.transformation import Transformation
from modelserver.wire.codec import decode, encode
from modelserver.wire.journal import JournalRecord

TURNED = 3e-10


def pose(x: float = 1.0, yaw: float = 0.5, bound: float = 2.0, epoch: int = 0) -> bytes:
    X = Pose.from_rpy((x, 2.0, 3.0), 0.0, 0.0, yaw)
    return encode(PoseAnswer(Transformation("Cart:Base", "World:UTM", X, pose_epoch=epoch), horizontal_bound=bound))


def vector(x: float = 1.0, yaw: float = 0.5) -> bytes:
    X = Pose.from_rpy((x, 2.0, 3.0), 0.0, 0.0, yaw)
    return encode(PoseAnswer(Transformation("Cart:Base", "World:UTM", X)), "pose_vector_t")


@pytest.mark.parametrize("make", [pose, vector])
def test_given_a_pose_that_is_a_little_off_then_meters_and_radians_are_told_apart(make: object) -> None:
    was, moved, turned = make(), make(x=1.0 + 4e-10), make(yaw=0.5 + TURNED)  # type: ignore[operator]
    off = deviation(was, moved)
    assert off is not None
    assert math.isclose(off.meters, 4e-10, rel_tol=1e-5)
    assert (off.radians, off.share, off.is_tolerable) == (0.0, 0.0, True)
    off = deviation(was, turned)
    assert off is not None
    # never less than the angle between the two
    assert off.meters == 0.0
    assert TURNED * 0.99 < off.radians < 3.0 * TURNED
    far = deviation(was, make(x=1.0 + 2e-9))  # type: ignore[operator]
    assert far is not None
    assert not far.is_tolerable


def test_given_other_numbers_then_they_count_by_their_share() -> None:
    off = deviation(pose(bound=2000.0), pose(bound=2000.0 + 1e-6))
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
    assert deviation(was, now) is None


def test_given_two_messages_then_the_fields_that_differ_are_named() -> None:
    found = changes(pose(), pose(x=4.0, epoch=3))
    assert found is not None
    assert [each.name for each in found] == ["h_transform[0][3]", "pose_epoch"]
    assert changes(pose(), vector()) is None


def test_given_the_largest_of_two_then_each_kind_is_kept() -> None:
    assert Deviation(1.0, 0.0, 3.0).largest(Deviation(0.5, 2.0, 4.0)) == Deviation(1.0, 2.0, 4.0)


def shifted(data: bytes, meters: float) -> bytes:
    answer = decode("pose_transform_t", data)
    t = answer.transformation
    moved = Transformation(
        t.frame_of_interest, t.frame_of_reference, Pose._of((t.pose.xyz[0] + meters, *t.pose.xyz[1:]), t.pose.wxyz),
        t.covariance, t.utime, t.invalid_reasons, t.pose_epoch, t.origin_id, t.model_revision,
    )  # fmt: skip
    return encode(answer._replace(transformation=moved))


@pytest.mark.parametrize(("meters", "result"), [(5e-10, VerificationResult.CLOSE), (5e-9, VerificationResult.DIFFERS)])
def test_given_a_run_again_that_sums_in_another_order_then_that_is_a_result_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meters: float, result: VerificationResult
) -> None:
    kept = Kept(tmp_path, SMALL)
    kept.drive(1.0)
    files = kept.finish()

    class Shifting(Rerun):
        def handle(self, record: JournalRecord) -> list[tuple[str, bytes]]:
            return [
                (channel, shifted(data, meters) if channel == "POSE_ODOM" else data)
                for channel, data in super().handle(record)
            ]

    monkeypatch.setattr(journal_verify, "Rerun", Shifting)
    found = verify(files)
    assert found.result is result
    if result is VerificationResult.CLOSE:
        assert found.close["POSE_ODOM"] == len(kept.bus.said("POSE_ODOM"))
        assert "POSE_ODOM" not in found.said
        assert found.said["POSE"] > 40
        assert math.isclose(found.largest.meters, meters, rel_tol=1e-3)
        assert found.largest_at[0] == "POSE_ODOM"
    else:
        assert found.difference is not None
        assert found.difference.channel == "POSE_ODOM"
