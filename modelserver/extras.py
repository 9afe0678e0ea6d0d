"""Optional dependencies ("extras"), and the command that adds one to this installation.

ModelServer is in no package index, so the command depends on how it was installed: PEP 610's direct_url.json names the
source folder, the wheel or the repository, and whether the installation is editable; the Debian package names itself in
INSTALLER (PEP 627) and has no pip.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

EXTRAS: Final = {
    "archive": ("bokeh", "distributed", "fsspec", "pyarrow"),
    "bags": ("rosbags", "mcap"),
    "dynamics": ("pinocchio",),
    "foxglove": ("foxglove", "trimesh"),
    "map": ("rasterio",),
    "report": ("plotly",),
    "view": ("viser",),
}
"""Extras for users, with the modules that each adds."""

DEBIAN_INSTALLER: Final = "dpkg"
"""Content of INSTALLER in the Debian package."""

SYSTEM_ENVIRONMENT: Final = "/opt/modelserver"
"""Environment that units can access."""

SOURCE: Final = Path(__file__).resolve().parents[1]
"""Folder of the source where the package is not installed."""


def make_install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation."""
    installer, url = read_installation()
    if installer == DEBIAN_INSTALLER:
        command = make_system_command(f".[{extra}]")
        return f"the Debian package does not have the extra {extra}; in a folder with the source: {command}"
    folder = os.path.dirname(os.path.abspath(sys.executable))
    pip = os.path.join(folder, "pip")
    program = shlex.quote(pip) if os.path.isfile(pip) else f"{shlex.quote(sys.executable)} -m pip"
    if installer == "uv":
        program = f"uv pip install --python {shlex.quote(sys.executable)}"
    else:
        program += " install"
    sudo = "" if os.access(folder, os.W_OK) else "sudo "
    editable = "-e " if "dir_info" in url and url["dir_info"].get("editable") else ""
    return f"{sudo}{program} {editable}{shlex.quote(make_requirement(extra, url))}"


def make_system_command(requirement: str) -> str:
    """Return the command that installs to a folder that units and all users can access.

    Another python3 in the PATH may be in a home directory, and an environment that was made with it refers to it until
    it is cleared.
    """
    install = f"sudo {SYSTEM_ENVIRONMENT}/bin/pip install {shlex.quote(requirement)}"
    return f"sudo /usr/bin/python3 -m venv --clear {SYSTEM_ENVIRONMENT} && {install}"


def make_requirement(extra: str = "", url: dict[str, dict[str, object]] | None = None) -> str:
    """Return what pip installs this version from, with an extra: a folder, a wheel, or a repository (PEP 508)."""
    url = read_installation()[1] if url is None else url
    place, brackets = str(url.get("url", "")), f"[{extra}]" if extra else ""
    if "vcs_info" in url:
        version = url["vcs_info"]
        return f"modelserver{brackets} @ {version['vcs']}+{place}@{version['commit_id']}"
    parts = urlsplit(place)
    if parts.scheme == "file":
        return f"{unquote(parts.path)}{brackets}"
    if place:
        return f"modelserver{brackets} @ {place}"
    return f"{SOURCE if (SOURCE / 'pyproject.toml').is_file() else '.'}{brackets}"


def read_installation() -> tuple[str, dict[str, dict[str, object]]]:
    """Return the program that installed this package, and the content of direct_url.json; empty ones if unknown."""
    try:
        found = distribution("modelserver")
        url = json.loads(found.read_text("direct_url.json") or "{}")
        return (found.read_text("INSTALLER") or "").strip(), url if isinstance(url, dict) else {}
    except (PackageNotFoundError, ValueError, OSError):
        return "", {}


def is_installed(extra: str) -> bool:
    """Return whether the modules of an extra are there."""
    return all(map(find_spec, EXTRAS[extra]))


def describe_missing() -> str:
    """Return a line with the extras that are not installed and the command that adds them, empty if all are there."""
    missing = ",".join(extra for extra in EXTRAS if not is_installed(extra))
    return f"Extras that are not installed: {missing}. To add them: {make_install_command(missing)}" if missing else ""
