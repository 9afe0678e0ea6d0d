"""What is asked, and on which channel."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, NamedTuple, TypeAlias

from modelserver.messages.flags import Policy
from modelserver.messages.replies import PoseAnswer


class RequestHeader(NamedTuple):
    """Which request, and where the answer goes."""

    request_id: int
    reply_channel: str

    def is_answerable(self, prefix: str) -> bool:
        """Return whether a server may speak on the reply channel: within its prefix, plain, not too long."""
        # the length first: what is looked up is kept
        return len(self.reply_channel) <= MAX_CHANNEL_LENGTH and _is_answerable(self.reply_channel, prefix)


MAX_CHANNEL_LENGTH = 63
"""LCM refuses longer names."""

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_]+")


@lru_cache(maxsize=1024)
def _is_answerable(channel: str, prefix: str) -> bool:
    return len(channel) > len(prefix) and channel.startswith(prefix) and _PLAIN_NAME.fullmatch(channel) is not None


class TimeQuery(NamedTuple):
    """What time a request means; `at` 0 is the latest common time. See time_query_t."""

    at: int = 0
    policy: Policy = Policy.INTERPOLATED
    wait_ms: int = 0


class GetTransformation(NamedTuple):
    """Where is `frame_of_interest` in `frame_of_reference`?"""

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    time: TimeQuery = TimeQuery()


class GetBodyList(NamedTuple):
    """Which bodies are there?"""

    header: RequestHeader


class GetBodyFrameList(NamedTuple):
    """Which frames has a body?"""

    header: RequestHeader
    body: str


class GetStateVector(NamedTuple):
    """Where is the vehicle in the world, as a 7-vector?"""

    header: RequestHeader
    time: TimeQuery = TimeQuery()


class GetHTransform(NamedTuple):
    """Where is the vehicle in the world, or with `inverse` the world in the vehicle?"""

    header: RequestHeader
    inverse: bool = False
    time: TimeQuery = TimeQuery()


class GetHistory(NamedTuple):
    """Where was the vehicle in the world between two times?"""

    header: RequestHeader
    start_utime: int
    end_utime: int
    rate_hz: float


MOST_INSTANTS: Final = 2_000
"""In one GetTransformations, all pairs together: they take the server about a hundredth of a second."""


class GetTransformations(NamedTuple):
    """Where are frames in others at many instants? `pairs` are of frame of interest and frame of reference.

    With `fixed_frame`, at the instants in the frames of reference at `reference_at`; see get_transformations_request_t.
    """

    header: RequestHeader
    pairs: tuple[tuple[str, str], ...]
    at: tuple[int, ...]
    fixed_frame: str = ""
    reference_at: int = 0
    with_covariance: bool = True


class GetMotion(NamedTuple):
    """How does `frame_of_interest` move in `frame_of_reference`, along the axes of `expressed_in`?"""

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    expressed_in: str = ""
    time: TimeQuery = TimeQuery()


class GetExplanation(NamedTuple):
    """Where is `frame_of_interest` in `frame_of_reference`, and what does that rest on?"""

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    time: TimeQuery = TimeQuery()


class ReloadModel(NamedTuple):
    """Read the geometry anew; with `dry_run` only say what would change."""

    header: RequestHeader
    dry_run: bool = False


class SetStateVector(NamedTuple):
    """The vehicle is there: its base frame's pose in World:UTM; see set_state_vector_request_t."""

    header: RequestHeader
    pose: PoseAnswer


class SetHTransform(NamedTuple):
    """As SetStateVector; see set_h_transform_request_t."""

    header: RequestHeader
    pose: PoseAnswer


Request: TypeAlias = (
    GetTransformation
    | GetBodyList
    | GetBodyFrameList
    | GetStateVector
    | GetHTransform
    | GetHistory
    | GetTransformations
    | GetMotion
    | GetExplanation
    | ReloadModel
    | SetStateVector
    | SetHTransform
)

CHANNEL_OF: Final[Mapping[type, str]] = {
    GetTransformation: "PLATFORM_GET_TRANSFORMATION",
    GetBodyList: "PLATFORM_GET_BODY_LIST",
    GetBodyFrameList: "PLATFORM_GET_BODY_FRAME_LIST",
    GetStateVector: "POSE_GET_STATE_VECTOR",
    GetHTransform: "POSE_GET_H_TRANSFORM",
    GetHistory: "POSE_GET_HISTORY",
    GetTransformations: "PLATFORM_GET_TRANSFORMATIONS",
    GetMotion: "PLATFORM_GET_MOTION",
    GetExplanation: "PLATFORM_GET_EXPLANATION",
    ReloadModel: "PLATFORM_RELOAD_MODEL",
    SetStateVector: "POSE_SET_STATE_VECTOR",
    SetHTransform: "POSE_SET_H_TRANSFORM",
}
"""The channel that each kind of request comes in on, without the vehicle's prefix."""
