"""Hook of mkdocs: adds the pages and tables that are generated from the code, and keeps the site readable offline."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import docs_pages
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    for place, make in docs_pages.PAGES.items():
        files.append(File.generated(config, place, content=make()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Fill in the generated tables of a page."""
    try:
        if page.file.src_uri == "words.md":
            docs_pages.check_words(markdown)
        return docs_pages.fill(markdown)
    except (ValueError, AttributeError, ImportError) as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error


_LOADED = re.compile(r"<(?:script|img|iframe)\b[^>]*\bsrc=[\"']?(?:https?:)?//|<link\b[^>]*\bhref=[\"']?(?:https?:)?//")
"""What a browser loads by itself; a link that a reader clicks is none of it."""


def on_post_build(config: Any) -> None:
    """Fail where a page loads something from the network."""
    for path in sorted(Path(config["site_dir"]).rglob("*.html")):
        for found in _LOADED.finditer(path.read_text(encoding="utf-8")):
            if 'rel="canonical"' not in found[0]:
                raise PluginError(f"{path.name} loads from the network: {found[0]}")
