"""Signed commands at a real loop on a fake bus: what is obeyed, what is refused, and what is said to whom."""

from __future__ import annotations

from typing import Any

import pytest
from support_samples import ME, START, Scripted, imu, started
from support_signing import KEY, envelope

from modelserver.core.reload import ModelLoaded
from modelserver.errors import Status
from modelserver.messages import (
    CHANNEL_OF,
    GetBodyList,
    Mode,
    PoseAnswer,
    ReloadModel,
    ReplyHeader,
    RequestHeader,
    SensorHeader,
    SetHTransform,
    SetStateVector,
    SwitchMode,
)
from modelserver.service.clock import FakeClock
from modelserver.service.fake_bus import FakeBus
from modelserver.service.heard import SensorChannel
from modelserver.service.hooks import Hooks
from modelserver.service.loop import Loop, LoopSettings
from modelserver.service.requests.gate import Gate
from modelserver.signing import Key
from modelserver.spatial import Pose, Transformation
from modelserver.wire.codec import decode, encode

HERE = PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose((100.0, 50.0, 5.0))))
RELOAD, SET, SET_H = ReloadModel(ME), SetStateVector(ME, HERE), SetHTransform(ME, HERE)
WISH = SwitchMode(SensorHeader(START, "operator"), Mode.NO_GPS)
OTHER = Key("other", b"another secret of the fleet")
REPLY_OF = {"PLATFORM_RELOAD_MODEL": "reload_model_reply_t"}


class Rig:
    """A loop that obeys who signs; the clock stands an hour after its start."""

    def __init__(self, prefix: str = "", keys: tuple[Key, ...] = (KEY,), mode_channel: str = "LOCALIZATION_MODE"):
        self.clock = FakeClock(START)
        self.bus = FakeBus(self.clock)
        self.prefix = prefix
        self.loads = 0
        self.wishes: list[SwitchMode] = []
        gate = Gate(keys, prefix, 5.0, mode_channel, self.clock.monotonic_ns() - 3600 * 10**9)
        state = started(Scripted(newest=START), may_reload=True, may_set_pose=True)
        sensors = {
            f"{prefix}IMU": SensorChannel("imu_t"),
            f"{prefix}{mode_channel}": SensorChannel("localization_mode_t"),
        }
        self.loop = Loop(
            self.bus,
            self.clock,
            state,
            LoopSettings(20_000_000, sensors, prefix),
            Hooks(on_wish=lambda wish, before, after: self.wishes.append(wish), on_load=self.load, gate=gate),
        )

    def load(self, wish: Any, state: Any) -> ModelLoaded:
        self.loads += 1
        return ModelLoaded(wish.request, state.model, state.localizer)

    def says(self, data: bytes, channel: str = "MODELSERVER_SIGNED") -> list[bytes]:
        """Put a message on the bus; return the replies to it."""
        before = len(self.bus.said("REPLY_TEST"))
        self.bus.publish(f"{self.prefix}{channel}", data)
        self.loop.turn()
        self.loop.turn()
        return self.bus.said("REPLY_TEST")[before:]

    def signed(self, order: Any, **options: Any) -> list[bytes]:
        options = {"utime": self.clock.utime(), "prefix": self.prefix} | options
        return self.says(encode(envelope(order, **options)))

    def header(self, replies: list[bytes], channel: str = "PLATFORM_RELOAD_MODEL") -> ReplyHeader:
        (data,) = replies
        header: ReplyHeader = decode(REPLY_OF.get(channel, "acknowledgement_t"), data).header
        assert header.request_id == ME.request_id
        return header

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        return dict(self.loop.state.rejected)

    @property
    def obeyed(self) -> int:
        """How many orders were carried out."""
        return self.loads + self.loop.state.localizer.taken + len(self.wishes)  # type: ignore[union-attr]


# --- obeyed ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["", "V1_"])
@pytest.mark.parametrize("order", [RELOAD, SET, SET_H])
def test_given_a_signed_command_then_it_is_obeyed_and_answered_once(order: Any, prefix: str) -> None:
    rig = Rig(prefix)
    header = rig.header(rig.signed(order, utime=START), CHANNEL_OF[type(order)])
    assert header.status is Status.OK
    assert (rig.obeyed, rig.rejected) == (1, {})
    again = rig.header(rig.signed(order, utime=START), CHANNEL_OF[type(order)])
    assert again.status is Status.FORBIDDEN
    assert "send it anew" in again.message
    assert rig.obeyed == 1
    assert rig.rejected == {(f"{prefix}{CHANNEL_OF[type(order)]}", "replayed"): 1}


def test_given_a_signed_wish_for_a_mode_then_it_is_obeyed_and_a_plain_one_is_counted() -> None:
    rig = Rig()
    assert rig.signed(WISH) == []
    assert rig.loop.state.localizer.mode is Mode.NO_GPS  # type: ignore[union-attr]
    assert [wish.mode for wish in rig.wishes] == [Mode.NO_GPS]
    rig.says(encode(SwitchMode(SensorHeader(START + 1, "operator"), Mode.RAW)), "LOCALIZATION_MODE")
    assert rig.loop.state.localizer.mode is Mode.NO_GPS  # type: ignore[union-attr]
    assert [wish.mode for wish in rig.wishes] == [Mode.NO_GPS]
    assert rig.rejected == {("LOCALIZATION_MODE", "unsigned"): 1}


def test_given_two_keys_then_either_does_so_that_keys_can_be_changed() -> None:
    rig = Rig(keys=(KEY, OTHER))
    for key in (KEY, OTHER):
        assert rig.header(rig.signed(RELOAD, key=key)).status is Status.OK
    rig = Rig(keys=(OTHER,))
    assert rig.signed(RELOAD) == []
    assert rig.rejected == {("MODELSERVER_SIGNED", "unknown_key"): 1}


def test_given_two_senders_of_one_instant_then_both_are_obeyed() -> None:
    rig = Rig()
    for sender in ("a@console", "b@console"):
        assert rig.header(rig.signed(RELOAD, sender=sender)).status is Status.OK
    assert rig.loads == 2


# --- refused --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [RELOAD, SET, SET_H])
def test_given_a_command_without_a_signature_then_it_is_forbidden_and_says_how(order: Any) -> None:
    rig = Rig()
    channel = CHANNEL_OF[type(order)]
    header = rig.header(rig.says(encode(order), channel), channel)
    assert header.status is Status.FORBIDDEN
    assert "MODELSERVER_KEY_FILE" in header.message
    assert (rig.obeyed, rig.rejected) == (0, {(channel, "unsigned"): 1})


def test_given_a_signature_that_is_wrong_then_nobody_is_told_anything() -> None:
    rig = Rig("V1_")
    stranger = Key("test", b"a secret that is guessed")
    wrong = {
        "bad_signature": [
            {"key": stranger},
            {"key": stranger, "utime": 1},
            {"prefix": "V2_"},
            {"prefix": ""},
        ],
        "unknown_key": [{"key": OTHER}],
    }
    for reason, several in wrong.items():
        for number, options in enumerate(several, 1):
            assert rig.signed(RELOAD, **options) == []
            assert rig.rejected["V1_MODELSERVER_SIGNED", reason] == number
    assert sum(rig.rejected.values()) == 5
    assert rig.obeyed == 0


@pytest.mark.slow
def test_given_one_bit_flipped_anywhere_then_it_is_not_obeyed_and_only_counted() -> None:
    rig = Rig()
    good = encode(envelope(RELOAD, START))
    for at in range(len(good)):
        for bit in range(8):
            # fresh each time, so that it is the signature alone that tells
            data = bytearray(encode(envelope(RELOAD, rig.clock.utime())))
            data[at] ^= 1 << bit
            assert rig.says(bytes(data)) == []
    assert rig.obeyed == 0
    assert sum(rig.rejected.values()) == 8 * len(good)
    reasons = {why for _, why in rig.rejected}
    assert reasons <= {"fingerprint", "truncated", "malformed", "unknown_key", "bad_signature", "load"}
    assert rig.loop.state.handler_errors == 0
    assert rig.header(rig.signed(RELOAD)).status is Status.OK


def test_given_any_cut_or_more_bytes_then_it_is_counted() -> None:
    rig = Rig()
    good = encode(envelope(RELOAD, START))
    for data in [good[:n] for n in range(len(good))] + [good + b"\0"]:
        assert rig.says(data) == []
    rig.clock.advance(1.0)  # of many the core is told once a second
    rig.loop.turn()
    assert (rig.obeyed, sum(rig.rejected.values())) == (0, len(good) + 1)
    assert {why for _, why in rig.rejected} <= {"fingerprint", "truncated", "malformed", "load"}


@pytest.mark.parametrize("hours", [1.0, -1.0])
def test_given_the_vehicles_clock_stepped_then_the_client_is_told_by_how_much(hours: float) -> None:
    rig = Rig()
    now = rig.clock.utime()
    rig.clock.step_utime(hours * 3600)
    header = rig.header(rig.signed(RELOAD, utime=now))
    assert header.status is Status.FORBIDDEN
    assert f"3600.0 s {'before' if hours > 0 else 'after'} what the vehicle's clock says" in header.message
    assert rig.rejected == {("PLATFORM_RELOAD_MODEL", "stale"): 1}
    # who has the right time is obeyed all the same
    assert rig.header(rig.signed(RELOAD)).status is Status.OK


def test_given_a_command_of_before_the_start_then_it_is_refused() -> None:
    rig = Rig()
    rig.loop._requests._gate._started_ns = rig.clock.monotonic_ns()  # type: ignore[union-attr]
    header = rig.header(rig.signed(RELOAD))
    assert header.status is Status.FORBIDDEN
    assert "has just started" in header.message
    rig.clock.advance(1.1)
    assert rig.header(rig.signed(RELOAD)).status is Status.OK


@pytest.mark.parametrize("channel", ["PLATFORM_GET_BODY_LIST", "IMU", "POSE", "MODELSERVER_SIGNED", "", "x" * 64])
def test_given_a_channel_that_takes_no_commands_then_it_is_counted(channel: str) -> None:
    rig = Rig()
    assert rig.signed(GetBodyList(ME), channel=channel) == []
    assert rig.rejected == {("MODELSERVER_SIGNED", "channel"): 1}


def test_given_no_channel_for_modes_then_an_empty_one_is_none() -> None:
    rig = Rig(mode_channel="")
    assert rig.signed(WISH, channel="") == []
    assert (rig.wishes, rig.rejected) == ([], {("MODELSERVER_SIGNED", "channel"): 1})


def test_given_something_signed_that_is_no_message_of_its_channel_then_it_is_counted_and_answered_where_it_can_be() -> (
    None
):
    rig = Rig()
    good = encode(RELOAD)
    assert rig.signed(b"junk", channel="PLATFORM_RELOAD_MODEL", counter=1) == []
    (reply,) = rig.signed(good + b"\0", channel="PLATFORM_RELOAD_MODEL", counter=2)
    assert decode("reload_model_reply_t", reply).header.status is Status.MALFORMED
    rig.signed(encode(imu(START)), channel="LOCALIZATION_MODE", counter=3)
    assert rig.rejected == {
        ("PLATFORM_RELOAD_MODEL", "fingerprint"): 1,
        ("PLATFORM_RELOAD_MODEL", "malformed"): 1,
        ("LOCALIZATION_MODE", "fingerprint"): 1,
    }


def test_given_a_signed_command_that_names_a_channel_outside_the_rules_then_nothing_is_said_on_it() -> None:
    rig = Rig()
    for number, channel in enumerate(("POSE", "IMU", "REPLY_", "REPLY_\n", "")):
        rig.signed(ReloadModel(RequestHeader(1, channel)), counter=number)
        rig.signed(ReloadModel(RequestHeader(1, channel)), counter=number)  # the same again: refused
    assert all(decode("pose_transform_t", data) for data in rig.bus.said("POSE"))
    assert not rig.bus.said("IMU")
    assert rig.loads == 0


def test_given_a_flood_of_envelopes_then_questions_are_answered_and_the_excess_is_counted() -> None:
    rig = Rig()
    junk = encode(envelope(RELOAD, START, key=Key("test", b"a secret that is guessed")))
    for _ in range(3000):
        rig.bus.publish("MODELSERVER_SIGNED", junk)
    rig.bus.publish("PLATFORM_GET_BODY_LIST", encode(GetBodyList(ME)))
    for _ in range(300):
        rig.loop.turn()
    assert len(rig.bus.said("REPLY_TEST")) == 1
    assert sum(rig.rejected.values()) == 3000
    assert {why for _, why in rig.rejected} == {"bad_signature", "load"}


def test_given_signed_texts_with_control_characters_then_the_log_is_clean(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    rig = Rig()
    evil = "x\nERROR root: FORGED\x1b[31m\r"
    rig.signed(RELOAD, sender=evil)
    rig.signed(RELOAD, sender=evil)
    rig.signed(RELOAD, channel=evil)
    assert caplog.records
    assert all(record.getMessage().isprintable() for record in caplog.records)
