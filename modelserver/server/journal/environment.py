"""Facts of build and machine on which the bits of a result depend."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np

from modelserver.version import __version__

COMPARED_FACTS: Final = {
    "modelserver": "version of modelserver",
    "source": "source of modelserver",
    "python": "Python",
    "numpy": "numpy",
    "filterpy": "filterpy",
    "pyproj": "pyproj",
    "pinocchio": "Pinocchio",
    "libc": "C library",
    "machine": "machine type",
    "processor": "processor",
    "threads": "threads of the linear algebra",
}
"""Facts that affect the last bits of results, with their names in messages."""


@cache
def collect_facts() -> Mapping[str, str]:
    """Return the facts of `COMPARED_FACTS`, and host name and kernel, which do not affect results."""
    return {
        "modelserver": __version__,
        "source": _hash_source(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "numpy": np.__version__,
        # read from the metadata, without importing them
        "filterpy": version("filterpy"),
        "pyproj": version("pyproj"),
        "pinocchio": _read_version("pin"),
        "libc": " ".join(platform.libc_ver()),
        "machine": platform.machine(),
        "processor": _read_processor(),
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", ""),
        "host": platform.node(),
        "kernel": platform.release(),
    }


def list_differences(then: Mapping[str, Any]) -> list[str]:
    """Return the differences between the facts of a journal and those here, in words.

    An unknown processor counts as equal: a unit with a restricted /proc cannot read it.
    """
    now = collect_facts()
    changed = [key for key in COMPARED_FACTS if then.get(key) != now[key]]
    if not (then.get("processor") and now["processor"]):
        changed = [key for key in changed if key != "processor"]
    return [f"{COMPARED_FACTS[key]} was {then.get(key)}, is {now[key]}" for key in changed]


def _read_version(name: str) -> str:
    """Return the version of an installed package; empty for none."""
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _hash_source() -> str:
    """Return a digest of the source files, which identifies the build."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[2]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _read_processor() -> str:
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
            for line in file:
                key, _, value = line.partition(":")
                if key.strip() in ("model name", "Model", "CPU part"):
                    return value.strip()
    except OSError:
        pass
    return platform.processor()
