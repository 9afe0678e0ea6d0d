"""Hostile text in every field of every type, on every channel of a real loop: the log has it escaped only."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
from support_samples import START, ScriptedLocalizer, start_core
from support_signing import KEY, envelope
from support_wire import EXAMPLES

import mslcm
from modelserver.estimation.history import LocalizerEvent
from modelserver.messages import Rejected, Sample, SwitchMode
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.daemon import log_mode_switch
from modelserver.server.ingress import COMMANDS, CommandVerifier, SensorChannel
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.codec import decode, encode

HOSTILE = [
    b"x\nERROR root: FORGED line",
    b"\x1b[2J\x1b]0;owned\x07\x1b[31m",
    b"../../../../etc/passwd",
    b"/dev/null; rm -rf $HOME `id` $(id)",
    b"%s%d%n%(x)s {0} {x!r}",
    b"\xff\xfe\xc3\x28\x80",
    "\u202e\u2028\u0085\u0000\u200b".encode(),
    b"\r\x08\x08\x7f",
    b"A" * 4000,
]
"""Text for each field, some of it not valid UTF-8."""

SENSORS = {
    each.name: each.type_name for each in CHANNELS if each.use is ChannelUse.SENSOR and each.name != "VEHICLE_STATUS"
}
MODE = "LOCALIZATION_MODE"


class EchoingLocalizer(ScriptedLocalizer):
    """A localizer that rejects every sample with its source name as reason."""

    def process(self, sample: Sample | SwitchMode) -> tuple[ScriptedLocalizer, tuple[LocalizerEvent, ...]]:
        if isinstance(sample, SwitchMode):
            return super().process(sample)
        return self, (Rejected(f"sensor:{sample.header.source}", sample.header.source or "none"),)


class Rig:
    """A loop with all channels of a vehicle."""

    def __init__(self) -> None:
        self.clock = FakeClock(START)
        self.bus = FakeBus(self.clock)
        sensors = {name: SensorChannel(type_name) for name, type_name in SENSORS.items()} | {
            MODE: SensorChannel("localization_mode_t")
        }
        gate = CommandVerifier((KEY,), "", 5.0, MODE, self.clock.monotonic_ns() - 10**13)
        settings = LoopSettings(20_000_000, sensors, publisher_conflict="ignore", shared_channels=frozenset({"JOINTS"}))
        state = start_core(EchoingLocalizer(), may_reload=True, may_set_pose=True)
        self.loop = Loop(self.bus, self.clock, state, settings, Hooks(on_mode_switch=log_mode_switch, verifier=gate))

    def settle(self) -> None:
        # all messages are handled in the first passes; the others are for what follows them
        for passes in (40, 10, 10):
            # longer than the log's rate limit and the health report's period
            self.clock.advance(6.0)
            for _ in range(passes):
                self.loop.run_once()
        assert not self.bus.sensors.pending
        assert not self.bus.requests.pending


class Text(bytes):
    """Bytes that the generated encoder accepts as a text."""

    def encode(self, *_: object) -> bytes:
        return bytes(self)


def fill_fields(type_name: str, hostile: bytes) -> list[bytes]:
    """Return messages of a type with one text after the other, and all together, replaced by a hostile one."""
    messages = []
    for example in EXAMPLES[type_name]:
        data = encode(example, type_name) if type_name in ("pose_transform_t", "pose_vector_t") else encode(example)
        count = _replace(getattr(mslcm, type_name).decode(data), None, hostile)
        for number in [*range(count), -1]:
            message = getattr(mslcm, type_name).decode(data)
            _replace(message, number, hostile)
            messages.append(bytes(message.encode()))
    return messages


def _replace(message: Any, number: int | None, hostile: bytes) -> int:
    """Put the hostile text in the number-th text field (-1: in all); return how many there are."""
    count = 0

    def visit(value: Any) -> Any:
        nonlocal count
        if isinstance(value, str):
            count += 1
            return Text(hostile) if number in (count - 1, -1) else value
        if isinstance(value, (list, tuple)):
            return [visit(each) for each in value]
        if hasattr(value, "__slots__") and hasattr(value, "_get_packed_fingerprint"):
            for name in value.__slots__:
                setattr(value, name, visit(getattr(value, name)))
        return value

    visit(message)
    return count


def assert_clean(caplog: pytest.LogCaptureFixture) -> None:
    for record in caplog.records:
        first, *rest = record.getMessage().split("\n")
        assert first.isprintable(), first
        assert len(first) < 2000
        assert all(line.startswith("    ") and line.isprintable() for line in rest), rest


@pytest.mark.slow
@pytest.mark.parametrize("hostile", HOSTILE, ids=range(len(HOSTILE)))
def test_given_hostile_text_in_any_field_on_any_channel_then_the_log_is_clean_and_the_loop_goes_on(
    hostile: bytes, caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.chdir(tmp_path)
    rig = Rig()
    for channel in CHANNELS:
        inbox = rig.bus.sensors if channel.use is ChannelUse.SENSOR or channel.name == MODE else rig.bus.requests
        for data in fill_fields(channel.type_name, hostile):
            inbox.put(channel.name, data)
        rig.settle()
    assert rig.loop.state.handler_errors == 0, rig.loop.state.rejected
    assert rig.loop.state.rejected
    assert_clean(caplog)
    assert all(name.isprintable() for name, _ in rig.bus.published)
    assert list(tmp_path.iterdir()) == []
    # what it published can be decoded
    for data in rig.bus.get_published("MODELSERVER_HEALTH"):
        decode("health_t", data)


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(len(HOSTILE)))
def test_given_hostile_text_that_is_signed_then_the_log_is_clean(
    hostile: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    rig = Rig()
    text = hostile.decode("utf-8", "replace")
    number = 0
    types = {channel: next(each.type_name for each in CHANNELS if each.name == channel) for channel in COMMANDS}
    for channel, type_name in (types | {MODE: "localization_mode_t"}).items():
        for data in fill_fields(type_name, hostile):
            number += 1
            rig.bus.requests.put(
                "MODELSERVER_SIGNED",
                encode(envelope(data, rig.clock.utime(), counter=number, channel=channel, sender=text[:64])),
            )
            rig.loop.run_once()
    rig.settle()
    assert rig.loop.state.handler_errors == 0, rig.loop.state.rejected
    assert_clean(caplog)
