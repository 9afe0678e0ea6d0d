"""Geodesy against other routes through PROJ, earth-centered numbers and published points."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Proj, Transformer
from scipy.spatial.transform import Rotation

from modelserver.earth.geodesy import (
    Geodesy,
    GeodesyError,
    LocalFrame,
    compute_geodetic,
    ecef_from_geodetic,
    geodesy_of,
    geodetic_from_ecef,
    make_origin,
    origin_at,
    utm_zone,
)
from modelserver.messages import Origin
from modelserver.transforms import Pose

PLACES = {
    "Suffield": (50.27, -111.1, 700.0),
    "Cambridge": (42.3758, -71.1474, 7.3),
    "Sydney": (-33.8568, 151.2153, 30.0),
    "Quito": (-0.1807, -78.4678, 2850.0),
    "Bergen": (60.39, 5.32, 20.0),
    "Longyearbyen": (78.22, 15.65, 10.0),
}
latitudes = st.floats(-79.9, 83.9)
longitudes = st.floats(-180.0, 180.0)
heights = st.floats(-400.0, 9000.0)


def epsg(zone, north):
    return f"EPSG:{(32600 if north else 32700) + zone}"


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_utm_equals_the_epsg_route(place):
    origin = origin_at(*place)
    route = Transformer.from_crs("EPSG:4326", epsg(origin.zone, origin.north), always_xy=True)
    easting, northing = route.transform(place[1] + 0.01, place[0] + 0.01)
    found = Geodesy(origin).utm_from_geodetic(place[0] + 0.01, place[1] + 0.01, place[2])
    assert found == pytest.approx((easting, northing, place[2]), abs=1e-6)


def test_published_point_cn_tower():
    # CN Tower, Toronto: 43 38 33.24 N, 79 23 13.7 W is 17T 630084 4833438 (Wikipedia, UTM, worked example)
    origin = origin_at(43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600), 0.0)
    assert (origin.zone, origin.north) == (17, True)
    assert origin.easting == pytest.approx(630084, abs=1.0)
    assert origin.northing == pytest.approx(4833438, abs=1.0)


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone", "north"),
    [
        (60.0, 5.0, 32, True),  # south-west Norway
        (60.0, 2.99, 31, True),
        (55.99, 5.0, 31, True),
        (64.0, 5.0, 31, True),
        (78.0, 8.99, 31, True),  # Svalbard
        (78.0, 9.0, 33, True),
        (78.0, 20.99, 33, True),
        (78.0, 21.0, 35, True),
        (78.0, 33.0, 37, True),
        (78.0, 41.99, 37, True),
        (78.0, 42.0, 38, True),
        (71.99, 10.0, 32, True),
        (10.0, -180.0, 1, True),
        (10.0, 180.0, 1, True),
        (10.0, 179.99, 60, True),
        (10.0, 190.0, 2, True),
        (0.0, 0.0, 31, True),
        (-1e-9, 0.0, 31, False),
        (-33.9, 151.2, 56, False),
        (84.0, 3.0, 31, True),
        (-80.0, 3.0, 31, False),
    ],
)
def test_zone_of_a_place(latitude, longitude, zone, north):
    assert utm_zone(latitude, longitude) == (zone, north)


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(84.01, 0.0), (-80.01, 0.0), (90.0, 0.0), (math.nan, 0.0), (0.0, math.inf), (91.0, 0.0)]
)
def test_no_zone_beyond_utm(latitude, longitude):
    with pytest.raises(GeodesyError, match="latitude"):
        utm_zone(latitude, longitude)


def test_origin_id_is_a_positive_hash_of_the_numbers():
    a = make_origin(500000.0, 5568000.0, 700.0, 12, True)
    assert a == make_origin(500000.0, 5568000.0, 700.0, 12, True)
    others = [
        make_origin(500000.001, 5568000.0, 700.0, 12, True),
        make_origin(500000.0, 5568000.001, 700.0, 12, True),
        make_origin(500000.0, 5568000.0, 700.001, 12, True),
        make_origin(500000.0, 5568000.0, 700.0, 13, True),
        make_origin(500000.0, 5568000.0, 700.0, 12, False),
    ]
    assert len({a.origin_id, *(each.origin_id for each in others)}) == 6
    assert all(0 < each.origin_id < 2**63 for each in others)
    assert a.origin_id == 6388294630773820315  # never changes between versions or machines


@pytest.mark.parametrize(
    "numbers",
    [
        (500000.0, 5e6, 0.0, 0, True),
        (500000.0, 5e6, 0.0, 61, True),
        (math.nan, 5e6, 0.0, 12, True),
        (500000.0, math.inf, 0.0, 12, True),
        (500000.0, 5e6, math.nan, 12, True),
        (500000.0, 1e7 + 1, 0.0, 12, True),
        (5e6, 5e6, 0.0, 12, True),
    ],
)
def test_no_origin_of_impossible_numbers(numbers):
    with pytest.raises(GeodesyError):
        make_origin(*numbers)
    with pytest.raises(GeodesyError):
        Geodesy(Origin(*numbers, origin_id=1))


def test_pinned_zone_holds_across_its_border():
    origin = origin_at(50.0, -108.01, 0.0)  # zone 12, 0.7 km from zone 13
    geodesy = Geodesy(origin)
    route = Transformer.from_crs("EPSG:4326", epsg(12, True), always_xy=True)
    assert utm_zone(50.0, -107.9)[0] == 13
    expected = route.transform(-107.9, 50.0)
    assert geodesy.utm_from_geodetic(50.0, -107.9, 5.0)[:2] == pytest.approx(expected, abs=1e-6)
    assert geodesy.geodetic_from_utm(*expected, 5.0) == pytest.approx((50.0, -107.9, 5.0), abs=1e-9)


def test_a_place_far_from_the_zone_is_rejected():
    geodesy = Geodesy(origin_at(50.0, -111.0, 0.0))
    with pytest.raises(GeodesyError, match="zone 12"):
        geodesy.utm_from_geodetic(50.0, 0.0, 0.0)
    with pytest.raises(GeodesyError, match="84 N"):
        geodesy.convergence(85.0, -111.0)
    with pytest.raises(GeodesyError):
        geodesy.geodetic_from_utm(1e30, 1e30, 0.0)


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_convergence_and_scale_equal_numerical_differences(place):
    geodesy = Geodesy(origin_at(*place))
    latitude, longitude = place[0] + 0.3, place[1] + 0.5
    # a geodesic of 20 m to true north, seen in the grid
    north_lon, north_lat, _ = Geod(ellps="WGS84").fwd(longitude, latitude, 0.0, 20.0)
    a = np.array(geodesy.utm_from_geodetic(latitude, longitude, 0.0)[:2])
    b = np.array(geodesy.utm_from_geodetic(north_lat, north_lon, 0.0)[:2])
    east, north = b - a
    assert geodesy.convergence(latitude, longitude) == pytest.approx(math.atan2(north, east) - math.pi / 2, abs=1e-6)
    assert geodesy.scale(latitude, longitude) == pytest.approx(math.hypot(east, north) / 20.0, abs=1e-7)


def test_convergence_has_its_textbook_signs_and_scale_its_value():
    north = Geodesy(origin_at(50.0, -111.0, 0.0))
    assert north.scale(50.0, -111.0) == pytest.approx(0.9996, abs=1e-9)
    assert north.convergence(50.0, -111.0) == pytest.approx(0.0, abs=1e-12)
    # Snyder: tan(convergence) = tan(longitude difference) sin(latitude), on the sphere
    assert north.convergence(50.0, -110.0) == pytest.approx(math.radians(1) * math.sin(math.radians(50)), rel=1e-3)
    assert north.convergence(50.0, -112.0) < 0
    south = Geodesy(origin_at(-50.0, -111.0, 0.0))
    assert south.convergence(-50.0, -110.0) < 0


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_tangent_plane_equals_proj_topocentric(place):
    latitude, longitude, height = place
    route = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={longitude} +lat_0={latitude} +h_0={height}"
    )
    local = LocalFrame.at(latitude, longitude, height)
    expected = route.transform(longitude + 0.02, latitude - 0.01, height + 12.0)
    found = local.from_ecef(ecef_from_geodetic(latitude - 0.01, longitude + 0.02, height + 12.0))
    assert found == pytest.approx(expected, abs=1e-7)


def test_tangent_axes_are_east_north_up():
    local = LocalFrame.at(50.0, -111.0, 100.0)
    east, north, up = (np.array(local.to_ecef(v)) - local.ecef for v in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    h = 1e-6
    x = np.array(ecef_from_geodetic(50.0, -111.0, 100.0))
    for axis, moved in (
        (east, ecef_from_geodetic(50.0, -111.0 + h, 100.0)),
        (north, ecef_from_geodetic(50.0 + h, -111.0, 100.0)),
        (up, ecef_from_geodetic(50.0, -111.0, 101.0)),
    ):
        step = np.array(moved) - x
        assert axis == pytest.approx(step / np.linalg.norm(step), abs=1e-6)


@given(latitudes, longitudes, heights)
def test_ecef_round_trip(latitude, longitude, height):
    back = geodetic_from_ecef(ecef_from_geodetic(latitude, longitude, height))
    assert back[0] == pytest.approx(latitude, abs=1e-9)
    assert math.remainder(back[1] - longitude, 360.0) == pytest.approx(0.0, abs=1e-9)
    assert back[2] == pytest.approx(height, abs=1e-6)


@given(latitudes, longitudes, heights, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_utm_and_enu_round_trips(latitude, longitude, height, north, east):
    geodesy = Geodesy(origin_at(latitude, longitude, height))
    there = (max(min(latitude + north, 84.0), -80.0), longitude + east, height + 5.0)
    for back in (
        geodesy.geodetic_from_utm(*geodesy.utm_from_geodetic(*there)),
        geodesy.geodetic_from_enu(geodesy.enu_from_geodetic(*there)),
    ):
        assert back[0] == pytest.approx(there[0], abs=1e-8)
        assert math.remainder(back[1] - there[1], 360.0) == pytest.approx(0.0, abs=1e-7)
        assert back[2] == pytest.approx(there[2], abs=1e-5)
    assert geodesy.utm_from_ecef(ecef_from_geodetic(*there)) == pytest.approx(
        geodesy.utm_from_geodetic(*there), abs=1e-5
    )


@given(latitudes, longitudes, heights)
def test_origin_is_the_zero_of_both_worlds(latitude, longitude, height):
    geodesy = Geodesy(origin_at(latitude, longitude, height))
    at_origin = geodesy.pose_in_utm(Pose.identity())
    assert at_origin.xyz == pytest.approx((0.0, 0.0, 0.0), abs=1e-5)
    place = geodesy.geodetic_from_utm(*geodesy.origin.initial_utm)
    assert at_origin.rpy[2] == pytest.approx(geodesy.convergence(*place[:2]), abs=1e-9)
    assert geodesy.enu_from_geodetic(latitude, longitude, height) == pytest.approx((0, 0, 0), abs=2e-4)


def test_pose_in_utm_counts_tilt_and_yaw_at_the_vehicle_ten_kilometers_away():
    geodesy = Geodesy(origin_at(50.0, -110.0, 700.0))
    place = (50.05, -109.9, 720.0)
    # a vehicle level there, facing true north-east there
    local = LocalFrame.at(*place)
    q = geodesy.tangent.rotation_of(local)
    tangent_to_local = Rotation.from_quat(q, scalar_first=True)
    level = tangent_to_local * Rotation.from_euler("z", 45, degrees=True)
    pose = Pose(geodesy.enu_from_geodetic(*place), level.as_quat(scalar_first=True))

    found = geodesy.pose_in_utm(pose)

    route = Proj(epsg(geodesy.origin.zone, True))
    easting, northing = route(place[1], place[0])
    convergence = math.radians(route.get_factors(place[1], place[0]).meridian_convergence)
    expected = (easting - geodesy.origin.easting, northing - geodesy.origin.northing, 20.0)
    assert found.xyz == pytest.approx(expected, abs=1e-4)
    assert found.rpy == pytest.approx((0.0, 0.0, math.radians(45) + convergence), abs=1e-9)
    # chained through the tangent plane alone it would be meters off
    assert abs(pose.xyz[2] - found.xyz[2]) > 5.0


def test_values_are_immutable_equal_and_pickle():
    geodesy = Geodesy(origin_at(50.0, -110.0, 700.0))
    assert geodesy == pickle.loads(pickle.dumps(geodesy))
    assert hash(geodesy) == hash(Geodesy(geodesy.origin))
    assert geodesy != Geodesy(origin_at(50.0, -110.0, 701.0))
    with pytest.raises(AttributeError):
        geodesy.origin = None


def test_only_localization_and_simulation_pay_for_pyproj():
    code = (
        "import sys, modelserver, modelserver.geometry.model, modelserver.messages, modelserver.query, "
        "modelserver.config.vehicle_file, modelserver.estimation.sensor_rig, modelserver.estimation.history; "
        "sys.exit('pyproj' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (1200.0, -800.0, 15.0), (-40_000.0, 60_000.0, 300.0)])
def test_given_a_pose_in_enu_then_it_comes_back_from_utm(place: tuple[float, float, float]) -> None:
    for latitude, longitude in ((50.27, -111.1), (-33.9, 151.2), (78.2, 15.6), (0.0, 9.0)):
        geodesy = Geodesy(origin_at(latitude, longitude, 700.0))
        pose = Pose.from_rpy(place, 0.1, -0.2, 2.5)
        assert geodesy.pose_in_enu(geodesy.pose_in_utm(pose)).is_close(pose, 1e-7, 1e-11)


@pytest.mark.parametrize("reference", ["World:UTM", "World:ENU"])
@given(
    place=st.sampled_from(list(PLACES.values())),
    xyz=st.tuples(*[st.floats(-3000.0, 3000.0)] * 2, st.floats(-50.0, 50.0)),
    rpy=st.tuples(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1)),
)
def test_geodetic_pose_equals_the_geodesic_to_a_point_ahead(reference, place, xyz, rpy):
    origin = origin_at(*place)
    X = Pose.from_rpy(xyz, *rpy)
    found = compute_geodetic(X, reference, origin)
    assert found is not None
    ahead = compute_geodetic(Pose(tuple(X.transform([5.0, 0.0, 0.0])), X.wxyz), reference, origin)
    assert ahead is not None
    azimuth, _, _ = Geod(ellps="WGS84").inv(
        found.longitude_deg, found.latitude_deg, ahead.longitude_deg, ahead.latitude_deg
    )
    assert math.remainder(found.heading_deg - azimuth, 360.0) == pytest.approx(0.0, abs=0.06)
    assert 0.0 <= found.heading_deg < 360.0
    absolute = Geodesy(origin).enu_from_geodetic(*found[:3])
    as_enu = X.xyz if reference == "World:ENU" else Geodesy(origin).pose_in_enu(X).xyz
    assert absolute == pytest.approx(as_enu, abs=1e-6)


@pytest.mark.parametrize("longitude", [-179.99, 179.99, 0.01, -3.0, -111.18, 8.4])
@pytest.mark.parametrize("latitude", [-79.0, -33.0, 0.0, 0.0004, 50.27, 83.0])
def test_given_places_around_an_origin_then_their_heading_has_the_exact_convergence(latitude, longitude):
    origin = origin_at(latitude, longitude, 0.0)
    geodesy = geodesy_of(origin)
    for east, north in ((0.0, 0.0), (37.0, -81.0), (-4000.0, 2500.0), (9000.0, 9000.0)):
        found = compute_geodetic(Pose.from_rpy((east, north, 0.0)), "World:UTM", origin)
        expected = 90.0 + math.degrees(geodesy.convergence(found.latitude_deg, found.longitude_deg))
        assert math.remainder(found.heading_deg - expected, 360.0) == pytest.approx(0.0, abs=math.degrees(3e-8))


def test_given_a_vertical_axis_or_another_reference_then_there_is_no_heading_or_no_place():
    origin = origin_at(*PLACES["Suffield"])
    upright = compute_geodetic(Pose.from_rpy((0.0, 0.0, 0.0), 0.0, -math.pi / 2, 0.0), "World:UTM", origin)
    assert upright is not None
    assert math.isnan(upright.heading_deg)
    assert "heading" not in str(upright)
    assert compute_geodetic(Pose.identity(), "Raptor:CG", origin) is None
    assert compute_geodetic(Pose.from_rpy((4e7, 0.0, 0.0)), "World:UTM", origin) is None


def test_magnetic_heading_is_the_true_one_less_the_declination():
    found = compute_geodetic(Pose.from_rpy((0.0, 0.0, 0.0), 0.0, 0.0, 1.0), "World:ENU", origin_at(*PLACES["Sydney"]))
    assert found is not None
    # magnetic north lies 12.8 deg east of true north there
    assert math.remainder(found.heading_deg - found.compute_magnetic_heading(1_795_000_000_000_000), 360.0) == (
        pytest.approx(12.8, abs=0.2)
    )
    assert math.isnan(found.compute_magnetic_heading(0))
