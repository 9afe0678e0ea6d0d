"""Requests, their channels and limits. The requests themselves are generated from the .lcm files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, TypeAlias

from modelserver.messages.generated import (
    GetBodyFrameList,
    GetBodyList,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    ReloadModel,
    RequestHeader,
    SetHTransform,
    SetStateVector,
)

MAX_CHANNEL_LENGTH = 63
"""LCM rejects longer names."""

MAX_REQUEST_INSTANTS: Final = 2_000
"""In one GetTransformations, all pairs together: they take the server about a hundredth of a second."""

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_]+")


def is_answerable(header: RequestHeader, prefix: str) -> bool:
    """Return whether a server may reply on the request's reply channel: within its prefix, plain, not too long."""
    channel = header.reply_channel
    # the length first: what is looked up is cached
    return len(channel) <= MAX_CHANNEL_LENGTH and _is_plain(channel, prefix)


@lru_cache(maxsize=1024)
def _is_plain(channel: str, prefix: str) -> bool:
    return len(channel) > len(prefix) and channel.startswith(prefix) and _PLAIN_NAME.fullmatch(channel) is not None


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
"""The channel of each request type, without the vehicle's prefix."""
