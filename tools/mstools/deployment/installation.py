"""Location of this installation of the package, and whether a service can run from there."""

from __future__ import annotations

import os
import stat
import sys
from importlib.resources import files
from pathlib import Path
from typing import Final

from mstools.deployment import files as install_files
from mstools.terminal.problems import ProblemCollector

INSTALL_HINT: Final = (
    "install with the system's Python, to a folder that all users may read: sudo /usr/bin/python3 -m venv --clear "
    "/opt/modelserver && sudo /opt/modelserver/bin/pip install modelserver, then sudo /opt/modelserver/bin/modelserver "
    "install ... (another python3 in the PATH may be in a home directory, and an environment that was made with it "
    "keeps it unless it is cleared)"
)


def get_command_path() -> str:
    """Return the path of this installation's command."""
    return os.path.join(os.path.dirname(os.path.abspath(sys.executable)), "modelserver")


def check_installation() -> None:
    """Raise ConfigError where the units could not access or read this installation, with all problems."""
    package = str(Path(str(files("modelserver"))).resolve())
    paths = [
        (get_command_path(), "the command of this installation"),
        (os.path.realpath(sys.executable), "its Python"),
        (sys.base_prefix, "its Python's library"),
        (package, "its package"),
    ]
    gathered = ProblemCollector()
    with gathered.collect("this installation"):
        install_files.check_visible(paths, INSTALL_HINT)
    if not os.path.isfile(get_command_path()):
        gathered.add(
            "this installation", f"there is no {get_command_path()}: the package is not installed", INSTALL_HINT
        )
    else:
        with gathered.collect("this installation"):
            install_files.check_program(get_command_path())
    for path, what in paths:
        closed = (
            "" if install_files.find_hiding_setting(path) or not os.path.exists(path) else find_unreadable_part(path)
        )
        if closed:
            why = f"{what} is {path}, and the service's user may not read {closed}"
            gathered.add("this installation", why, f"sudo chmod -R o+rX {closed}")
    gathered.raise_any()


def find_unreadable_part(path: str) -> str:
    """Return the first part of a path that other users cannot read, empty for none."""
    for part in (*reversed(Path(path).parents), Path(path)):
        mode = part.stat().st_mode
        needed = stat.S_IXOTH if stat.S_ISDIR(mode) else stat.S_IROTH
        if not mode & needed:
            return str(part)
    return ""


def get_examples_folder() -> Path:
    """Return the folder of vehicle files and units that comes with the package."""
    installed = Path(str(files("modelserver"))) / "share" / "config"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "config"
