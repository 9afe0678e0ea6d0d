"""Replies, by the request they answer. The others are generated from the .lcm files."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from modelserver.messages.answers import Explanation, MotionAnswer, PoseBatch
from modelserver.messages.generated import (
    Acknowledgement,
    HistoryReply,
    NameListReply,
    ReloadReply,
    ReplyHeader,
    StateVectorReply,
    TransformReply,
)


class PoseBatchReply(NamedTuple):
    """One part of the answer to GetTransformations: pair number `pair`, from instant number `first` on.

    `poses` is None unless the status is OK.
    """

    header: ReplyHeader
    part: int = 0
    parts: int = 1
    pair: int = 0
    first: int = 0
    poses: PoseBatch | None = None


class MotionReply(NamedTuple):
    """Answers GetMotion; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: MotionAnswer | None = None


class ExplanationReply(NamedTuple):
    """Answers GetExplanation; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: Explanation | None = None


Reply: TypeAlias = (
    TransformReply
    | NameListReply
    | StateVectorReply
    | HistoryReply
    | PoseBatchReply
    | MotionReply
    | ExplanationReply
    | ReloadReply
    | Acknowledgement
)
