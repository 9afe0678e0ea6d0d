"""Readings of a joint give the same history in whatever order they come, and however often."""

from __future__ import annotations

import math
from collections.abc import Iterator
from unittest import mock

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from modelserver.joints import track as joint_track
from modelserver.joints.track import JointTrack, combine, interpolate_batch
from modelserver.transforms import so3
from modelserver.transforms.so3 import left_jacobian

NAN = math.nan
numbers = st.one_of(st.just(NAN), st.sampled_from((0.0, 0.1, 0.2)))
readings = st.lists(
    st.tuples(st.integers(0, 12), st.tuples(st.sampled_from((-1.0, 0.0, 1.0)), numbers, numbers, numbers)),
    min_size=1,
    max_size=12,
)


def read_all(some: list[tuple[int, tuple[float, float, float, float]]], horizon: float = 8e-6) -> list[object]:
    track = JointTrack(horizon)
    for utime, values in some:
        track = track.insert(utime, values)
    held = [track.hold(utime) for utime in range(track.first, track.last + 1)]
    return [len(track), *(tuple(str(each) for each in reading) for reading in held)]


@pytest.fixture(autouse=True, scope="module", params=[1, 512])
def block(request: pytest.FixtureRequest) -> Iterator[None]:
    """Blocks so small that every test has several, and as they are."""
    with mock.patch.object(joint_track, "BLOCK_SIZE", request.param):
        yield


@given(readings, readings)
def test_given_a_track_held_apart_when_the_first_grows_then_it_does_not_and_goes_on_alike(some, more) -> None:
    track = JointTrack(8e-6)
    for utime, values in some:
        track = track.insert(utime, values)
    apart = track.detach()
    blocks = repr(apart._blocks)
    grown = track
    for utime, values in more:
        grown = grown.insert(utime, values)
    assert repr(apart._blocks) == blocks
    for utime, values in more:
        apart = apart.insert(utime, values)
    assert len(apart) == len(grown)
    for utime in range(grown.first, grown.last + 1):
        assert repr(apart.hold(utime)) == repr(grown.hold(utime))


@given(readings, st.randoms(use_true_random=False))
def test_given_readings_in_any_order_and_twice_then_the_same_is_held(some, random) -> None:
    shuffled = some + random.sample(some, random.randint(0, len(some)))
    random.shuffle(shuffled)
    assert read_all(shuffled) == read_all(some)


@pytest.mark.slow
@given(readings, st.randoms(use_true_random=False))
def test_given_more_than_may_be_held_then_the_newest_are_held_in_any_order(some, random) -> None:
    shuffled = random.sample(some, len(some))
    with mock.patch.object(joint_track, "MAX_READINGS", 4):
        assert read_all(shuffled, 1.0) == read_all(some, 1.0)


@given(readings, st.integers(0, 11), readings)
def test_given_a_track_that_others_extend_then_it_stays_what_it_was(some, cut, more) -> None:
    track = JointTrack(1.0)
    tracks = []
    for utime, values in some:
        track = track.insert(utime, values)
        tracks.append((track, len(track), track.first, track.last, str(track.newest)))
    old = tracks[min(cut, len(tracks) - 1)][0]
    for utime, values in more:
        old = old.insert(utime, values)
    assert all((len(t), t.first, t.last, str(t.newest)) == (*known,) for t, *known in tracks)


@given(readings, st.lists(st.integers(-2, 14), min_size=1), st.booleans())
def test_given_any_instants_then_interpolate_batch_agrees_with_interpolate(some, utimes, turns) -> None:
    track = JointTrack(1.0, turns)
    for each, (position, *others) in some:
        track = track.insert(each, (4.0 * position, *others))
    utimes = [min(max(utime, track.first), track.last) for utime in utimes]
    single = [track.interpolate(utime) for utime in utimes]
    expected = [[each.position for each in single], [each.sigma for each in single], [each.gap for each in single]]
    assert np.allclose(track.interpolate_batch(np.array(utimes)), expected, rtol=1e-12, atol=1e-12, equal_nan=True)


components = st.floats(-2.4, 2.4)
vectors = st.tuples(components, components, components)


@given(vectors, vectors, st.floats(0.01, 0.99))
def test_given_two_orientations_then_between_them_it_turns_about_one_axis(v0, v1, part) -> None:
    q0, q1 = so3.exponential(v0), so3.exponential(v1)
    turn = so3.logarithm(so3.normalize(so3.multiply(q1, so3.conjugate(q0))))
    assume(math.hypot(*turn) < math.pi - 1e-3)
    utime = round(1_000_000 * part)
    tracks = tuple(
        JointTrack(60.0).insert(0, (a, NAN, NAN, NAN)).insert(1_000_000, (b, NAN, NAN, NAN))
        for a, b in zip(v0, v1, strict=True)
    )
    found = combine(tracks, tuple(track.interpolate(utime) for track in tracks), (math.inf,) * 3)
    v = tuple(each.position for each in found)
    q, wanted = so3.exponential(v), so3.slerp(q0, q1, utime * 1e-6)
    assert math.hypot(*so3.logarithm(so3.normalize(so3.multiply(q, so3.conjugate(wanted))))) < 1e-7
    rate = [each.rate for each in found]
    if not any(map(math.isnan, rate)):
        assert np.allclose(left_jacobian(v) @ rate, turn, atol=1e-6)
    positions = interpolate_batch(tracks, np.array([0, utime, 1_000_000]))[0]
    assert np.allclose(positions[[0, 2]], (v0, v1), atol=1e-12)
    wanted = so3.exponential(tuple(positions[1].tolist()))
    assert math.hypot(*so3.logarithm(so3.normalize(so3.multiply(q, so3.conjugate(wanted))))) < 1e-7
