"""Import of filterpy's KalmanFilter without the rest of filterpy, for a fast start."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any


def import_kalman_filter() -> Any:
    """Import the class filterpy.kalman.KalmanFilter without the rest of filterpy.

    filterpy's packages import all of its filters and scipy.stats: 1.1 s of 1.75 s of processor time at a start. Its
    module kalman_filter needs numpy and two helpers: it is imported below empty packages, which are removed from
    sys.modules afterwards, so that filterpy can still be imported completely in the same process. Raises
    ModuleNotFoundError where filterpy is not installed.
    """
    spec = find_spec("filterpy")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError("filterpy is not installed; pip install filterpy", name="filterpy")
    folder = Path(spec.submodule_search_locations[0])
    before = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "filterpy"}
    for name in before:
        del sys.modules[name]
    try:
        for name in ("", "common", "kalman", "stats"):
            package = ModuleType(f"filterpy.{name}".rstrip("."))
            package.__path__ = [str(folder / name)]
            sys.modules[package.__name__] = package
        helpers = import_module("filterpy.common.helpers")
        vars(sys.modules["filterpy.common"]).update(vars(helpers))
        # for the log-likelihood, which is not used here
        vars(sys.modules["filterpy.stats"])["logpdf"] = None
        return import_module("filterpy.kalman.kalman_filter").KalmanFilter
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "filterpy"]:
            del sys.modules[name]
        sys.modules.update(before)
