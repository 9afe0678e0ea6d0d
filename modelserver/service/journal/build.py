"""Which build on which machine this is: what the same bits may be expected of."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from modelserver.version import __version__

TOLD: Final = {
    "modelserver": "version of modelserver",
    "source": "source of modelserver",
    "python": "Python",
    "numpy": "numpy",
    "scipy": "scipy",
    "pyproj": "pyproj",
    "libc": "C library",
    "machine": "kind of machine",
    "processor": "processor",
    "threads": "threads of the linear algebra",
}
"""The facts that decide on bits, and what each is in words."""


@cache
def facts() -> Mapping[str, str]:
    """Return the facts by the keys of `TOLD`, and the host's name and the kernel, which decide on nothing."""
    return {
        "modelserver": __version__,
        "source": _source(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "numpy": np.__version__,
        # asked without loading them
        "scipy": version("scipy"),
        "pyproj": version("pyproj"),
        "libc": " ".join(platform.libc_ver()),
        "machine": platform.machine(),
        "processor": _processor(),
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", ""),
        "host": platform.node(),
        "kernel": platform.release(),
    }


def differences(then: Mapping[str, Any]) -> list[str]:
    """Return in words what is other here than in the facts of a journal: any of it may change the last bits.

    A processor that is not known is no other one: a unit that sees of /proc its processes alone cannot name it.
    """
    now = facts()
    other = [key for key in TOLD if then.get(key) != now[key]]
    if not (then.get("processor") and now["processor"]):
        other = [key for key in other if key != "processor"]
    return [f"{TOLD[key]} was {then.get(key)}, is {now[key]}" for key in other]


def _source() -> str:
    """Return a digest of the package's own source files: a changed line is another build."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _processor() -> str:
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
            for line in file:
                key, _, value = line.partition(":")
                if key.strip() in ("model name", "Model", "CPU part"):
                    return value.strip()
    except OSError:
        pass
    return platform.processor()
