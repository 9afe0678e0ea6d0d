"""Whatever the samples say, raw mode neither raises nor says nonsense."""

from __future__ import annotations

import math

from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from support_localization import MOUNTS, ORIGIN, START, Drive, Sensors, constant

from modelserver.localization.raw.localizer import RawLocalizer
from modelserver.messages import (
    FixType,
    GpsSample,
    ImuSample,
    Invalid,
    JointSample,
    JointsSample,
    OrientationReference,
    Rejected,
    SensorHeader,
    WheelSample,
    WheelsSample,
    YawSource,
)

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

REASONS = {"order", "duplicate", "future", "nan", "range", "gap", "no_fix", "satellites", "dilution", "sigma"} | {
    "jump",
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
        assert math.isfinite(estimate.horizontal_bound)
        assert 0.0 < estimate.heading_bound <= math.pi


# without shrinking: on samples of thirty fields it takes minutes
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


@settings(max_examples=120, phases=PHASES)
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
            localizer, _ = localizer.take(sample)
    for sample in samples:
        localizer, notes = localizer.take(sample)
        for note in notes:
            if isinstance(note, Rejected):
                assert note.reason in REASONS
        check(localizer.estimate(sample.header.utime))
    for at in asked:
        check(localizer.estimate(at))


@settings(max_examples=15, phases=PHASES)
@given(samples=st.lists(st.one_of(gps, imu), max_size=20))
def test_given_any_samples_when_good_ones_follow_then_the_pose_is_valid_again(samples):
    localizer = RawLocalizer.start(MOUNTS, None, ORIGIN)
    for sample in samples:
        localizer, _ = localizer.take(sample)
    for sample in Sensors().events(Drive(30.0, speed=constant(2.0), yaw_rate=constant(0.2))):
        localizer, _ = localizer.take(sample)
    assert localizer.estimate(localizer.utime).invalid == Invalid(0)
