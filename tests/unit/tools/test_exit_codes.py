"""Exit codes: the documented ones are those of the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from modelserver.server.journal.verify import VerificationResult
from mstools.cli import COMMANDS, main
from mstools.commands import doctor, query, status

PAGE = Path(__file__).parents[3] / "docs" / "operation.md"


def read_table() -> dict[str, set[int]]:
    """Return the exit codes of each command of the table."""
    table = PAGE.read_text(encoding="utf-8").partition("| commands | code | meaning |")[2].partition("\n\n")[0]
    found: dict[str, set[int]] = {}
    for commands, codes in re.findall(r"^\| ([^|]+) \| ([\d, ]+) \|", table, re.MULTILINE):
        for name in commands.replace("`", "").split(", "):
            found.setdefault(name, set()).update(map(int, codes.split(", ")))
    return found


def test_given_the_table_then_its_codes_are_those_of_the_commands() -> None:
    table = read_table()
    assert {name.split()[0] for name in table} - {"all"} <= set(COMMANDS)
    assert table["all"] == {0, 1, 2, 130}
    assert table["query"] == {query.EXIT_UNMET}
    assert table["status"] == {status.EXIT_UNHEALTHY}
    assert table["doctor"] == {doctor.EXIT_WARNINGS, doctor.EXIT_ERRORS}
    assert table["replay --verify"] == set(VerificationResult) - table["all"]


@pytest.mark.parametrize("name", COMMANDS)
def test_given_a_wrong_option_then_every_command_exits_with_2_and_its_help_with_0(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for option, code in (("--no-such-option", 2), ("--help", 0)):
        with pytest.raises(SystemExit) as ended:
            main([name, option])
        assert (ended.value.code or 0) == code
    capsys.readouterr()


@pytest.mark.parametrize(
    "words",
    [
        ("check", "{}"),
        ("query", "A", "B", "--model", "{}"),
        ("tree", "{}"),
        ("run", "-c", "{}"),
        ("up", "-c", "{}"),
        ("replay", "{}", "-c", "{}", "--poses", "-"),
        ("import-bag", "{}"),
        ("status", "-c", "{}"),
        ("view", "{}"),
    ],
)
def test_given_a_file_that_does_not_exist_then_the_exit_code_is_1(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([word.format(tmp_path / "none.yaml") for word in words])
    assert ended.value.code == 1
    output = capsys.readouterr()
    assert "none.yaml" in (output.out if words[0] == "check" else output.err)
