"""What a package index shows, what the container file copies, and which sources may be compiled."""

from __future__ import annotations

import ast
import re
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("url", ["", "https://example.org/modelserver/blob/main"])
def test_given_the_readme_then_no_link_of_an_index_page_leads_nowhere(url: str) -> None:
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed")
    make_index_readme = runpy.run_path(str(ROOT / "tools" / "index_readme.py"))["make_index_readme"]
    shown = make_index_readme(README, url)
    links = re.findall(r"\]\(([^)]*)\)", shown)
    assert links
    assert all(link.startswith("https://") for link in links)
    assert [link.removeprefix(f"{url}/") for link in re.findall(r"\]\(([^)]*)\)", README)] == [
        link.removeprefix(f"{url}/") for link in links
    ] or not url
    # the words of the links stay
    assert "Tutorial: a rover from nothing to a valid pose" in shown
    assert "make demo" in shown


def test_given_the_container_file_then_what_it_copies_is_there_and_its_targets_exist() -> None:
    text = (ROOT / "config" / "container" / "Containerfile").read_text(encoding="utf-8")
    copied = [words for line in re.findall(r"^COPY (?!--)(.*)$", text, re.MULTILINE) for words in line.split()[:-1]]
    assert {"pyproject.toml", "modelserver", "lcmtypes", "drivers", "tools", "config"} <= set(copied)
    assert [name for name in copied if not (ROOT / name).exists()] == []
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^RUN make (\w+)", text, re.MULTILINE):
        assert f"\n{target}:" in makefile


@pytest.fixture(scope="module")
def wheel_hook() -> dict[str, Any]:
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed")
    return runpy.run_path(str(ROOT / "tools" / "wheel_hook.py"))


def test_given_a_module_to_compile_then_the_types_of_its_fields_become_strings_on_their_lines(
    wheel_hook: dict[str, Any],
) -> None:
    source = "from __future__ import annotations\n\nclass A:\n    a: int | None = None\n    b: tuple[str, ...]\n"
    assert wheel_hook["_quote_annotations"](source) == (
        "from __future__ import annotations; from typing import Union\n\n"
        "class A:\n    a: 'Union[int, None]' = None\n    b: 'tuple[str, ...]'\n"
    )


def test_given_the_modules_to_compile_then_they_have_nothing_that_mypyc_computes_otherwise(
    wheel_hook: dict[str, Any],
) -> None:
    for name in wheel_hook["COMPILED"]:
        for node in ast.walk(ast.parse((ROOT / name).read_text(encoding="utf-8"))):
            # Python 3.12 and later compensate the rounding of a sum; mypyc adds up what a generator yields
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "sum":
                assert not isinstance(node.args[0], ast.GeneratorExp), f"{name}:{node.lineno}: sum a list instead"
            # mypyc 2.4 reads a constant tuple of floats as one that was not set
            if isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation).startswith("Final"):
                assert not isinstance(node.value, ast.Tuple), f"{name}:{node.lineno}: leave Final out"
