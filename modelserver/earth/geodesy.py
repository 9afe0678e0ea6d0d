"""Geodesy on WGS 84: geodetic, earth-centered (ECEF), UTM with a pinned zone, and local tangent planes (ENU). Pure.

UTM is the transverse Mercator projection; projections and ellipsoid are those of PROJ (pyproj). Latitudes and
longitudes are degrees, north and east positive; lengths are meters; heights are above the ellipsoid, up. Importing this
module loads pyproj.

Sources: J. Snyder, "Map projections: a working manual", USGS 1395, 1987 (UTM zones, convergence); NGA.SIG.0012, 2014, 7
(the zones of Norway and Svalbard, latitude limits of UTM).
"""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

from pyproj import Proj, Transformer
from pyproj.enums import TransformDirection

from modelserver.earth import Origin
from modelserver.earth.magnetism import MagnetismError, declination
from modelserver.errors import ModelServerError
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

SOUTHERN_LIMIT = -80.0
NORTHERN_LIMIT = 84.0
"""UTM covers the latitudes between; the polar caps have a projection of their own (UPS)."""

MAX_ZONE_OFFSET = 20.0
"""Degrees of longitude from the zone's central meridian within which a pinned zone is used."""

CELLS_PER_DEG = 1000
"""Places per degree at which `compute_geodetic` computes the convergence exactly."""

MIN_HORIZONTAL = 1e-6
"""Horizontal part of a unit vector below which it has no heading."""

_INVERSE = TransformDirection.INVERSE


class GeodesyError(ModelServerError, ValueError):
    """A place that the coordinates cannot express: not finite, polar, or far outside the zone."""


@lru_cache(maxsize=1)
def _cart() -> Transformer:
    """Return the transformer from (longitude, latitude, height) to ECEF, cached: creating it costs 0.2 ms."""
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
    )


@lru_cache(maxsize=128)
def _utm(zone: int, north: bool) -> Proj:
    return Proj(proj="utm", zone=zone, south=not north, ellps="WGS84")


@lru_cache(maxsize=128)
def _cart_to_utm(zone: int, north: bool) -> Transformer:
    """Return the transformer from ECEF to (easting, northing, height), in one call for each pose."""
    south = "" if north else " +south"
    return Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone={zone}{south} +ellps=WGS84"
    )


def utm_zone(latitude_deg: float, longitude_deg: float) -> tuple[int, bool]:
    """Return the UTM zone of a place and whether it is of the northern hemisphere.

    South-west Norway is in zone 32 and Svalbard in 31, 33, 35 and 37. Raises GeodesyError outside 80 S to 84 N, or
    where a number is not finite.
    """
    _check_place(latitude_deg, longitude_deg)
    if not SOUTHERN_LIMIT <= latitude_deg <= NORTHERN_LIMIT:
        raise GeodesyError(
            f"latitude {latitude_deg:.6f} deg is beyond UTM, which ends at 80 S and 84 N: "
            "the vehicle is too near a pole for World:UTM"
        )
    longitude = math.fmod(math.fmod(longitude_deg + 180.0, 360.0) + 360.0, 360.0) - 180.0
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 if longitude < 9.0 else 33 if longitude < 21.0 else 35 if longitude < 33.0 else 37
    return zone, latitude_deg >= 0.0


def ecef_from_geodetic(latitude_deg: float, longitude_deg: float, height: float) -> Vector3:
    """Return ECEF x, y, z. Raises GeodesyError where a number is not finite."""
    _check_place(latitude_deg, longitude_deg, height)
    x, y, z = _cart().transform(longitude_deg, latitude_deg, height)
    return (x, y, z)


def geodetic_from_ecef(ecef: Vector3) -> Vector3:
    """Return latitude, longitude in degrees and height of an ECEF point."""
    longitude, latitude, height = _cart().transform(*ecef, direction=_INVERSE)
    return (latitude, longitude, height)


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """A tangent plane (ENU): x true east, y true north, z up along the ellipsoid's normal.

    `ecef` is its origin and `rotation` the quaternion R_EL from its axes to ECEF.
    """

    ecef: Vector3
    rotation: Quaternion

    @classmethod
    def at(cls, latitude_deg: float, longitude_deg: float, height: float) -> LocalFrame:
        """Return the tangent plane at a place. Raises GeodesyError where a number is not finite."""
        ecef = ecef_from_geodetic(latitude_deg, longitude_deg, height)
        return cls(ecef, _tangent_rotation(latitude_deg, longitude_deg))

    def to_ecef(self, point: Vector3) -> Vector3:
        """Return a point of this frame (east, north, up) in ECEF."""
        x, y, z = so3.rotate(self.rotation, point)
        a, b, c = self.ecef
        return (a + x, b + y, c + z)

    def from_ecef(self, ecef: Vector3) -> Vector3:
        """Return an ECEF point as east, north, up in this frame."""
        a, b, c = self.ecef
        return so3.rotate_back(self.rotation, (ecef[0] - a, ecef[1] - b, ecef[2] - c))

    def rotation_of(self, other: LocalFrame) -> Quaternion:
        return so3.multiply(so3.conjugate(self.rotation), other.rotation)


def _tangent_rotation(latitude_deg: float, longitude_deg: float) -> Quaternion:
    """Return R_EL = Rz(longitude + 90 deg) Rx(90 deg - latitude): columns east, north, up."""
    a = math.radians(longitude_deg + 90.0) / 2.0
    b = math.radians(90.0 - latitude_deg) / 2.0
    ca, sa, cb, sb = math.cos(a), math.sin(a), math.cos(b), math.sin(b)
    return so3.normalize((ca * cb, ca * sb, sa * sb, sa * cb))


def make_origin(easting: float, northing: float, height: float, zone: int, north: bool) -> Origin:
    """Return the origin of World:UTM at grid coordinates; its `origin_id` is a hash of the five numbers.

    Raises GeodesyError for a zone outside 1 to 60, or coordinates far outside the zone.
    """
    if not 1 <= zone <= 60:
        raise GeodesyError(f"a UTM zone is 1 to 60, got {zone}")
    if not (math.isfinite(height) and 0.0 <= northing <= 1e7 and -1.5e6 <= easting <= 2.5e6):
        raise GeodesyError(
            f"no origin in zone {zone}: easting {easting}, northing {northing}, height {height} m; "
            "give grid meters, northing counted from the equator or in the south from 10,000,000 m"
        )
    # + 0.0 turns a negative zero into zero, so that equal numbers have equal ids
    numbers = struct.pack(">dddB?", easting + 0.0, northing + 0.0, height + 0.0, zone, north)
    digest = int.from_bytes(hashlib.sha256(numbers).digest()[:8], "big") & 0x7FFF_FFFF_FFFF_FFFF
    return Origin(easting, northing, height, zone, north, digest or 1)


def origin_at(latitude_deg: float, longitude_deg: float, height: float) -> Origin:
    """Return an origin at a place, in the zone of that place, rounded to 0.1 mm.

    Raises GeodesyError beyond UTM's latitudes, or where a number is not finite.
    """
    zone, north = utm_zone(latitude_deg, longitude_deg)
    easting, northing = _utm(zone, north)(longitude_deg, latitude_deg)
    return make_origin(round(easting, 4), round(northing, 4), round(height, 4), zone, north)


@dataclass(frozen=True, slots=True)
class Geodesy:
    """World coordinates around one origin: its pinned UTM zone and its tangent plane (World:ENU).

    The zone stays that of the origin where the vehicle crosses into the next: PROJ's series hold far beyond a zone's
    border. Scalar calls cost microseconds. Raises GeodesyError for an invalid origin.
    """

    origin: Origin
    tangent: LocalFrame = field(init=False, repr=False, compare=False)
    """The tangent plane at the origin."""

    def __post_init__(self) -> None:
        origin = self.origin
        # the caller's origin_id stays: it may have been persisted by another version
        checked = make_origin(origin.easting, origin.northing, origin.height, origin.zone, origin.north)
        longitude, latitude = _utm(origin.zone, origin.north)(checked.easting, checked.northing, inverse=True)
        object.__setattr__(self, "tangent", LocalFrame.at(latitude, longitude, origin.height))

    def utm_from_geodetic(self, latitude_deg: float, longitude_deg: float, height: float) -> Vector3:
        """Return grid easting, grid northing and height, absolute, in the pinned zone."""
        self._check_zone_offset(latitude_deg, longitude_deg)
        easting, northing = _utm(self.origin.zone, self.origin.north)(longitude_deg, latitude_deg)
        return (easting, northing, height)

    def geodetic_from_utm(self, easting: float, northing: float, height: float) -> Vector3:
        """Return latitude, longitude and height of absolute grid coordinates in the pinned zone.

        Raises GeodesyError for coordinates far outside the zone.
        """
        longitude, latitude = _utm(self.origin.zone, self.origin.north)(easting, northing, inverse=True)
        _check_place(latitude, longitude, height)
        return (latitude, longitude, height)

    def utm_from_ecef(self, ecef: Vector3) -> Vector3:
        """Return absolute grid easting, grid northing and height of an ECEF point, in one step."""
        easting, northing, height = _cart_to_utm(self.origin.zone, self.origin.north).transform(*ecef)
        if not math.isfinite(easting + northing + height):
            raise GeodesyError(f"earth-centered point {ecef} is outside UTM zone {self.origin.zone}")
        return (easting, northing, height)

    def enu_from_geodetic(self, latitude_deg: float, longitude_deg: float, height: float) -> Vector3:
        """Return a place as east, north, up in the tangent plane at the origin."""
        return self.tangent.from_ecef(ecef_from_geodetic(latitude_deg, longitude_deg, height))

    def geodetic_from_enu(self, enu: Vector3) -> Vector3:
        """Return latitude, longitude and height of a point of the tangent plane's frame."""
        return geodetic_from_ecef(self.tangent.to_ecef(enu))

    def convergence(self, latitude_deg: float, longitude_deg: float) -> float:
        """Return the grid convergence at a place, radians: yaw from grid east minus yaw from true east.

        Positive where grid north lies clockwise of true north: east of the central meridian in the north.
        """
        self._check_zone_offset(latitude_deg, longitude_deg)
        factors = _utm(self.origin.zone, self.origin.north).get_factors(longitude_deg, latitude_deg)
        return math.radians(factors.meridian_convergence)

    def scale(self, latitude_deg: float, longitude_deg: float) -> float:
        """Return the grid scale factor at a place: 0.9996 on the central meridian."""
        self._check_zone_offset(latitude_deg, longitude_deg)
        return float(
            _utm(self.origin.zone, self.origin.north).get_factors(longitude_deg, latitude_deg).meridional_scale
        )

    def pose_in_utm(self, X_enu: Pose) -> Pose:
        """Return the pose in World:UTM of a pose in World:ENU.

        The position is projected. The orientation is rotated to the tangent plane at the pose's own place, and by the
        convergence there: yaw counts from grid east, and tilt from the local vertical.
        """
        ecef = self.tangent.to_ecef(X_enu.xyz)
        latitude, longitude, height = geodetic_from_ecef(ecef)
        local = LocalFrame(ecef, _tangent_rotation(latitude, longitude))
        q_local = so3.multiply(local.rotation_of(self.tangent), X_enu.wxyz)
        return Pose(
            self.to_relative_utm(self.utm_from_geodetic(latitude, longitude, height)),
            so3.multiply(rotation_about_up(self.convergence(latitude, longitude)), q_local),
        )

    def pose_in_enu(self, X_utm: Pose) -> Pose:
        """Return the pose in World:ENU of a pose in World:UTM, the inverse of `pose_in_utm`.

        Raises GeodesyError outside the zone.
        """
        east, north, height = self.origin.initial_utm
        x, y, z = X_utm.xyz
        place = self.geodetic_from_utm(east + x, north + y, height + z)
        local = LocalFrame.at(*place)
        q_local = so3.multiply(rotation_about_up(-self.convergence(*place[:2])), X_utm.wxyz)
        return Pose(self.tangent.from_ecef(local.ecef), so3.multiply(self.tangent.rotation_of(local), q_local))

    def to_relative_utm(self, utm: Vector3) -> Vector3:
        """Return absolute grid coordinates as meters from the origin: a position in World:UTM."""
        east, north, height = self.origin.initial_utm
        return (utm[0] - east, utm[1] - north, utm[2] - height)

    def _check_zone_offset(self, latitude_deg: float, longitude_deg: float) -> None:
        _check_place(latitude_deg, longitude_deg)
        if not SOUTHERN_LIMIT <= latitude_deg <= NORTHERN_LIMIT:
            raise GeodesyError(f"latitude {latitude_deg:.6f} deg is beyond UTM, which ends at 80 S and 84 N")
        away = math.remainder(longitude_deg - (6.0 * self.origin.zone - 183.0), 360.0)
        if abs(away) > MAX_ZONE_OFFSET:
            raise GeodesyError(
                f"longitude {longitude_deg:.6f} deg lies {abs(away):.1f} deg from the middle of the pinned UTM "
                f"zone {self.origin.zone}, which reaches {MAX_ZONE_OFFSET:g} deg: set a new origin"
            )


class GeodeticPose(NamedTuple):
    """Where a frame is on the earth, and where its x axis points.

    `latitude_deg` and `longitude_deg` are of WGS 84, north and east positive; `height` is above the ellipsoid, m.
    `heading_deg` is clockwise from true north, 0 to 360, as on a compass rose; nan where x is vertical.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    heading_deg: float

    def compute_magnetic_heading(self, utime: int) -> float:
        """Return what a compass would show for the heading at a time, degrees; nan where no magnetic model covers it.

        Without deviation by the vehicle's own iron.
        """
        try:
            east = declination(self.latitude_deg, self.longitude_deg, self.height, utime)
        except MagnetismError:
            return math.nan
        return (self.heading_deg - math.degrees(east)) % 360.0

    def __str__(self) -> str:
        heading = "" if math.isnan(self.heading_deg) else f", heading {self.heading_deg:.2f} deg"
        return f"{self.latitude_deg:.8f}, {self.longitude_deg:.8f} deg, height {self.height:.3f} m{heading}"


@lru_cache(maxsize=8)
def geodesy_of(origin: Origin) -> Geodesy:
    """Return the world coordinates around an origin. Raises GeodesyError for an invalid one."""
    return Geodesy(origin)


def compute_geodetic(X_world: Pose, frame_of_reference: str, origin: Origin) -> GeodeticPose | None:
    """Return where a frame is from its pose in World:UTM or World:ENU; None for another reference, or out of range."""
    try:
        geodesy = geodesy_of(origin)
        if frame_of_reference == "World:ENU":
            X_world = geodesy.pose_in_utm(X_world)
        elif frame_of_reference != "World:UTM":
            return None
        east, north, height = geodesy.origin.initial_utm
        x, y, z = X_world.xyz
        latitude, longitude, height = geodesy.geodetic_from_utm(east + x, north + y, height + z)
        convergence = _approximate_convergence(geodesy, latitude, longitude)
    except GeodesyError:
        return None
    ahead_x, ahead_y, _ = so3.rotate(X_world.wxyz, (1.0, 0.0, 0.0))
    heading = math.nan
    if math.hypot(ahead_x, ahead_y) > MIN_HORIZONTAL:
        heading = (90.0 - math.degrees(math.atan2(ahead_y, ahead_x) - convergence)) % 360.0
    return GeodeticPose(latitude, longitude, height, heading)


def _approximate_convergence(geodesy: Geodesy, latitude_deg: float, longitude_deg: float) -> float:
    """Return the convergence to 3e-8 rad, from the exact one at a grid of places, at a tenth of its cost.

    Between them it changes as on a sphere, in proportion to (longitude - central meridian) sin(latitude) (Snyder, 8).
    """
    origin = geodesy.origin
    south, west = round(latitude_deg * CELLS_PER_DEG), round(longitude_deg * CELLS_PER_DEG)
    there = south / CELLS_PER_DEG, west / CELLS_PER_DEG
    center = 6.0 * origin.zone - 183.0
    change = math.remainder(longitude_deg - center, 360.0) * math.sin(math.radians(latitude_deg))
    change -= math.remainder(there[1] - center, 360.0) * math.sin(math.radians(there[0]))
    return _cell_convergence(geodesy, south, west) + math.radians(change)


@lru_cache(maxsize=1024)
def _cell_convergence(geodesy: Geodesy, south: int, west: int) -> float:
    return geodesy.convergence(south / CELLS_PER_DEG, west / CELLS_PER_DEG)


def rotation_about_up(angle: float) -> Quaternion:
    """Return the rotation by `angle` radians about z, counter-clockwise seen from above."""
    return (math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0))


def _check_place(latitude_deg: float, longitude_deg: float, height: float = 0.0) -> None:
    if not (
        math.isfinite(latitude_deg + longitude_deg + height)
        and -90.0 <= latitude_deg <= 90.0
        and -540.0 <= longitude_deg <= 540.0
    ):
        raise GeodesyError(f"not a place: latitude {latitude_deg}, longitude {longitude_deg} deg, height {height} m")
