"""Mean NIS per degree of freedom of wheels and fixes on the Husky recording."""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path

from benchmarks.protocols import data_directory
from benchmarks.support import ROOT
from modelserver.config.vehicle_file import load_config
from modelserver.messages import Decision, Verdict
from modelserver.server.recordings import OfflineRun
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.eventlog import LogFile
from mstools.recordings.bag_log import import_bag

KINDS = ("gps_position", "wheel_speed")


def compute_mean_nis() -> dict[str, float] | None:
    """Return the mean NIS per degree of freedom of the used wheels and fixes; None without the recording."""
    bag = data_directory() / "husky" / "test1.bag"
    if not bag.is_file():
        return None
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}

    def on_decision(decision: Decision) -> None:
        if decision.kind in found and decision.verdict is Verdict.USED:
            found[decision.kind].append(decision.statistic / decision.dof)

    vehicle = load_vehicle(load_config(ROOT / "config" / "husky" / "vehicle.yaml"))
    with tempfile.TemporaryDirectory() as directory:
        log = Path(directory) / "husky.lcm"
        import_bag(bag, log)
        with LogFile(log) as recording:
            for _ in OfflineRun(vehicle, recording, vehicle.config.base_frame, on_decision).rows(None, 0.1):
                pass
    return {kind: statistics.mean(values) for kind, values in found.items()}
