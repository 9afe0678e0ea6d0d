"""Metadata hook of hatch: the README as a package index shows it, where links into the source lead nowhere.

With the address of the source's files in $MODELSERVER_SOURCE_URL (e.g. https://host/owner/modelserver/blob/main), the
links lead there, and it is the project's URL; without it, their words stay, and pictures are left out.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Final

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK: Final = re.compile(r"(!?)\[([^]]*)\]\((?!https?://)([^)]+)\)")
PICTURE: Final = re.compile(r"!\[[^]]*\]\((?!https?://)[^)]+\)\n\n(\*[^*]+\*\n\n)?")


def make_index_readme(text: str, source_url: str) -> str:
    """Return the text with links that lead to the source at an address, or without those links and the pictures."""
    if source_url:
        return LINK.sub(lambda found: f"{found[1]}[{found[2]}]({source_url}/{found[3]})", text)
    return LINK.sub(lambda found: found[2], PICTURE.sub("", text))


class IndexReadmeHook(MetadataHookInterface):
    """Sets readme and URLs of the metadata."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set them."""
        source_url = os.environ.get("MODELSERVER_SOURCE_URL", "").rstrip("/")
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": make_index_readme(text, source_url)}
        if source_url:
            urls = {"Source": "", "Documentation": "/docs/index.md", "Changelog": "/CHANGELOG.md"}
            metadata["urls"] = {name: f"{source_url}{path}" for name, path in urls.items()}
