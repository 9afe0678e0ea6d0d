"""Messages that differ in the last bits."""

from __future__ import annotations

from pathlib import Path

import pytest
from support_journal import SMALL, JournalRig

from modelserver.messages import PoseAnswer
from modelserver.server.journal import verify as journal_verify
from modelserver.server.journal.verify import (
    ReplayLoop,
    VerificationResult,
    diff_messages,
    verify,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.codec import decode, encode
from modelserver.wire.journal import JournalRecord


def pose(x: float = 1.0, yaw: float = 0.5, bound: float = 2.0, epoch: int = 0) -> bytes:
    X = Pose.from_rpy((x, 2.0, 3.0), 0.0, 0.0, yaw)
    return encode(
        PoseAnswer(Transformation("Cart:Base", "World:UTM", X, pose_epoch=epoch), horizontal_protection_level=bound)
    )


def vector(x: float = 1.0, yaw: float = 0.5) -> bytes:
    X = Pose.from_rpy((x, 2.0, 3.0), 0.0, 0.0, yaw)
    return encode(PoseAnswer(Transformation("Cart:Base", "World:UTM", X)), "pose_vector_t")


def test_given_two_messages_then_the_fields_that_differ_are_named() -> None:
    found = diff_messages(pose(), pose(x=4.0, epoch=3))
    assert found is not None
    assert [each.name for each in found] == ["h_transform[0][3]", "pose_epoch"]
    assert diff_messages(pose(), vector()) is None


def shift(data: bytes, meters: float) -> bytes:
    answer = decode("pose_transform_t", data)
    t = answer.transformation
    moved = Transformation(
        t.frame_of_interest, t.frame_of_reference, Pose._of((t.pose.xyz[0] + meters, *t.pose.xyz[1:]), t.pose.wxyz),
        t.covariance, t.utime, t.invalid_reasons, t.pose_epoch, t.origin_id, t.model_revision,
    )  # fmt: skip
    return encode(answer._replace(transformation=moved))


def test_given_a_replay_that_sums_in_another_order_then_it_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = JournalRig(tmp_path, SMALL)
    rig.drive(1.0)
    files = rig.finish()

    class Shifting(ReplayLoop):
        def handle(self, record: JournalRecord) -> list[tuple[str, bytes]]:
            return [
                (channel, shift(data, 5e-10) if channel == "POSE_ODOM" else data)
                for channel, data in super().handle(record)
            ]

    monkeypatch.setattr(journal_verify, "ReplayLoop", Shifting)
    found = verify(files)
    assert found.result is VerificationResult.DIFFERS
    assert found.difference is not None
    assert found.difference.channel == "POSE_ODOM"
