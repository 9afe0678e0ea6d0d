"""The edge of `install` and `uninstall`: how the system is, and carrying out a plan on it."""

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
    Facts,
    Keep,
    Manifest,
    Plan,
    Remove,
    RunProgram,
    Step,
    Write,
    digest,
    folders_around,
    in_root,
)
from mstools.terminal.output import safe

PROGRAMS: Final = ("systemctl", "systemd-run", "udevadm", "sysctl", "ip")
SEARCHED: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
COMMAND_S: Final = 120.0
"""How long one command may take: a start waits until the service is ready."""


def read_facts(paths: Iterable[str], root: Path) -> Facts:
    """Return how the system below `root` is, `paths` being the files that may be written. Raises ModelServerError."""
    paths = tuple(paths)
    manifest = read_manifest(root)
    files = {}
    for path in {*paths, *manifest.files}:
        content = _content(below(root, path))
        if content is not None:
            files[path] = digest(content)
    around = {folder for path in (*paths, MANIFEST) for folder in folders_around(path)}
    absent = frozenset(folder for folder in around if not below(root, folder).is_dir())
    programs = {name: found for name in PROGRAMS if (found := shutil.which(name, path=SEARCHED))}
    is_live = root == Path("/") and os.path.isdir("/run/systemd/system")
    rules = (_content(below(root, RULES)) or b"").decode("utf-8", "replace")
    return Facts(
        files=files,
        absent=absent,
        manifest=manifest,
        by_id=_by_id(),
        rules=rules,
        rmem_max=_rmem_max() if root == Path("/") else 0,
        programs=programs,
        realtime=is_live and may_be_realtime(programs.get("systemd-run", "")),
        is_live=is_live,
        root=str(root),
    )


def read_manifest(root: Path) -> Manifest:
    """Return what was installed below `root`; an empty one where nothing was. Raises ModelServerError."""
    raw = _content(below(root, MANIFEST))
    return Manifest() if raw is None else Manifest.decoded(raw, str(below(root, MANIFEST)))


def below(root: Path, path: str) -> Path:
    """Return where an absolute path of the system is below its root."""
    return Path(in_root(str(root), path))


def check_may(root: Path, command: str) -> None:
    """Raise ModelServerError where this user cannot change the system."""
    if os.geteuid() != 0 and root == Path("/"):
        raise ModelServerError(f"this changes /etc and needs root: sudo {command} (to see what it would do: --dry-run)")


def show(plan: Plan, root: Path) -> None:
    """Print a plan for the system below `root`."""
    for step in plan.steps:
        _say(_words(step, root))
    for note in plan.notes:
        _say(f"note    {note}")


def carry_out(plan: Plan, root: Path) -> None:
    """Do what a plan says, telling each step. Raises ModelServerError, OSError at the first that fails."""
    for step in plan.steps:
        _say(_words(step, root))
        _carry_out(step, root)
    for note in plan.notes:
        _say(f"note    {note}")


def _words(step: Step, root: Path) -> str:
    """Return a step for people, with the path that is touched."""
    return str(step if isinstance(step, RunProgram) else replace(step, path=str(below(root, step.path))))


def _carry_out(step: Step, root: Path) -> None:
    if isinstance(step, Write):
        _write(step, root)
    elif isinstance(step, Remove):
        _remove(step, root)
    elif isinstance(step, RunProgram):
        _run(step)
    else:
        assert isinstance(step, Keep)


def _write(step: Write, root: Path) -> None:
    path = below(root, step.path)
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    # whole or not at all: a power cut leaves the old file or the new one
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


def _remove(step: Remove, root: Path) -> None:
    path = below(root, step.path)
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(mode):
        path.unlink()
    elif step.whole:
        shutil.rmtree(path)
    else:
        # one that still holds something is somebody's
        with suppress(OSError):
            path.rmdir()


def _run(step: RunProgram) -> None:
    said = ""
    try:
        done = subprocess.run(step.arguments, capture_output=True, text=True, timeout=COMMAND_S, check=False)
        failed, said = done.returncode != 0, (done.stderr or done.stdout).strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        failed, said = True, str(error)
    if not failed:
        return
    command = " ".join(step.arguments)
    if not step.may_fail:
        hint = (
            "journalctl -e -u 'modelserver*' says why" if "restart" in step.arguments else "mend that, then do it again"
        )
        raise ModelServerError(f"{command} failed: {said or 'it says nothing'}; {hint}")
    _say(f"        that failed, and the rest goes on: {said or 'it says nothing'}")


def _say(text: str) -> None:
    for line in text.splitlines():
        typer.echo(safe(line))


def _content(path: Path) -> bytes | None:
    """Return what a file holds, None where there is none. Raises OSError."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None


def may_be_realtime(systemd_run: str) -> bool:
    """Return whether systemd can have a unit scheduled in real time, and there is a core left for the others.

    Some kernels (CONFIG_RT_GROUP_SCHED) refuse it to units, and a unit that asks for it does not start there.
    """
    if os.geteuid() != 0 or not systemd_run or (os.cpu_count() or 1) < 2:
        return False
    asked = ("--quiet", "--wait", "--collect", "-p", "CPUSchedulingPolicy=rr", "-p", "CPUSchedulingPriority=1", "true")
    try:
        done = subprocess.run((systemd_run, *asked), capture_output=True, timeout=20.0, check=False)
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


def configuration_there(root: Path) -> Path | None:
    """Return the vehicle file that is installed already, None where there is none."""
    path = below(root, VEHICLE)
    return path if path.is_file() else None
