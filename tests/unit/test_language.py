"""The project's language: no coined word, no metaphor and no British spelling in names, docs and messages.

Run as a program, it lists what it finds: python tests/unit/test_language.py [FILE_OR_FOLDER ...]
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

EXEMPT = (
    "tests/unit/test_language.py",
    "lcmtypes/mslcm/",
)
"""This list; what lcm-gen wrote."""

BANNED = {
    # private vocabulary -> the term
    r"told|tells?|telling": "publish, report, send; message",
    r"said|says?|saying": "message, report; state",
    r"heard|hears?|hearing|ears?": "receive; listener, subscriber",
    r"wish|wishes|wished|orders? to|obey|obeys|obeyed": "request, command, apply",
    r"anew": "re-",
    r"sureness|unsure|sure of": "uncertainty, sigma, covariance",
    r"lingers?|lingered|lingering": "time-correlated error",
    r"doubts?|doubted": "warning, suspect",
    r"remarks?|troubles?": "warning, finding, problem",
    r"rivals?|rivalry": "publisher conflict",
    r"sought": "search, heading alignment",
    r"vouch|vouched|vouches": "verify",
    r"mends?|mended|mending": "fix, remedy",
    r"stillness|stands still|stood still|standstill": "stationary",
    r"lateness": "latency, delay",
    r"ageing|aging": "inflate while stopped",
    r"woken|wakes up": "timer, wake",
    r"carried on|gone on": "propagate, continue",
    r"come by|comes by|came by": "provenance",
    r"taken up": "re-initialize",
    r"turned down|turns down": "reject, deny, drop",
    r"house|houses|reception|desk|desks": "request handler, queue",
    r"swing|swings|swung": "large-angle",
    r"whoever|who speaks|who tells": "publisher",
    # spelling
    r"metres?|centimetres?|millimetres?|kilometres?|centres?|centred|behaviours?|colours?|coloured|neighbours?"
    r"|neighbouring|levell(?:ed|ing|s)|modell(?:ed|ing)|labell(?:ed|ing)|cancell(?:ed|ing)|grey|licence|honours?"
    r"|favours?|analys(?:e|ed|es|ing)|quantis\w+|normalis\w+|initialis\w+|serialis\w+|organis\w+|recognis\w+"
    r"|optimis\w+|linearis\w+|synchronis\w+|summaris\w+|minimis\w+|maximis\w+|authoris\w+|realis\w+|utilis\w+"
    r"|standardis\w+|visualis\w+|characteris\w+|customis\w+|emphasis(?:e|ed|es|ing)\b|parametris\w+": "American",
}  # fmt: skip
"""Regular expression of words, in names as parts of snake_case or CamelCase, with what to write instead."""

NAMES_ONLY = {
    r"kept|keeping": "persist, retain, store",
    r"carried|begun|stood": "an imperative verb, or the field's noun",
    r"notices?|noticed": "warning, diagnostic",
    r"losses": "unsupported",
    r"circles": "cycles",
    r"spelling": "suggestion",
    r"patience": "timeout",
    r"proving|proved": "heading check, verify",
    r"resuming|recalled": "warm start, restore",
    r"still": "stationary",
}
"""Words that prose may use in their plain meaning."""

PROSE = re.compile(rf"\b(?:{'|'.join(BANNED)})\b", re.IGNORECASE)
PHRASE = re.compile(rf"\b(?:{'|'.join(each for words in BANNED for each in words.split('|') if ' ' in each)})\b")
"""What of it has several words."""
WORDS_OF_NAMES = re.compile(rf"^(?:{'|'.join([*BANNED, *NAMES_ONLY])})$", re.IGNORECASE)
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
PARTICIPLE = re.compile(
    r"_*(?:[a-z]+(?<!e)ed|begun|broken|built|chosen|done|drawn|driven|forgotten|found|frozen|given|gone|grown|kept|known"
    r"|laid|led|left|lost|made|meant|met|paid|proven|seen|sent|shown|sought|spoken|spread|spun|stood|taken|thrown|told|torn"
    r"|understood|woken|written)_*"
)
"""A function name that says what has happened instead of what to do."""
IDENTIFIER = re.compile(r"[^\W\d]\w*")
DEFINITION = re.compile(r"\bdef\s+(\w+)")
INLINE_CODE = re.compile(r"`[^`]*`|https?://\S+")


def instead(word: str) -> str:
    """Return what to write instead of a banned word."""
    return next(
        (use for words, use in {**BANNED, **NAMES_ONLY}.items() if re.fullmatch(words, word, re.IGNORECASE)), "?"
    )


def in_prose(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and word of each banned word in a text."""
    for number, line in enumerate(text.splitlines(), 1):
        for found in PROSE.finditer(INLINE_CODE.sub("", line)):
            yield number, found[0]


@cache
def in_name(name: str) -> tuple[str, ...]:
    """Return the banned words in an identifier."""
    return tuple(word for word in WORD.findall(name) if WORDS_OF_NAMES.match(word))


@cache
def is_banned_in_prose(word: str) -> bool:
    """Return whether one word of prose is banned."""
    return PROSE.fullmatch(word) is not None


def can_have_banned(text: str) -> bool:
    """Return whether a Python file may have a banned word: the tokenizer takes 50 times as long."""
    words = set(IDENTIFIER.findall(text))
    return (
        any(map(in_name, words))
        or any(map(is_banned_in_prose, words))
        or any(PHRASE.search(each.lower()) for each in (text, INLINE_CODE.sub("", text)))
    )


def in_python(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and word of each banned word in names, strings and comments of a Python file."""
    if not can_have_banned(text):
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        line = token.start[0]
        if token.type == tokenize.NAME:
            yield from ((line, f"{token.string}: {word}") for word in in_name(token.string))
        elif (
            token.type == tokenize.COMMENT
            or token.type == tokenize.STRING
            or "FSTRING" in tokenize.tok_name[token.type]
        ):
            yield from ((line + above - 1, word) for above, word in in_prose(token.string))


def findings(path: Path) -> list[str]:
    """Return `file:line: word; write ...` for each banned word of a file."""
    text = path.read_text(encoding="utf-8")
    name = path.resolve().relative_to(ROOT).as_posix()
    found = list(in_python(text) if path.suffix == ".py" else in_prose(text))
    found += [(0, f"file name {path.name}: {word}") for word in in_name(path.stem)]
    return [f"{name}:{line}: {word!r}; write {instead(word.split(': ')[-1])}" for line, word in found]


def tracked() -> list[Path]:
    """Return the text files of the repository that the language binds."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [
        ROOT / name
        for name in listed.stdout.splitlines()
        if name.endswith((".py", ".md", ".lcm", ".yaml", ".toml", ".html"))
        and not name.startswith(EXEMPT)
        and (ROOT / name).is_file()
    ]


@pytest.mark.parametrize("folder", ["modelserver", "drivers", "tools", "lcmtypes", "config", "docs", "tests", "."])
def test_given_the_repository_then_no_banned_word_is_in_it(folder: str) -> None:
    inside = [
        path
        for path in tracked()
        if (path.parent == ROOT if folder == "." else path.relative_to(ROOT).parts[0] == folder)
    ]
    assert inside, f"no file in {folder}: is this a git checkout?"
    found = [line for path in inside for line in findings(path)]
    assert not found, "\n".join(["", *found])


def participles(path: Path) -> list[str]:
    """Return `file:line: name` for each function that is named by a bare participle; a property is a value."""
    text = path.read_text(encoding="utf-8")
    # only a file with such a name is parsed
    if not any(map(PARTICIPLE.fullmatch, set(DEFINITION.findall(text)))):
        return []
    return [
        f"{path.resolve().relative_to(ROOT).as_posix()}:{node.lineno}: function {node.name!r}; write an imperative verb"
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef)
        and PARTICIPLE.fullmatch(node.name)
        and not any("property" in ast.unparse(each) for each in node.decorator_list)
    ]


def test_given_the_functions_then_none_is_named_by_a_bare_participle() -> None:
    found = [line for path in tracked() if path.suffix == ".py" for line in participles(path)]
    assert not found, "\n".join(["", *found])


@pytest.mark.parametrize(
    "text", ["told = 1", '"""What is heard."""', "# 3 metres", 'f(f"it says {x}")', "class EarOf: ..."]
)
def test_given_a_banned_word_then_it_is_found(text: str) -> None:
    assert list(in_python(text))


if __name__ == "__main__":
    given = [Path(argument).resolve() for argument in sys.argv[1:]] or [ROOT]
    lines = [
        line
        for path in tracked()
        if any(path == each or each in path.parents for each in given)
        for line in findings(path) + (participles(path) if path.suffix == ".py" else [])
    ]
    print("\n".join(lines))
    sys.exit(bool(lines))
