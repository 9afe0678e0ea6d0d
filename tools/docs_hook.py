"""Hook of mkdocs: adds the change log, and keeps the site readable offline."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

LOADED = re.compile(r"<(?:script|img|iframe)\b[^>]*\bsrc=[\"']?(?:https?:)?//|<link\b[^>]*\bhref=[\"']?(?:https?:)?//")
"""What a browser loads by itself; a link that a reader clicks is none of it."""


def on_files(files: Files, config: Any) -> Files:
    """Add the change log, which lies beside docs/."""
    text = Path(__file__).resolve().parents[1].joinpath("CHANGELOG.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "changelog.md", content=text))
    return files


def on_post_build(config: Any) -> None:
    """Fail where a page loads something from the network."""
    for path in sorted(Path(config["site_dir"]).rglob("*.html")):
        for found in LOADED.finditer(path.read_text(encoding="utf-8")):
            if 'rel="canonical"' not in found[0]:
                raise PluginError(f"{path.name} loads from the network: {found[0]}")
