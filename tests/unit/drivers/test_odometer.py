"""From counters to signed travel."""

from __future__ import annotations

import math

import pytest

from msdrivers.devices.can import CanFrameAssembler
from msdrivers.devices.wheels import Odometer
from msdrivers.endpoint import FrameKey

S = 1_000_000_000


def travels(odometer: Odometer, *counts: tuple[float, int], direction: int | None = None) -> list[tuple[float, str]]:
    found = []
    for seconds, count in counts:
        odometer, travel, reason = odometer.update(count, round(seconds * S), direction)
        found.append((travel, reason))
    return found


SMALL = Odometer(256, 0.01, max_speed=5.0, delay=0.0)


def test_given_counts_up_and_down_over_the_wrap_then_travel_is_signed() -> None:
    found = travels(SMALL, (0.0, 250), (0.1, 254), (0.2, 3), (0.3, 254), (0.4, 240))
    assert [round(travel, 9) for travel, _ in found] == [0.0, 0.04, 0.09, 0.04, -0.10]


@pytest.mark.parametrize("bits", [8, 12, 16, 32])
def test_given_many_turns_of_the_counter_either_way_then_nothing_is_lost(bits: int) -> None:
    step = (1 << bits) // 5
    odometer = Odometer(1 << bits, 0.01, max_speed=step * 0.01 * 12.0, delay=0.0)
    count, way = 3, 0
    for n in range(200):
        move = step if n % 50 < 35 else -step
        count, way = (count + move) % (1 << bits), way + (move if n else 0)
        odometer, travel, reason = odometer.update(count, n * S // 10)
        assert reason == ""
        assert travel == pytest.approx(way * 0.01)


def test_given_a_signed_counter_then_it_wraps_as_well() -> None:
    found = travels(SMALL, (0.0, 126), (0.1, -127), (0.2, 126))
    assert [round(travel, 9) for travel, _ in found] == [0.0, 0.03, 0.0]


def test_given_an_encoder_mounted_the_other_way_then_forward_is_positive() -> None:
    found = travels(Odometer(256, -0.01, 5.0, 0.0), (0.0, 10), (0.1, 5))
    assert found[-1] == (pytest.approx(0.05), "")


def test_given_one_damaged_count_then_only_that_one_has_no_travel() -> None:
    found = travels(SMALL, (0.0, 10), (0.01, 110), (0.02, 12), (0.03, 13))
    assert [reason for _, reason in found] == ["", "jump", "", ""]
    assert math.isnan(found[1][0])
    assert found[3][0] == pytest.approx(0.03)


def test_given_a_counter_that_restarts_then_travel_goes_on_from_where_it_was() -> None:
    found = travels(SMALL, (0.0, 10), (0.1, 60), (0.2, 165), (0.3, 169), (0.4, 173))
    assert [reason for _, reason in found] == ["", "", "jump", "resumed", ""]
    assert [round(travel, 9) for travel, reason in found if reason != "jump"] == [0.0, 0.5, 0.54, 0.58]


def test_given_random_counts_then_none_is_believed_for_long() -> None:
    odometer = Odometer(1 << 32, 0.01, 5.0, 0.0)
    odometer, _, _ = odometer.update(7, 0)
    for n in range(1, 100):
        odometer, travel, reason = odometer.update(n * 0x9E3779B1 % (1 << 32), n * S // 100)
        assert (math.isnan(travel), reason) == (True, "jump")


def test_given_no_count_for_so_long_that_it_may_have_gone_round_then_one_has_no_travel() -> None:
    found = travels(SMALL, (0.0, 10), (0.24, 100), (0.6, 100), (0.7, 104))
    assert [reason for _, reason in found] == ["", "", "gap", "resumed"]
    assert found[-1][0] == pytest.approx(0.94)


def test_given_frames_held_up_on_their_way_then_counts_that_come_together_are_no_jump() -> None:
    late = Odometer(1 << 16, 0.01, 5.0, delay=0.1)
    found = travels(late, (0.0, 0), (0.1, 5), (0.1, 10), (0.1, 15), (0.1, 50))
    assert [reason for _, reason in found] == [""] * 5


def test_given_a_count_beyond_its_wrap_then_it_is_rejected() -> None:
    assert travels(Odometer(100, 0.01, 5.0, 0.0), (0.0, 10), (0.1, 100), (0.2, 11))[1][1] == "range"


def test_given_a_counter_that_counts_up_only_then_the_direction_gives_the_sign() -> None:
    odometer = Odometer(256, 0.01, 5.0, 0.0, counts_up_only=True)
    found = []
    for n, (count, direction) in enumerate([(250, 1), (4, 1), (8, -1), (8, 0), (10, 0), (14, None), (15, 1), (16, 1)]):
        odometer, travel, reason = odometer.update(count, n * S // 10, direction)
        found.append((round(travel, 9), reason))
    assert found[:5] == [(0.0, ""), (0.10, ""), (0.06, ""), (0.06, ""), (0.04, "")]
    assert found[5][1] == "direction"
    assert found[6:] == [(0.05, ""), (0.06, "")]


# --- frames of one instant ---------------------------------------------------------------------------------------

A, B = FrameKey(1), FrameKey(2)


def test_given_all_frames_of_an_instant_then_it_ends_at_once_with_the_time_of_the_first() -> None:
    assembler = CanFrameAssembler(frozenset((A, B)), 10)
    assert assembler.add(B, {"b": 1}, 100, 7) == []
    (instant,) = assembler.add(A, {"a": 2}, 105, 8)
    assert (instant.monotonic_ns, instant.utime, instant.is_complete) == (100, 7, True)
    assert instant.values == {A: {"a": 2}, B: {"b": 1}}
    assert assembler.get_deadline() is None


def test_given_a_frame_a_second_time_then_the_instant_before_ends_without_the_lost_one() -> None:
    assembler = CanFrameAssembler(frozenset((A, B)), 1000)
    assembler.add(A, {"a": 1}, 100, 1)
    (lost,) = assembler.add(A, {"a": 2}, 200, 2)
    assert (lost.values, lost.is_complete) == ({A: {"a": 1}}, False)
    (whole,) = assembler.add(B, {"b": 2}, 210, 3)
    assert (whole.values[A], whole.is_complete) == ({"a": 2}, True)


def test_given_a_frame_too_late_then_it_belongs_to_the_next_instant() -> None:
    assembler = CanFrameAssembler(frozenset((A, B)), 10)
    assembler.add(A, {"a": 1}, 100, 1)
    assert assembler.get_deadline() == 110
    assert assembler.pop_expired(109) == []
    (late,) = assembler.add(B, {"b": 1}, 110, 2)
    assert late.values == {A: {"a": 1}}
    assert assembler.get_deadline() == 120
