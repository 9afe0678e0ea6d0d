"""The source of the product, parsed once in a process for all tests that examine it."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a file, which is shared and must not be modified."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))
