"""Where this installation of the package lies, and whether a service can run from there."""

from __future__ import annotations

import os
import stat
import sys
from importlib.resources import files
from pathlib import Path
from typing import Final

from mstools.deployment import files as install_files
from mstools.terminal.gathered import Gathered

ELSEWHERE: Final = (
    "install with the system's own Python, to a folder that all may read: sudo /usr/bin/python3 -m venv --clear "
    "/opt/modelserver && sudo /opt/modelserver/bin/pip install modelserver, then sudo /opt/modelserver/bin/modelserver "
    "install ... (whichever python3 the shell finds first may be one of a home directory, and an environment that was "
    "made with it keeps it unless it is cleared)"
)


def program() -> str:
    """Return the path of this installation's command."""
    return os.path.join(os.path.dirname(os.path.abspath(sys.executable)), "modelserver")


def check_installation() -> None:
    """Raise ConfigError where the units would not see this installation, or could not read it: with all of that."""
    package = str(Path(str(files("modelserver"))).resolve())
    paths = [
        (program(), "the command of this installation"),
        (os.path.realpath(sys.executable), "its Python"),
        (sys.base_prefix, "its Python's library"),
        (package, "its package"),
    ]
    gathered = Gathered()
    with gathered.of("this installation"):
        install_files.check_seen(paths, ELSEWHERE)
    if not os.path.isfile(program()):
        gathered.add("this installation", f"there is no {program()}: it is none of the package", ELSEWHERE)
    else:
        with gathered.of("this installation"):
            install_files.check_program(program())
    for path, what in paths:
        closed = "" if install_files.hidden_by(path) or not os.path.exists(path) else closed_to_others(path)
        if closed:
            why = f"{what} is {path}, and the service's user may not read {closed}"
            gathered.add("this installation", why, f"sudo chmod -R o+rX {closed}")
    gathered.check()


def closed_to_others(path: str) -> str:
    """Return which part of a path keeps other users from it, empty where none does."""
    for part in (*reversed(Path(path).parents), Path(path)):
        mode = part.stat().st_mode
        needed = stat.S_IXOTH if stat.S_ISDIR(mode) else stat.S_IROTH
        if not mode & needed:
            return str(part)
    return ""


def examples() -> Path:
    """Return the folder of vehicle files and units that comes with the package."""
    installed = Path(str(files("modelserver"))) / "share" / "config"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "config"
