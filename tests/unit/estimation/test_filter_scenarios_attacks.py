"""The filter under attack: faults that an independent review found, each as the drive that showed it."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from support_filter import (
    IMU,
    MOUNT,
    ORIGIN,
    PLAIN_GPS,
    RIG,
    RTK_LIKE,
    WHEELS_TIMING,
    drive,
    simulation,
)

from benchmarks.rough_simulation import EncoderModel
from modelserver.estimation.filter import fusion, heading_alignment, heading_step
from modelserver.estimation.filter.eskf import ATTITUDE
from modelserver.estimation.filter.heading_alignment import Rotation
from modelserver.estimation.filter.localizer import FilterLocalizer, Timeline
from modelserver.estimation.filter.state import Aligned, Leveling, Setup
from modelserver.messages import GpsSample, ImuSample, Invalid, Mode, Phase, Verdict, WheelSample, WheelsSample
from modelserver.simulation import START_UTIME, DrivePhase, Event, WheelsModel, figure_eight, stationary
from modelserver.transforms import so3

pytestmark = pytest.mark.slow

EIGHT = figure_eight(speed=2.5, radius=8.0, stationary=4.0, laps=2)


def drive_straight(speed: float, acceleration: float, seconds: float, at_rest: float = 3.0) -> tuple[DrivePhase, ...]:
    return (
        DrivePhase(at_rest, 0.0),
        DrivePhase(speed / acceleration, speed),
        DrivePhase(seconds, speed),
        DrivePhase(9.0, 0.0),
    )


@pytest.mark.parametrize(("speed", "latency"), [(5.0, 0.1), (20.0, 0.05), (20.0, 0.1)])
def test_given_precise_delayed_fixes_when_driven_straight_then_the_protection_level_covers_the_distance_meanwhile(
    speed, latency
):
    gps = replace(RTK_LIKE, unstated_latency=latency)

    found = drive(simulation(drive_straight(speed, 2.5, 40.0), gps_model=gps), 45.0)

    valid = [row for row in found.rows if row.valid]
    assert len(valid) > 50
    outside = [row for row in valid if row.off > row.estimate.horizontal_protection_level]
    assert len(outside) <= 2


def test_given_a_hard_start_then_the_height_stays_that_of_the_fixes():
    found = drive(simulation(drive_straight(20.0, 2.5, 40.0), gps_model=RTK_LIKE), 45.0)

    off = [row.estimate.enu.xyz[2] - found.simulation.truth(row.estimate.utime).enu.xyz[2] for row in found.between(15)]
    assert max(map(abs, off)) < 1.0
    assert not found.decisions("gps_height", Verdict.REJECTED)


def test_given_wheels_that_jitter_at_rest_then_leveling_ends_at_its_timeout():
    rng = np.random.default_rng(2)

    def add_jitter(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, WheelsSample):
                event = replace(
                    event,
                    wheels=tuple(
                        WheelSample(wheel.name, wheel.travel + float(rng.normal(0.0, 0.004)), 0.004)
                        for wheel in event.wheels
                    ),
                )
            yield event

    found = drive(simulation(stationary(20.0)), 8.0, transform=add_jitter)

    assert found.localizer.head.phase is not Phase.LEVELING


def test_given_encoders_that_are_stuck_on_a_smooth_road_then_odom_continues():
    encoder = EncoderModel(stuck=(("left", 25.0), ("right", 25.0)))
    wheels = WheelsModel(WHEELS_TIMING, encoder=encoder)

    found = drive(simulation(drive_straight(5.0, 1.0, 40.0), wheels_model=wheels), 45.0)

    distance = math.dist(found.at(30.0).estimate.odom.xyz, found.at(44.0).estimate.odom.xyz)
    assert distance == pytest.approx(70.0, abs=5.0)
    assert not [word for word in found.decisions("zero_rate", Verdict.USED) if found.seconds(word) > 10.0]


def test_given_encoders_stuck_at_rest_when_it_starts_without_fixes_then_speed_and_heading_do_not_rest_on_them():
    phases = (*EIGHT, DrivePhase(10.0, 0.0), DrivePhase(4.0, 4.0), DrivePhase(30.0, 4.0), DrivePhase(4.0, 0.0))
    at = sum(phase.duration for phase in EIGHT) + 5.0
    encoder = EncoderModel(stuck=(("left", at), ("right", at)))
    gps = replace(PLAIN_GPS, outages=((at, at + 25.0),))
    wheels = WheelsModel(WHEELS_TIMING, encoder=encoder)

    found = drive(simulation(phases, gps_model=gps, wheels_model=wheels), at + 35.0)

    # it moves from at + 5 on; the wheels are found to be stuck a second later
    driving = found.between(at + 7.0, at + 9.0)
    assert all(abs(row.estimate.motion.velocity[0] - row.speed) < 0.2 for row in driving)
    # the constraint has shown a heading by a speed that nothing measured
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in found.between(at + 25.5))
    assert found.last.valid


@pytest.mark.parametrize(
    "unmeasured",
    [
        pytest.param(lambda common: common._replace(wheels=common.wheels.suspect()), id="stuck wheels"),
        pytest.param(lambda common: common._replace(mode=Mode.NO_WHEELS), id="no wheels"),
    ],
)
def test_given_a_speed_that_nothing_measures_then_the_constraint_changes_no_gyro_bias_and_shows_no_heading(
    unmeasured,
):
    gps = replace(PLAIN_GPS, outages=((25.0, 60.0),))
    localizer = drive(simulation(EIGHT, gps_model=gps), 35.0).localizer
    state, setup = localizer.head, localizer.setup
    assert isinstance(state, Aligned)
    x, y, z = state.nav.velocity
    sliding = state._replace(nav=state.nav._replace(velocity=(x - 0.2 * y, y + 0.2 * x, z)))
    stuck = sliding._replace(common=unmeasured(state.common))

    def constrain(slid: Aligned) -> tuple[float, float, np.ndarray]:
        """Return the change of the bias, the sideways speed, and the change of the variances."""
        utime = slid.nav.utime + 100_000
        before = fusion.propagate_covariance(setup, slid).nav.covariance
        after, (decision,) = fusion.fuse_non_holonomic(setup, slid, utime)
        assert decision.verdict is Verdict.USED
        learned = after.nav.gyro_bias[2] - slid.nav.gyro_bias[2]
        return learned, after.nav.body_velocity(RIG.base)[1], np.diagonal(after.nav.covariance - before)

    slid = abs(sliding.nav.body_velocity(RIG.base)[1])
    changed, slides, known = constrain(sliding)
    held, slides_too, known_too = constrain(stuck)
    assert abs(changed) > 1e-6
    assert held == pytest.approx(0.0, abs=1e-12)
    assert known[8] < 0.0 > known[11]
    assert known_too[8] == 0.0 == known_too[11]
    assert known_too[4] == pytest.approx(known[4], rel=0.01)
    assert slides_too == pytest.approx(slides, abs=0.01)
    assert abs(slides) < 0.9 * slid


def test_given_a_heading_that_is_lost_and_half_a_turn_wrong_then_it_is_found_as_at_the_start():
    run = simulation(EIGHT, gps_model=PLAIN_GPS)
    localizer = drive(run, 12.0).localizer
    state, setup = localizer.head, localizer.setup
    assert isinstance(state, Aligned)
    nav = heading_alignment.rotate(state.nav, Rotation(math.pi, 1.0), setup.layout)
    lost = state._replace(nav=nav._replace(position=state.nav.position), bank=None, bounds=None)
    last = localizer.clocks.newest
    localizer = localizer._replace(timeline=Timeline(lost), head=lost)

    found = drive(
        run,
        40.0,
        localizer=localizer,
        transform=lambda events: (event for event in events if event.header.host_utime > last),
    )

    (reported,) = found.decisions("gps_position", Verdict.RESET, "the heading is lost")
    assert found.seconds(reported) < 13.0
    assert {row.estimate.pose_epoch for row in found.rows} == {state.common.epoch, state.common.epoch + 1}
    assert all(row.valid and abs(row.heading) < row.estimate.heading_protection_level for row in found.between(25.0))
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in found.rows if row.valid)


@pytest.mark.parametrize("is_along_body", [True, False])
def test_given_a_heading_that_is_lost_then_only_a_velocity_along_the_body_stays_known(is_along_body):
    localizer = drive(simulation(EIGHT, gps_model=PLAIN_GPS), 12.0).localizer
    state = localizer.head
    assert isinstance(state, Aligned)
    x, y, _ = state.nav.velocity
    P = 1e-6 * np.eye(len(state.nav.covariance))
    turned = np.zeros(len(P))
    turned[8] = 1.0
    if is_along_body:
        turned[3:5] = -y, x
    P += np.outer(turned, turned)

    lost = heading_step.lose_heading(state._replace(nav=state.nav._replace(covariance=P)))

    after = lost.nav.covariance
    across = np.array((-y, x)) / math.hypot(x, y)
    sigma = math.sqrt(across @ after[3:5, 3:5] @ across)
    assert sigma == pytest.approx((1e-3 if is_along_body else 1.0) * math.hypot(x, y), rel=0.1)
    assert not after[8].any()
    assert np.linalg.eigvalsh(after).min() > -1e-12
    assert (lost.earth.rotation[:2], lost.site) == ((0.0, 0.0), state.site)


def test_given_an_imu_that_repeats_a_sample_in_a_turn_then_the_protection_level_covers_the_turn_meanwhile():
    begin, end = START_UTIME + 25_000_000, START_UTIME + 25_900_000
    held: list[ImuSample] = []

    def repeat(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample) and begin <= event.header.utime < end:
                held[:] = held or [event]
                event = replace(held[0], header=event.header)
            yield event

    found = drive(simulation(EIGHT), 45.0, transform=repeat, every=0.1)

    assert found.decisions("inertial", Verdict.MONITORED, "interpolated")
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in found.between(20.0) if row.valid)


IMU_VALUES = ("angular_velocity", "specific_force")
FIX_VALUES = ("latitude_deg", "longitude_deg")


def fill_gap(events: Iterable[Event], begin: float, end: float) -> Iterator[Event]:
    """Replace what IMU and receiver measured between two times by straight lines, and drop the wheels."""
    rows = [event for event in events if not isinstance(event, WheelsSample)]

    def seconds(event: Event) -> float:
        return (event.header.utime - START_UTIME) * 1e-6

    for event in rows:
        if not begin <= seconds(event) < end:
            yield event
            continue
        same = [each for each in rows if type(each) is type(event)]
        first = max((each for each in same if seconds(each) < begin), key=seconds)
        last = min((each for each in same if seconds(each) >= end), key=seconds)
        share = (seconds(event) - seconds(first)) / (seconds(last) - seconds(first))
        names = IMU_VALUES if isinstance(event, ImuSample) else FIX_VALUES
        ends = [np.array([getattr(each, name) for name in names]) for each in (first, last)]
        values = (ends[0] + share * (ends[1] - ends[0])).tolist()
        numbers = [tuple(each) if isinstance(each, list) else each for each in values]
        yield replace(event, **dict(zip(names, numbers, strict=True)))


@pytest.mark.parametrize("begin", [14.2, 24.2])
def test_given_a_unit_whose_gap_was_filled_by_straight_lines_in_a_turn_then_its_fixes_do_not_turn_the_heading(begin):
    eight = figure_eight(speed=5.0, radius=10.0, stationary=4.0, laps=2)
    gone = simulation(eight, gps_model=replace(RTK_LIKE, has_velocity=False))

    found = drive(gone, 40.0, transform=lambda events: fill_gap(events, begin, begin + 2.0))

    assert found.decisions("gps_position", Verdict.REJECTED, "interpolated")
    assert isinstance(found.localizer.head, Aligned)
    assert found.localizer.head.reckoning.turn_variance > 0.0
    assert all(abs(row.heading) < math.radians(1.3) for row in found.between(begin + 3.5))
    assert all(row.valid for row in found.between(begin + 7.0))


EIGHTS_WITH_A_RIDE = (*EIGHT, *drive_straight(4.0, 0.4, 40.0, 10.0), DrivePhase(20.0, 0.0), *EIGHT)
RIDE = (sum(each.duration for each in EIGHT) + 5.0, sum(each.duration for each in EIGHTS_WITH_A_RIDE[: -len(EIGHT)]))


def transport(events: Iterable[Event], angle: float) -> Iterator[Event]:
    """Turn the way of a vehicle by an angle during the ride, but not the vehicle, and drop the wheels."""
    turn = np.array(so3.matrix_rows(so3.from_rpy(0.0, 0.0, angle)))
    mount = np.array(so3.matrix_rows(MOUNT.wxyz))
    start: complex | None = None
    left = 0j
    for event in events:
        if isinstance(event, WheelsSample):
            continue
        t = (event.header.utime - START_UTIME) * 1e-6
        if isinstance(event, ImuSample) and RIDE[0] <= t < RIDE[1]:
            force = mount.T @ turn @ mount @ np.array(event.specific_force)
            yield replace(event, specific_force=tuple(force.tolist()))
        elif isinstance(event, GpsSample) and t >= RIDE[0]:
            narrow = math.cos(math.radians(event.latitude_deg))
            at = complex(event.longitude_deg * narrow, event.latitude_deg)
            start = at if start is None else start
            if t < RIDE[1]:
                left = (at - start) * (cmath.rect(1.0, angle) - 1.0)
            at += left
            yield replace(event, longitude_deg=at.real / narrow, latitude_deg=at.imag)
        else:
            yield event


@pytest.mark.parametrize(("angle", "has_velocity"), [(25.0, False), (25.0, True), (50.0, True)])
def test_given_a_vehicle_that_is_transported_beside_its_own_axis_then_no_valid_heading_is_that_of_the_course(
    angle, has_velocity
):
    gone = simulation(EIGHTS_WITH_A_RIDE, gps_model=replace(PLAIN_GPS, has_velocity=has_velocity))
    seconds = sum(each.duration for each in EIGHTS_WITH_A_RIDE)

    found = drive(gone, seconds, transform=lambda events: transport(events, math.radians(angle)))

    assert any("own axis" in each.reason for each in found.ledger if each.verdict is Verdict.RESET)
    assert any("by itself" in each.reason for each in found.decisions("consistency"))
    assert not all(row.valid for row in found.between(*RIDE))
    valid = [row for row in found.rows if row.valid]
    limit = found.localizer.summary(found.localizer.utime).heading_limit
    assert all(abs(row.heading) < limit for row in valid)
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in valid)
    assert found.last.valid
    assert abs(found.last.heading) < math.radians(3.0)


def test_given_a_carrier_that_turns_when_the_wheels_are_at_rest_then_no_pose_is_wrong_and_valid():
    phases = (*EIGHT, DrivePhase(80.0, 0.0), *EIGHT)
    begin = sum(each.duration for each in EIGHT) + 10.0
    rate, speed, seconds = 0.03, 2.0, 60.0

    def carry(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            t = min(max((event.header.utime - START_UTIME) * 1e-6 - begin, 0.0), seconds)
            if isinstance(event, ImuSample) and 0.0 < t < seconds:
                turn = so3.rotate(so3.conjugate(MOUNT.wxyz), (0.0, 0.0, rate))
                event = replace(event, angular_velocity=so3.add(event.angular_velocity, turn))
            elif isinstance(event, GpsSample):
                # along an arc; after it, the drive is turned by it
                moved = speed / rate * (cmath.rect(1.0, rate * t) - 1.0)
                north, east = moved.imag / 111_200.0, moved.real / 111_200.0
                event = replace(
                    event,
                    latitude_deg=event.latitude_deg + north,
                    longitude_deg=event.longitude_deg + east / math.cos(math.radians(event.latitude_deg)),
                )
            yield event

    found = drive(simulation(phases), begin + 70.0, transform=carry)

    riding = found.between(begin + 20.0, begin + seconds)
    assert not any(row.valid for row in riding)
    reasons = [each.reason for each in found.ledger if each.verdict is not Verdict.USED]
    assert any("it is transported" in each or "it moves" in each for each in reasons)


@pytest.mark.parametrize("step", [0.02, -0.02])
def test_given_a_gyro_whose_bias_changes_at_speed_then_it_is_corrected_for_good_by_wheels_of_unequal_size(step):
    phases = (*EIGHT[:-1], DrivePhase(6.0, 8.0), DrivePhase(70.0, 8.0), DrivePhase(6.0, 0.0))
    begin = sum(each.duration for each in EIGHT[:-1]) + 16.0

    def change(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample) and event.header.utime >= START_UTIME + round(1e6 * begin):
                turn = so3.rotate(so3.conjugate(MOUNT.wxyz), (0.0, 0.0, step))
                event = replace(event, angular_velocity=so3.add(event.angular_velocity, turn))
            elif isinstance(event, WheelsSample):
                wheels = (replace(each, travel=each.travel * (1.0 + 0.005 * n)) for n, each in enumerate(event.wheels))
                event = replace(event, wheels=tuple(wheels))
            yield event

    found = drive(simulation(phases), begin + 60.0, transform=change)

    assert found.decisions("consistency", Verdict.RESET)
    healed = found.between(begin + 25.0)
    assert all(row.valid for row in healed)
    assert all(abs(row.heading) < math.radians(3.0) for row in healed)
    # the sensor's own bias is 0.002
    assert found.localizer.head.nav.gyro_bias[2] == pytest.approx(step, abs=0.004)


def test_given_a_long_gap_of_the_imu_on_a_vehicle_without_wheels_then_it_is_leveled_again():
    fixes = replace(PLAIN_GPS, has_velocity=False)
    gone = simulation(EIGHT * 2, imu_model=replace(IMU, outages=((25.0, 60.0),)), gps_model=fixes)

    def drop_wheels(events: Iterable[Event]) -> Iterator[Event]:
        return (event for event in events if not isinstance(event, WheelsSample))

    found = drive(gone, 75.0, transform=drop_wheels)

    assert [word for word in found.decisions("inertial", Verdict.RESET) if "after a gap" in word.reason]
    valid = [row for row in found.between(60.0) if row.valid]
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in valid)


def test_given_two_sources_of_wheels_then_one_is_used_and_the_other_is_reported():
    def add_source(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            yield event
            if isinstance(event, WheelsSample):
                yield replace(event, header=replace(event.header, source="other", utime=event.header.utime + 1000))

    found = drive(simulation(EIGHT), 30.0, transform=add_source)

    words = [word for word in found.ledger if word.source == "other"]
    assert {(word.verdict, word.reason) for word in words} == {(Verdict.REJECTED, "source")}
    assert found.last.valid


def create_swapped_wheels(names: set[str]) -> WheelsModel:
    return WheelsModel(WHEELS_TIMING, encoder=EncoderModel(swapped=frozenset(names)))


@pytest.mark.parametrize("names", [{"left"}, {"left", "right"}])
def test_given_wheels_with_the_wrong_sign_then_the_heading_is_found_without_them_or_is_not_valid(names):
    found = drive(
        simulation(drive_straight(3.0, 1.0, 15.0, 4.0) + EIGHT, wheels_model=create_swapped_wheels(names)), 45.0
    )

    valid = [row for row in found.rows if row.valid]
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in valid)
    if len(names) == 1:
        assert len(valid) > 40
    else:
        # forces and wheels contradict each other as they do with an IMU mounted backward
        assert Invalid.MISMOUNTED in found.last.estimate.invalid


def test_given_an_accelerometer_that_measures_in_g_then_gravity_is_not_found_and_the_pose_is_never_valid():
    def convert_to_g(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample) and event.specific_force is not None:
                x, y, z = event.specific_force
                event = replace(event, specific_force=(x / 9.81, y / 9.81, z / 9.81))
            yield event

    found = drive(simulation(EIGHT), 20.0, transform=convert_to_g)

    assert found.decisions("inertial", Verdict.REJECTED, "gravity")
    assert not any(row.valid for row in found.rows)


# --- the order of arrival -----------------------------------------------------------------------------------


def process_all(events: Iterable[Event]) -> FilterLocalizer:
    found = FilterLocalizer.start(Setup(RIG), ORIGIN)
    for event in events:
        found, _ = found.process(event)
    return found


def are_same(a: FilterLocalizer, b: FilterLocalizer) -> bool:
    assert not isinstance(a.head, Leveling)
    assert not isinstance(b.head, Leveling)
    x, y = a.head.nav, b.head.nav
    return x.position == y.position and x.attitude == y.attitude and bool((x.covariance == y.covariance).all())


def test_given_two_samples_of_one_source_and_instant_then_the_same_one_is_used_in_any_order():
    events = list(simulation(EIGHT).events(20.0))
    at = next(n for n, event in enumerate(events) if n > len(events) // 2 and isinstance(event, GpsSample))
    first = events[at]
    assert isinstance(first, GpsSample)
    header = replace(first.header, seq=first.header.seq + 500)
    second = replace(first, header=header, latitude_deg=first.latitude_deg + 1e-6)

    one = process_all([*events[:at], first, second, *events[at + 1 :]])
    other = process_all([*events[:at], second, first, *events[at + 1 :]])

    assert are_same(one, other)


@pytest.mark.parametrize("bits", [8, 0], ids=["counts to 255", "stamps that jitter"])
def test_given_sequence_numbers_that_do_not_follow_the_stamps_then_any_order_within_the_horizon_gives_the_same_state(
    bits,
):
    rng = np.random.default_rng(5)
    events = []
    for event in simulation(EIGHT).events(20.0):
        header = event.header
        if bits:
            header = replace(header, seq=header.seq % 2**bits)
        elif isinstance(event, ImuSample) and header.seq % 50 == 7:
            header = replace(header, utime=header.utime + 25_000)
        events.append(replace(event, header=header))
    late = sorted(
        enumerate(events), key=lambda each: each[0] + (rng.uniform(0.0, 12.0) if each[0] < len(events) - 90 else 0.0)
    )

    assert are_same(process_all(events), process_all(event for _, event in late))


# --- algebra ------------------------------------------------------------------------------------------------


def test_given_an_attitude_error_when_injected_then_the_covariance_is_rotated_with_the_reset():
    setup = Setup(RIG)
    found = drive(simulation(EIGHT), 12.0).localizer.head.nav
    assert isinstance(FilterLocalizer.start(setup, ORIGIN).head, Leveling)
    e = np.zeros(setup.layout.size)
    e[ATTITUDE] = (0.06, -0.04, 0.08)
    before = np.zeros((setup.layout.size, setup.layout.size))
    before[ATTITUDE, ATTITUDE] = np.diag((1.0, 4.0, 9.0))

    def compute_remainder(theta: np.ndarray) -> np.ndarray:
        """Return what remains of a true error about the fixed axes after the estimated one was injected."""
        true = so3.multiply(so3.exponential(tuple(theta)), found.attitude)
        after = so3.multiply(so3.exponential((0.06, -0.04, 0.08)), found.attitude)
        return np.array(so3.logarithm(so3.multiply(true, so3.conjugate(after))))

    h = 1e-6
    J = np.column_stack(
        [
            (compute_remainder(e[ATTITUDE] + h * axis) - compute_remainder(e[ATTITUDE] - h * axis)) / (2 * h)
            for axis in np.eye(3)
        ]
    )

    after = found.inject(e, before).covariance[ATTITUDE, ATTITUDE]

    # to first order in the error: a wrong sign is off by twice as much as none
    expected = J @ before[ATTITUDE, ATTITUDE] @ J.T
    assert np.abs(after - expected).max() < 0.25 * np.abs(before[ATTITUDE, ATTITUDE] - expected).max()


def test_given_an_element_that_changes_then_others_change_as_is_expected_with_it_and_a_certain_one_not_at_all():
    size = Setup(RIG).layout.size
    P = np.eye(size)
    P[0, 11] = P[11, 0] = 0.5
    P[10, 10] = 0.0
    nav = drive(simulation(EIGHT), 12.0).localizer.head.nav._replace(covariance=P)

    changed = nav.change(11, 0.02)

    assert changed.gyro_bias[2] - nav.gyro_bias[2] == pytest.approx(0.02)
    assert changed.position[0] - nav.position[0] == pytest.approx(0.01)
    assert changed.covariance is P
    assert nav.change(10, 0.0) is nav
