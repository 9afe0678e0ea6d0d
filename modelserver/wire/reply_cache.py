"""Cache of encoded static replies (static transforms): answers that do not depend on time, by the pair of frames.

Most queries are about rigidly mounted frames, and their answers hold until the model changes. The bytes of such a reply
differ only in request id and utime, and do not depend on the client. So the pair of names in the bytes of a request
leads to the rest of the reply, without decoding, core or encoding. The capacity is the number of pairs of the model's
frames, within a limit; the least recently used entry is evicted.
"""

from __future__ import annotations

import struct
from typing import Final

from modelserver.errors import Status
from modelserver.messages import Policy, Reply, TransformReply
from modelserver.wire.fields import MAX_UTIME
from modelserver.wire.generated import FINGERPRINTS

CACHED_TYPE: Final = "get_transformation_request_t"
"""The only type of request whose replies are cached."""

MAX_ENTRIES: Final = 16_384
"""Entries: all pairs of 128 frames, some 10 MB."""

MAX_PAIR_BYTES: Final = 512
"""Bytes of both names; longer ones are not cached."""

_REQUEST: Final = FINGERPRINTS[CACHED_TYPE]
_REPLY: Final = FINGERPRINTS["get_transformation_reply_t"]
_CHANNEL: Final = 20
"""Offset of the reply channel in a request: behind fingerprint, id and the channel's length."""
_TIME = struct.Struct(">qbi")
_UTIME = struct.Struct(">q")
_AFTER_UTIME: Final = 24
"""Offset in a reply behind fingerprint, request id and utime."""
_LAST_POLICY: Final = max(Policy)


class StaticReplyCache:
    """LRU cache of the static replies of one model."""

    def __init__(self) -> None:
        self._entries: dict[bytes, bytes] = {}
        self._model: object = None
        self._capacity = 0

    def __len__(self) -> int:
        return len(self._entries)

    def reset(self, model: object, frames: int) -> None:
        """Clear the cache for another model with so many frames."""
        self._entries.clear()
        self._model = model
        self._capacity = min(max(frames, 1) ** 2, MAX_ENTRIES)

    def is_of(self, model: object) -> bool:
        """Return whether the cache is for this model."""
        return model is self._model

    def find(self, request: bytes, client: bytes, utime: int) -> bytes | None:
        """Return the bytes of the reply to a get_transformation_request_t; None where it is not cached.

        `client` is the reply channel in the bytes of the request.
        """
        if request[:8] != _REQUEST:
            return None
        pair = request[_CHANNEL + len(client) : -_TIME.size]
        entries = self._entries
        rest = entries.pop(pair, None)
        if rest is None:
            return None
        # re-inserted as the newest: the first entry is the least recently used one
        entries[pair] = rest
        at, policy, wait_ms = _TIME.unpack(request[-_TIME.size :])
        if not (0 <= at < MAX_UTIME and 0 <= policy <= _LAST_POLICY and wait_ms >= 0):
            return None
        return b"%b%b%b%b" % (_REPLY, request[8:16], _UTIME.pack(utime), rest)

    def add(self, request: bytes, client: bytes, reply: Reply, encoded: bytes) -> None:
        """Cache a reply to a request, if it does not depend on time; `encoded` are its bytes."""
        if not isinstance(reply, TransformReply) or reply.header.status is not Status.OK or reply.answer is None:
            return
        pair = request[_CHANNEL + len(client) : -_TIME.size]
        if reply.answer.transformation.utime or len(pair) > MAX_PAIR_BYTES:
            return
        if len(self._entries) >= self._capacity:
            self._entries.pop(next(iter(self._entries), b""), None)
        self._entries[pair] = encoded[_AFTER_UTIME:]
