"""Names in the product: one name, one meaning."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

from support_source import parse

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("modelserver", "drivers/msdrivers", "tools/mstools")


def public_classes() -> dict[str, list[str]]:
    """Return where each name of a public class is defined."""
    found: dict[str, list[str]] = defaultdict(list)
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(parse(path)):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found[node.name].append(str(path.relative_to(ROOT)))
    return found


def test_no_two_public_classes_share_a_name() -> None:
    classes = public_classes()
    assert len(classes) > 500
    assert {name: places for name, places in classes.items() if len(places) > 1} == {}
