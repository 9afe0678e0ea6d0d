"""I/O of `install` and `uninstall`: the state of the system, and the execution of a plan."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import typer

from modelserver.errors import ModelServerError
from mstools.deployment.plan import (
    MANIFEST,
    RULES,
    VEHICLE,
    KeepFile,
    Manifest,
    Plan,
    RemovePath,
    RunProgram,
    Step,
    SystemFacts,
    WriteFile,
    digest,
    parent_folders,
    path_in_root,
)
from mstools.terminal.output import escape

PROGRAMS: Final = ("systemctl", "systemd-run", "udevadm", "sysctl", "ip")
SEARCH_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
COMMAND_TIMEOUT_S: Final = 120.0
"""Time limit of a command: a start waits until the service is ready."""


def read_facts(paths: Iterable[str], root: Path) -> SystemFacts:
    """Return the system's state below `root`; `paths` are the files that may be written. Raises ModelServerError."""
    paths = tuple(paths)
    manifest = read_manifest(root)
    files = {}
    for path in {*paths, *manifest.files}:
        content = _read_file(path_below(root, path))
        if content is not None:
            files[path] = digest(content)
    around = {folder for path in (*paths, MANIFEST) for folder in parent_folders(path)}
    absent = frozenset(folder for folder in around if not path_below(root, folder).is_dir())
    programs = {name: found for name in PROGRAMS if (found := shutil.which(name, path=SEARCH_PATH))}
    is_live = root == Path("/") and os.path.isdir("/run/systemd/system")
    rules = (_read_file(path_below(root, RULES)) or b"").decode("utf-8", "replace")
    return SystemFacts(
        files=files,
        absent=absent,
        manifest=manifest,
        by_id=_by_id(),
        rules=rules,
        rmem_max=_rmem_max() if root == Path("/") else 0,
        programs=programs,
        realtime=is_live and can_be_realtime(programs.get("systemd-run", "")),
        is_live=is_live,
        root=str(root),
    )


def read_manifest(root: Path) -> Manifest:
    """Return what was installed below `root`; an empty manifest where nothing was. Raises ModelServerError."""
    raw = _read_file(path_below(root, MANIFEST))
    return Manifest() if raw is None else Manifest.decode(raw, str(path_below(root, MANIFEST)))


def path_below(root: Path, path: str) -> Path:
    """Return the location of an absolute path of the system below its root."""
    return Path(path_in_root(str(root), path))


def check_root_user(root: Path, command: str) -> None:
    """Raise ModelServerError where this user cannot change the system."""
    if os.geteuid() != 0 and root == Path("/"):
        raise ModelServerError(f"this changes /etc and needs root: sudo {command} (to see what it would do: --dry-run)")


def print_plan(plan: Plan, root: Path) -> None:
    """Print a plan for the system below `root`."""
    for step in plan.steps:
        _print(_format_step(step, root))
    for note in plan.notes:
        _print(f"note    {note}")


def execute_plan(plan: Plan, root: Path) -> None:
    """Execute a plan and print each step. Raises ModelServerError, OSError at the first that fails."""
    for step in plan.steps:
        _print(_format_step(step, root))
        _execute_step(step, root)
    for note in plan.notes:
        _print(f"note    {note}")


def _format_step(step: Step, root: Path) -> str:
    """Return a step with the path that is touched."""
    return str(step if isinstance(step, RunProgram) else replace(step, path=str(path_below(root, step.path))))


def _execute_step(step: Step, root: Path) -> None:
    if isinstance(step, WriteFile):
        _write(step, root)
    elif isinstance(step, RemovePath):
        _remove(step, root)
    elif isinstance(step, RunProgram):
        _run(step)
    else:
        assert isinstance(step, KeepFile)


def _write(step: WriteFile, root: Path) -> None:
    path = path_below(root, step.path)
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    # atomic: a power failure leaves the old file or the new one
    handle, draft = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with open(handle, "wb") as file:
            file.write(step.content)
            os.fchmod(file.fileno(), step.mode)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(draft)


def _remove(step: RemovePath, root: Path) -> None:
    path = path_below(root, step.path)
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(mode):
        path.unlink()
    elif step.is_recursive:
        shutil.rmtree(path)
    else:
        # a folder with other files is left
        with suppress(OSError):
            path.rmdir()


def _run(step: RunProgram) -> None:
    output = ""
    try:
        done = subprocess.run(step.arguments, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False)
        failed, output = done.returncode != 0, (done.stderr or done.stdout).strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        failed, output = True, str(error)
    if not failed:
        return
    command = " ".join(step.arguments)
    if not step.may_fail:
        hint = "see journalctl -e -u 'modelserver*'" if "restart" in step.arguments else "fix that, then try again"
        raise ModelServerError(f"{command} failed: {output or 'without a message'}; {hint}")
    _print(f"        failed, continuing: {output or 'without a message'}")


def _print(text: str) -> None:
    for line in text.splitlines():
        typer.echo(escape(line))


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
    arguments = (
        "--quiet",
        "--wait",
        "--collect",
        "-p",
        "CPUSchedulingPolicy=rr",
        "-p",
        "CPUSchedulingPriority=1",
        "true",
    )
    try:
        done = subprocess.run((systemd_run, *arguments), capture_output=True, timeout=20.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _by_id() -> dict[str, str]:
    folder = "/dev/serial/by-id"
    try:
        return {name: os.path.realpath(os.path.join(folder, name)) for name in os.listdir(folder)}
    except OSError:
        return {}


def _rmem_max() -> int:
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return 0


def find_installed_vehicle(root: Path) -> Path | None:
    """Return the installed vehicle file, None where there is none."""
    path = path_below(root, VEHICLE)
    return path if path.is_file() else None
