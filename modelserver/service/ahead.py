"""How long before its deadline a tick is to begin, so that what it says is ready when it is due."""

from __future__ import annotations

from typing import Final

MOST_NS: Final = 2_000_000
"""A tick begins no earlier than this: what is measured meanwhile waits."""

STEP_NS: Final = 4_000
SHARE: Final = 12
"""One tick in so many may take longer than it is begun ahead; how far the lead moves with each tick."""


class Lead:
    """The lead, nanoseconds, learnt from what ticks take: from when one should have begun to when all was ready.

    It goes up by `SHARE` steps with a tick that was not ready in time and down by one with each that was, and so
    settles where one in `SHARE` and one is not. With ticks that take no time it stays 0; one that came much later than
    a lead can make good was held up by something else, and tells nothing.
    """

    def __init__(self) -> None:
        self.ns = 0

    def learn(self, took_ns: int) -> None:
        """Take what one tick took."""
        if took_ns > self.ns + 2 * MOST_NS:
            return
        if took_ns > self.ns:
            self.ns = min(self.ns + SHARE * STEP_NS, MOST_NS)
        else:
            self.ns = max(self.ns - STEP_NS, 0)
