"""`modelserver import-bag`: convert a ROS bag to an LCM event log of this project's types."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated

import typer

from modelserver.errors import quote
from modelserver.messages import MAX_CHANNEL_LENGTH
from mstools.recordings.bag_log import ImportReport, choose_topics, import_bag
from mstools.recordings.bags import (
    Altitude,
    BagOptions,
    ImuOrientation,
    TopicKind,
    open_bag,
)
from mstools.terminal.options import JsonOption, argument, option
from mstools.terminal.output import check_writable


def command(
    bag: Annotated[Path, argument("BAG", "ROS 1 file, folder of a ROS 2 recording, or MCAP file of export.")],
    log: Annotated[Path | None, argument("[LOG]", "LCM event log to write. Without: show what would be taken.")] = None,
    topic: Annotated[
        list[str] | None,
        option(
            "--topic KIND=TOPIC",
            "Topic of the gps, imu, wheels or joints. Default: of each type the busiest one that no estimator makes.",
        ),
    ] = None,
    geometry: Annotated[
        Path | None,
        option("--geometry FILE", "Write the frames of tf as a geometry file; those that move become joints."),
    ] = None,
    altitude: Annotated[
        Altitude, option("--altitude", "Reference of the fixes' altitudes. ROS prescribes the ellipsoid.")
    ] = Altitude.ELLIPSOIDAL,
    undulation: Annotated[
        float, option("--undulation", "Geoid's height above the ellipsoid, meters; with --altitude msl.")
    ] = math.nan,
    imu_orientation: Annotated[
        ImuOrientation,
        option("--imu-orientation", "Reference of the IMU's orientation, which a bag does not state. none: drop it."),
    ] = ImuOrientation.NONE,
    track_width: Annotated[
        float, option("--track-width", "Distance of the two virtual wheels from odometry, meters.")
    ] = 0.555,
    prefix: Annotated[str, option("--prefix", "Prefix of the channels.")] = "",
    force: Annotated[bool, option("--force", "Replace LOG if it exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Convert a ROS bag to an LCM log of this project's types, or an exported MCAP file back to its log.

    NavSatFix becomes GPS, Imu IMU, Odometry WHEELS, JointState JOINTS. A message's stamp is used as the time of
    measurement; the times of the log are the recorder's receive times. Options give what a bag does not state;
    docs/recordings.md explains them.

    \b
    Example:
      modelserver import-bag drive.bag
      modelserver import-bag drive.bag drive.lcm --topic gps=/ublox/fix
      modelserver replay drive.lcm -c config/husky/vehicle.yaml --poses poses.csv
    """
    if not 0.0 < track_width < 100.0:
        raise typer.BadParameter(f"a track width must be above 0 and below 100 m, got {track_width:g}")
    if math.isfinite(undulation) and altitude is not Altitude.MSL:
        raise typer.BadParameter("--undulation goes with --altitude msl")
    if any(not (c.isascii() and (c.isalnum() or c == "_")) for c in prefix) or len(prefix) > MAX_CHANNEL_LENGTH - 16:
        raise typer.BadParameter(f"a prefix consists of letters, digits and underscores, got {quote(prefix)}")
    kinds: dict[str, TopicKind] = {}
    for pair in topic or ():
        kind, _, name = pair.partition("=")
        if not name or kind not in list(TopicKind):
            kinds_of = ", ".join(TopicKind)
            raise typer.BadParameter(f"--topic takes KIND=TOPIC with one of {kinds_of}, got {quote(pair)}")
        kinds[name] = TopicKind(kind)
    if log is None:
        with open_bag(bag) as opened:
            _, topics = choose_topics(opened.topics, kinds, str(bag), has_tf=geometry is not None)
        report = ImportReport("", list(topics.values()))
    else:
        if geometry is not None:
            check_writable(str(geometry), replace=force)
        options = BagOptions(altitude, undulation, imu_orientation, track_width)
        report = import_bag(bag, log, options, kinds, prefix, force, geometry)
    typer.echo(json.dumps(dataclasses.asdict(report), indent=2) if as_json else report.to_text())
