"""What a loop needs of the outside beside its bus and its clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from modelserver.core import CoreState
from modelserver.core.reload import ModelLoaded
from modelserver.messages import Gauges, Kept, LoadModel, OriginLatched, SwitchMode
from modelserver.service.heard import SensorChannel
from modelserver.service.journal.queue import Journal, NoJournal
from modelserver.service.requests.gate import Gate


def _nothing_to_load(wish: LoadModel, state: CoreState) -> ModelLoaded:
    return ModelLoaded(wish.request, why="this service has no file to read its geometry from")


@dataclass(frozen=True, slots=True)
class Hooks:
    """Who is told or asked while a loop runs; by default nobody.

    on_origin: told of an origin that was captured. on_wish: told of a wish for a mode and the states around it.
    on_load: reads the geometry anew. snapshot: returns its bytes for the bus. channels: which sensors are heard once
    another is in force: joints, where it has any. on_keep: keeps a state for the next run without waiting for the
    disk, and returns what is wrong with that, empty where nothing is. gauges: reads what the health report tells of
    the process, given how many requests wait. run_delay: reads for how long the loop's thread was ready to run and
    had no processor, nanoseconds in all; None where nobody knows. on_tick: called after each tick that went through.
    gate: opens signed commands; without one none are heard, and wishes for modes count without a signature, as in a
    recording. journal: told of everything that is handled and said.
    """

    on_origin: Callable[[OriginLatched], None] = lambda note: None
    on_wish: Callable[[SwitchMode, CoreState, CoreState], None] = lambda wish, before, after: None
    on_load: Callable[[LoadModel, CoreState], ModelLoaded] = _nothing_to_load
    snapshot: Callable[[CoreState], bytes] = lambda state: b""
    channels: Callable[[CoreState], Mapping[str, SensorChannel]] = lambda state: {}
    on_keep: Callable[[Kept], str] = lambda kept: ""
    gauges: Callable[[int], Gauges | None] = lambda queued: None
    run_delay: Callable[[], int | None] = lambda: None
    on_tick: Callable[[CoreState], None] = lambda state: None
    gate: Gate | None = None
    journal: Journal = field(default_factory=NoJournal)
