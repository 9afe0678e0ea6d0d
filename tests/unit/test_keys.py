"""Key files: made for their owner alone, read only where others cannot, and no secret is ever repeated."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from modelserver.errors import KeyFileError
from modelserver.keys import KEY_BYTES, new_key, read_keys, write_key
from mstools.cli import main

HEX = "00112233445566778899aabbccddeeff"


def written(folder: Path, text: str, mode: int = 0o600) -> Path:
    path = folder / "some.key"
    path.write_text(text)
    path.chmod(mode)
    return path


def test_given_a_new_key_then_its_file_is_its_owners_and_reads_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "new.key"
    with pytest.raises(SystemExit) as ended:
        main(["key", "new", str(path), "--name", "raptor-1"])
    assert ended.value.code == 0
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    (key,) = read_keys(path)
    assert (key.name, len(key.secret)) == ("raptor-1", KEY_BYTES)
    out, err = capsys.readouterr()
    assert "raptor-1" in out
    assert key.secret.hex() not in out + err
    with pytest.raises(SystemExit) as ended:
        main(["key", "new", str(path)])
    assert ended.value.code == 1
    assert "exists already" in capsys.readouterr().err
    assert read_keys(path) == (key,)


def test_given_two_new_keys_then_secrets_and_names_differ() -> None:
    one, other = new_key(), new_key()
    assert one.secret != other.secret
    assert one.name != other.name
    with pytest.raises(KeyFileError):
        new_key("with space")


def test_given_several_keys_then_all_are_read_in_order(tmp_path: Path) -> None:
    path = written(tmp_path, f"# ours\n\nold {HEX}\n  new {HEX}00\n")
    assert [key.name for key in read_keys(path)] == ["old", "new"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "holds 0 keys"),
        ("# nothing\n", "holds 0 keys"),
        (f"short {HEX[:30]}\n", "can be guessed"),
        (f"{HEX}\n", "can be guessed"),
        ("name xyz\n", "NAME HEX"),
        (f"a {HEX}\na {HEX}\n", "given twice"),
        (f"a/b {HEX}\n", "the name of a key"),
        ("".join(f"k{n} {HEX}\n" for n in range(9)), "holds 9 keys"),
        ("x" * 10_000, "longer than"),
        ("\x00\xff\x1b[31m", "the name of a key"),
    ],
)
def test_given_a_file_that_is_no_key_file_then_it_says_why_and_repeats_nothing_of_it(
    tmp_path: Path, text: str, why: str
) -> None:
    with pytest.raises(KeyFileError, match=why) as caught:
        read_keys(written(tmp_path, text))
    assert HEX[:30] not in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("mode", [0o604, 0o644, 0o602, 0o601, 0o620, 0o777])
def test_given_a_file_that_others_may_touch_then_it_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(KeyFileError, match="chmod 600"):
        read_keys(written(tmp_path, f"a {HEX}\n", mode))


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o640, 0o440])
def test_given_a_file_of_its_owner_and_group_then_it_is_read(tmp_path: Path, mode: int) -> None:
    assert read_keys(written(tmp_path, f"a {HEX}\n", mode))[0].name == "a"


def test_given_what_systemd_hands_over_then_that_is_read_whatever_its_mode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handed = tmp_path / "credentials"
    handed.mkdir()
    written(handed, f"handed {HEX}\n", 0o444)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(handed))
    assert read_keys("/etc/modelserver/some.key")[0].name == "handed"
    with pytest.raises(KeyFileError, match="there is no key file"):
        read_keys(tmp_path / "other.key")


def test_given_no_file_then_it_says_what_makes_one(tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match="modelserver key new"):
        read_keys(tmp_path / "none")
    with pytest.raises(KeyFileError, match="cannot be read"):
        read_keys(tmp_path)
    with pytest.raises(KeyFileError, match="cannot be written"):
        write_key(tmp_path / "none" / "a.key", new_key())
