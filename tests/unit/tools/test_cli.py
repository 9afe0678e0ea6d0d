"""The command line itself: errors name the nearest known word."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support_samples import VEHICLE, write_vehicle

from mstools.cli import COMMAND_ALIASES, COMMANDS, COMPLETION_VARIABLE, main


@pytest.mark.parametrize(
    ("word", "words"),
    [
        ("serve", "did you mean run? Run the service"),
        ("replya", "did you mean replay?"),
        ("xyzzy", "commands: demo, new, up, run, check"),
    ],
)
def test_given_an_unknown_command_then_the_nearest_is_offered(
    capsys: pytest.CaptureFixture[str], word: str, words: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([word, "-c", "vehicle.yaml"])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert f"unknown command {word!r}" in err
    assert words in err


@pytest.mark.parametrize("command", [("run",), ("driver", "gps")])
@pytest.mark.parametrize("option", ["--log-level", "--log-format"])
def test_given_a_log_that_there_is_not_then_those_there_are_are_reported(
    capsys: pytest.CaptureFixture[str], command: tuple[str, ...], option: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command, "-c", "vehicle.yaml", option, "loud"])
    assert ended.value.code == 2
    assert f"{option}: 'loud' is not one of " in " ".join(capsys.readouterr().err.split())


def test_given_the_words_of_others_then_they_lead_to_commands_that_there_are() -> None:
    assert set(COMMAND_ALIASES.values()) <= COMMANDS.keys()
    assert not COMMAND_ALIASES.keys() & COMMANDS.keys()


Complete = Callable[[str], tuple[object, list[str]]]


@pytest.fixture
def complete(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Complete:
    """A function that completes the last of some words as bash asks; it returns exit code and names."""

    def run(words: str) -> tuple[object, list[str]]:
        monkeypatch.setenv(COMPLETION_VARIABLE, "complete_bash")
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        with pytest.raises(SystemExit) as ended:
            main([])
        return ended.value.code, capsys.readouterr().out.split()

    return run


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("modelserver query Cam", ["Camera", "Camera:Origin"]),
        ("modelserver query Camera Odom", ["Odom:Origin"]),
        ("modelserver query Camera m", ["map"]),
        ("modelserver query a --expressed-in Cart:M", ["Cart:Mast"]),
        ("modelserver query --model missing.yaml Cam", []),
        ("modelserver replay a.lcm --frame Cart:A", ["Cart:Antenna"]),
        ("modelserver replay a.lcm --channel POSE_O", ["POSE_ODOM"]),
        ("modelserver driver fro", ["front"]),
        ("modelserver emulate x", []),
    ],
)
def test_given_a_vehicle_file_then_the_shell_completes_its_names(
    words: str, expected: list[str], tmp_path: Path, complete: Complete, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_vehicle(tmp_path, VEHICLE + "drivers: {front: {device: gpsd, address: 'localhost:2947'}}\n")
    monkeypatch.chdir(tmp_path)
    assert complete(words) == (0, expected)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("modelserver qu", ["query"]),
        ("modelserver query --exp", ["--explain", "--expressed-in"]),
        ("modelserver up --em", ["--emulate"]),
        ("modelserver key n", ["new"]),
        ("modelserver xyzzy --a", []),
    ],
)
def test_given_a_shell_that_completes_then_commands_and_their_options_are_offered(
    words: str, expected: list[str], complete: Complete
) -> None:
    assert complete(words) == (0, expected)
