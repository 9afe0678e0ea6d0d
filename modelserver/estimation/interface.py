"""Interface between the core and a localizer."""

from __future__ import annotations

from typing import Protocol, Self, TypeAlias, runtime_checkable

from modelserver.estimation.history import DeferredEstimate
from modelserver.messages import (
    Decision,
    Estimate,
    Invalid,
    LocalizerSummary,
    NavigationState,
    PersistedState,
    PersistOrigin,
    Rejected,
    Sample,
    SwitchMode,
)

LocalizerEvent: TypeAlias = Rejected | PersistOrigin | Decision
"""What a localizer reports beside its estimate: a rejected sample, the origin that it has set, the decision on a
measurement.
"""


@runtime_checkable
class PersistentLocalizer(Protocol):
    """A localizer with a state for the warm start of the next run."""

    def get_state_to_persist(self) -> PersistedState | None:
        """Return the state for the next run; None where it is no better than what was persisted before."""
        ...


class Localizer(Protocol):
    """An immutable localizer state. No clock: time comes in samples."""

    def process(self, sample: Sample | SwitchMode) -> tuple[Self, tuple[LocalizerEvent, ...]]: ...

    def estimate(self, utime: int) -> Estimate:
        """Return the base frame's pose predicted to `utime` from the samples processed."""
        ...

    def defer_estimate(self, utime: int) -> Estimate | DeferredEstimate:
        """Return `estimate(utime)`, deferred until it is read where that saves work."""
        ...

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the navigation state as of the newest sample; None for a localizer without a filter."""
        ...

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at `utime`, at a fraction of its cost."""
        ...

    def summary(self, utime: int) -> LocalizerSummary: ...

    @property
    def utime(self) -> int:
        """The instant of the newest sample processed, 0 before the first."""
        ...
