"""Drives that share their beginning: they give the same as drives that are computed alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import pytest
import support_filter
import support_shared
from support_cart import same
from support_drive import SimulatedDrive, run_core
from support_filter import drive, simulation

from modelserver.messages import GpsSample
from modelserver.simulation import Event, figure_eight

pytestmark = pytest.mark.slow

EIGHT = figure_eight(speed=3.0, radius=8.0, stationary=3.0)
SECONDS = 20.0


def drop_fixes(events: Iterable[Event]) -> Iterator[Event]:
    """Drop the fixes from the tenth second on."""
    begin = None
    for event in events:
        begin = event.header.utime if begin is None else begin
        if not isinstance(event, GpsSample) or event.header.utime < begin + 10_000_000:
            yield event


def count_updates(kind: type, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    updated: list[Any] = []
    update = kind.update

    def counting(self: Any, event: Any) -> None:
        updated.append(event)
        update(self, event)

    monkeypatch.setattr(kind, "update", counting)
    support_shared.begin_test(())  # nothing of the product is patched here
    return updated


def test_given_drives_that_differ_later_then_only_the_rest_is_computed_and_the_result_is_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    updated = count_updates(support_filter.Progress, monkeypatch)
    first = drive(simulation(EIGHT), SECONDS)
    num_first = len(updated)
    shared = drive(simulation(EIGHT), SECONDS, transform=drop_fixes)
    num_shared = len(updated) - num_first
    again = drive(simulation(EIGHT), SECONDS)
    assert num_shared < 0.7 * num_first
    assert len(updated) == num_first + num_shared

    monkeypatch.setattr(support_shared, "is_enabled", False)
    alone = drive(simulation(EIGHT), SECONDS, transform=drop_fixes)
    assert same(tuple(alone.ledger), tuple(shared.ledger))
    assert [row.off for row in alone.rows] == pytest.approx([row.off for row in shared.rows], abs=0.0, nan_ok=True)
    assert same(
        alone.localizer.estimate(alone.localizer.utime).enu, shared.localizer.estimate(shared.localizer.utime).enu
    )
    assert same(tuple(first.ledger), tuple(again.ledger))


def test_given_drives_of_other_truths_after_the_same_samples_then_each_is_compared_with_its_own() -> None:
    start = 1_700_000_000_000_000
    long, short = (SimulatedDrive.create(start, seconds) for seconds in (14.0, 8.0))
    cut = [each for each in long.events() if each.header.host_utime < start + 8_000_000]
    run_core(short, cut)
    found = run_core(long, long.events())
    assert found.drive is long
    support_shared.begin_test(("monkeypatch",))
    alone = run_core(long, long.events())
    assert found.poses[-1][1] == alone.poses[-1][1]
    assert len(found.poses) == len(alone.poses)
