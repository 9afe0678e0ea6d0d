"""Localization error at withheld ranges: Plaza, which has no GPS to score by.

Every second range is withheld. At its time the distance from the causal estimate to the beacon is compared with the
range, relative to dead reckoning from the same start; no value is required.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from benchmarks.protocols import load_with_overrides
from benchmarks.recordings import plaza
from benchmarks.recordings.plaza import Array, Beacons
from benchmarks.support import ROOT
from modelserver.earth.geodesy import Geodesy
from modelserver.errors import ModelServerError
from modelserver.server.recordings import OfflineRun
from modelserver.server.vehicle import Vehicle, get_configured_origin
from modelserver.wire.eventlog import LogEvent, LogFile

VEHICLE = ROOT / "benchmarks" / "vehicles" / "plaza" / "vehicle.yaml"


def report(name: str, data: Path, settings: Mapping[str, str], mode: str) -> str:
    """Return the lines on one of `plaza1` and `plaza2`."""
    where = plaza.find_beacons(data, name)
    kind = "surveyed" if name == "plaza2" else f"self-calibrated on the first quarter, {where.residual:.2f} m left"
    alone = plaza.dead_reckoning_rms(data, name, where)
    with tempfile.TemporaryDirectory() as directory:
        try:
            off = _score_withheld(
                name, data, where, load_with_overrides(VEHICLE, settings, mode, Path(directory)), Path(directory)
            )
        except ModelServerError as error:
            ours = f"no figure: {error}"
        else:
            good = off[np.isfinite(off)]
            ours = (
                f"{plaza.rms(good):.3f} m, {len(off) - len(good)} missing" if len(good) else "no pose: nothing to score"
            )
    return f"{name} ranges   ours {ours}; dead reckoning {alone['rms']:.3f} m; n {alone['n']}; beacons {kind}"


def _score_withheld(name: str, data: Path, where: Beacons, vehicle: Vehicle, directory: Path) -> Array:
    """Return the residuals at the scored ranges, meters; nan without a pose."""
    increments, ranges = plaza.read(data, name)
    log = directory / f"{name}.lcm"
    plaza.convert(data, log, name, where)
    chosen = plaza.scored_ranges(increments, ranges, where)
    with LogFile(log) as recording:
        run = OfflineRun(vehicle, _drop_withheld(recording), plaza.FRAME)
        rows = list(run.rows([plaza.utime_of(t) for t in ranges[chosen, 0]]))
    origin = get_configured_origin(vehicle.config)
    assert origin is not None
    geodesy = Geodesy(origin)
    spots = np.array(
        [geodesy.utm_from_geodetic(*geodesy.geodetic_from_enu((x, y, 0.0)))[:2] for x, y in where.positions.tolist()]
    )
    to = spots[ranges[chosen, 1].astype(int)]
    distance = np.hypot(to[:, 0] - [row.easting for row in rows], to[:, 1] - [row.northing for row in rows])
    result: Array = distance - ranges[chosen, 2] / where.scale
    return result


def _drop_withheld(events: Iterable[LogEvent]) -> Iterator[LogEvent]:
    count = 0
    for event in events:
        if event.channel == "RANGE":
            count += 1
            if count % 2 == 0:
                continue
        yield event
