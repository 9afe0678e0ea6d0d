"""What a report's page has: its answer, its figures, and their numbers."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np


def read_answer(page: Path) -> list[str]:
    """Return the headline and the lines of a page's answer, which precedes all else but the heads."""
    before, _, rest = page.read_text(encoding="utf-8").partition('<div class="answer ')
    assert "<h2>" not in before
    assert 'class="figures"' not in before
    return [html.unescape(each) for each in re.findall(r"<(?:strong|p)>(.*?)</", rest.partition("</div>")[0])]


def read_figures(page: Path) -> list[dict[str, Any]]:
    """Return the figures of a page."""
    found = re.findall(r'<script type="application/json">(.*?)</script>', page.read_text(encoding="utf-8"))
    return [json.loads(each) for each in found]


def read_numbers(encoded: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(encoded["bdata"]), f"<{encoded['dtype']}")
