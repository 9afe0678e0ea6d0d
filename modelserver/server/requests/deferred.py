"""Deferred replies: computed in steps, encoded message by message, sent in portions that fit a receive buffer."""

from __future__ import annotations

from collections import deque
from typing import Final

from modelserver.messages import GetDynamics, GetHistory, GetTransformations, Request
from modelserver.query.answers import COVARIANCES_IN_PART, DeferredAnswer
from modelserver.query.view import HISTORY_LIMIT, Steps, complete
from modelserver.server.requests.scheduler import MAX_REPLY_BYTES, QueuedRequest
from modelserver.wire.codec import encode

PORTION_BYTES: Final = 100_000
"""Bytes of a portion: a receive buffer of the kernel's default size (212,992 bytes) holds it beside other messages."""

MESSAGE_BYTES: Final = 300
POSE_BYTES: Final = 74
COVARIANCE_BYTES: Final = 288
HISTORY_POSE_BYTES: Final = 500
DYNAMICS_BYTES: Final = 90_000
"""Bytes of a message without poses, of a pose, of its covariance, of a pose in a history, and of equations of motion
with as many coordinates as there may be."""


def estimate_reply_bytes(request: Request) -> int:
    """Return an upper bound of the size of the reply to a request, bytes; not valid for an error reply."""
    if isinstance(request, GetTransformations):
        instants = len(request.at)
        each = POSE_BYTES + COVARIANCE_BYTES * request.with_covariance
        messages = -(-instants // COVARIANCES_IN_PART)
        return min(len(request.pairs) * (MESSAGE_BYTES * messages + instants * each), MAX_REPLY_BYTES)
    if isinstance(request, GetHistory):
        poses = (request.end_utime - request.start_utime) * 1e-6 * request.rate_hz + 1.0
        return MESSAGE_BYTES + round(HISTORY_POSE_BYTES * poses) if 0.0 < poses <= HISTORY_LIMIT else MESSAGE_BYTES
    if isinstance(request, GetDynamics):
        return DYNAMICS_BYTES if request.with_equations else 2 * MESSAGE_BYTES
    return MESSAGE_BYTES


class DeferredReply:
    """The reply of a deferred answer: `step` until it is `ready`, then `pop` messages.

    `queued` is the request as received; None in a replay of the journal.
    """

    def __init__(self, answer: DeferredAnswer, queued: QueuedRequest | None = None):
        self.queued = queued
        self.request = answer.request
        self.channel = answer.request.header.reply_channel
        self.ready = False
        self._messages: deque[bytes] = deque()
        self._work = self._encode(answer)

    def step(self) -> None:
        self.ready = next(self._work, self) is self

    def complete(self) -> None:
        """Do the rest of the work."""
        if not self.ready:
            complete(self._work)
            self.ready = True

    @property
    def portion(self) -> int:
        """Number of messages of the next portion; 0 if all are sent."""
        count = size = 0
        for message in self._messages:
            size += len(message)
            if count and size > PORTION_BYTES:
                break
            count += 1
        return count

    def pop(self, count: int) -> list[bytes]:
        """Remove and return the next messages."""
        return [self._messages.popleft() for _ in range(min(count, len(self._messages)))]

    def _encode(self, answer: DeferredAnswer) -> Steps[None]:
        replies = yield from answer.work()
        for reply in replies:
            self._messages.append(encode(reply))
            yield
