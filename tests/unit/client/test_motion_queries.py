"""The client's queries of moving frames, over a real bus on loopback, to a core in a thread."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from typing import Any

import lcm
import numpy as np
import pytest
from support_lcm import TIMEOUT_S, reserved_url
from support_moving import BASE, DEEP, ODOM, SCAN, T0, UTM, S, rover, view

from modelserver.client.remote import Platform
from modelserver.core import CoreSettings, Instant, start, step
from modelserver.errors import LimitError, MalformedRequestError, Status, TooNewError, UnknownFrameError, WireError
from modelserver.messages import (
    CHANNEL_OF,
    MAX_REQUEST_INSTANTS,
    MET,
    GetExplanation,
    GetMotion,
    GetTransformation,
    GetTransformations,
    PoseBatchReply,
    RequestHeader,
    SendReply,
    TimeQuery,
    Unmet,
)
from modelserver.query.answers import DeferredAnswer
from modelserver.query.batch import lookup_batch
from modelserver.query.path import compute_motion, explain
from modelserver.query.view import complete
from modelserver.wire.codec import decode, encode

HELD = view(2.0)
NOW = T0 + 2 * S
TYPES = {
    CHANNEL_OF[GetTransformations]: "get_transformations_request_t",
    CHANNEL_OF[GetMotion]: "get_motion_request_t",
    CHANNEL_OF[GetExplanation]: "get_explanation_request_t",
    CHANNEL_OF[GetTransformation]: "get_transformation_request_t",
}


def answering(url: str, stop: threading.Event, ready: threading.Event) -> None:
    """Answer requests on the bus with the core until `stop` is set."""
    state = start(CoreSettings(BASE), rover(), None, Instant(0, T0))._replace(view=HELD)
    bus = lcm.LCM(url)

    def answer(channel: str, data: bytes) -> None:
        request: Any = decode(TYPES[channel], data)
        for each in step(state, request, Instant(0, NOW))[1]:
            if isinstance(each, DeferredAnswer):
                for reply in complete(each.work()):
                    bus.publish(request.header.reply_channel, encode(reply))
                continue
            assert isinstance(each, SendReply)
            bus.publish(each.channel, encode(each.reply))

    subscriptions = [bus.subscribe(channel, answer) for channel in TYPES]
    ready.set()
    while not stop.is_set():
        bus.handle_timeout(20)
    # the handlers refer to the bus, and keep it open
    for each in subscriptions:
        bus.unsubscribe(each)


@pytest.fixture(scope="module")
def platform() -> Iterator[Platform]:
    with reserved_url() as url:
        stop, ready = threading.Event(), threading.Event()
        thread = threading.Thread(target=answering, args=(url, stop, ready))
        thread.start()
        try:
            assert ready.wait(TIMEOUT_S)
            with Platform(url, name="test", timeout=TIMEOUT_S, retries=1) as asking:
                yield asking
        finally:
            stop.set()
            thread.join()


def utimes(count: int) -> np.ndarray:
    return T0 + np.linspace(0, 2 * S, count).astype(np.int64)


@pytest.mark.parametrize("covariance", [True, False])
def test_given_several_pairs_then_each_is_answered_as_the_platform_does(platform: Platform, covariance: bool) -> None:
    pairs, at = [(SCAN, UTM), (DEEP, SCAN), (UTM, BASE)], utimes(300)
    for (interest, reference), found in zip(
        pairs, platform.get_transformations(pairs, at, covariance=covariance), strict=True
    ):
        expected = complete(lookup_batch(HELD, interest, reference, at, with_covariance=covariance, now=NOW))
        assert (found.frame_of_interest, found.frame_of_reference) == (interest, reference)
        assert np.array_equal(found.vectors, expected.vectors)
        assert np.array_equal(found.utimes, at)
        assert (found.covariances is None) == (not covariance)
        assert found.origin == expected.origin
        assert found.model_revision == HELD.model.revision


def test_given_more_instants_than_a_question_holds_then_several_are_asked(platform: Platform) -> None:
    at = utimes(5000)
    (found,) = platform.get_transformations([(SCAN, UTM)], at, covariance=False)
    assert found.vectors.shape == (5000, 7)
    for some in (slice(0, 2000), slice(2000, 4000), slice(4000, 5000)):
        assert np.array_equal(
            found.vectors[some], complete(lookup_batch(HELD, SCAN, UTM, at[some], with_covariance=False)).vectors
        )


def test_given_a_fixed_frame_then_many_instants_need_a_reference_time(platform: Platform) -> None:
    with pytest.raises(MalformedRequestError, match="give reference_at"):
        platform.get_transformations([(SCAN, BASE)], utimes(2001), fixed_frame=ODOM)
    (found,) = platform.get_transformations([(SCAN, BASE)], utimes(2001), fixed_frame=ODOM, reference_at=T0 + S)
    expected = complete(lookup_batch(HELD, SCAN, BASE, utimes(2001)[:2000], T0 + S, ODOM))
    assert np.array_equal(found.vectors[:2000], expected.vectors)
    (latest,) = platform.get_transformations([(SCAN, BASE)], utimes(5), fixed_frame=ODOM)
    assert np.array_equal(latest.vectors, complete(lookup_batch(HELD, SCAN, BASE, utimes(5), NOW, ODOM)).vectors)


def test_given_no_instants_then_the_answer_is_empty(platform: Platform) -> None:
    (found,) = platform.get_transformations([(SCAN, UTM)], [])
    assert found.vectors.shape == (0, 7)


def test_given_a_demand_then_the_answer_has_what_is_unmet(platform: Platform) -> None:
    plain = platform.get_pose(SCAN, BASE)
    loose = platform.get_pose(SCAN, BASE, max_horizontal=0.1, max_heading=0.1, max_age=0.1, min_integrity=0.9)
    strict = platform.get_pose(SCAN, BASE, max_horizontal=1e-3, max_heading=0.1, min_integrity=0.9)
    assert (plain.unmet, plain.unmet_reason) == (loose.unmet, loose.unmet_reason) == (MET, "")
    assert strict.unmet is Unmet.HORIZONTAL
    assert strict.unmet_reason.startswith("the horizontal error is up to ")
    assert repr(strict._replace(unmet=MET, unmet_reason="")) == repr(plain)
    old = platform.get_pose(BASE, UTM, at=NOW - S, max_age=0.5)
    assert (old.unmet, old.unmet_reason) == (Unmet.AGE, "the newest data are 1 s old, asked for: at most 0.5 s")


@pytest.mark.parametrize("demand", [{"max_age": -1.0}, {"min_integrity": 1.0}, {"max_heading": math.nan}])
def test_given_a_demand_that_cannot_be_then_nothing_is_asked(platform: Platform, demand: dict[str, Any]) -> None:
    with pytest.raises(MalformedRequestError, match=f"{next(iter(demand))} .* is not from 0"):
        platform.get_pose(SCAN, BASE, **demand)
    with pytest.raises(MalformedRequestError):
        platform.get_pose(SCAN, BASE, max_age="soon")  # type: ignore[arg-type]


@pytest.mark.parametrize("at", [[1.5], [[T0]], ["now"], [None], [2**70], T0])
def test_given_what_are_no_instants_then_nothing_is_asked(platform: Platform, at: Any) -> None:
    with pytest.raises(MalformedRequestError, match="integer microseconds"):
        platform.get_transformations([(SCAN, UTM)], at)


@pytest.mark.parametrize("count", [0, 65])
def test_given_no_pairs_or_too_many_then_nothing_is_asked(platform: Platform, count: int) -> None:
    with pytest.raises(MalformedRequestError, match=f"a batch query has 1 to 64 pairs, got {count}"):
        platform.get_transformations([(SCAN, UTM)] * count, [T0])


def test_given_frames_that_there_are_not_then_the_error_names_the_nearest(platform: Platform) -> None:
    with pytest.raises(UnknownFrameError) as caught:
        platform.get_transformations([(SCAN, UTM)], [T0], fixed_frame="Odom:Orign")
    assert ODOM in caught.value.nearest
    with pytest.raises(UnknownFrameError) as caught:
        platform.get_transformations([("Laser:Scn", UTM)], [T0])
    assert SCAN in caught.value.nearest


@pytest.mark.parametrize("pairs", [1, 3])
def test_given_more_than_one_question_may_hold_then_the_server_reports_the_limit(pairs: int) -> None:
    at = tuple(utimes(MAX_REQUEST_INSTANTS // pairs + 1).tolist())
    request = GetTransformations(RequestHeader(1, "REPLY_ME"), ((SCAN, UTM),) * pairs, at)
    (reply,) = complete(DeferredAnswer(HELD, request, NOW).work())
    assert isinstance(reply, PoseBatchReply)
    assert reply.header.status is LimitError.status
    assert f"at most {MAX_REQUEST_INSTANTS}; split it" in reply.header.message


def test_given_a_pair_then_its_motion_comes_whole(platform: Platform) -> None:
    found = platform.get_motion(SCAN, UTM, expressed_in=BASE, at=T0 + S)
    expected = compute_motion(HELD, SCAN, UTM, BASE, platform_time(T0 + S), NOW)
    assert found[1:6] == expected[1:6]
    assert found.covariance == expected.covariance
    assert found.pose.transformation.pose.is_close(expected.pose.transformation.pose)


def platform_time(at: int) -> TimeQuery:
    return TimeQuery(at)


def test_given_a_pair_then_its_explanation_comes_whole(platform: Platform) -> None:
    found = platform.explain(SCAN, UTM, at=T0 + S + 1)
    expected = explain(HELD, SCAN, UTM, platform_time(T0 + S + 1), NOW)
    assert len(found.edges) == len(expected.edges)
    for one, other in zip(found.edges, expected.edges, strict=True):
        assert (one.kind, one.name, one.forward, one.ends) == (other.kind, other.name, other.forward, other.ends)
        assert (one.pose, one.provenance, one.stamp, one.coordinates) == (
            other.pose,
            other.provenance,
            other.stamp,
            other.coordinates,
        )
        assert one.position_share == pytest.approx(other.position_share, nan_ok=True)
        assert one.age == other.age or (math.isnan(one.age) and math.isnan(other.age))


def test_given_a_time_that_is_not_held_then_the_error_is_the_servers(platform: Platform) -> None:
    for ask in (platform.get_motion, platform.explain):
        with pytest.raises(TooNewError, match="after the time covered"):
            ask(SCAN, UTM, at=T0 + 5 * S)
    (found,) = platform.get_transformations([(SCAN, UTM)], [T0 + 5 * S, T0])
    assert found.status.tolist() == [Status.TOO_NEW, Status.OK]


@pytest.mark.parametrize("count", [0, -1, 65, 2**31 - 1])
def test_given_a_number_of_pairs_that_cannot_be_then_the_request_is_no_message(count: int) -> None:
    good = encode(GetTransformations(RequestHeader(1, "REPLY_ME"), ((SCAN, UTM),), (T0,)))
    at = good.index((1).to_bytes(4, "big"), 8 + 8 + 4 + len("REPLY_ME"))
    with pytest.raises(WireError, match="num_pairs is 1 to 64"):
        decode("get_transformations_request_t", good[:at] + count.to_bytes(4, "big", signed=True) + good[at + 4 :])
