"""`modelserver mode`: the wish reaches the channel that the vehicle file names, and slips are told with what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from support_lcm import Listener, reserved_url
from support_samples import VEHICLE, write_vehicle

from modelserver.messages import Mode, SwitchMode
from modelserver.wire.codec import decode
from mstools.cli import main
from mstools.mode import MODES, parse_mode

LISTENS = VEHICLE + "localization: {mode_channel: console/mode}\n"
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


@pytest.mark.parametrize("prefix", ["", "V1_"])
def test_given_a_mode_then_the_wish_is_heard_on_the_channel_of_the_vehicle_file(
    tmp_path: Path, run: Run, prefix: str
) -> None:
    config = write_vehicle(tmp_path, f"{LISTENS}lcm: {{channel_prefix: '{prefix}'}}\n")
    with reserved_url() as url:
        listener = Listener(url, f"{prefix}console/mode")
        code, out, err = run("no_gps", "-c", config, "--url", url)
        assert (code, out, err) == (0, f"told {prefix}console/mode: no_gps\n", "")
        assert listener.wait()
    (data,) = listener.heard
    wish: SwitchMode = decode("localization_mode_t", data)
    assert wish.mode is Mode.NO_GPS
    assert wish.header.source == "operator"
    assert wish.header.utime == wish.header.host_utime > 1_700_000_000_000_000


def test_given_no_url_then_it_is_the_vehicle_files(tmp_path: Path, run: Run) -> None:
    with reserved_url() as url:
        config = write_vehicle(tmp_path, f"{LISTENS}lcm: {{url: '{url}'}}\n")
        listener = Listener(url, "console/mode")
        assert run("full", "--config", config)[0] == 0
        assert listener.wait()


def test_given_a_vehicle_file_without_a_channel_then_it_says_what_to_write(tmp_path: Path, run: Run) -> None:
    code, out, err = run("raw", "-c", write_vehicle(tmp_path), "--url", "memq://")
    assert (code, out) == (1, "")
    assert "names no channel for wishes about the mode" in err
    assert "localization.mode_channel" in err
    assert "write mode_channel: LOCALIZATION_MODE under localization" in err


@pytest.mark.parametrize(
    ("text", "words"),
    [("no_gsp", "did you mean no_gps?"), ("FUL", "did you mean full?"), ("xyzzy", "there are: full, raw, no_imu")],
)
def test_given_a_mistyped_mode_then_the_nearest_is_offered(tmp_path: Path, run: Run, text: str, words: str) -> None:
    code, _, err = run(text, "-c", write_vehicle(tmp_path, LISTENS))
    assert code == 2
    assert words in " ".join(err.split())


def test_given_a_vehicle_file_that_is_wrong_or_missing_then_it_is_told(tmp_path: Path, run: Run) -> None:
    code, _, err = run("raw", "-c", write_vehicle(tmp_path, f"{VEHICLE}localization: {{mode_chanel: M}}\n"))
    assert code == 1
    assert "write mode_channel" in err
    assert run("raw", "-c", tmp_path / "none.yaml")[0] == 1


@pytest.mark.parametrize("mode", Mode)
def test_given_the_name_of_a_mode_in_any_spelling_then_it_is_understood(mode: Mode) -> None:
    name = mode.name.lower()
    assert name in MODES
    assert {parse_mode(text) for text in (name, mode.name, name.replace("_", "-"), f" {name} ")} == {mode}
    with pytest.raises(typer.BadParameter):
        parse_mode(f"{name}s_of_another_kind_altogether")
