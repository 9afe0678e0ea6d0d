"""Cached replies are bit for bit those of the core."""

from __future__ import annotations

import pytest

from modelserver import core
from modelserver.core import CoreSettings, Instant
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model
from modelserver.messages import GetTransformation, Policy, PoseDemand, RequestHeader, SendReply, TimeQuery
from modelserver.transforms.pose import Pose
from modelserver.wire import codec
from modelserver.wire.codec import StaticReplyCache, encode

LATER = Instant(10, 20_000_000)


def cart(height: float = 1.0) -> Model:
    builder = ModelBuilder("cart")
    builder.add_body("Cart").add_frame("Origin").add_frame("Mast", Pose((0.2, 0.0, height)))
    builder.add_body("Camera").add_frame("Origin").add_frame("Lens", Pose.from_rpy((0.1, 0.0, 0.0), 0.0, 0.3, 0.0))
    return builder.add_constraint("CameraFixed", "Cart:Mast", "Camera:Origin").build()


NOW = TimeQuery()


def make_request(request_id: int = 7, interest: str = "Camera:Lens", time: TimeQuery = NOW) -> GetTransformation:
    return GetTransformation(RequestHeader(request_id, "REPLY_TEST"), interest, "Cart:Origin", time)


def reply_of(model: Model, request: GetTransformation, now: Instant = LATER) -> SendReply:
    state = core.start(CoreSettings("Cart:Origin"), model, None, Instant(0, 1))
    _, (reply,) = core.step(state, request, now)
    assert isinstance(reply, SendReply)
    return reply


CLIENT = b"REPLY_TEST"


def cache_of(model: Model, frames: int = 10) -> StaticReplyCache:
    cache = StaticReplyCache()
    cache.reset(model, frames)
    return cache


def make_cache(model: Model) -> StaticReplyCache:
    cache = cache_of(model)
    reply = reply_of(model, make_request(1), Instant(1, 2))
    cache.add(encode(make_request(1)), CLIENT, reply.reply, encode(reply.reply))
    return cache


@pytest.mark.parametrize(
    "request_",
    [
        make_request(7),
        make_request(-8),
        make_request(9, time=TimeQuery(123, Policy.PREDICTED, 50)),
        make_request(10, time=TimeQuery(5)),
    ],
)
def test_given_a_cached_pair_then_the_reply_is_the_one_the_core_gives(request_: GetTransformation) -> None:
    model = cart()
    reply = reply_of(model, request_)
    assert make_cache(model).find(encode(request_), CLIENT, LATER.utime) == encode(reply.reply)


def test_given_another_client_then_it_gets_the_same_reply_from_the_cache() -> None:
    model = cart()
    other = GetTransformation(RequestHeader(12, "REPLY_OTHER_ONE"), "Camera:Lens", "Cart:Origin")
    found = make_cache(model).find(encode(other), b"REPLY_OTHER_ONE", LATER.utime)
    assert found == encode(reply_of(model, other).reply)


def test_given_another_model_then_the_cache_is_empty() -> None:
    old, new = cart(1.0), cart(2.0)
    cache = make_cache(old)
    assert cache.is_of(old)
    assert not cache.is_of(new)
    cache.reset(new, 10)
    assert cache.find(encode(make_request()), CLIENT, 5) is None
    assert len(cache) == 0


@pytest.mark.parametrize("time", [TimeQuery(-1), TimeQuery(1 << 62), TimeQuery(0, Policy.HELD, -5)])
def test_given_a_time_that_cannot_be_then_it_goes_to_the_core(time: TimeQuery) -> None:
    assert make_cache(cart()).find(encode(make_request(time=time)), CLIENT, 5) is None


def test_given_a_policy_that_is_none_then_it_goes_to_the_core() -> None:
    data = bytearray(encode(make_request()))
    data[-37] = 9
    assert make_cache(cart()).find(bytes(data), CLIENT, 5) is None


def test_given_a_demand_then_it_goes_to_the_core_and_its_reply_is_not_cached() -> None:
    model = cart()
    demanding = make_request()._replace(demand=PoseDemand(max_age=1.0))
    assert make_cache(model).find(encode(demanding), CLIENT, 5) is None
    cache, reply = cache_of(model), reply_of(model, demanding)
    cache.add(encode(demanding), CLIENT, reply.reply, encode(reply.reply))
    assert len(cache) == 0


def test_given_other_bytes_then_they_go_to_the_core() -> None:
    good = encode(make_request())
    cache = make_cache(cart())
    for data in (b"", b"x", good[:8], good[:-1], good + b"\0", b"\0" * 8 + good[8:], good[:34] + b"?" + good[35:]):
        assert cache.find(data, CLIENT, 5) is None


def test_given_a_question_that_fails_then_it_is_not_cached() -> None:
    model = cart()
    wrong = make_request(interest="Camera:Lans")
    reply = reply_of(model, wrong)
    cache = cache_of(model)
    cache.add(encode(wrong), CLIENT, reply.reply, encode(reply.reply))
    assert len(cache) == 0


def test_given_all_pairs_of_a_model_then_they_fit() -> None:
    model = cart()
    cache = cache_of(model, frames=57)
    reply = reply_of(model, make_request())
    requests = [encode(GetTransformation(RequestHeader(1, "REPLY_TEST"), f"A:{n}", "B:C")) for n in range(57 * 57)]
    for request in requests:
        cache.add(request, CLIENT, reply.reply, encode(reply.reply))
    assert all(cache.find(request, CLIENT, 5) is not None for request in requests)


def test_given_more_pairs_than_fit_then_the_least_recently_used_is_evicted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "MAX_ENTRIES", 3)
    model = cart()
    cache = cache_of(model)
    reply = reply_of(model, make_request())
    requests = [encode(GetTransformation(RequestHeader(1, "REPLY_TEST"), f"A:{n}", "B:C")) for n in range(20)]
    for request in requests[:3]:
        cache.add(request, CLIENT, reply.reply, encode(reply.reply))
    assert cache.find(requests[0], CLIENT, 5) is not None
    cache.add(requests[3], CLIENT, reply.reply, encode(reply.reply))
    assert [cache.find(request, CLIENT, 5) is not None for request in requests[:4]] == [True, False, True, True]
    for request in requests:
        cache.add(request, CLIENT, reply.reply, encode(reply.reply))
        assert len(cache) <= 3


def test_given_a_pair_of_long_names_then_it_is_not_cached() -> None:
    model = cart()
    cache = cache_of(model)
    reply = reply_of(model, make_request())
    long = GetTransformation(RequestHeader(1, "REPLY_TEST"), "x" * 600, "y")
    cache.add(encode(long), CLIENT, reply.reply, encode(reply.reply))
    assert len(cache) == 0
