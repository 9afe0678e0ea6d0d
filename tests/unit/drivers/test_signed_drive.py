"""Commands to the vehicle controller: signed where there is a key, and nobody without it drives."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import lcm
import pytest

import modelserver as ms
from modelserver.config.vehicle_file import CommandsConfig, LcmConfig, VehicleConfig
from modelserver.key_files import generate_key, write_key
from modelserver.messages import Envelope, VehicleCommand
from modelserver.signing import Key, sign
from modelserver.wire.codec import encode
from modelserver.wire.provider import handle_message
from msdrivers.endpoint import HostTime
from msdrivers.runner import CommandDeniedError, DriveVerifier, SystemTimeSource
from mstools.commands.driver import subscribe_commands

KEY = Key("key-1", b"0123456789abcdef")
UTIME = 1_800_000_000_000_000
COMMAND = VehicleCommand(UTIME, 0.3, 0, "planner", 1.0, 0.1)


def seal(key: Key = KEY, prefix: str = "", channel: str = "VEHICLE_COMMAND", utime: int = UTIME, counter: int = 1,
         payload: bytes = encode(COMMAND)) -> bytes:  # fmt: skip
    return encode(sign(key, prefix, Envelope("", "planner@here", utime, counter, channel, payload)))


@pytest.fixture
def verifier() -> DriveVerifier:
    return DriveVerifier([KEY], "", "VEHICLE_COMMAND", 5.0, 0)


NOW = HostTime(10_000_000_000, UTIME + 100_000)


def test_given_a_signed_command_then_it_is_accepted_once(verifier: DriveVerifier) -> None:
    assert verifier.verify(seal(), NOW) == COMMAND
    with pytest.raises(CommandDeniedError) as denied:
        verifier.verify(seal(), NOW)
    assert denied.value.reason == "replayed"
    assert verifier.verify(seal(counter=2), NOW) == COMMAND


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (seal(Key("key-1", b"another secret!!")), "bad_signature"),
        (seal(Key("other", KEY.secret)), "unknown_key"),
        (seal(prefix="other/"), "bad_signature"),
        (seal(channel="PLATFORM_RELOAD_MODEL"), "channel"),
        (seal(utime=UTIME - 60_000_000), "stale"),
        (seal(utime=UTIME + 60_000_000), "stale"),
        (seal(payload=b"no command"), "fingerprint"),
        (b"", "fingerprint"),
        (encode(COMMAND), "fingerprint"),
    ],
)
def test_given_another_key_vehicle_channel_or_time_then_it_is_denied(
    verifier: DriveVerifier, data: bytes, reason: str
) -> None:
    with pytest.raises(CommandDeniedError) as denied:
        verifier.verify(data, NOW)
    assert denied.value.reason == reason


def test_given_a_command_that_an_earlier_run_could_have_accepted_then_it_is_denied() -> None:
    verifier = DriveVerifier([KEY], "", "VEHICLE_COMMAND", 5.0, NOW.monotonic_ns)
    with pytest.raises(CommandDeniedError, match="just started"):
        verifier.verify(seal(), NOW)


class FakeRunner:
    """Records what a driver would get."""

    def __init__(self) -> None:
        self.commands: list[VehicleCommand] = []
        self.rejected: list[str] = []

    def send_command(self, command: VehicleCommand) -> None:
        self.commands.append(command)

    def reject_command(self, reason: str, text: str) -> None:
        self.rejected.append(reason)


def run_bus(url: str, commands: CommandsConfig, send: Any, until: Any) -> FakeRunner:
    runner = FakeRunner()
    vehicle = VehicleConfig(
        "cart", "geometry.yaml", "Cart:Base", lcm=LcmConfig(channel_prefix="cart_"), commands=commands
    )
    bus = lcm.LCM(url)
    attend = subscribe_commands(bus, vehicle, "VEHICLE_COMMAND", runner, SystemTimeSource())  # type: ignore[arg-type]
    deadline = time.monotonic() + 30.0
    while not until(runner) and time.monotonic() < deadline:
        send()
        handle_message(bus, 50)
        attend()
    return runner


def test_given_a_key_file_then_only_signed_commands_drive(tmp_path: Path, lcm_url: str) -> None:
    file = tmp_path / "commands.key"
    write_key(file, generate_key())
    with (
        ms.VehicleCommander("planner", url=lcm_url, channel_prefix="cart_", key_file=file) as commander,
        ms.VehicleCommander("stranger", url=lcm_url, channel_prefix="cart_") as stranger,
    ):

        def send() -> None:
            stranger.drive(5.0)
            commander.drive(1.0, 0.1)

        runner = run_bus(
            lcm_url, CommandsConfig(key_file=str(file)), send, lambda runner: runner.commands and runner.rejected
        )
    assert {each.source for each in runner.commands} == {"planner"}
    assert "unsigned" in runner.rejected
    assert set(runner.rejected) <= {"unsigned", "stale"}  # stale: within a second of the driver's start


def test_given_no_key_file_or_a_choice_then_commands_need_no_signature(tmp_path: Path, lcm_url: str) -> None:
    file = tmp_path / "commands.key"
    write_key(file, generate_key())
    for commands in (CommandsConfig(), CommandsConfig(drive="unsigned", key_file=str(file))):
        with ms.VehicleCommander("planner", url=lcm_url, channel_prefix="cart_") as commander:
            runner = run_bus(lcm_url, commands, lambda: commander.drive(1.0), lambda runner: runner.commands)
        assert runner.commands[0].forward_speed == 1.0
        assert not runner.rejected


def test_given_a_choice_without_a_key_then_it_is_an_error() -> None:
    with pytest.raises(ValueError, match="drive: signed needs a key_file beside it"):
        CommandsConfig(drive="signed")
    assert not CommandsConfig().is_drive_signed
    assert CommandsConfig(key_file="a.key").is_drive_signed


@pytest.mark.parametrize("values", [(float("nan"), 0.0, 0.3), (1.0, 20.0, 0.3), (1.0, 0.0, 0.0)])
def test_given_a_command_that_cannot_be_then_it_is_rejected(values: tuple[float, float, float], lcm_url: str) -> None:
    with (
        ms.VehicleCommander("planner", url=lcm_url) as commander,
        pytest.raises(ValueError, match="a command has a finite speed"),
    ):
        commander.drive(values[0], values[1], valid_for=values[2])
