"""`modelserver mode`: the command arrives on the channel of the vehicle file; errors name the fix."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import lcm
import pytest
import typer
from support_lcm import Listener, reserved_url
from support_samples import START, VEHICLE
from support_samples import write_vehicle as write_files
from support_signing import KEY, write_test_key

from modelserver.core import RUNNING
from modelserver.messages import VALID, Envelope, Health, LocalizationHealth, Mode, RejectedCount, SwitchMode
from modelserver.signing import has_valid_signature
from modelserver.wire.codec import decode, encode
from mstools.cli import main
from mstools.commands.control import MODES, parse_mode

LISTENS = VEHICLE + "commands: {key_file: commands.key}\nlocalization: {mode_channel: console/mode}\n"
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; return its exit code, standard output and error."""

    def mode(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["mode", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return mode


def write_vehicle(folder: Path, vehicle: str = VEHICLE) -> Path:
    """Write a vehicle's files, and the key beside them."""
    write_test_key(folder)
    return write_files(folder, vehicle)


class Answering:
    """A daemon that receives mode commands and publishes its health, as far as a test wants."""

    def __init__(self, url: str, prefix: str = "", mode: Mode | None = Mode.FULL, applies: bool = True):
        self.mode, self.applies, self.prefix = mode, applies, prefix
        self.rejected: tuple[RejectedCount, ...] = (RejectedCount(f"{prefix}MODELSERVER_SIGNED", "stale", 3),)
        self.commands: list[SwitchMode] = []
        self.bus = lcm.LCM(url)
        self.subscriptions = [self.bus.subscribe(f"{prefix}MODELSERVER_SIGNED", self.on_command)]
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.run)

    def __enter__(self) -> Answering:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.thread.join()
        # its handler refers to this object, and so to the bus
        self.bus.unsubscribe(self.subscriptions.pop())

    def run(self) -> None:
        while not self.ended.is_set():
            self.bus.handle_timeout(20)
            health = Health(
                *(START, 1.0, "1", "cart", "", RUNNING, VALID, 0, 0, 0, 0, 0, 0, 0),
                localization=LocalizationHealth(self.mode),
                rejected=self.rejected,
            )
            self.bus.publish(f"{self.prefix}MODELSERVER_HEALTH", encode(health))

    def on_command(self, _: str, data: bytes) -> None:
        envelope: Envelope = decode("signed_t", data)
        assert envelope.channel == "console/mode"
        assert has_valid_signature(KEY, self.prefix, envelope)
        command: SwitchMode = decode("localization_mode_t", envelope.payload)
        self.commands.append(command)
        if self.applies:
            self.mode = command.mode
        else:
            self.rejected = (*self.rejected, RejectedCount(f"{self.prefix}MODELSERVER_SIGNED", "bad_signature", 1))


@pytest.mark.parametrize("prefix", ["", "V1_"])
def test_given_a_daemon_that_applies_then_the_mode_before_and_now_are_reported(
    tmp_path: Path, run: Run, prefix: str
) -> None:
    config = write_vehicle(tmp_path, f"{LISTENS}lcm: {{channel_prefix: '{prefix}'}}\n")
    with reserved_url() as url, Answering(url, prefix) as daemon:
        assert run("no_wheels", "-c", config, "--url", url) == (0, "now no_wheels (was full)\n", "")
    (command,) = daemon.commands
    assert command.mode is Mode.NO_WHEELS
    assert command.header.source == "operator"
    assert command.header.utime == command.header.host_utime > 1_700_000_000_000_000


def test_given_a_daemon_that_goes_to_raw_mode_then_that_is_reported(tmp_path: Path, run: Run) -> None:
    config = write_vehicle(tmp_path, LISTENS)
    with reserved_url() as url, Answering(url):
        assert run("raw", "-c", config, "--url", url)[:2] == (0, "now raw (was full)\n")
        assert run("raw", "-c", config, "--url", url)[:2] == (0, "now raw (was raw)\n")


def test_given_a_daemon_that_stays_in_its_mode_then_that_is_reported(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mstools.commands.control.TIMEOUT_S", 0.5)
    with reserved_url() as url, Answering(url, applies=False):
        code, out, err = run("no_gps", "-c", write_vehicle(tmp_path, LISTENS), "--url", url)
    assert (code, out) == (1, "")
    assert "but the daemon stays in mode full (bad_signature: see docs/words.md)" in err


def test_given_nobody_then_it_is_reported_what_was_sent_and_that_nobody_answers(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mstools.commands.control.TIMEOUT_S", 0.1)
    with reserved_url() as url:
        config = write_vehicle(tmp_path, f"{LISTENS}lcm: {{url: '{url}'}}\n")
        listener = Listener(url, "MODELSERVER_SIGNED")
        code, out, err = run("full", "--config", config)
        assert (code, out) == (1, "")
        assert "sent console/mode: full, but no health report was received" in err
        assert listener.wait()


def test_given_a_daemon_without_localization_then_it_reports_that(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mstools.commands.control.TIMEOUT_S", 0.5)
    with reserved_url() as url, Answering(url, mode=None, applies=False):
        code, _, err = run("no_gps", "-c", write_vehicle(tmp_path, LISTENS), "--url", url)
    assert code == 1
    assert "the daemon has no localization" in err


def test_given_a_vehicle_file_without_a_channel_then_it_reports_what_to_write(tmp_path: Path, run: Run) -> None:
    code, out, err = run("raw", "-c", write_vehicle(tmp_path), "--url", "memq://")
    assert (code, out) == (1, "")
    assert "no channel for mode commands is configured" in err
    assert "localization.mode_channel" in err
    assert "write mode_channel: LOCALIZATION_MODE under localization" in err


@pytest.mark.parametrize(
    ("text", "words"),
    [("no_gsp", "did you mean no_gps?"), ("FUL", "did you mean full?"), ("xyzzy", "modes: full, raw, no_imu")],
)
def test_given_a_mistyped_mode_then_the_nearest_is_offered(tmp_path: Path, run: Run, text: str, words: str) -> None:
    code, _, err = run(text, "-c", write_vehicle(tmp_path, LISTENS))
    assert code == 2
    assert words in " ".join(err.split())


def test_given_a_vehicle_file_that_is_wrong_or_missing_then_it_is_reported(tmp_path: Path, run: Run) -> None:
    code, _, err = run("raw", "-c", write_vehicle(tmp_path, f"{VEHICLE}localization: {{mode_chanel: M}}\n"))
    assert code == 1
    assert "write mode_channel" in err
    assert run("raw", "-c", tmp_path / "none.yaml")[0] == 1


@pytest.mark.parametrize("mode", Mode)
def test_given_the_name_of_a_mode_in_any_suggestion_then_it_is_understood(mode: Mode) -> None:
    name = mode.name.lower()
    assert name in MODES
    assert {parse_mode(text) for text in (name, mode.name, name.replace("_", "-"), f" {name} ")} == {mode}
    with pytest.raises(typer.BadParameter):
        parse_mode(f"{name}s_of_another_kind_altogether")
