"""What is answered."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from modelserver.errors import Status
from modelserver.messages.estimates import Origin
from modelserver.messages.flags import NAN, NO_FLAGS, Quality
from modelserver.spatial.transformation import Transformation


class PoseAnswer(NamedTuple):
    """A transformation with all that the wire says beside it; see pose_transform_t.

    `origin` is None where no world frame is involved or the origin is not known.
    """

    transformation: Transformation
    origin: Origin | None = None
    quality: Quality = NO_FLAGS
    horizontal_bound: float = NAN
    heading_bound: float = NAN
    seconds_to_limit: float = NAN


class ReplyHeader(NamedTuple):
    """How a request ended."""

    request_id: int
    utime: int
    status: Status = Status.OK
    message: str = ""
    nearest: tuple[str, ...] = ()
    model_revision: str = ""


class TransformReply(NamedTuple):
    """Answers GetTransformation and GetHTransform; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: PoseAnswer | None = None


class NameListReply(NamedTuple):
    """Answers GetBodyList and GetBodyFrameList."""

    header: ReplyHeader
    names: tuple[str, ...] = ()
    descriptions: tuple[str, ...] = ()


class StateVectorReply(NamedTuple):
    """Answers GetStateVector; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: PoseAnswer | None = None


class HistoryReply(NamedTuple):
    """Answers GetHistory."""

    header: ReplyHeader
    answers: tuple[PoseAnswer, ...] = ()


Reply: TypeAlias = TransformReply | NameListReply | StateVectorReply | HistoryReply
