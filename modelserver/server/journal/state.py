"""Schema and encoding of a run's state and events, so that a replay can continue from a segment bit for bit.

The schema (see `server.encoding`) covers the declared types of a run. A state is immutable and may be encoded while the
loop continues, except for the histories of poses and of joints, which share growing lists with their successors: they
are copied first, poses only for the last `HISTORY_S` seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final, NamedTuple

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import CoreState
from modelserver.core.commands import ModelLoaded
from modelserver.estimation.filter.localizer import Deferred
from modelserver.estimation.filter.measurements import REGISTRY, Measurement
from modelserver.estimation.filter.output import TwistCovariance
from modelserver.estimation.history import DeferredEstimate
from modelserver.estimation.interface import Localizer
from modelserver.estimation.modes import ModeLocalizer
from modelserver.messages import Event, MotionCovariance
from modelserver.server.encoding.schema import Schema, read_document, write_document

HISTORY_S: Final = 2.0
"""Seconds of the pose history that are written; all of it would be fifty times as much."""


class RunState(NamedTuple):
    """State from which a run can be continued."""

    config: VehicleConfig
    state: CoreState


def get_schema() -> Schema:
    """Return the schema of this build, with the measurement types that are registered now."""
    return _make_schema(tuple(REGISTRY.values()))


@lru_cache(maxsize=4)
def _make_schema(measurements: tuple[type[Measurement], ...]) -> Schema:
    return Schema(
        {"run": RunState, "event": Event | ModelLoaded},
        {
            Localizer: (ModeLocalizer,),
            DeferredEstimate: (Deferred,),
            Measurement: measurements,
            MotionCovariance: (TwistCovariance,),
        },
        # the service does not use the sections of drivers, which may contain any type; the vehicle file is stored too
        {VehicleConfig: frozenset({"drivers"})},
    )


def detach(state: CoreState) -> CoreState:
    """Copy what a state shares with its successors, with the history that is written."""
    view = state.view
    view = view._replace(history=view.history.copy_recent(HISTORY_S), joints=view.joints.detach())
    return state._replace(view=view)


def encode_run(run: RunState, pause: Callable[[], object] = lambda: None) -> bytes:
    """Encode a run with the description of its types; `pause`: see `Schema.encode`. Raises EncodingError."""
    return write_document(get_schema(), "run", run, pause)


def decode_run(data: bytes) -> RunState:
    """Decode a run. Raises RecordingError."""
    run: RunState = read_document(get_schema(), "run", data)
    return run


def encode_event(event: Event | ModelLoaded, pause: Callable[[], object] = lambda: None) -> bytes:
    """Encode an internal event without the description, which the state of the segment has."""
    return get_schema().encode("event", event, pause)


def decode_event(data: bytes) -> Any:
    """Decode an internal event. Raises RecordingError."""
    return get_schema().decode("event", data)
