"""Plan of `install` and `install --remove`: a list of steps, before anything is executed. Pure.

The state of the system comes in as `SystemFacts`, the steps go out as a `Plan`, and steps.py executes it. A file is
replaced or removed only if its hash is one that `install` wrote (manifest); edited files are kept. The manifest is
written first, so that an interrupted installation can be undone.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeAlias

from modelserver.errors import ModelServerError

CONFIGURATION: Final = "/etc/modelserver"
VEHICLE: Final = f"{CONFIGURATION}/vehicle.yaml"
MANIFEST: Final = f"{CONFIGURATION}/installed.json"
UNITS: Final = "/etc/systemd/system"
RULES: Final = "/etc/udev/rules.d/90-modelserver.rules"
SYSCTL: Final = "/etc/sysctl.d/60-modelserver.conf"
STATE: Final = ("/var/lib/modelserver", "/var/lib/private/modelserver")
"""State directory of a service with a dynamic user: a link, and the folder that it leads to."""

SERVICE: Final = "modelserver.service"
LOOPBACK: Final = "modelserver-loopback.service"
DRIVER: Final = "modelserver-driver@.service"

MANIFEST_VERSION: Final = 1


@dataclass(frozen=True, slots=True)
class WriteFile:
    """Write a file atomically; `description` and `summary` of its content are for the user."""

    path: str
    content: bytes
    description: str
    summary: str = ""
    mode: int = 0o644

    def __str__(self) -> str:
        text = f"write   {self.path}  ({len(self.content)} bytes, {self.mode:04o}): {self.description}"
        return text + "".join(f"\n            {line}" for line in self.summary.splitlines())


@dataclass(frozen=True, slots=True)
class KeepFile:
    """Leave a file as it is, for a reason."""

    path: str
    reason: str

    def __str__(self) -> str:
        return f"leave   {self.path}: {self.reason}"


@dataclass(frozen=True, slots=True)
class RemovePath:
    """Remove a file, or a folder: recursively where `is_recursive`, else only an empty one."""

    path: str
    description: str
    is_recursive: bool = False

    def __str__(self) -> str:
        return f"remove  {self.path}: {self.description}"


@dataclass(frozen=True, slots=True)
class RunProgram:
    """Run a program. Where it `may_fail`, the following steps are executed all the same."""

    arguments: tuple[str, ...]
    description: str
    may_fail: bool = False

    def __str__(self) -> str:
        return f"run     {' '.join(self.arguments)}: {self.description}"


Step: TypeAlias = WriteFile | KeepFile | RemovePath | RunProgram


@dataclass(frozen=True, slots=True)
class Plan:
    """Steps in their order, with notes for the user."""

    steps: tuple[Step, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Manifest:
    """Record of an earlier `install`: for each file the hashes that it wrote, units it enabled, folders it made."""

    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()

    def encode(self) -> bytes:
        files = dict(sorted(self.files.items()))
        content = {"version": MANIFEST_VERSION, "files": files, "units": self.units, "folders": self.folders}
        return (json.dumps(content, indent=1) + "\n").encode()

    @classmethod
    def decode(cls, raw: bytes, file: str = MANIFEST) -> Manifest:
        """Return the manifest in a `file`. Raises ModelServerError for a damaged one."""
        try:
            content = json.loads(raw)
            if content["version"] != MANIFEST_VERSION:
                raise ValueError(f"its version is {content['version']!r}, not {MANIFEST_VERSION}")
            return cls(
                {
                    _parse("file", path): tuple(_parse("hash", each) for each in hashes)
                    for path, hashes in content["files"].items()
                },
                tuple(_parse("unit", each) for each in content["units"]),
                tuple(_parse("folder", each) for each in content["folders"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ModelServerError(
                f"{file}: the record of the installation is damaged ({error}); remove it: the installed files then "
                "count as edited"
            ) from None


@dataclass(frozen=True, slots=True)
class SystemFacts:
    """State of the system to install to.

    Attributes
    ----------
    files : hash of each existing file of those that may be written
    absent : missing folders around them
    by_id : device of each name below /dev/serial/by-id
    rules : content of the installed udev rules
    rmem_max : the kernel's limit of receive buffers, bytes, 0 if unknown
    programs : paths of the available programs
    realtime : whether the service may be scheduled in real time
    is_live : whether it is the running system, with systemd
    root : root folder for systemctl
    """

    files: Mapping[str, str] = field(default_factory=dict)
    absent: frozenset[str] = frozenset()
    manifest: Manifest = field(default_factory=Manifest)
    by_id: Mapping[str, str] = field(default_factory=dict)
    rules: str = ""
    rmem_max: int = 0
    programs: Mapping[str, str] = field(default_factory=dict)
    realtime: bool = False
    is_live: bool = True
    root: str = "/"


def path_in_root(root: str | Path, path: str) -> Path:
    """Return the location of an absolute path of a system with the given root."""
    return Path(root, path.lstrip("/"))


def digest(content: bytes) -> str:
    """Return the hash of a file's content."""
    return hashlib.sha256(content).hexdigest()


def plan_install(
    writes: Iterable[WriteFile], units: Iterable[str], facts: SystemFacts, *, start: bool, notes: Iterable[str]
) -> Plan:
    """Return the steps that write `writes` and start `units`. Edited files are kept.

    A file is written where there is none, or where the existing one is what an earlier `install` wrote. What an earlier
    one wrote and this one does not is removed, except for the configuration, which is not always given again.
    """
    writes = tuple(writes)
    steps: list[Step] = []
    owned = dict(facts.manifest.files)
    changed = set()
    for write in writes:
        there, new = facts.files.get(write.path), digest(write.content)
        if there == new:
            # a file that was there before is not owned: a removal leaves it
            if write.path in owned:
                owned[write.path] = (new,)
            steps.append(KeepFile(write.path, f"unchanged ({write.description})"))
        elif there is None or there in owned.get(write.path, ()):
            owned[write.path] = (new,) if there is None else (new, there)
            changed.add(write.path)
            steps.append(write)
        else:
            why = f"edited, or not installed by modelserver; not written: {write.description}"
            steps.append(KeepFile(write.path, why))
    for path in sorted(set(owned) - {write.path for write in writes}):
        there = facts.files.get(path)
        if path.startswith(f"{CONFIGURATION}/") or (there is not None and there not in owned[path]):
            continue
        del owned[path]
        if there is not None:
            changed.add(path)
            steps.append(RemovePath(path, "installed earlier, no longer needed"))
    units = tuple(units)
    obsolete = [unit for unit in facts.manifest.units if unit not in units]
    made = {folder for path in (*changed, MANIFEST) for folder in parent_folders(path)} & facts.absent
    manifest = Manifest(owned, units, tuple(sorted({*facts.manifest.folders, *made})))
    # first, so that an interrupted installation can be undone
    steps.insert(0, WriteFile(MANIFEST, manifest.encode(), "the record for `modelserver install --remove`"))
    steps += _plan_reloads(facts, changed)
    if obsolete:
        steps.append(_systemctl(facts, "units that are no longer needed", "disable", *obsolete))
    steps.append(_systemctl(facts, "start at boot", "enable", *units))
    if start and facts.is_live:
        steps.append(_systemctl(facts, "start now, with the new files", "restart", *units))
    return Plan(tuple(steps), tuple(notes))


def plan_removal(facts: SystemFacts, *, purge: bool) -> Plan:
    """Return the steps that undo an installation; with `purge` also edited files and the state.

    Raises ModelServerError where nothing was installed.
    """
    manifest = facts.manifest
    if not manifest.files:
        raise ModelServerError(f"nothing to remove: {path_in_root(facts.root, MANIFEST)} has no installation")
    steps: list[Step] = []
    if manifest.units:
        stop = _systemctl(facts, "stop, and do not start again", "disable", *manifest.units)
        steps.append(replace(stop, may_fail=True))
    removed = set()
    for path, hashes in sorted(manifest.files.items()):
        if (there := facts.files.get(path)) is None:
            continue
        if there in hashes or purge:
            removed.add(path)
            steps.append(RemovePath(path, "as installed" if there in hashes else "installed, edited since"))
        else:
            steps.append(KeepFile(path, "edited since; remove it yourself, or with --purge"))
    steps.append(RemovePath(MANIFEST, "the record of the installation"))
    if purge:
        steps += [RemovePath(path, "the service's state", is_recursive=True) for path in STATE]
    # nested folders first
    steps += [RemovePath(folder, "the folder, if it is empty") for folder in sorted(manifest.folders, reverse=True)]
    steps += _plan_reloads(facts, removed)
    notes = []
    if SYSCTL in removed:
        notes.append("the kernel's limit of receive buffers stays until the next boot")
    if not purge:
        notes.append(f"the service's state is still in {path_in_root(facts.root, STATE[0])}; --purge removes it too")
    return Plan(tuple(steps), tuple(notes))


def _plan_reloads(facts: SystemFacts, changed: Iterable[str]) -> list[Step]:
    """Return the commands that make a running system reload changed files."""
    if not facts.is_live:
        return []
    changed = set(changed)
    commands: list[tuple[tuple[str, ...], str]] = []
    if RULES in changed:
        trigger = ("udevadm", "trigger", "--subsystem-match=tty", "--action=change")
        commands += [(("udevadm", "control", "--reload"), "apply the rules for serial ports")]
        commands += [(trigger, "apply them to connected devices")]
    if SYSCTL in changed and SYSCTL not in facts.files:
        commands += [(("sysctl", "--quiet", "--load", SYSCTL), "apply the limit")]
    steps: list[Step] = [
        RunProgram((facts.programs[program], *rest), what, may_fail=True)
        for (program, *rest), what in commands
        if program in facts.programs
    ]
    if any(path.startswith(f"{UNITS}/") for path in changed):
        steps.append(_systemctl(facts, "systemd reloads the units", "daemon-reload"))
    return steps


def parent_folders(path: str) -> list[str]:
    """Return the folders around a file, the outermost first."""
    parts = path.split("/")[:-1]
    return ["/".join(parts[:n]) for n in range(2, len(parts) + 1)]


def _systemctl(facts: SystemFacts, what: str, verb: str, *units: str) -> RunProgram:
    root = () if facts.root == "/" else (f"--root={facts.root}",)
    now = ("--now",) if verb == "disable" and facts.is_live else ()
    return RunProgram((facts.programs.get("systemctl", "systemctl"), *root, verb, *now, *units), what)


_OWN: Final = {
    "file": rf"{re.escape(RULES)}|{re.escape(SYSCTL)}|{CONFIGURATION}/.*|{UNITS}/modelserver.*",
    "unit": "modelserver[^/]*",
    "folder": "/etc(/.*)?",
    "hash": ".*",
}
"""What a manifest may name; it decides what is removed. A folder is removed only where it is empty."""


def _parse(kind: str, value: Any) -> str:
    is_own = isinstance(value, str) and re.fullmatch(_OWN[kind], value, re.DOTALL)
    if not is_own or not {"..", "."}.isdisjoint(value.split("/")):
        raise ValueError(f"{value!r} is no {kind} of this installation")
    return str(value)
