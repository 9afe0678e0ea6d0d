"""Measurements in the queue of the filter, each at its instant, and their words in the decision ledger."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from modelserver.estimation.filter import updates
from modelserver.estimation.filter.measurements import Measurement
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.messages import Decision, ImuSample, Sample, SwitchMode, VehicleStatusSample, Verdict

INERTIAL, STEERING = "inertial", "steering"


class Item(NamedTuple):
    """One measurement of a sample, at its instant. Items are fused in the order of their first four fields.

    `measurement` is None for the inertial part of an inertial sample, for the steering angle of a vehicle status, and
    for an order to switch the mode.
    """

    utime: int
    source: str
    seq: int
    part: int
    kind: str
    measurement: Measurement | None
    sample: Sample | SwitchMode

    @property
    def key(self) -> tuple[int, str, int, int]:
        """What items are ordered by: instant, source, sequence, part of the sample."""
        return (self.utime, self.source, self.seq, self.part)


Fused: TypeAlias = tuple[FilterState, tuple[Decision, ...]]


NOTHING: tuple[Decision, ...] = ()


def items(setup: Setup, sample: Sample | SwitchMode) -> list[Item]:
    """Return what a sample measured, each at its instant."""
    header = sample.header
    found: list[Item] = []
    if isinstance(sample, (ImuSample, SwitchMode)):
        kind = INERTIAL if isinstance(sample, ImuSample) else "mode"
        found.append(Item(header.utime, header.source, header.seq, 0, kind, None, sample))
    if isinstance(sample, VehicleStatusSample) and setup.rig.steering is not None:
        found.append(Item(header.utime, header.source, header.seq, 0, STEERING, None, sample))
    for part, measurement in enumerate(setup.measurements.get(type(sample), ()), start=1):
        instant = measurement.instant(sample)
        if instant is not None:
            found.append(Item(instant, header.source, header.seq, part, measurement.kind, measurement, sample))
    return found


def refused(item: Item, reason: str) -> Decision:
    """Return the word for an item that was refused before it could be compared."""
    return updates.refused(item.utime, item.source, item.seq, item.kind, reason)


def took_up(item: Item, reason: str) -> Decision:
    """Return the word for a decision that an item led to."""
    return Decision(item.utime, item.source, item.seq, item.kind, Verdict.RESET, reason)
