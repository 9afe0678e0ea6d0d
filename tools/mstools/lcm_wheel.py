"""Paths of the lcm wheel's programs and libraries, and of the .lcm files.

The programs are the wheel's binaries, not its `lcm-*` console scripts: those start the binary as a child process and
leave it running when they get SIGTERM.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from modelserver.errors import ModelServerError
from modelserver.extras import DEBIAN_INSTALLER, make_system_command, read_installation


class MissingToolError(ModelServerError):
    """A program or a file that a tool needs is missing; the message is how to install it."""


def find_binary(name: str) -> Path:
    """Return the path of the wheel's program `name`, e.g. lcm-gen. Raises MissingToolError."""
    return _check_file(_get_site_packages() / "bin" / name)


def find_java_library() -> Path:
    """Return the path of the wheel's lcm.jar. Raises MissingToolError."""
    return _check_file(_get_site_packages() / "share" / "java" / "lcm.jar")


def find_type_files() -> tuple[Path, ...]:
    """Return the .lcm files: of the checkout, or as installed with the package mslcm. Raises MissingToolError."""
    spec = find_spec("mslcm")
    if spec is None or spec.origin is None:
        raise MissingToolError("the package mslcm is missing; reinstall modelserver")
    package = Path(spec.origin).parent
    for folder in (package / "lcm", package.parent):
        files = tuple(sorted(folder.glob("*_t.lcm")))
        if files:
            return files
    raise MissingToolError(f"no .lcm files beside {package}; reinstall modelserver")


def _get_site_packages() -> Path:
    spec = find_spec("lcm")
    if spec is None or spec.origin is None:
        raise MissingToolError("the package lcm is missing: pip install lcm")
    return Path(spec.origin).resolve().parent.parent


def _check_file(path: Path) -> Path:
    if not path.is_file():
        if read_installation()[0] == DEBIAN_INSTALLER:
            fix = f"the Debian package does not have it; in a folder with the source: {make_system_command('.')}"
            raise MissingToolError(f"{path.name} is missing: {fix}")
        raise MissingToolError(f"{path} is missing; reinstall the wheel: pip install --force-reinstall lcm")
    return path
