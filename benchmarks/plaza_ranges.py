"""How far the localization is off at ranges that were withheld from it: Plaza, where there is no GPS to score by.

Every second range is taken out of the log. At its time the distance from the causal estimate to the beacon is compared
with the range. A figure, held against dead reckoning from the same start; nothing is required.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from benchmarks.overrides import vehicle_with
from benchmarks.recordings import plaza
from benchmarks.recordings.plaza import Array, Beacons
from benchmarks.support import ROOT
from modelserver.earth.geodesy import Geodesy
from modelserver.errors import ModelServerError
from modelserver.service.daemon import Vehicle, configured_origin
from modelserver.service.offline import OfflineRun
from modelserver.wire.eventlog import LogEvent, LogFile

VEHICLE = ROOT / "benchmarks" / "vehicles" / "plaza" / "vehicle.yaml"


def report(name: str, data: Path, settings: Mapping[str, str], mode: str) -> str:
    """Return the lines on one of `plaza1` and `plaza2`."""
    where = plaza.beacons(data, name)
    kind = "surveyed" if name == "plaza2" else f"self-calibrated on the first quarter, {where.residual:.2f} m left"
    alone = plaza.dead_reckoned(data, name, where)
    with tempfile.TemporaryDirectory() as directory:
        try:
            off = _withheld(name, data, where, vehicle_with(VEHICLE, settings, mode, Path(directory)), Path(directory))
        except ModelServerError as error:
            ours = f"no figure: {error}"
        else:
            good = off[np.isfinite(off)]
            ours = (
                f"{plaza.rms(good):.3f} m, {len(off) - len(good)} missing" if len(good) else "no pose: nothing to score"
            )
    return f"{name} ranges   ours {ours}; dead reckoning {alone['rms']:.3f} m; n {alone['n']}; beacons {kind}"


def _withheld(name: str, data: Path, where: Beacons, vehicle: Vehicle, directory: Path) -> Array:
    """Return the misses at the scored ranges, metres; nan where there is no pose."""
    increments, ranges = plaza.read(data, name)
    log = directory / f"{name}.lcm"
    plaza.convert(data, log, name, where)
    chosen = plaza.scored(increments, ranges, where)
    with LogFile(log) as recording:
        run = OfflineRun(vehicle, _given(recording), plaza.FRAME)
        rows = list(run.rows([plaza.utime_of(t) for t in ranges[chosen, 0]]))
    origin = configured_origin(vehicle.config)
    assert origin is not None
    geodesy = Geodesy(origin)
    spots = np.array(
        [geodesy.utm_from_geodetic(*geodesy.geodetic_from_enu((x, y, 0.0)))[:2] for x, y in where.places.tolist()]
    )
    to = spots[ranges[chosen, 1].astype(int)]
    distance = np.hypot(to[:, 0] - [row.easting for row in rows], to[:, 1] - [row.northing for row in rows])
    result: Array = distance - ranges[chosen, 2] / where.scale
    return result


def _given(events: Iterable[LogEvent]) -> Iterator[LogEvent]:
    count = 0
    for event in events:
        if event.channel == "RANGE":
            count += 1
            if count % 2 == 0:
                continue
        yield event
