"""What is found of many instants on a way, instant by instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.errors import Status
from modelserver.messages import Estimate

Times = npt.NDArray[np.int64]
Flags = npt.NDArray[np.int32]

STEP_ROWS: Final = 250
"""Rows of covariances that are worked out in one step."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The instants, and what is found of each on the way: status, reasons, flags, pose epoch; arrays of n.

    with_covariance: whether it is asked how sure each is. around: the vehicle's estimates around the instants, as
    `History.around`, once they were looked up.
    """

    utimes: Times
    status: Flags
    invalid: Flags
    quality: Flags
    epochs: Flags
    with_covariance: bool = True
    around: tuple[list[Estimate], npt.NDArray[np.intp]] | None = None

    def within(self, first: int, last: int) -> Rows:
        """Return the rows with those marked that lie outside a span, their times moved to its edge."""
        old, new = self.utimes < first, self.utimes > last
        if not (old.any() or new.any()):
            return self
        status = np.where(self.status != Status.OK, self.status, np.where(old, int(Status.TOO_OLD), 0))
        status = np.where((status == Status.OK) & new, int(Status.TOO_NEW), status)
        return replace(self, utimes=np.clip(self.utimes, first, last), status=status.astype(np.int32))

    def told(self, invalid: Flags | int, quality: Flags | int) -> Rows:
        """Return the rows with more reasons and flags."""
        return replace(self, invalid=self.invalid | invalid, quality=self.quality | quality)
