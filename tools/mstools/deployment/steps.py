"""I/O of `install`: this installation, the state of the system, and the execution of a plan."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Final

import typer

from modelserver.errors import ModelServerError
from mstools.deployment import files as install_files
from mstools.deployment import plan as planning
from mstools.deployment.plan import Manifest, Plan, RunProgram, Step, SystemFacts, path_in_root
from mstools.terminal.output import escape
from mstools.terminal.problems import ProblemCollector

PROGRAMS: Final = ("systemctl", "systemd-run", "udevadm", "sysctl", "ip")
SEARCH_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
COMMAND_TIMEOUT_S: Final = 120.0
"""Time limit of a command: a start waits until the service is ready."""

INSTALL_HINT: Final = (
    "install with the system's Python, to a folder that all users may read: sudo /usr/bin/python3 -m venv --clear "
    "/opt/modelserver && sudo /opt/modelserver/bin/pip install modelserver, then sudo /opt/modelserver/bin/modelserver "
    "install ... (another python3 in the PATH may be in a home directory, and an environment that was made with it "
    "keeps it unless it is cleared)"
)


def get_command_path() -> str:
    return os.path.join(os.path.dirname(os.path.abspath(sys.executable)), "modelserver")


def get_examples_folder() -> Path:
    """Return the folder of vehicle files and units that comes with the package."""
    installed = Path(str(files("modelserver"))) / "share" / "config"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "config"


def check_installation() -> None:
    """Raise ConfigError where the units could not access or read this installation, with all problems."""
    subject, command = "this installation", get_command_path()
    paths = [
        (command, "the command of this installation"),
        (os.path.realpath(sys.executable), "its Python"),
        (sys.base_prefix, "its Python's library"),
        (str(Path(str(files("modelserver"))).resolve()), "its package"),
    ]
    gathered = ProblemCollector()
    with gathered.collect(subject):
        install_files.check_visible(paths, INSTALL_HINT)
    if not os.path.isfile(command):
        gathered.add(subject, f"there is no {command}: the package is not installed", INSTALL_HINT)
    else:
        with gathered.collect(subject):
            install_files.check_program(command)
    for path, what in paths:
        is_seen = os.path.exists(path) and not install_files.find_hiding_setting(path)
        if is_seen and (closed := find_unreadable_part(path)):
            why = f"{what} is {path}, and the service's user may not read {closed}"
            gathered.add(subject, why, f"sudo chmod -R o+rX {closed}")
    gathered.raise_any()


def find_unreadable_part(path: str) -> str:
    """Return the first part of a path that other users cannot read, empty for none."""
    for part in (*reversed(Path(path).parents), Path(path)):
        mode = part.stat().st_mode
        if not mode & (stat.S_IXOTH if stat.S_ISDIR(mode) else stat.S_IROTH):
            return str(part)
    return ""


def read_facts(paths: Iterable[str], root: Path) -> SystemFacts:
    """Return the system's state below `root`; `paths` are the files that may be written. Raises ModelServerError."""
    paths = tuple(paths)
    manifest = read_manifest(root)
    contents = {path: _read_file(path_in_root(root, path)) for path in {*paths, *manifest.files}}
    around = {folder for path in (*paths, planning.MANIFEST) for folder in planning.parent_folders(path)}
    programs = {name: found for name in PROGRAMS if (found := shutil.which(name, path=SEARCH_PATH))}
    is_live = root == Path("/") and os.path.isdir("/run/systemd/system")
    by_id, rmem_max = {}, 0
    with suppress(OSError):
        by_id = {link.name: os.path.realpath(link) for link in Path(install_files.BY_ID).iterdir()}
    with suppress(OSError, ValueError):
        rmem_max = int(Path("/proc/sys/net/core/rmem_max").read_text()) if root == Path("/") else 0
    return SystemFacts(
        files={path: planning.digest(content) for path, content in contents.items() if content is not None},
        absent=frozenset(folder for folder in around if not path_in_root(root, folder).is_dir()),
        manifest=manifest,
        by_id=by_id,
        rules=(_read_file(path_in_root(root, planning.RULES)) or b"").decode("utf-8", "replace"),
        rmem_max=rmem_max,
        programs=programs,
        realtime=is_live and can_be_realtime(programs.get("systemd-run", "")),
        is_live=is_live,
        root=str(root),
    )


def read_manifest(root: Path) -> Manifest:
    """Return what was installed below `root`; an empty manifest where nothing was. Raises ModelServerError."""
    path = path_in_root(root, planning.MANIFEST)
    raw = _read_file(path)
    return Manifest() if raw is None else Manifest.decode(raw, str(path))


def _read_file(path: Path) -> bytes | None:
    """Return the content of a file, None where there is none. Raises OSError."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None


def can_be_realtime(systemd_run: str) -> bool:
    """Return whether systemd can schedule a unit in real time, and another core is left.

    Some kernels (CONFIG_RT_GROUP_SCHED) deny it to units, and a unit that requests it does not start there.
    """
    if os.geteuid() != 0 or not systemd_run or (os.cpu_count() or 1) < 2:
        return False
    options = "--quiet --wait --collect -p CPUSchedulingPolicy=rr -p CPUSchedulingPriority=1 true"
    try:
        command = (systemd_run, *options.split())
        return subprocess.run(command, capture_output=True, timeout=20.0, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def check_root_user(root: Path, command: str) -> None:
    """Raise ModelServerError where this user cannot change the system."""
    if os.geteuid() != 0 and root == Path("/"):
        raise ModelServerError(f"this changes /etc and needs root: sudo {command} (to see what it would do: --dry-run)")


def execute_plan(plan: Plan, root: Path, dry_run: bool) -> None:
    """Print each step of a plan and execute it; the first that fails raises ModelServerError or OSError.

    With `dry_run` the steps are only printed.
    """
    for step in plan.steps:
        _print(str(step if isinstance(step, RunProgram) else replace(step, path=str(path_in_root(root, step.path)))))
        if not dry_run:
            _execute_step(step, root)
    for note in plan.notes:
        _print(f"note    {note}")
    if dry_run:
        typer.echo("nothing was done")


def _print(text: str) -> None:
    for line in text.splitlines():
        typer.echo(escape(line))


def _execute_step(step: Step, root: Path) -> None:
    match step:
        case planning.WriteFile():
            _write(path_in_root(root, step.path), step.content, step.mode)
        case planning.RemovePath():
            path = path_in_root(root, step.path)
            if path.is_symlink() or not path.is_dir():
                path.unlink(missing_ok=True)
            elif step.is_recursive:
                shutil.rmtree(path)
            else:
                # a folder with other files is left
                with suppress(OSError):
                    path.rmdir()
        case RunProgram():
            _run(step)


def _write(path: Path, content: bytes, mode: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    # atomic: a power failure leaves the old file or the new one
    handle, draft = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with open(handle, "wb") as file:
            file.write(content)
            os.fchmod(file.fileno(), mode)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(draft)


def _run(step: RunProgram) -> None:
    try:
        done = subprocess.run(step.arguments, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False)
        if done.returncode == 0:
            return
        output = (done.stderr or done.stdout).strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        output = str(error)
    if not step.may_fail:
        hint = "see journalctl -e -u 'modelserver*'" if "restart" in step.arguments else "fix that, then try again"
        raise ModelServerError(f"{' '.join(step.arguments)} failed: {output or 'without a message'}; {hint}")
    _print(f"        failed, continuing: {output or 'without a message'}")
