"""Replies from memory are the very bytes that the core would have sent."""

from __future__ import annotations

import pytest

from modelserver import core
from modelserver.core import CoreSettings, Instant
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model
from modelserver.messages import GetTransformation, Policy, RequestHeader, SendReply, TimeQuery
from modelserver.spatial.pose import Pose
from modelserver.wire import timeless
from modelserver.wire.codec import encode
from modelserver.wire.timeless import TimelessReplies

LATER = Instant(10, 20_000_000)


def cart(height: float = 1.0) -> Model:
    builder = ModelBuilder("cart")
    builder.body("Cart").frame("Origin").frame("Mast", Pose((0.2, 0.0, height)))
    builder.body("Camera").frame("Origin").frame("Lens", Pose.from_rpy((0.1, 0.0, 0.0), 0.0, 0.3, 0.0))
    return builder.constraint("CameraFixed", "Cart:Mast", "Camera:Origin").build()


NOW = TimeQuery()


def asked(request_id: int = 7, interest: str = "Camera:Lens", time: TimeQuery = NOW) -> GetTransformation:
    return GetTransformation(RequestHeader(request_id, "REPLY_TEST"), interest, "Cart:Origin", time)


def reply_of(model: Model, request: GetTransformation, now: Instant = LATER) -> SendReply:
    state = core.start(CoreSettings("Cart:Origin"), model, None, Instant(0, 1))
    _, (reply,) = core.step(state, request, now)
    assert isinstance(reply, SendReply)
    return reply


def taught(model: Model) -> TimelessReplies:
    replies = TimelessReplies()
    reply = reply_of(model, asked(1), Instant(1, 2))
    replies.learn(encode(asked(1)), reply, encode(reply.reply), model)
    return replies


@pytest.mark.parametrize(
    "request_", [asked(7), asked(-8), asked(9, time=TimeQuery(123, Policy.PREDICTED, 50)), asked(10, time=TimeQuery(5))]
)
def test_given_a_known_question_then_the_reply_is_the_one_the_core_gives(request_: GetTransformation) -> None:
    model = cart()
    reply = reply_of(model, request_)
    assert taught(model).find(encode(request_), LATER.utime, model) == (reply.channel, encode(reply.reply))


def test_given_another_model_then_what_was_known_is_not_said() -> None:
    old, new = cart(1.0), cart(2.0)
    replies = taught(old)
    assert replies.find(encode(asked()), 5, new) is None
    reply = reply_of(new, asked())
    replies.learn(encode(asked()), reply, encode(reply.reply), new)
    assert replies.find(encode(asked()), 5, old) is None
    assert replies.find(encode(asked()), LATER.utime, new) == (reply.channel, encode(reply.reply))


@pytest.mark.parametrize("time", [TimeQuery(-1), TimeQuery(1 << 62), TimeQuery(0, Policy.HELD, -5)])
def test_given_a_time_that_cannot_be_then_it_goes_to_the_core(time: TimeQuery) -> None:
    model = cart()
    assert taught(model).find(encode(asked(time=time)), 5, model) is None


def test_given_a_policy_that_is_none_then_it_goes_to_the_core() -> None:
    model = cart()
    data = bytearray(encode(asked()))
    data[-5] = 9
    assert taught(model).find(bytes(data), 5, model) is None


def test_given_other_bytes_then_they_go_to_the_core() -> None:
    model = cart()
    good = encode(asked())
    replies = taught(model)
    for data in (b"", b"x", good[:8], good[:-1], good + b"\0", b"\0" * 8 + good[8:], good[:20] + b"?" + good[21:]):
        assert replies.find(data, 5, model) is None


def test_given_a_question_that_fails_then_it_is_not_kept() -> None:
    model = cart()
    wrong = asked(interest="Camera:Lans")
    reply = reply_of(model, wrong)
    replies = TimelessReplies()
    replies.learn(encode(wrong), reply, encode(reply.reply), model)
    assert replies.find(encode(wrong), 5, model) is None


def test_given_a_flood_of_questions_then_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timeless, "KEPT", 3)
    model = cart()
    replies = TimelessReplies()
    reply = reply_of(model, asked())
    for number in range(20):
        request = GetTransformation(RequestHeader(1, f"REPLY_{number}"), "Camera:Lens", "Cart:Origin")
        replies.learn(encode(request), reply, encode(reply.reply), model)
        assert len(replies._known) <= 3
    long = GetTransformation(RequestHeader(1, "REPLY_TEST"), "x" * 600, "y")
    replies.learn(encode(long), reply, encode(reply.reply), model)
    assert replies.find(encode(long), 5, model) is None
