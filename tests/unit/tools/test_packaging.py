"""What a package index shows and what the container file copies."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

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
