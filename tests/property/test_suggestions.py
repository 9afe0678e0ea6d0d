"""Each suggestion is applied to the file that it is made for, which must then mean what it meant before it was broken.

Every name and word of the shipped and example files is misspelled in turn, in the ways that people misspell: a letter
left out, doubled or exchanged with its neighbor, another case. Wrong advice is worse than none: a suggestion may be
withheld, but one that is made must fix the file. A definition counts as right, so where it is the definition of a name
that is misspelled, the name must be the same everywhere after.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support_formats import YAML, miro, tree, tree_frame

from modelserver.config.reader import read_lines, read_partly
from modelserver.config.vehicle_file import VehicleConfig
from modelserver.errors import ConfigError, Problem, Severity
from modelserver.formats import parse_content, parse_model
from msdrivers.settings import SourceMap, read_drivers

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
GEOMETRIES = sorted(
    path
    for path in (ROOT / "config").rglob("*")
    if path.suffix in (".xml", ".urdf", ".yaml") and "geometry" in path.name
)
VEHICLES = sorted((ROOT / "config").rglob("vehicle*.yaml"))
WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]{2,}")
MOST = 25
"""Words of a file outside of comments that are misspelled, spread evenly over it."""

TREE = tree(
    tree_frame("Rover"),
    tree_frame("PanTiltUnit", "Rover", Z="-1"),
    tree_frame("Pan", "PanTiltUnit", X="0.5"),
    tree_frame("Lens", "PanTiltUnit/Pan", X="0.1"),
    tree_frame("LeftWheel", "/Rover", Y="0.3"),
    tree_frame("RightWheel", "Rover/.../PanTiltUnit", Y="-0.3"),
    tree_frame("Site", "UtmGrid10S"),
)


def misspellings(word: str, number: int) -> Iterator[str]:
    """Yield ways to misspell a word; at which letter depends on `number`."""
    at = 1 + number % (len(word) - 1)
    for wrong in (
        word[:at] + word[at + 1 :],
        word[:at] + word[at] + word[at:],
        word[: at - 1] + word[at] + word[at - 1] + word[at + 1 :],
        word.swapcase(),
    ):
        if wrong != word:
            yield wrong


def misspell(text: str) -> Iterator[tuple[str, str]]:
    """Yield a file with one word misspelled, many times, each with the file where that word is so everywhere."""
    places = [
        each for each in WORD.finditer(text) if "#" not in text[text.rfind("\n", 0, each.start()) + 1 : each.start()]
    ]
    for number, place in enumerate(places[:: max(1, len(places) // MOST)]):
        for wrong in misspellings(place[0], number):
            once = text[: place.start()] + wrong + text[place.end() :]
            yield once, re.sub(rf"\b{place[0]}\b", wrong, text)


def geometry(text: str, file: str = "file") -> tuple[object, tuple[Problem, ...]]:
    """Return what a geometry file means, and its problems."""
    model, problems = parse_content(text.encode(), file).check()
    return None if model is None else model.revision, problems


def vehicle(text: str) -> tuple[object, tuple[Problem, ...]]:
    """Return what a vehicle file means with its drivers, and its problems."""
    try:
        config, problems = read_partly(text.encode(), "file", VehicleConfig)
    except ConfigError as error:
        return None, error.problems
    if config is None:
        return None, problems
    drivers, more = read_drivers(config.drivers, SourceMap("file", read_lines(text.encode(), "file", VehicleConfig)))
    return (config, sorted(drivers)), (*problems, *more)


def apply_all(text: str, mean: Callable[[str], tuple[object, tuple[Problem, ...]]], counts: Counter[str]) -> None:
    """Break a file in many ways, and apply each suggestion that is made."""
    whole, before = mean(text)
    assert whole is not None
    known = Counter((each.element, each.message) for each in before)
    for wrong, renamed in misspell(text):
        _, problems = mean(wrong)
        for problem in problems:
            if problem.edit is None or not problem.line or known[problem.element, problem.message]:
                continue
            counts["made"] += 1
            try:
                fixed = problem.edit.apply(wrong)
            except ValueError:
                counts["unclear"] += 1
                continue
            counts["applied"] += 1
            meaning, after = mean(fixed)
            why = f"{problem}\n{[line for line in wrong.splitlines() if line not in text.splitlines()]}"
            # where the one definition of a name is misspelled, a reference is brought into line with it
            assert meaning == whole or meaning == mean(renamed)[0], why
            assert len([each for each in after if each.severity is Severity.ERROR]) == len(
                [each for each in before if each.severity is Severity.ERROR]
            ), why


@pytest.mark.parametrize("path", GEOMETRIES, ids=lambda path: str(path.relative_to(ROOT)))
def test_each_suggestion_for_a_shipped_geometry_fixes_it(path: Path) -> None:
    counts: Counter[str] = Counter()
    apply_all(path.read_text(encoding="utf-8"), lambda text: geometry(text, path.name), counts)
    assert counts["applied"] >= 3, counts
    assert counts["applied"] >= 0.5 * counts["made"], counts


@pytest.mark.parametrize(("name", "text"), [("yaml", YAML), ("miro", miro()), ("tree", TREE)])
def test_each_suggestion_for_a_small_geometry_fixes_it(name: str, text: str) -> None:
    counts: Counter[str] = Counter()
    apply_all(text, geometry, counts)
    assert parse_model(text.encode())
    assert counts["applied"] >= 3, (name, counts)


@pytest.mark.parametrize("path", VEHICLES, ids=lambda path: str(path.relative_to(ROOT)))
def test_each_suggestion_for_a_shipped_vehicle_file_fixes_it(path: Path) -> None:
    counts: Counter[str] = Counter()
    apply_all(path.read_text(encoding="utf-8"), vehicle, counts)
    assert counts["applied"] >= 10, counts
