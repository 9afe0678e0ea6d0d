"""Replies that do not change with time, remembered as bytes.

Most questions are about how the vehicle is bolted together, come again and again, and have the same answer at
every time. The loop gives such an answer from here: the question's bytes, without its id and its time, lead to the
reply's bytes, without their id and stamp. The core is told how many were given, with its next tick.
"""

from __future__ import annotations

import struct
from typing import Final

from modelserver.errors import Status
from modelserver.messages import Policy, SendReply, TransformReply
from modelserver.wire.fields import MAX_UTIME
from mslcm.get_transformation_reply_t import get_transformation_reply_t
from mslcm.get_transformation_request_t import get_transformation_request_t

TIMELESS_TYPE: Final = get_transformation_request_t.__name__
"""The only kind of request whose answers are remembered."""

_REQUEST: Final[bytes] = get_transformation_request_t._get_packed_fingerprint()
_REPLY: Final[bytes] = get_transformation_reply_t._get_packed_fingerprint()
_NAMES: Final = slice(16, -13)
"""Reply channel and frames in a request: behind fingerprint and id, before the time."""
_TIME = struct.Struct(">qbi")
_UTIME = struct.Struct(">q")
_LAST_POLICY: Final = max(Policy)

KEPT: Final = 1024
LONGEST_NAMES: Final = 512
"""Bytes; longer ones come from strangers and are not kept."""


class TimelessReplies:
    """What has been answered once and holds for good, for one model; see the module."""

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[str, bytes]] = {}
        self._model: object = None

    def find(self, request: bytes, utime: int, model: object) -> tuple[str, bytes] | None:
        """Return channel and bytes of the reply to a get_transformation_request_t; None where it is not known."""
        known = self._known.get(request[_NAMES])
        if known is None or model is not self._model or request[:8] != _REQUEST:
            return None
        at, policy, wait_ms = _TIME.unpack(request[-13:])
        if not (0 <= at < MAX_UTIME and 0 <= policy <= _LAST_POLICY and wait_ms >= 0):
            return None
        channel, rest = known
        return channel, b"%b%b%b%b" % (_REPLY, request[8:16], _UTIME.pack(utime), rest)

    def learn(self, request: bytes, reply: SendReply, encoded: bytes, model: object) -> None:
        """Keep a reply that `model` gave, if it holds for good; `encoded` are its bytes."""
        body = reply.reply
        if not isinstance(body, TransformReply) or body.header.status is not Status.OK or body.answer is None:
            return
        if body.answer.transformation.utime or len(request) > LONGEST_NAMES:
            return
        if model is not self._model or len(self._known) >= KEPT:
            self._known.clear()
            self._model = model
        self._known[request[_NAMES]] = (reply.channel, encoded[24:])
