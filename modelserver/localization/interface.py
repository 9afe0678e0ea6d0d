"""What the core asks of a localizer, whichever it is."""

from __future__ import annotations

from typing import Protocol, Self, TypeAlias, runtime_checkable

from modelserver.history import Later
from modelserver.messages import (
    Decision,
    Estimate,
    Invalid,
    Kept,
    LocalizerSummary,
    NavigationState,
    OriginLatched,
    Rejected,
    Sample,
    SwitchMode,
)

Note: TypeAlias = Rejected | OriginLatched | Decision
"""What a localizer has to say beside its estimate: a sample it did not use and why, the origin it has set, what
became of a measurement."""


@runtime_checkable
class Keeps(Protocol):
    """A localizer that the next run of the service can learn from."""

    def kept(self) -> Kept | None:
        """Return what the next run should know; None where it is no better than what was kept before."""
        ...


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

    def silence(self, utime: int) -> Invalid:
        """Return what of SILENCE speaks against an estimate at `utime`, at a fraction of that one's cost."""
        ...

    def summary(self, utime: int) -> LocalizerSummary:
        """Return what it is about at `utime`, in few words."""
        ...

    @property
    def utime(self) -> int:
        """The instant of the newest sample taken, 0 before the first."""
        ...
