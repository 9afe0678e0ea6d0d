"""`modelserver replay --verify` on the command line: what it prints, and its exit codes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support_journal import SMALL, JournalRig
from support_samples import gps

from modelserver.key_files import generate_key, write_key
from modelserver.server.journal.verify import VerificationResult
from modelserver.server.journal.writer import NEWEST_NAME, NewestMarker
from modelserver.wire.codec import encode
from modelserver.wire.journal import JournalRecord, encode_batch, read_segment
from mstools import cli
from mstools.commands.replay import find_differences

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; return its exit code, standard output and error."""

    def replay(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["replay", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return replay


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The one segment of a short run."""
    rig = JournalRig(tmp_path_factory.mktemp("vehicle"), SMALL)
    rig.drive(2.0)
    (path,) = rig.finish()
    return path.read_bytes()


@pytest.fixture
def folder(tmp_path: Path, journal: bytes) -> Path:
    (tmp_path / "journal-00000000.lcm").write_bytes(journal)
    (tmp_path / NEWEST_NAME).write_bytes(NewestMarker(0, 0).encode(None))
    return tmp_path


def change(path: Path) -> None:
    data = path.read_bytes()
    records = [each for each in read_segment(data) if isinstance(each, JournalRecord)]
    at = next(n for n, each in enumerate(records) if each.channel == "POSE" and n > 60)
    other = records[at].data
    records[at] = records[at]._replace(data=other[:48] + bytes([other[48] ^ 1]) + other[49:])
    path.write_bytes(data[: records[0].at] + encode_batch(0, records))


def test_given_a_journal_when_verified_then_the_counts_are_printed_and_the_code_is_that_of_reproduced(
    run: Run, folder: Path
) -> None:
    for target in (folder, folder / "journal-00000000.lcm"):
        code, out, err = run("--verify", target)
        assert (code, err) == (0, "")
        assert "not proved authentic (--key FILE checks the seals" in out
        assert "1 segment of 1 run" in out
        assert "reproduced bit for bit" in out
        assert "  POSE_ODOM " in out


def test_given_json_then_it_holds_all_of_it(run: Run, folder: Path) -> None:
    code, out, _ = run("--verify", folder, "--json")
    reported = json.loads(out)
    assert code == 0
    assert (reported["result"], reported["proved"], reported["authentic"]) == ("reproduced", True, False)
    assert reported["poses"] == 3 * reported["exact"]["POSE"] > 200
    assert reported["difference"] is None


def test_given_a_pose_that_was_changed_then_it_is_named_field_by_field_and_the_code_is_1(
    run: Run, folder: Path
) -> None:
    path = folder / "journal-00000000.lcm"
    change(path)
    code, out, _ = run("--verify", folder)
    assert code == 1
    assert "NOT REPRODUCED: POSE differs" in out
    assert str(path) in out
    assert ": was " in out
    reported = json.loads(run("--verify", folder, "--json")[1])
    assert reported["difference"]["channel"] == "POSE"
    assert len(reported["difference"]["fields"]) == 1


def test_given_a_torn_tail_then_it_is_reported_and_the_code_is_that_of_reproduced(run: Run, folder: Path) -> None:
    path = folder / "journal-00000000.lcm"
    path.write_bytes(path.read_bytes()[:-300])
    code, _, err = run("--verify", folder)
    assert code == 0
    assert "is truncated" in err


def test_given_damage_then_its_place_is_reported_and_the_code_is_1(run: Run, folder: Path) -> None:
    path = folder / "journal-00000000.lcm"
    data = bytearray(path.read_bytes())
    data[-5000] ^= 1
    path.write_bytes(data)
    code, _, err = run("--verify", folder)
    assert code == 1
    assert "checksum" in err


def test_given_a_key_and_a_journal_that_is_not_sealed_with_one_then_that_is_reported(run: Run, folder: Path) -> None:
    write_key(folder / "k.key", generate_key("rover"))
    code, out, _ = run("--verify", folder, "--key", folder / "k.key")
    assert code == VerificationResult.REPRODUCED
    assert "not proved authentic: 1 segment of 1 not closed, or not sealed with a key" in out
    code, _, err = run(folder / "journal-00000000.lcm", "--key", folder / "k.key")
    assert (code, "--key needs --verify" in err) == (2, True)


@pytest.mark.parametrize("more", [["--speed", "2"], ["--poses", "x.csv"], ["--url", "x"], ["--all"]])
def test_given_options_of_another_use_then_the_usage_is_wrong(run: Run, folder: Path, more: list[str]) -> None:
    code, _, err = run("--verify", folder, *more)
    assert code == 2
    assert "--verify accepts only --json and --key" in err


def test_given_what_is_no_journal_then_that_is_reported(run: Run, tmp_path: Path) -> None:
    code, out, err = run("--verify", tmp_path)
    assert (code, out) == (1, "")
    assert "is no journal" in err
    (tmp_path / "README.md").write_text("# Not a journal\n")
    code, out, err = run("--verify", tmp_path / "README.md")
    assert (code, out) == (1, "")
    assert "README.md: is no journal" in err
    assert "No such file" in run("--verify", tmp_path / "gone.lcm")[2]
    (tmp_path / "journal-00000000.lcm").write_bytes(b"nonsense")
    code, out, err = run("--verify", tmp_path)
    assert code == 1
    assert "nothing is reproduced" in out
    assert "is truncated" in err


def test_given_two_messages_then_the_fields_that_differ_are_named() -> None:
    one, other = encode(gps(1_000_000_000)), encode(gps(1_000_000_001, source="other"))
    assert [name for name, _, _ in find_differences(one, other)] == ["header.utime", "header.source"]
    assert find_differences(one, b"12345678") == [
        ("type or content", f"{len(one)} bytes {one[:12].hex()}", "8 bytes 3132333435363738")
    ]
    assert find_differences(one, one[:20])[0][0] == "type or content"
