"""Signed commands in a loop on a fake bus: execution, denial, replies."""

from __future__ import annotations

from typing import Any

import pytest
from support_samples import ME, START, ScriptedLocalizer, imu, start_core
from support_signing import KEY, envelope

from modelserver.core import ModelLoaded
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
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import CommandVerifier, SensorChannel
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.reloading import PollReload
from modelserver.signing import Key
from modelserver.transforms import Pose, Transformation
from modelserver.wire.codec import decode, encode

HERE = PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose((100.0, 50.0, 5.0))))
RELOAD, SET, SET_H = ReloadModel(ME), SetStateVector(ME, HERE), SetHTransform(ME, HERE)
MODE_COMMAND = SwitchMode(SensorHeader(START, "operator"), Mode.NO_GPS)
OTHER = Key("other", b"another secret of the fleet")
REPLY_OF = {"PLATFORM_RELOAD_MODEL": "reload_model_reply_t"}


class Rig:
    """A loop with send_signed commands, an hour after its start."""

    def __init__(self, prefix: str = "", keys: tuple[Key, ...] = (KEY,), mode_channel: str = "LOCALIZATION_MODE"):
        self.clock = FakeClock(START)
        self.bus = FakeBus(self.clock)
        self.prefix = prefix
        self.loads = 0
        self.mode_commands: list[SwitchMode] = []
        gate = CommandVerifier(keys, prefix, 5.0, mode_channel, self.clock.monotonic_ns() - 3600 * 10**9)
        state = start_core(ScriptedLocalizer(newest=START), may_reload=True, may_set_pose=True)
        sensors = {
            f"{prefix}IMU": SensorChannel("imu_t"),
            f"{prefix}{mode_channel}": SensorChannel("localization_mode_t"),
        }
        self.loop = Loop(
            self.bus,
            self.clock,
            state,
            LoopSettings(20_000_000, sensors, prefix),
            Hooks(
                on_mode_switch=lambda command, before, after: self.mode_commands.append(command),
                on_load=self.load,
                verifier=gate,
            ),
        )

    def load(self, command: Any, state: Any) -> PollReload:
        self.loads += 1
        return lambda state: ModelLoaded(command.request, state.model, state.localizer)

    def get_replies(self, data: bytes, channel: str = "MODELSERVER_SIGNED") -> list[bytes]:
        """Put a message on the bus; return the replies to it."""
        before = len(self.bus.get_published("REPLY_TEST"))
        self.bus.publish(f"{self.prefix}{channel}", data)
        self.loop.run_once()
        self.loop.run_once()
        return self.bus.get_published("REPLY_TEST")[before:]

    def send_signed(self, command: Any, **options: Any) -> list[bytes]:
        options = {"utime": self.clock.utime(), "prefix": self.prefix} | options
        return self.get_replies(encode(envelope(command, **options)))

    def header(self, replies: list[bytes], channel: str = "PLATFORM_RELOAD_MODEL") -> ReplyHeader:
        (data,) = replies
        header: ReplyHeader = decode(REPLY_OF.get(channel, "acknowledgement_t"), data).header
        assert header.request_id == ME.request_id
        return header

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        return dict(self.loop.state.rejected)

    @property
    def executed(self) -> int:
        """Number of executed commands."""
        return self.loads + self.loop.state.localizer.count + len(self.mode_commands)  # type: ignore[union-attr]


# --- executed -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["", "V1_"])
@pytest.mark.parametrize("command", [RELOAD, SET, SET_H])
def test_given_a_signed_command_then_it_is_executed_and_answered_once(command: Any, prefix: str) -> None:
    rig = Rig(prefix)
    header = rig.header(rig.send_signed(command, utime=START), CHANNEL_OF[type(command)])
    assert header.status is Status.OK
    assert (rig.executed, rig.rejected) == (1, {})
    again = rig.header(rig.send_signed(command, utime=START), CHANNEL_OF[type(command)])
    assert again.status is Status.FORBIDDEN
    assert "send a new one" in again.message
    assert rig.executed == 1
    assert rig.rejected == {(f"{prefix}{CHANNEL_OF[type(command)]}", "replayed"): 1}


def test_given_a_signed_mode_command_then_it_is_executed_and_a_plain_one_is_counted() -> None:
    rig = Rig()
    assert rig.send_signed(MODE_COMMAND) == []
    assert rig.loop.state.localizer.mode is Mode.NO_GPS  # type: ignore[union-attr]
    assert [command.mode for command in rig.mode_commands] == [Mode.NO_GPS]
    rig.get_replies(encode(SwitchMode(SensorHeader(START + 1, "operator"), Mode.RAW)), "LOCALIZATION_MODE")
    assert rig.loop.state.localizer.mode is Mode.NO_GPS  # type: ignore[union-attr]
    assert [command.mode for command in rig.mode_commands] == [Mode.NO_GPS]
    assert rig.rejected == {("LOCALIZATION_MODE", "unsigned"): 1}


def test_given_two_keys_then_either_does_so_that_keys_can_be_changed() -> None:
    rig = Rig(keys=(KEY, OTHER))
    for key in (KEY, OTHER):
        assert rig.header(rig.send_signed(RELOAD, key=key)).status is Status.OK
    rig = Rig(keys=(OTHER,))
    assert rig.send_signed(RELOAD) == []
    assert rig.rejected == {("MODELSERVER_SIGNED", "unknown_key"): 1}


def test_given_two_senders_of_one_instant_then_both_commands_are_executed() -> None:
    rig = Rig()
    for sender in ("a@console", "b@console"):
        assert rig.header(rig.send_signed(RELOAD, sender=sender)).status is Status.OK
    assert rig.loads == 2


# --- denied ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [RELOAD, SET, SET_H])
def test_given_a_command_without_a_signature_then_it_is_forbidden_with_advice(command: Any) -> None:
    rig = Rig()
    channel = CHANNEL_OF[type(command)]
    header = rig.header(rig.get_replies(encode(command), channel), channel)
    assert header.status is Status.FORBIDDEN
    assert "MODELSERVER_KEY_FILE" in header.message
    assert (rig.executed, rig.rejected) == (0, {(channel, "unsigned"): 1})


def test_given_an_invalid_signature_then_there_is_no_reply() -> None:
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
            assert rig.send_signed(RELOAD, **options) == []
            assert rig.rejected["V1_MODELSERVER_SIGNED", reason] == number
    assert sum(rig.rejected.values()) == 5
    assert rig.executed == 0


@pytest.mark.slow
def test_given_one_bit_flipped_anywhere_then_it_is_not_executed_and_only_counted() -> None:
    rig = Rig()
    good = encode(envelope(RELOAD, START))
    for at in range(len(good)):
        for bit in range(8):
            # fresh each time, so that only the signature is wrong
            data = bytearray(encode(envelope(RELOAD, rig.clock.utime())))
            data[at] ^= 1 << bit
            assert rig.get_replies(bytes(data)) == []
    assert rig.executed == 0
    assert sum(rig.rejected.values()) == 8 * len(good)
    reasons = {why for _, why in rig.rejected}
    assert reasons <= {"fingerprint", "truncated", "malformed", "unknown_key", "bad_signature", "overload"}
    assert rig.loop.state.handler_errors == 0
    assert rig.header(rig.send_signed(RELOAD)).status is Status.OK


def test_given_any_cut_or_more_bytes_then_it_is_counted() -> None:
    rig = Rig()
    good = encode(envelope(RELOAD, START))
    for data in [good[:n] for n in range(len(good))] + [good + b"\0"]:
        assert rig.get_replies(data) == []
    rig.clock.advance(1.0)  # many rejections are counted once a second
    rig.loop.run_once()
    assert (rig.executed, sum(rig.rejected.values())) == (0, len(good) + 1)
    assert {why for _, why in rig.rejected} <= {"fingerprint", "truncated", "malformed", "overload"}


@pytest.mark.parametrize("hours", [1.0, -1.0])
def test_given_the_vehicles_clock_stepped_then_the_client_gets_the_difference(hours: float) -> None:
    rig = Rig()
    now = rig.clock.utime()
    rig.clock.step_utime(hours * 3600)
    header = rig.header(rig.send_signed(RELOAD, utime=now))
    assert header.status is Status.FORBIDDEN
    assert f"3600.0 s {'before' if hours > 0 else 'after'} the time of the vehicle's clock" in header.message
    assert rig.rejected == {("PLATFORM_RELOAD_MODEL", "stale"): 1}
    # a sender with the right time is not affected
    assert rig.header(rig.send_signed(RELOAD)).status is Status.OK


def test_given_a_command_from_before_the_start_then_it_is_denied() -> None:
    rig = Rig()
    rig.loop._requests._verifier._started_ns = rig.clock.monotonic_ns()  # type: ignore[union-attr]
    header = rig.header(rig.send_signed(RELOAD))
    assert header.status is Status.FORBIDDEN
    assert "has just started" in header.message
    rig.clock.advance(1.1)
    assert rig.header(rig.send_signed(RELOAD)).status is Status.OK


@pytest.mark.parametrize("channel", ["PLATFORM_GET_BODY_LIST", "IMU", "POSE", "MODELSERVER_SIGNED", "", "x" * 64])
def test_given_a_channel_that_takes_no_commands_then_it_is_counted(channel: str) -> None:
    rig = Rig()
    assert rig.send_signed(GetBodyList(ME), channel=channel) == []
    assert rig.rejected == {("MODELSERVER_SIGNED", "channel"): 1}


def test_given_no_channel_for_modes_then_an_empty_one_is_none() -> None:
    rig = Rig(mode_channel="")
    assert rig.send_signed(MODE_COMMAND, channel="") == []
    assert (rig.mode_commands, rig.rejected) == ([], {("MODELSERVER_SIGNED", "channel"): 1})


def test_given_something_signed_that_is_no_message_of_its_channel_then_it_is_counted_and_answered_where_it_can_be() -> (
    None
):
    rig = Rig()
    good = encode(RELOAD)
    assert rig.send_signed(b"junk", channel="PLATFORM_RELOAD_MODEL", counter=1) == []
    (reply,) = rig.send_signed(good + b"\0", channel="PLATFORM_RELOAD_MODEL", counter=2)
    assert decode("reload_model_reply_t", reply).header.status is Status.MALFORMED
    rig.send_signed(encode(imu(START)), channel="LOCALIZATION_MODE", counter=3)
    assert rig.rejected == {
        ("PLATFORM_RELOAD_MODEL", "fingerprint"): 1,
        ("PLATFORM_RELOAD_MODEL", "malformed"): 1,
        ("LOCALIZATION_MODE", "fingerprint"): 1,
    }


def test_given_a_signed_command_with_a_reply_channel_outside_the_rules_then_there_is_no_reply() -> None:
    rig = Rig()
    for number, channel in enumerate(("POSE", "IMU", "REPLY_", "REPLY_\n", "")):
        rig.send_signed(ReloadModel(RequestHeader(1, channel)), counter=number)
        rig.send_signed(ReloadModel(RequestHeader(1, channel)), counter=number)  # a replayed one: denied
    assert all(decode("pose_transform_t", data) for data in rig.bus.get_published("POSE"))
    assert not rig.bus.get_published("IMU")
    assert rig.loads == 0


def test_given_a_flood_of_envelopes_then_questions_are_answered_and_the_excess_is_counted() -> None:
    rig = Rig()
    junk = encode(envelope(RELOAD, START, key=Key("test", b"a secret that is guessed")))
    for _ in range(3000):
        rig.bus.publish("MODELSERVER_SIGNED", junk)
    rig.bus.publish("PLATFORM_GET_BODY_LIST", encode(GetBodyList(ME)))
    for _ in range(300):
        rig.loop.run_once()
    assert len(rig.bus.get_published("REPLY_TEST")) == 1
    assert sum(rig.rejected.values()) == 3000
    assert {why for _, why in rig.rejected} == {"bad_signature", "overload"}


def test_given_signed_texts_with_control_characters_then_the_log_is_clean(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    rig = Rig()
    evil = "x\nERROR root: FORGED\x1b[31m\r"
    rig.send_signed(RELOAD, sender=evil)
    rig.send_signed(RELOAD, sender=evil)
    rig.send_signed(RELOAD, channel=evil)
    assert caplog.records
    assert all(record.getMessage().isprintable() for record in caplog.records)
