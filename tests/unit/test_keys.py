"""Key files: made for their owner alone, read only where others cannot, and no secret is ever repeated."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from modelserver.errors import KeyFileError
from modelserver.key_files import KEY_BYTES, generate_key, read_keys, write_key
from mstools.cli import main

HEX = "00112233445566778899aabbccddeeff"


def write_file(folder: Path, text: str, mode: int = 0o600) -> Path:
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
    one, other = generate_key(), generate_key()
    assert one.secret != other.secret
    assert one.name != other.name
    with pytest.raises(KeyFileError):
        generate_key("with space")


def test_given_several_keys_then_all_are_read_in_order(tmp_path: Path) -> None:
    path = write_file(tmp_path, f"# ours\n\nold {HEX}\n  new {HEX}00\n")
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
def test_given_a_file_that_is_no_key_file_then_it_is_rejected_without_quoting_it(
    tmp_path: Path, text: str, why: str
) -> None:
    with pytest.raises(KeyFileError, match=why) as caught:
        read_keys(write_file(tmp_path, text))
    assert HEX[:30] not in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("mode", [0o604, 0o644, 0o602, 0o601, 0o620, 0o777])
def test_given_a_file_that_others_may_touch_then_it_is_rejected(tmp_path: Path, mode: int) -> None:
    with pytest.raises(KeyFileError, match="chmod 600"):
        read_keys(write_file(tmp_path, f"a {HEX}\n", mode))


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o640, 0o440])
def test_given_a_file_of_its_owner_and_group_then_it_is_read(tmp_path: Path, mode: int) -> None:
    assert read_keys(write_file(tmp_path, f"a {HEX}\n", mode))[0].name == "a"


def test_given_what_systemd_hands_over_then_that_is_read_whatever_its_mode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handed = tmp_path / "credentials"
    handed.mkdir()
    write_file(handed, f"handed {HEX}\n", 0o444)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(handed))
    assert read_keys("/etc/modelserver/some.key")[0].name == "handed"
    with pytest.raises(KeyFileError, match="there is no key file"):
        read_keys(tmp_path / "other.key")


def test_given_no_file_then_the_error_names_the_command_that_makes_one(tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match="modelserver key new"):
        read_keys(tmp_path / "none")
    with pytest.raises(KeyFileError, match="cannot be read"):
        read_keys(tmp_path)
    with pytest.raises(KeyFileError, match="cannot be written"):
        write_key(tmp_path / "none" / "a.key", generate_key())


# --- who can put another file in its place ------------------------------------------------------------------


@pytest.mark.parametrize("by", ["name", "link"])
def test_given_a_key_in_a_folder_that_everyone_may_write_then_it_is_not_read_nor_made(tmp_path: Path, by: str) -> None:
    folder = tmp_path / "open"
    folder.mkdir()
    path = write_file(folder, f"a {HEX}")
    if by == "link":
        path = tmp_path / "link.key"
        path.symlink_to(folder / "some.key")
    assert read_keys(path)[0].name == "a"
    folder.chmod(0o777)
    with pytest.raises(KeyFileError, match=r"open, which everyone may write \(mode 0777\): chmod o-w it"):
        read_keys(path)
    with pytest.raises(KeyFileError, match="everyone may write"):
        write_key(folder / "new.key", generate_key())
    assert not (folder / "new.key").exists()
    # files in one with the sticky bit are their owners'
    folder.chmod(0o1777)
    assert read_keys(path)[0].name == "a"


def test_given_a_key_or_a_folder_of_another_user_then_it_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_file(tmp_path, f"a {HEX}")
    stranger = os.geteuid() + 12345
    if os.geteuid() == 0:
        os.chown(path, stranger, -1)
        with pytest.raises(KeyFileError, match=f"owned by user {stranger}, who can replace it"):
            read_keys(path)
        os.chown(path, 0, -1)
        os.chown(tmp_path, stranger, -1)
        with pytest.raises(KeyFileError, match=f"reached by the folder .*owned by user {stranger}"):
            read_keys(path)
        os.chown(tmp_path, 0, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: stranger)
        with pytest.raises(KeyFileError, match="who can replace it"):
            read_keys(path)
        monkeypatch.undo()
    assert read_keys(path)[0].name == "a"
