"""The daemon: connects the parts of the server for a vehicle, and serves until a signal.

`run` opens the persistent stores, probes the bus, and runs a `Loop`; SIGTERM and SIGINT stop it, SIGHUP reloads the
geometry.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import socket

from modelserver import core
from modelserver.core import CoreState
from modelserver.errors import quote
from modelserver.messages import Mode, SwitchMode
from modelserver.server.bus import LcmBus
from modelserver.server.clock import Clock
from modelserver.server.diagnostics import DuplicateServerMonitor, probe_bus, read_gauges, report_findings
from modelserver.server.journal import JournalQueue
from modelserver.server.journal.writer import make_writer
from modelserver.server.log import escape_text
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.persistence import SUBJECT as RESTART
from modelserver.server.persistence import PersistentStores, open_stores
from modelserver.server.reloading import GeometryReader
from modelserver.server.supervision import Notifier, ServiceSupervisor
from modelserver.server.vehicle import Vehicle
from modelserver.version import __version__
from modelserver.wire.provider import resolve_url

log = logging.getLogger(__name__)

YOUNGEST = 5_000
"""Values between two collections of the youngest generation: with the default, 700, they are 4 % of the work."""

NEVER = 1 << 30
"""Threshold that disables the collection of a generation."""


def log_mode_switch(command: SwitchMode, before: CoreState, after: CoreState) -> None:
    """Log the effect of a mode command."""
    old, new, source = _get_mode(before), _get_mode(after), quote(command.header.source)
    old_name, new_name = ("none" if mode is None else mode.name.lower() for mode in (old, new))
    if new is not command.mode:
        log.warning("%s requested mode %s, the mode stays %s", source, command.mode.name.lower(), new_name)
    elif old is not new:
        log.info("mode %s, requested by %s (before: %s)", new_name, source, old_name)


def _get_mode(state: CoreState) -> Mode | None:
    from modelserver.estimation.filter.localizer import FilterLocalizer
    from modelserver.estimation.modes import ModeLocalizer

    if not isinstance(state.localizer, ModeLocalizer):
        return None
    active = state.localizer.active
    return active.mode if isinstance(active, FilterLocalizer) else Mode.RAW


def run(vehicle: Vehicle, url: str = "", file: str = "", notifier: Notifier | None = None) -> None:
    """Serve a vehicle until SIGTERM or SIGINT; SIGHUP reloads its geometry. `file` is the path of the vehicle file.

    Raises BusError if the bus cannot be joined, or does not deliver messages.
    """
    notifier = notifier or Notifier.from_environment()
    notifier.notify_starting("joining the bus")
    store = open_stores(vehicle.config, localizes=vehicle.rig is not None)
    try:
        _serve(vehicle, store, notifier, url, file)
    finally:
        store.close()
    log.info("stopped")


def _restrict_collector() -> None:
    """Restrict the garbage collector to the youngest generation.

    Values are immutable and have no reference cycles (tests/unit/server/test_garbage.py). A full collection would find
    nothing and stop the loop for 40 ms once the history is full, one of the middle generation for 4 ms, one of
    `YOUNGEST` values for a tenth of one.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNGEST, NEVER, NEVER)


def _serve(vehicle: Vehicle, store: PersistentStores, notifier: Notifier, url: str, file: str) -> None:
    config = vehicle.config
    clock = Clock()
    origins, states, warm_start = store.origin, store.state, config.warm_start
    origin = origins.load() if origins else None
    restored = states.restore(clock.now(), warm_start.max_pose_age_s, warm_start.max_age_s) if states else None

    verifier = vehicle.make_command_verifier(clock.monotonic_ns(), file)
    bus = LcmBus(resolve_url(url or config.lcm.url))
    notifier.notify_starting("probing the bus")
    findings = probe_bus(bus.url)
    reader = GeometryReader(vehicle, file, frames=store.frames)
    vehicle, frames_problem = reader.restore_frames()
    supervisor = ServiceSupervisor(notifier, clock, lambda channel: loop.is_sensor_channel(channel))
    journal = make_writer(config, clock, next(iter(vehicle.read_keys(file)), None))
    loop = Loop(
        bus,
        clock,
        vehicle.start_core(clock.now(), origin, restored),
        LoopSettings.of(vehicle),
        Hooks(
            on_origin=lambda output: origins.save(output.origin) if origins is not None else None,
            on_mode_switch=log_mode_switch,
            on_load=reader.begin,
            on_reload=supervisor.on_reload,
            snapshot=reader.encode_snapshot,
            channels=lambda state: vehicle.sensor_channels(state.model),
            on_persist=states.save if states is not None else lambda state: "",
            gauges=read_gauges,
            on_tick=supervisor.on_tick,
            verifier=verifier,
            journal=JournalQueue() if journal is None else journal[0],
        ),
    )
    report_findings(findings, loop.set_warning)
    if frames_problem:
        log.warning("added frames: %s", escape_text(frames_problem))
        loop.set_warning("frames", frames_problem)
    if store.warning:
        loop.set_warning(RESTART, store.warning)
    DuplicateServerMonitor(socket.gethostname(), os.getpid(), loop.set_warning, clock).subscribe(
        bus.requests, config.lcm.channel_prefix
    )
    signal.signal(signal.SIGHUP, lambda *_: loop.reload())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: loop.stop())
    log.info(
        "modelserver %s serves %s (%s) on %s; publishing %s",
        __version__,
        config.vehicle,
        vehicle.model,
        bus.url,
        f"at {config.publish.rate_hz:g} Hz" if config.publish.mode == "timer" else "on every sensor event",
    )
    if vehicle.rig is None:
        log.warning(
            "no localization sensor is configured (section 'sensors' of the vehicle file): POSE is not published"
        )
    if origin is not None and origins is not None:
        log.info(
            "using the persisted origin %s (remove the file to set a new one): %.3f E %.3f N %.3f m, zone %d%s",
            origins.path,
            *origin.initial_utm,
            origin.zone,
            "N" if origin.north else "S",
        )
    if loop.state.warnings:
        log.info("%s", "; ".join(loop.state.warnings.values()))
    _restrict_collector()
    if journal is not None:
        journal[1].start()
    try:
        loop.run()
    finally:
        notifier.notify_stopping()
        reader.close()
        if states is not None:
            states.close(core.get_state_to_persist(loop.state, clock.now()))
        if journal is not None:
            journal[1].close()
