"""The decision ledger: what became of each measurement, and why."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Verdict(IntEnum):
    """What became of a measurement."""

    USED = 0
    REJECTED = 1
    """It contradicts what is known, or is not good enough; `reason` says which."""
    MONITORED = 2
    """It was compared, and not used on purpose: a fix at rest, say."""
    TOOK_UP = 3
    """The state was set from it: heading found, position taken up anew."""


class Decision(NamedTuple):
    """One measurement of one sensor, compared with what was known at its instant.

    `kind` names the measurement (gps_position, wheel_speed, ...), `source` and `seq` the sample it came from.
    `residual` (m) is measured minus expected, in the unit of the measurement; `innovation_covariance` (m x m,
    row-major) is what was expected of it, noise included, and `noise` (m x m) the noise used. `statistic` is
    residual' S^-1 residual, chi-square distributed with `dof` = m degrees of freedom if all is well, and `limit`
    what it was gated at. Empty and nan where a sample was refused before it could be compared.
    """

    utime: int
    source: str
    seq: int
    kind: str
    verdict: Verdict
    reason: str = ""
    residual: tuple[float, ...] = ()
    innovation_covariance: tuple[float, ...] = ()
    noise: tuple[float, ...] = ()
    statistic: float = float("nan")
    limit: float = float("nan")

    @property
    def dof(self) -> int:
        """Degrees of freedom: how many numbers were compared."""
        return len(self.residual)
