"""How the Husky recording's innovations compare with what the filter expects of them: mean statistic by its freedom."""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path

from benchmarks.support import ROOT
from benchmarks.withheld import data_directory
from modelserver.config import load_config
from modelserver.messages import Decision, Verdict
from modelserver.service.daemon import load_vehicle
from modelserver.service.offline import OfflineRun
from modelserver.wire.eventlog import LogFile
from mstools.commands.import_bag import import_bag

KINDS = ("gps_position", "wheel_speed")


def mean_statistics() -> dict[str, float] | None:
    """Return for wheels and fixes the mean of statistic / dof over all used; None where there is no recording."""
    bag = data_directory() / "husky" / "test1.bag"
    if not bag.is_file():
        return None
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}

    def noted(decision: Decision) -> None:
        if decision.kind in found and decision.verdict is Verdict.USED:
            found[decision.kind].append(decision.statistic / decision.dof)

    vehicle = load_vehicle(load_config(ROOT / "config" / "husky" / "vehicle.yaml"))
    with tempfile.TemporaryDirectory() as directory:
        log = Path(directory) / "husky.lcm"
        import_bag(bag, log)
        with LogFile(log) as recording:
            for _ in OfflineRun(vehicle, recording, vehicle.config.base_frame, noted).rows(None, 0.1):
                pass
    return {kind: statistics.mean(values) for kind, values in found.items()}
