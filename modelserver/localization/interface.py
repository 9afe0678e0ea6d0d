"""What the core asks of a localizer, whichever it is."""

from __future__ import annotations

from typing import Protocol, Self, TypeAlias

from modelserver.history import Later
from modelserver.messages import Decision, Estimate, NavigationState, OriginLatched, Rejected, Sample, SwitchMode

Note: TypeAlias = Rejected | OriginLatched | Decision
"""What a localizer has to say beside its estimate: a sample it did not use and why, the origin it has set, what
became of a measurement."""


class Localizer(Protocol):
    """An immutable value: all that has been concluded from the samples so far. No clock: time comes in samples."""

    def take(self, sample: Sample | SwitchMode) -> tuple[Self, tuple[Note, ...]]:
        """Return what is concluded with one sample more, and what there is to say about it."""
        ...

    def estimate(self, utime: int) -> Estimate:
        """Return the base frame's pose predicted to `utime`, from nothing but the samples taken."""
        ...

    def deferred(self, utime: int) -> Estimate | Later:
        """Return `estimate(utime)`, to be worked out when it is looked at where that saves work."""
        ...

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the whole state, as of the newest sample; None for a localizer that has no filter."""
        ...

    @property
    def utime(self) -> int:
        """The instant of the newest sample taken, 0 before the first."""
        ...
