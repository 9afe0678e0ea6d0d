"""From what a receiver says to a sample: units, angles, fix types. What it did not say stays nan."""

from __future__ import annotations

import math

from modelserver.messages import FixType, GpsSample, SensorHeader
from modelserver.messages.flags import NAN
from modelserver.messages.samples import Matrix3
from modelserver.spatial.so3 import Vector3
from msdrivers.protocol.nmea import NmeaEpoch
from msdrivers.protocol.novatel import HeadingLog, Position, PositionType, SolutionStatus, TimeStatus, Velocity

USABLE_TIME = frozenset(
    {
        TimeStatus.COARSE,
        TimeStatus.COARSESTEERING,
        TimeStatus.FREEWHEELING,
        TimeStatus.FINEADJUSTING,
        TimeStatus.FINE,
        TimeStatus.FINEBACKUPSTEERING,
        TimeStatus.FINESTEERING,
    }
)
"""With the others the header's time may be wrong by seconds, or by years."""

FIX_TYPES: dict[int, FixType] = {
    PositionType.FIXEDHEIGHT: FixType.FIX_2D,
    PositionType.FLOATCONV: FixType.RTK_FLOAT,
    PositionType.WIDELANE: FixType.RTK_FIXED,
    PositionType.NARROWLANE: FixType.RTK_FIXED,
    PositionType.SINGLE: FixType.FIX_3D,
    PositionType.PSRDIFF: FixType.DIFFERENTIAL,
    PositionType.WAAS: FixType.DIFFERENTIAL,
    PositionType.PROPAGATED: FixType.DEAD_RECKONING,
    PositionType.OMNISTAR: FixType.DIFFERENTIAL,
    PositionType.L1_FLOAT: FixType.RTK_FLOAT,
    PositionType.IONOFREE_FLOAT: FixType.RTK_FLOAT,
    PositionType.NARROW_FLOAT: FixType.RTK_FLOAT,
    PositionType.L1_INT: FixType.RTK_FIXED,
    PositionType.WIDE_INT: FixType.RTK_FIXED,
    PositionType.NARROW_INT: FixType.RTK_FIXED,
    PositionType.RTK_DIRECT_INS: FixType.RTK_FIXED,
    PositionType.INS_SBAS: FixType.DIFFERENTIAL,
    PositionType.INS_PSRSP: FixType.FIX_3D,
    PositionType.INS_PSRDIFF: FixType.DIFFERENTIAL,
    PositionType.INS_RTKFLOAT: FixType.RTK_FLOAT,
    PositionType.INS_RTKFIXED: FixType.RTK_FIXED,
    PositionType.OMNISTAR_HP: FixType.DIFFERENTIAL,
    PositionType.OMNISTAR_XP: FixType.DIFFERENTIAL,
    PositionType.CDGPS: FixType.DIFFERENTIAL,
    PositionType.PPP_CONVERGING: FixType.DIFFERENTIAL,
    PositionType.PPP: FixType.DIFFERENTIAL,
    PositionType.INS_PPP_CONVERGING: FixType.DIFFERENTIAL,
    PositionType.INS_PPP: FixType.DIFFERENTIAL,
    PositionType.PPP_BASIC_CONVERGING: FixType.DIFFERENTIAL,
    PositionType.PPP_BASIC: FixType.DIFFERENTIAL,
    PositionType.INS_PPP_BASIC_CONVERGING: FixType.DIFFERENTIAL,
    PositionType.INS_PPP_BASIC: FixType.DIFFERENTIAL,
}
"""The rest is no position from satellites: none, typed in (FIXEDPOS), velocity only, or not known here."""


def course(track: float) -> float:
    """Return radians counter-clockwise from true east, -pi to pi, of degrees clockwise from true north."""
    return math.remainder(math.radians(90.0 - track), math.tau)


def nmea_sample(header: SensorHeader, epoch: NmeaEpoch) -> GpsSample:
    """Return the sample of an NMEA epoch."""
    return GpsSample(
        header,
        epoch.fix_type,
        epoch.latitude,
        epoch.longitude,
        height_ellipsoidal=epoch.height_msl + epoch.undulation,
        height_msl=epoch.height_msl,
        undulation=epoch.undulation,
        satellites=epoch.satellites,
        hdop=epoch.hdop,
        vdop=epoch.vdop,
        pdop=epoch.pdop,
        position_covariance=covariance(epoch.sigma_longitude, epoch.sigma_latitude, epoch.sigma_height),
        speed=epoch.speed,
        course=course(epoch.track),
        baseline_yaw=course(epoch.heading),
    )


def novatel_sample(
    header: SensorHeader, position: Position, velocity: Velocity | None = None, heading: HeadingLog | None = None
) -> GpsSample:
    """Return the sample of a position log, with the velocity and the heading of the same instant where they are."""
    # without a solution the receiver fills in zeros, which say nothing
    empty = position.type == PositionType.NONE and position.latitude == 0.0 and position.longitude == 0.0
    height = NAN if empty else position.height
    undulation = NAN if empty else position.undulation
    moving = velocity is not None and _solved(velocity)
    turned = heading is not None and _solved(heading)
    return GpsSample(
        header,
        FIX_TYPES.get(position.type, FixType.NONE) if _solved(position) else FixType.NONE,
        NAN if empty else position.latitude,
        NAN if empty else math.remainder(position.longitude, 360.0),
        height_ellipsoidal=height + undulation,
        height_msl=height,
        undulation=undulation,
        satellites=position.used,
        position_covariance=covariance(position.sigma_longitude, position.sigma_latitude, position.sigma_height),
        velocity=_enu(velocity) if moving and velocity else None,
        velocity_latency=max(0.0, velocity.latency - position.solution_age) if moving and velocity else NAN,
        speed=velocity.horizontal if moving and velocity else NAN,
        course=course(velocity.track) if moving and velocity else NAN,
        baseline_yaw=course(heading.heading) if turned and heading else NAN,
        # nobody is so sure as 0
        baseline_yaw_sigma=math.radians(heading.sigma_heading)
        if turned and heading and heading.sigma_heading > 0.0
        else NAN,
    )


def covariance(east: float, north: float, up: float) -> Matrix3 | None:
    """Return the covariance of standard deviations, m2; None where one is not said (nan or 0: nobody is so sure)."""
    if not (east > 0.0 and north > 0.0 and up > 0.0):
        return None
    return (east * east, 0.0, 0.0, 0.0, north * north, 0.0, 0.0, 0.0, up * up)


def _solved(said: Position | Velocity | HeadingLog) -> bool:
    return said.status == SolutionStatus.SOL_COMPUTED and said.type != PositionType.NONE


def _enu(velocity: Velocity) -> Vector3:
    track = math.radians(velocity.track)
    return velocity.horizontal * math.sin(track), velocity.horizontal * math.cos(track), velocity.vertical
