"""What is told of one coordinate of a joint at an instant. Pure."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple, TypeAlias

from modelserver.messages import NAN

LONGEST_GAP_S: Final = 1.0
"""Between two readings farther apart than this, and this long after the last, a joint counts as unheard."""

Values: TypeAlias = tuple[float, float, float, float]
"""Position, its sigma, rate, its sigma."""


class How(IntEnum):
    """How a position at an instant was come by."""

    MEASURED = 0
    INTERPOLATED = 1
    HELD = 2
    PREDICTED = 3
    AT_REST = 4
    """Nobody told: it is taken to stand where it rests."""


class Reading(NamedTuple):
    """A coordinate at `utime`: radians or metres, and a second; sigmas are nan where nobody told.

    `stamp` is that of the newest measurement it rests on. `apart` is how far in time the measurements are that it was
    interpolated between, or the one it was held or predicted from, seconds. `change` is the acceleration, where more is
    known of it than the coordinate's own readings tell.
    """

    utime: int
    position: float
    sigma: float = NAN
    rate: float = NAN
    rate_sigma: float = NAN
    how: How = How.MEASURED
    stamp: int = 0
    apart: float = 0.0
    change: float = NAN

    @property
    def is_stale(self) -> bool:
        """Whether the joint was silent for too long around this instant."""
        return self.apart > LONGEST_GAP_S


class Pair(NamedTuple):
    """Two readings, one after the other, `t0` before `t1`."""

    t0: int
    low: Values
    t1: int
    high: Values

    @property
    def span(self) -> float:
        """Seconds between the two."""
        return (self.t1 - self.t0) * 1e-6
