"""The generated reference of the documentation has every setting, channel, type and reason that the code defines."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import os
import re
import subprocess
import sys
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

import pytest

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.estimation.filter.settings import FilterSettings, SharedSettings
from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import Invalid
from modelserver.wire.channels import CHANNELS
from msdrivers.registry import KINDS
from msdrivers.settings import COMMON_KEYS
from mstools.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
LINKING = [
    *PAGES,
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "examples/README.md", "tests/realdata/README.md")),
]
WORDS_AT_MOST = 33_800
"""Over README and what is written by hand in docs/, as `wc -w` counts: what `make docs` writes does not count, neither
in the reference nor below the marks of other pages. They were 52,000, 29,300 without dynamics, and 30,800 without
operation (metrics, backup, upgrade, exit codes)
and frames added at run time, and 32,500 without archives and the campaign's table."""


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "tools")
        return importlib.import_module("docs_pages")


def read(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def read_rows(markdown: str) -> list[list[str]]:
    """Return the cells of the rows of all tables."""
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")] for line in markdown.splitlines() if line[:2] == "| "
    ]


def find_names(markdown: str) -> set[str]:
    """Return the names in the first columns of all tables."""
    return {name for row in read_rows(markdown) for name in re.findall(r"`([\w.-]+)`", row[0])}


# --- settings ---------------------------------------------------------------------------------------------------------


def keys_of(kind: type) -> tuple[set[str], set[str]]:
    """Return the keys of a section and of those in it, and the names of the sections; not those of another page."""
    keys, sections = set(), set()
    for field, hint in get_type_hints(kind).items():
        inner = [each for each in (hint, *get_args(hint)) if dataclasses.is_dataclass(each)]
        if field.startswith("__"):
            continue
        (sections if inner else keys).add(field)
        for each in inner:
            if not issubclass(each, SharedSettings):
                more, parts = keys_of(each)
                keys, sections = keys | more, sections | parts
    return keys, sections


def test_given_the_page_on_the_vehicle_file_then_it_names_every_key_and_no_other(pages: ModuleType) -> None:
    keys, sections = keys_of(VehicleConfig)
    assert keys <= find_names(read("vehicle-file.md")) <= keys | sections


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SharedSettings, FilterSettings, RawSettings])
def test_given_settings_of_localization_then_their_page_has_each_with_default_and_meaning(
    pages: ModuleType, kind: type
) -> None:
    text = read("filter-settings.md")
    table = {row[0].strip("`"): row for row in read_rows(text)}
    for field in dataclasses.fields(kind):
        assert len(table[field.name][2]) > 20
    own = {each.name: each for each in pages.read_settings(kind)}
    for field in dataclasses.fields(kind):
        assert ast.literal_eval(own[field.name].default.strip("`").capitalize()) == field.default


DEVICES = {
    "device-gps.md": {"novatel", "nmea"},
    "device-gx1.md": {"gx1"},
    "device-wheels.md": {"wheels", "vehicle"},
    "device-axis.md": {"axis"},
}


@pytest.mark.parametrize("page", DEVICES)
def test_given_the_page_of_a_device_then_its_tables_have_every_setting(pages: ModuleType, page: str) -> None:
    found = find_names(read(page))
    for name in DEVICES[page]:
        missing = settings_of(KINDS[name].load().settings) - found - {"source", "protocol"}
        assert not missing, f"{page} lacks {missing}"


@pytest.mark.parametrize("name", KINDS)
def test_given_a_setting_of_a_device_then_the_default_is_what_the_code_has(pages: ModuleType, name: str) -> None:
    kind = KINDS[name].load().settings
    shown = {each.name: each.default.strip("`") for each in pages.read_settings(kind)}
    for field in dataclasses.fields(kind):
        if field.name in shown and type(field.default) in (int, float, bool, str) and field.default != "":
            text = shown[field.name]
            assert (text if type(field.default) is str else ast.literal_eval(text.capitalize())) == field.default


def settings_of(kind: Any) -> set[str]:
    """Return the keys of a device's settings and of the sections in them."""
    found = set()
    for field, hint in get_type_hints(kind).items():
        if field.startswith("__") or field in ("about",):
            continue
        found.add(field)
        for each in (hint, *get_args(hint)):
            if dataclasses.is_dataclass(each) and not issubclass(each, Enum):  # type: ignore[arg-type]
                found |= settings_of(each)
    return found


def test_given_a_kind_of_device_then_the_overview_names_it_its_faults_and_the_keys_of_lines(pages: ModuleType) -> None:
    text = read("drivers.md")
    found = find_names(text)
    for kind in KINDS.values():
        assert kind.name in found
        assert set(kind.faults) <= found
        for line in kind.lines:
            assert {each.name for each in dataclasses.fields(line)} <= found
    assert all(f"`{key}`" in text for key in COMMON_KEYS)


def test_given_a_setting_without_a_description_then_the_build_fails(pages: ModuleType) -> None:
    with pytest.raises(ValueError, match="port has no description"):
        pages.read_settings(Bare)


@pytest.mark.slow
def test_given_a_supplement_then_the_code_has_no_description_of_its_own(
    pages: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: set[str] = set()

    class Recorder(dict[str, str]):
        def get(self, key: str, default: Any = None) -> Any:
            used.add(key)
            return super().get(key, default)

    supplement = pages.SUPPLEMENT
    monkeypatch.setattr(pages, "SUPPLEMENT", Recorder(supplement))
    for path in PAGES:
        pages.fill(path.read_text(encoding="utf-8"))
    assert set(supplement) <= used, "described in the code now: remove it from SUPPLEMENT"


@dataclasses.dataclass
class Bare:
    port: str


# --- wire, words, commands --------------------------------------------------------------------------------------------


def test_given_the_channels_then_the_wire_page_has_each_with_its_type(pages: ModuleType) -> None:
    text = read("wire.md")
    for channel in CHANNELS:
        assert f"| `{channel.name}` | [`{channel.type_name}`]" in text


def test_given_the_types_then_their_page_has_every_field_with_a_meaning(pages: ModuleType) -> None:
    for each in pages.read_structs(ROOT / "lcmtypes").values():
        assert each.comment, each.name
        assert each.fields or not each.name.startswith("pose")
        assert all(member.comment for member in (*each.fields, *pages.constants_of(each))), each.name
    text = read("reference/types.md")
    assert text.count("\n## ") == len(list((ROOT / "lcmtypes").glob("*.lcm")))


@pytest.mark.slow
def test_given_the_reasons_then_the_page_has_each_and_its_words_exist_in_the_code(
    pages: ModuleType,
) -> None:
    text = read("words.md")
    for flag in Invalid:
        assert f"| {flag.value} | `{flag.name}` |" in text
        assert text.count(f"`{flag.name}`") >= 2, f"{flag.name} has no remedy"
    rows = re.findall(r"^\| ((?:`[a-z_]+`(?:, )?)+) \|", text, re.MULTILINE)
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "modelserver").rglob("*.py")]
    strings = {node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    words = set(re.findall(r"`([a-z_]+)`", " ".join(rows)))
    assert len(words) > 50
    assert words <= strings


def test_given_the_commands_then_their_page_has_the_help_of_each(pages: ModuleType) -> None:
    text = read("reference/cli.md")
    for name in COMMANDS:
        assert f"\n## {name}\n" in text
        assert f"Usage: modelserver {name}" in text
    assert "\n### calibrate imu\n" in text


# --- all pages --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_given_the_code_then_the_generated_parts_of_the_pages_are_those_of_the_code(pages: ModuleType) -> None:
    made = pages.make_pages()
    stale = [path.name for path, text in made.items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    assert not stale, f"stale: {stale}; `make docs` (or `python tools/docs_pages.py`) writes them"


def test_given_the_pages_then_they_are_short_together(pages: ModuleType) -> None:
    counts = {}
    for path in [*PAGES, ROOT / "README.md"]:
        text = path.read_text(encoding="utf-8")
        by_hand = "" if text.startswith(pages.GENERATED) else pages.MARK.sub("", text)
        counts[path.relative_to(ROOT).as_posix()] = len(by_hand.split())
    assert sum(counts.values()) <= WORDS_AT_MOST, sorted(counts.items(), key=lambda each: -each[1])[:8]


def find_anchors(path: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub and mkdocs make them."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    heads = re.findall(r"^#+ (.*)", text, re.MULTILINE)
    return {re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", re.sub(r"\]\(.*?\)", "", head)).lower()) for head in heads}


@pytest.mark.parametrize("path", LINKING, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_given_a_page_then_its_links_and_paths_lead_somewhere(path: Path) -> None:
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", text):
        if not target.startswith("https://"):
            place = (path.parent / target).resolve() if target else path
            assert place.exists(), f"{path.name} names {target}"
            assert not anchor or anchor in find_anchors(place), f"{path.name} names {target}#{anchor}"
    if path in PAGES or path == ROOT / "README.md":  # the change log names what has gone
        for place in re.findall(PLACES, text):
            assert list(ROOT.glob(place.rstrip("/"))), f"{path.name} names {place}"


@pytest.mark.parametrize(
    ("start", "known"),
    [
        ("modelserver", set(COMMANDS)),
        ("make", set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))),
        ("python -m benchmarks", {path.stem for path in (ROOT / "benchmarks").glob("*.py")}),
    ],
)
def test_given_the_pages_then_the_commands_that_they_name_exist(start: str, known: set[str]) -> None:
    for path in LINKING[:-3]:
        named = set(
            re.findall(rf"(?:^|`|&& |\$ ){start} ([a-z][a-z_-]*)", path.read_text(encoding="utf-8"), re.MULTILINE)
        )
        assert named <= known, path.name


PLACES = r"`(?:python )?((?:tests|benchmarks|examples|config|drivers|tools|lcmtypes|modelserver)/[\w./*-]+)[` ]"


@pytest.mark.slow
def test_given_the_pages_then_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """`make docs` in .ci/run does the same where mkdocs is not installed here."""
    pytest.importorskip("material", reason="the extra docs is not installed; make docs")
    pytest.importorskip("mkdocstrings", reason="the extra docs is not installed; make docs")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", tmp_path / "site"],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "Usage: modelserver query" in (tmp_path / "site" / "reference" / "cli.html").read_text(encoding="utf-8")
