"""What the core knows and what happens to it, as bytes and back, so that a run can be gone on with bit for bit.

The schema is that of the declared types that a vehicle's run is made of; see `modelserver.service.encoding`. A state is
immutable and may be written while the loop goes on. Three kinds of value share growing lists with their successors, and
are copied first: the history of poses, of which only the last seconds are kept, and the joints'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

from modelserver.config import VehicleConfig
from modelserver.core import CoreState
from modelserver.core.reload import ModelLoaded
from modelserver.history import Later
from modelserver.localization.filter.localizer import Deferred
from modelserver.localization.filter.measurements import REGISTRY, Measurement
from modelserver.localization.filter.world import TwistCovariance
from modelserver.localization.interface import Localizer
from modelserver.localization.modes import ModeLocalizer
from modelserver.messages import Event, MotionCovariance
from modelserver.service.encoding.document import read_document, write_document
from modelserver.service.encoding.schema import Schema

KEPT_S: Final = 2.0
"""Seconds of the history of poses that are written: all of it would be fifty times as much."""


class RunState(NamedTuple):
    """All that a run is gone on with from."""

    config: VehicleConfig
    state: CoreState


def schema() -> Schema:
    """Return the schema of this build, with the measurements that are registered now."""
    return _schema(tuple(REGISTRY.values()))


@lru_cache(maxsize=4)
def _schema(measurements: tuple[type[Measurement], ...]) -> Schema:
    return Schema(
        {"run": RunState, "event": Event | ModelLoaded},
        {
            Localizer: (ModeLocalizer,),
            Later: (Deferred,),
            Measurement: measurements,
            MotionCovariance: (TwistCovariance,),
        },
        # the service does not look into drivers, and their sections may hold anything; the vehicle file is kept whole
        {VehicleConfig: frozenset({"drivers"})},
    )


def detach(state: CoreState) -> CoreState:
    """Return a state that shares nothing with its successors, with no more history than is written."""
    view = state.view
    return state._replace(view=replace(view, history=view.history.recent(KEPT_S), joints=view.joints.apart()))


def encode_run(run: RunState, pause: Callable[[], object] = lambda: None) -> bytes:
    """Return a run as bytes, with the description of its types; `pause`: see `Schema.encode`. Raises EncodingError."""
    return write_document(schema(), "run", run, pause)


def decode_run(data: bytes) -> RunState:
    """Return the run in what `encode_run` wrote. Raises RecordingError."""
    run: RunState = read_document(schema(), "run", data)
    return run


def encode_event(event: Event | ModelLoaded, pause: Callable[[], object] = lambda: None) -> bytes:
    """Return an event of the service's own as bytes, without the description: the segment's state has it."""
    return schema().encode("event", event, pause)


def decode_event(data: bytes) -> Any:
    """Return the event in what `encode_event` wrote. Raises RecordingError."""
    return schema().decode("event", data)
