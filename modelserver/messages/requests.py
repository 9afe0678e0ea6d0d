"""What is asked, and on which channel."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, NamedTuple, TypeAlias

from modelserver.messages.flags import Policy


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


Request: TypeAlias = GetTransformation | GetBodyList | GetBodyFrameList | GetStateVector | GetHTransform | GetHistory
CHANNEL_OF: Final[Mapping[type, str]] = {
    GetTransformation: "PLATFORM_GET_TRANSFORMATION",
    GetBodyList: "PLATFORM_GET_BODY_LIST",
    GetBodyFrameList: "PLATFORM_GET_BODY_FRAME_LIST",
    GetStateVector: "POSE_GET_STATE_VECTOR",
    GetHTransform: "POSE_GET_H_TRANSFORM",
    GetHistory: "POSE_GET_HISTORY",
}
"""The channel that each kind of request comes in on, without the vehicle's prefix."""
