"""Where the parts of the lcm wheel lie, and the wire types beside them.

The programs are the wheel's own binaries, not its `lcm-*` console scripts: those start the binary as a child
and leave it running when they are told to end.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from modelserver.errors import ModelServerError


class MissingToolError(ModelServerError):
    """A program or a file that a tool needs is not there; the message says how to get it."""


def binary(name: str) -> Path:
    """Return the wheel's program `name`, e.g. lcm-gen. Raises MissingToolError."""
    return _part(_site() / "bin" / name)


def java_library() -> Path:
    """Return the wheel's lcm.jar. Raises MissingToolError."""
    return _part(_site() / "share" / "java" / "lcm.jar")


def type_files() -> tuple[Path, ...]:
    """Return the .lcm files: of the checkout, or as installed with the package mslcm. Raises MissingToolError."""
    spec = find_spec("mslcm")
    if spec is None or spec.origin is None:
        raise MissingToolError("the package mslcm is missing; install modelserver again")
    package = Path(spec.origin).parent
    for folder in (package / "lcm", package.parent):
        files = tuple(sorted(folder.glob("*_t.lcm")))
        if files:
            return files
    raise MissingToolError(f"no .lcm files beside {package}; install modelserver again")


def _site() -> Path:
    spec = find_spec("lcm")
    if spec is None or spec.origin is None:
        raise MissingToolError("the package lcm is missing: pip install lcm")
    return Path(spec.origin).resolve().parent.parent


def _part(path: Path) -> Path:
    if not path.is_file():
        raise MissingToolError(f"{path} is missing; install the wheel again: pip install --force-reinstall lcm")
    return path
