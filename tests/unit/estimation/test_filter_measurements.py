"""Every measurement model: residual 0 where state and sample agree, and its Jacobian by finite differences."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from support_cart import (
    ANTENNA,
    CAMERA,
    GEODESY,
    IMU,
    SECOND,
    SITE,
    STEERED,
    WHEELS,
    model,
    rig,
    some_nav,
)

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.estimation.filter.eskf import NavState
from modelserver.estimation.filter.measurements import REGISTRY, Innovation, Measurement, MeasurementContext, wheels
from modelserver.estimation.filter.measurements.gnss import read_velocity
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.sensor_rig import SensorRig, magnetic_field
from modelserver.messages import (
    AbsolutePoseSample,
    FixType,
    GpsSample,
    ImuSample,
    OrientationReference,
    RangeSample,
    RelativePoseSample,
    Sample,
    SensorHeader,
    WheelSample,
    WheelsSample,
    YawSource,
)
from modelserver.simulation import START_UTIME
from modelserver.transforms import Pose, so3
from modelserver.transforms.so3 import Quaternion, Vector3, cross

SETTINGS = FilterSettings(use_magnetometer=True)
FOUR = tuple(WHEELS)
HEADER = SensorHeader(START_UTIME, "test")
STEP = 1e-5
SEEDS = range(4)
DT = 0.4


# --- what each sensor measures in a state -------------------------------------------------------------------


def create_fix(nav: NavState, the_rig: SensorRig, **more: object) -> GpsSample:
    lever = the_rig.lever_arm(ANTENNA)
    latitude, longitude, height = geodetic_from_ecef(SITE.to_ecef(nav.point(lever)))
    east, north, _ = (
        b - a
        for a, b in zip(
            so3.rotate(nav.attitude, lever), so3.rotate(nav.attitude, the_rig.lever_arm(SECOND)), strict=True
        )
    )
    return GpsSample(
        HEADER, FixType.DIFFERENTIAL, latitude, longitude, height, hdop=1.0,
        velocity=nav.point_velocity(lever), baseline_yaw=math.atan2(north, east), **more,  # type: ignore[arg-type]
    )  # fmt: skip


def create_course(nav: NavState, the_rig: SensorRig) -> GpsSample:
    lever = the_rig.lever_arm(ANTENNA)
    latitude, longitude, _ = geodetic_from_ecef(SITE.to_ecef(nav.point(lever)))
    x, y, _ = nav.point_velocity(lever)
    return GpsSample(
        HEADER, FixType.DIFFERENTIAL, latitude, longitude, hdop=1.0, speed=math.hypot(x, y), course=math.atan2(y, x)
    )


def create_imu_sample(
    nav: NavState, the_rig: SensorRig, reference: OrientationReference = OrientationReference.ENU
) -> ImuSample:
    mount = model().get_transformation(IMU, "Cart:Base").pose.wxyz
    q = so3.multiply(nav.attitude, mount)
    if reference is OrientationReference.NED:
        q = so3.multiply((0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0), q)
    latitude, longitude, height = geodetic_from_ecef(SITE.ecef)
    field = magnetic_field(latitude, longitude, height, START_UTIME)
    assert field is not None
    return ImuSample(
        HEADER,
        nav.rate,
        nav.force,
        so3.rotate(so3.conjugate(so3.multiply(nav.attitude, mount)), field),
        q,
        reference,
        YawSource.TRUE,
    )


def get_steering(the_rig: SensorRig, name: str) -> float:
    return 0.3 if the_rig.kinematics == "ackermann" and name in STEERED else 0.0


def compute_speeds(nav: NavState, the_rig: SensorRig, names: tuple[str, ...]) -> dict[str, float]:
    """Return the speed of each wheel by rigid-body motion, without the additional states."""
    found = {}
    for name in names:
        contact = the_rig.pose(WHEELS[name]).xyz
        v = np.add(nav.body_velocity(the_rig.base), np.cross(nav.angular_rate, contact))
        found[name] = math.cos(get_steering(the_rig, name)) * v[0] + math.sin(get_steering(the_rig, name)) * v[1]
    return found


def create_wheels(nav: NavState, the_rig: SensorRig, names: tuple[str, ...] = ("RL", "RR")) -> WheelsSample:
    return WheelsSample(
        HEADER,
        tuple(
            WheelSample(n, speed=v, steering=get_steering(the_rig, n))
            for n, v in compute_speeds(nav, the_rig, names).items()
        ),
    )


def find_pose_in_enu(nav: NavState, the_rig: SensorRig, frame: str) -> Pose:
    """Return a frame's pose in World:ENU, through earth-centered coordinates."""
    turn = so3.conjugate(SITE.rotation_of(GEODESY.tangent))
    place = GEODESY.tangent.from_ecef(SITE.to_ecef(nav.point(the_rig.lever_arm(frame))))
    return Pose(place, so3.multiply(turn, so3.multiply(nav.attitude, the_rig.pose(frame).wxyz)))


def create_pose(nav: NavState, the_rig: SensorRig, reference: str) -> AbsolutePoseSample:
    X = find_pose_in_enu(nav, the_rig, CAMERA)
    X = GEODESY.pose_in_utm(X) if reference == "World:UTM" else X
    return AbsolutePoseSample(HEADER, CAMERA, reference, X.xyz, X.wxyz)


def create_range(nav: NavState, the_rig: SensorRig) -> RangeSample:
    beacon = (300.0, -150.0, 20.0)
    place = find_pose_in_enu(nav, the_rig, CAMERA).xyz
    return RangeSample(HEADER, CAMERA, "b", beacon, "World:ENU", math.dist(place, beacon), 0.2)


def create_relative_pose(nav: NavState, the_rig: SensorRig) -> RelativePoseSample:
    """Return the motion of the frame in a tenth of a second at constant twist, by small steps."""
    n, dt = 400, 0.1
    X_BF = the_rig.pose(CAMERA)
    v, w = nav.body_velocity(the_rig.base), nav.angular_rate
    step = Pose(
        (v[0] * dt / n, v[1] * dt / n, v[2] * dt / n), so3.exponential((w[0] * dt / n, w[1] * dt / n, w[2] * dt / n))
    )
    X = Pose.identity()
    for _ in range(n):
        X = X @ step
    found = X_BF.inverse() @ X @ X_BF
    header = SensorHeader(START_UTIME + 50_000, "vo")
    return RelativePoseSample(header, CAMERA, START_UTIME - 50_000, found.xyz, found.wxyz)


@dataclass(frozen=True)
class Case:
    """A kind of measurement, its vehicle and its sample; `tolerance` is that of the residual."""

    kind: str
    sample: object
    rig: SensorRig
    tolerance: float = 1e-7


PAIR, SKID, ACKERMANN = rig(), rig("skid_steer", FOUR), rig("ackermann", ("FL", "FR"))
CASES = {
    "position": Case("gps_position", create_fix, PAIR, 2e-7),
    "height": Case("gps_height", create_fix, PAIR, 2e-7),
    "velocity": Case("gps_velocity", create_fix, PAIR),
    "course and speed": Case("gps_velocity", create_course, PAIR),
    "baseline": Case("gps_baseline", create_fix, PAIR),
    "tilt": Case("imu_tilt", create_imu_sample, PAIR),
    "tilt ned": Case("imu_tilt", lambda nav, the_rig: create_imu_sample(nav, the_rig, OrientationReference.NED), PAIR),
    "yaw": Case("imu_yaw", create_imu_sample, PAIR),
    "magnetometer": Case("magnetometer", create_imu_sample, PAIR),
    "wheels": Case("wheel_speed", create_wheels, PAIR),
    "wheels that skid": Case("wheel_speed", lambda nav, the_rig: create_wheels(nav, the_rig, FOUR), SKID),
    "wheels that steer": Case("wheel_speed", lambda nav, the_rig: create_wheels(nav, the_rig, ("FL", "FR")), ACKERMANN),
    "pose in ENU": Case("absolute_pose", lambda nav, the_rig: create_pose(nav, the_rig, "World:ENU"), PAIR, 2e-7),
    "pose in UTM": Case("absolute_pose", lambda nav, the_rig: create_pose(nav, the_rig, "World:UTM"), PAIR, 1e-5),
    "range": Case("range", create_range, PAIR, 2e-7),
    "relative pose": Case("relative_pose", create_relative_pose, PAIR, 1e-3),
}


def prepare(case: Case, seed: int, *, extras: bool) -> tuple[Measurement, MeasurementContext, Sample]:
    setup = Setup(case.rig, SETTINGS)
    nav = some_nav(setup, seed, extras=extras)
    sample = case.sample(nav, case.rig)  # type: ignore[operator]
    (measurement,) = (each for each in setup.measurements[type(sample)] if each.kind == case.kind)
    return measurement, MeasurementContext(nav, setup.layout, SETTINGS, case.rig, SITE, GEODESY), sample


def evaluate(measurement: Measurement, context: MeasurementContext, sample: Sample) -> Innovation:
    found = measurement.evaluate(context, sample)
    assert isinstance(found, Innovation), found
    return found


def differentiate(residual: object, nav: NavState, size: int) -> np.ndarray:
    """Return the Jacobian by finite differences: what is injected into the state is subtracted from the residual."""
    columns = []
    for k in range(size):
        error = np.zeros(size)
        error[k] = STEP
        ahead = residual(nav.inject(error, nav.covariance))  # type: ignore[operator]
        behind = residual(nav.inject(-error, nav.covariance))  # type: ignore[operator]
        columns.append((behind - ahead) / (2.0 * STEP))
    return np.array(columns).T


def test_given_the_registered_measurements_then_each_has_a_case_here():
    # own: those of packages, see test_own_measurement.py
    assert {case.kind for case in CASES.values()} == set(REGISTRY) - {"own"}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", CASES)
def test_given_a_sample_of_the_state_itself_then_the_residual_is_0(name, seed):
    case = CASES[name]
    found = evaluate(*prepare(case, seed, extras=False))
    assert np.abs(found.residual).max() < case.tolerance
    assert np.linalg.eigvalsh(found.noise)[0] > 0.0
    assert found.noise == pytest.approx(found.noise.T, abs=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", CASES)
def test_given_a_small_error_of_the_state_then_the_residual_follows_the_jacobian(name, seed):
    measurement, context, sample = prepare(CASES[name], seed, extras=True)
    H = evaluate(measurement, context, sample).jacobian
    numerical = differentiate(
        lambda nav: evaluate(measurement, context._replace(nav=nav), sample).residual, context.nav, context.layout.size
    )
    assert numerical == pytest.approx(H, abs=1e-5)
    assert np.abs(H).max() > 0.01


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["wheels", "wheels that skid", "wheels that steer"])
def test_given_wheels_that_measure_travel_in_steady_motion_then_residual_and_jacobian_are_those_of_speeds(name, seed):
    measurement, context, speed = prepare(CASES[name], seed, extras=True)
    assert isinstance(speed, WheelsSample)
    before = WheelsSample(
        SensorHeader(START_UTIME - round(DT * 1e6), "test"),
        tuple(WheelSample(w.name, travel=7.0) for w in speed.wheels),
    )
    travelled = WheelsSample(
        speed.header, tuple(WheelSample(w.name, travel=7.0 + DT * w.speed, steering=w.steering) for w in speed.wheels)
    )

    def create_steady_context(nav: NavState) -> MeasurementContext:
        velocity, rate = nav.body_velocity(context.rig.base), nav.angular_rate
        nav = nav._replace(
            travel=(velocity[0] * DT, velocity[1] * DT, velocity[2] * DT),
            rotation=(rate[0] * DT, rate[1] * DT, rate[2] * DT),
        )
        return context._replace(nav=nav, age=DT, previous=before)

    found = evaluate(measurement, create_steady_context(context.nav), travelled)
    assert found.residual == pytest.approx(evaluate(measurement, context, speed).residual, abs=1e-9)
    numerical = differentiate(
        lambda nav: evaluate(measurement, create_steady_context(nav), travelled).residual,
        context.nav,
        context.layout.size,
    )
    assert numerical == pytest.approx(found.jacobian, abs=1e-5)


# --- constraints --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_given_a_small_error_of_the_state_then_the_residual_of_a_constraint_follows_its_jacobian(seed):
    setup = Setup(PAIR, SETTINGS)
    nav = some_nav(setup, seed)
    context = MeasurementContext(nav, setup.layout, SETTINGS, PAIR, SITE, GEODESY)
    rolling = Setup(rig(wheels=()), SETTINGS)
    bare = MeasurementContext(some_nav(rolling, seed), rolling.layout, SETTINGS, rolling.rig)
    for each, constrain in (
        (context, lambda s: wheels.non_holonomic(s, 0.1)),
        (bare, lambda s: wheels.non_holonomic(s, 0.1)),
        (context, lambda s: wheels.zero_velocity(s, 0.1)),
        (context, lambda s: wheels.zero_rate(s, (0.1, 0.2, 0.3), (0.0, 0.0, 0.0), 1.0)),
    ):
        numerical = differentiate(
            lambda nav, each=each, constrain=constrain: constrain(each._replace(nav=nav)).residual,
            each.nav,
            each.layout.size,
        )
        assert numerical == pytest.approx(constrain(each).jacobian, abs=1e-5)


def test_given_a_vehicle_that_moves_as_constrained_then_the_residuals_are_0():
    setup = Setup(PAIR, SETTINGS)
    nav = some_nav(setup, 3, extras=False)
    forward = so3.rotate(nav.attitude, (3.0, 0.0, 0.0))
    arm = so3.rotate(nav.attitude, cross(nav.angular_rate, PAIR.base))
    rolling = nav._replace(velocity=(forward[0] - arm[0], forward[1] - arm[1], forward[2] - arm[2]))
    context = MeasurementContext(rolling, setup.layout, SETTINGS, PAIR)
    assert wheels.non_holonomic(context, 0.1).residual == pytest.approx([0.0, 0.0], abs=1e-12)
    stationary = context._replace(nav=nav._replace(velocity=(0.0, 0.0, 0.0)))
    assert wheels.zero_velocity(stationary, 0.1).residual == pytest.approx([0.0, 0.0, 0.0])
    earth = (0.0, 4.7e-5, 5.6e-5)
    measured = np.add(nav.gyro_bias, so3.rotate(so3.conjugate(nav.attitude), earth))
    assert wheels.zero_rate(context, tuple(measured), earth, 1.0).residual == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


# --- what is rejected, and what is used instead -------------------------------------------------------------


def evaluate_sample(kind: str, sample: Sample, **given: object) -> str | Innovation:
    setup = Setup(PAIR, SETTINGS)
    nav = some_nav(setup, 1)
    context = MeasurementContext(nav, setup.layout, SETTINGS, PAIR, SITE, GEODESY)._replace(**given)
    (measurement,) = (each for each in setup.measurements[type(sample)] if each.kind == kind)
    return measurement.evaluate(context, sample)


def create_oriented_sample(q: Quaternion) -> ImuSample:
    return ImuSample(HEADER, (0.0,) * 3, (0.0,) * 3, None, q, OrientationReference.ENU)


NAN3: Vector3 = (math.nan, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "sample", "word"),
    [
        ("gps_position", GpsSample(HEADER, FixType.NONE, 50.0, -111.0), "no_fix"),
        ("wheel_speed", WheelsSample(HEADER, ()), "empty"),
        ("wheel_speed", WheelsSample(HEADER, (WheelSample("RL", speed=math.nan),)), "nan"),
        ("wheel_speed", WheelsSample(HEADER, (WheelSample("nobody", speed=1.0),)), "names"),
        ("wheel_speed", WheelsSample(HEADER, (WheelSample("RL", speed=1e3),)), "range"),
        ("imu_tilt", create_oriented_sample((0.0, 0.0, 0.0, 0.0)), "orientation"),
        ("imu_tilt", create_oriented_sample((math.nan, 0.0, 0.0, 0.0)), "orientation"),
        ("magnetometer", ImuSample(HEADER, magnetic_field=NAN3), "nan"),
        ("magnetometer", ImuSample(HEADER, magnetic_field=(9e-5, 0.0, 9e-5)), "disturbed"),
        ("absolute_pose", AbsolutePoseSample(HEADER, "Cart:Nowhere", "World:ENU", (0.0,) * 3), "frame"),
        ("absolute_pose", AbsolutePoseSample(HEADER, CAMERA, "Odom:Origin", (0.0,) * 3), "frame"),
        ("absolute_pose", AbsolutePoseSample(HEADER, CAMERA, "World:ENU", NAN3), "nan"),
        ("absolute_pose", AbsolutePoseSample(HEADER, CAMERA, "World:ENU", None, (0.0,) * 4), "nan"),
        ("absolute_pose", AbsolutePoseSample(HEADER, CAMERA, "World:ENU"), "empty"),
        ("absolute_pose", AbsolutePoseSample(HEADER, CAMERA, "World:UTM", (1e9, 0.0, 0.0)), "range"),
        ("range", RangeSample(HEADER, CAMERA, "b", (0.0,) * 3, "World:ENU", math.nan), "nan"),
        ("range", RangeSample(HEADER, CAMERA, "b", (500.0, 0.0, 0.0), "World:ENU", -1.0), "range"),
        ("range", RangeSample(HEADER, "Cart:Nowhere", "b", (500.0, 0.0, 0.0), "World:ENU", 1.0), "frame"),
        ("relative_pose", RelativePoseSample(HEADER, CAMERA, START_UTIME, (0.0,) * 3, so3.IDENTITY), "interval"),
        ("relative_pose", RelativePoseSample(HEADER, CAMERA, 0, (0.0,) * 3, so3.IDENTITY), "interval"),
        ("relative_pose", RelativePoseSample(HEADER, CAMERA, START_UTIME - 1000, NAN3, so3.IDENTITY), "nan"),
    ],
)
def test_given_a_sample_that_measures_nothing_then_the_reason_is_one_word(kind, sample, word):
    assert evaluate_sample(kind, sample) == word


def test_given_an_unaligned_state_then_measurements_in_the_world_wait_and_are_not_counted():
    setup = Setup(PAIR, SETTINGS)
    nav = some_nav(setup, 1)
    for name in ("position", "height", "velocity", "baseline", "yaw", "magnetometer", "pose in ENU", "range"):
        case = CASES[name]
        assert evaluate_sample(case.kind, case.sample(nav, PAIR), site=None) == ""  # type: ignore[operator]


def test_given_a_beacon_too_near_then_its_direction_is_unknown():
    setup = Setup(PAIR, SETTINGS)
    near = find_pose_in_enu(some_nav(setup, 1), PAIR, CAMERA).xyz
    assert evaluate_sample("range", RangeSample(HEADER, CAMERA, "b", near, "World:ENU", 0.1)) == "near"


def test_given_a_magnetic_heading_in_vertical_gyro_mode_then_it_is_monitored_and_not_used():
    measurement, context, sample = prepare(CASES["magnetometer"], 1, extras=False)
    found = evaluate(measurement, context._replace(settings=FilterSettings()), sample)
    assert found.monitored == "vertical_gyro"
    assert evaluate(measurement, context, sample).monitored == ""


def test_given_a_velocity_without_covariance_or_a_slow_course_then_the_settings_decide():
    stated = read_velocity(GpsSample(HEADER, FixType.FIX_3D, 50.0, -111.0, velocity=(1.0, 2.0, 3.0)), SETTINGS)
    assert stated is not None
    assert stated[1] == pytest.approx(np.eye(3) * SETTINGS.velocity_sigma**2)
    slow = GpsSample(HEADER, FixType.FIX_3D, 50.0, -111.0, speed=0.9 * SETTINGS.course_speed, course=1.0)
    assert read_velocity(slow, SETTINGS) is None
    fast = GpsSample(HEADER, FixType.FIX_3D, 50.0, -111.0, speed=10.0, course=0.5, speed_sigma=0.2, course_sigma=0.1)
    velocity, R = read_velocity(fast, SETTINGS) or ((), np.zeros(0))
    along, across = np.array((math.cos(0.5), math.sin(0.5))), np.array((-math.sin(0.5), math.cos(0.5)))
    assert velocity == pytest.approx((*(10.0 * along), 0.0))
    assert along @ R @ along == pytest.approx(0.2**2)
    assert across @ R @ across == pytest.approx((10.0 * 0.1) ** 2)
    assert along @ R @ across == pytest.approx(0.0, abs=1e-12)
