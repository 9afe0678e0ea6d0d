#!/usr/bin/env python3
"""Write docs/filter-settings.md anew from the settings' own words: `make types`, or this script alone.

Each setting's default and meaning stand once, in `modelserver/localization`; a test compares the page with them.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path

from modelserver.localization.filter import settings as filter_settings
from modelserver.localization.settings import FixSettings

PAGE = Path(__file__).resolve().parent.parent / "docs" / "filter-settings.md"

HEAD = """\
# Settings of the filter

What can be set under `localization.filter` of the [vehicle file](vehicle-file.md). SI units and radians; a sigma is one
standard deviation. Defaults are a data sheet's or physics' numbers, named at each; none is tuned to a recording.

This page is written by `python tools/settings_page.py` from `FilterSettings` and the `FixSettings` that it shares with
[raw mode](raw-mode.md); a test fails where the two differ. Change the words there, and run it.
"""

TABLE = """
**{title}**

| setting | default | meaning, unit, where the default comes from |
|---|---|---|
"""


def page() -> str:
    """Return the whole page."""
    parts = [HEAD]
    for kind in (FixSettings, filter_settings.FilterSettings):
        for title, rows in _sections(kind):
            parts.append(TABLE.format(title=title))
            parts += [f"| `{name}` | {default} | {words} |\n" for name, default, words in rows]
    return "".join(parts)


def _sections(kind: type) -> Iterator[tuple[str, list[tuple[str, str, str]]]]:
    """Yield the title of each section of a class of settings, with name, default and words of each setting."""
    source = inspect.getsource(kind)
    lines = source.splitlines()
    titles = [(n, line.strip("# -")) for n, line in enumerate(lines, start=1) if line.startswith("    # --- ")]
    (cls,) = ast.parse(source).body
    assert isinstance(cls, ast.ClassDef)
    rows: dict[str, list[tuple[str, str, str]]] = {title: [] for _, title in titles}
    for node, after in zip(cls.body, cls.body[1:], strict=False):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None):
            continue
        if node.target.id.startswith("_"):
            continue
        words = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
        if not isinstance(words, str):
            raise ValueError(f"{kind.__name__}.{node.target.id} has no docstring")
        title = [title for n, title in titles if n < node.lineno][-1]
        # as it was written: 1e-3 and not 0.001
        default = ast.get_source_segment(source, node.value) or ""
        rows[title].append((node.target.id, default.lower(), " ".join(words.split()).replace("|", "&#124;")))
    for title, found in rows.items():
        yield title[:1].upper() + title[1:], found


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE.name} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
