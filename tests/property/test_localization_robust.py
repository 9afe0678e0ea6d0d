"""With any samples, neither raw mode nor the filter raises or answers nonsense."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import pytest
import support_cart
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from support_localization import MOUNTS, ORIGIN, START, Drive, Sensors, constant

from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.messages import (
    AbsolutePoseSample,
    FixType,
    GpsSample,
    ImuSample,
    Invalid,
    JointSample,
    JointsSample,
    Mode,
    OrientationReference,
    RangeSample,
    Rejected,
    RelativePoseSample,
    SensorHeader,
    SwitchMode,
    WheelSample,
    WheelsSample,
    YawSource,
)
from modelserver.simulation import START_UTIME, Event

pytestmark = pytest.mark.slow

wild = st.floats(allow_nan=True, allow_infinity=True, width=64)
number = st.one_of(wild, st.floats(-1e3, 1e3), st.sampled_from((0.0, -0.0, 1.0, math.nan, math.inf, 1e308, 5e-324)))
vector = st.none() | st.tuples(number, number, number)
matrix = st.none() | st.tuples(*[number] * 9) | st.just((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 4.0))
utime = st.one_of(
    st.integers(START, START + 5_000_000),
    st.integers(START - 20_000_000, START + 60_000_000),
    st.sampled_from((0, 1, -1, 2**63 - 1, -(2**63), START)),
)
header = st.builds(SensorHeader, utime, st.sampled_from(("gps", "imu", "")))
latitude = number | st.floats(50.26, 50.28) | st.floats(-90, 90)
longitude = number | st.floats(-111.2, -111.0) | st.floats(-180, 360)
gps = st.builds(
    GpsSample,
    header,
    st.sampled_from(FixType),
    latitude,
    longitude,
    height_ellipsoidal=number,
    height_msl=number,
    undulation=number,
    satellites=st.integers(-1, 40),
    hdop=number,
    vdop=number,
    position_covariance=matrix,
    velocity=vector,
    velocity_covariance=matrix,
    velocity_latency=number,
    speed=number,
    speed_sigma=number,
    course=number,
    course_sigma=number,
    baseline_yaw=number,
)
imu = st.builds(
    ImuSample,
    header,
    angular_velocity=vector,
    specific_force=vector,
    magnetic_field=vector,
    orientation=st.none() | st.tuples(number, number, number, number),
    orientation_reference=st.sampled_from(OrientationReference),
    yaw_source=st.sampled_from(YawSource),
)
other = st.sampled_from(
    (
        WheelsSample(SensorHeader(START), (WheelSample("left", math.nan),)),
        JointsSample(SensorHeader(START), (JointSample("pan", math.inf),)),
    )
)
GOOD = Sensors().events(Drive(6.0, speed=constant(2.0), yaw_rate=constant(0.2)))

REASONS = {"out_of_sequence", "duplicate", "future", "nan", "range", "gap", "no_fix", "satellites", "dilution"} | {
    "sigma",
    "course",
}


def check(estimate):
    numbers = [*estimate.odom.xyz, *estimate.odom.wxyz]
    for pose in (estimate.enu, estimate.utm):
        if pose is not None:
            numbers += [*pose.xyz, *pose.wxyz]
    numbers += estimate.covariance or ()
    numbers += estimate.odom_covariance or ()
    assert all(map(math.isfinite, numbers))
    assert (estimate.enu is None) == (estimate.utm is None)
    if estimate.utm is None:
        assert estimate.invalid
    else:
        assert math.isfinite(estimate.horizontal_protection_level)
        assert 0.0 < estimate.heading_protection_level <= math.pi


# without shrinking: on samples of thirty fields it takes minutes
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


@settings(max_examples=60, phases=PHASES)
@given(
    samples=st.lists(st.one_of(gps, imu, other, st.sampled_from(GOOD)), max_size=40),
    asked=st.lists(utime, min_size=1, max_size=4),
    origin=st.sampled_from((None, ORIGIN)),
    warm=st.booleans(),
)
def test_given_any_samples_when_taken_then_nothing_is_raised_and_numbers_are_finite(samples, asked, origin, warm):
    localizer = RawLocalizer.start(MOUNTS, None, origin)
    if warm:
        for sample in GOOD:
            localizer, _ = localizer.process(sample)
    for sample in samples:
        localizer, notes = localizer.process(sample)
        for note in notes:
            if isinstance(note, Rejected):
                assert note.reason in REASONS
        check(localizer.estimate(sample.header.utime))
    for at in asked:
        check(localizer.estimate(at))


@lru_cache
def half_a_minute() -> list[GpsSample | ImuSample]:
    return Sensors().events(Drive(30.0, speed=constant(2.0), yaw_rate=constant(0.2)))


@settings(max_examples=15, phases=PHASES)
@given(samples=st.lists(st.one_of(gps, imu), max_size=20))
def test_given_any_samples_when_good_ones_follow_then_the_pose_is_valid_again(samples):
    localizer = RawLocalizer.start(MOUNTS, None, ORIGIN)
    for sample in samples:
        localizer, _ = localizer.process(sample)
    for sample in half_a_minute():
        localizer, _ = localizer.process(sample)
    assert localizer.estimate(localizer.utime).invalid == Invalid(0)


# --- the filter ---------------------------------------------------------------------------------------------

turned = st.none() | st.tuples(number, number, number, number) | st.just((1.0, 0.0, 0.0, 0.0))
frames = st.sampled_from((support_cart.CAMERA, support_cart.BASE, "Cart:Nowhere", "", "World:UTM"))
worlds = st.sampled_from(("World:ENU", "World:UTM", "Odom:Origin", ""))
large = st.none() | st.tuples(*[number] * 36)
place = st.tuples(number, number, number)
any_header = st.builds(SensorHeader, utime, st.sampled_from(("gps", "imu", "wheels", "")), st.integers(0, 9))
wheel = st.builds(
    WheelSample,
    st.sampled_from(("RL", "RR", "x")),
    travel=number,
    travel_sigma=number,
    speed=number,
    speed_sigma=number,
    steering=number,
)
further = st.one_of(
    st.builds(WheelsSample, any_header, st.lists(wheel, max_size=3).map(tuple)),
    st.builds(AbsolutePoseSample, any_header, frames, worlds, st.none() | place, turned, large),
    st.builds(
        RelativePoseSample, any_header, frames, utime, place, turned.map(lambda q: q or (0.0, 0.0, 0.0, 0.0)), large
    ),
    st.builds(RangeSample, any_header, frames, st.just("b"), place, worlds, number, number),
    st.builds(SwitchMode, any_header, st.sampled_from([mode for mode in Mode if mode is not Mode.RAW])),
)


@lru_cache
def drive_filter() -> tuple[list[object], FilterLocalizer]:
    """Ten good seconds, and what the filter knows after them, the lead's clock as that of the wild samples."""
    samples: list[object] = [
        replace(each, header=replace(each.header, utime=each.header.utime - START_UTIME + START))
        for each in support_cart.drive(10.0, imu_hz=20.0)[1]
    ]
    localizer = support_cart.localizer(FilterSettings(use_magnetometer=True))
    for sample in samples:
        localizer, _ = localizer.process(sample)
    assert localizer.estimate(localizer.utime).invalid == Invalid(0)
    return samples, localizer


def check_state(localizer: FilterLocalizer) -> None:
    state = localizer.navigation(localizer.utime)
    if state is not None:
        assert all(
            map(math.isfinite, (*state.values, *state.covariance, *state.linear_velocity, *state.twist_covariance))
        )


@settings(max_examples=50, phases=PHASES, deadline=None)
@given(
    samples=st.lists(st.one_of(gps, imu, further), max_size=25),
    asked=st.lists(utime, min_size=1, max_size=3),
    warm=st.booleans(),
)
def test_given_any_samples_when_the_filter_fuses_them_then_it_neither_raises_nor_answers_nonsense(samples, asked, warm):
    localizer = drive_filter()[1] if warm else support_cart.localizer()
    for sample in samples:
        localizer, _ = localizer.process(sample)
        check(localizer.estimate(sample.header.utime))
    check_state(localizer)
    for at in asked:
        check(localizer.estimate(at))


@lru_cache
def forty_seconds() -> list[Event]:
    return support_cart.drive(40.0, imu_hz=20.0)[1]


@settings(max_examples=6, phases=PHASES, deadline=None)
@given(
    samples=st.lists(st.one_of(gps, imu, further.filter(lambda each: not isinstance(each, SwitchMode))), max_size=20)
)
def test_given_any_samples_when_good_ones_follow_then_the_filters_pose_is_valid_again(samples):
    localizer = support_cart.localizer()
    for sample in samples:
        localizer, _ = localizer.process(sample)
    for sample in forty_seconds():
        localizer, _ = localizer.process(sample)
    assert localizer.estimate(localizer.utime).invalid == Invalid(0)
