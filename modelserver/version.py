"""The one place where the version is written."""

from __future__ import annotations

from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec

__version__ = "0.1.0"


def is_filter_compiled() -> bool:
    """Return whether the filter is the compiled build, see `tools/wheel_hook.py`; the results are the same bits."""
    found = find_spec("modelserver.estimation.filter.eskf")
    return found is not None and str(found.origin).endswith(tuple(EXTENSION_SUFFIXES))
