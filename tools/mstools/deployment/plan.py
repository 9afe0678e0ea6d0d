"""What `install` and `uninstall` do, as a list of steps that nothing has carried out yet.

No file is touched here: what there is comes in as `Facts`, what is to be done goes out as a `Plan`, and
`install_steps` carries it out.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from modelserver.errors import ModelServerError

CONFIGURATION: Final = "/etc/modelserver"
VEHICLE: Final = f"{CONFIGURATION}/vehicle.yaml"
MANIFEST: Final = f"{CONFIGURATION}/installed.json"
UNITS: Final = "/etc/systemd/system"
RULES: Final = "/etc/udev/rules.d/90-modelserver.rules"
SYSCTL: Final = "/etc/sysctl.d/60-modelserver.conf"
STATE: Final = ("/var/lib/modelserver", "/var/lib/private/modelserver")
"""What a service with a dynamic user has for its state: a link, and the folder that it leads to."""

SERVICE: Final = "modelserver.service"
LOOPBACK: Final = "modelserver-loopback.service"
DRIVER: Final = "modelserver-driver@.service"

MANIFEST_VERSION: Final = 1


@dataclass(frozen=True, slots=True)
class Write:
    """Write a file whole. `what` it is and `summary` of its content are for people."""

    path: str
    content: bytes
    what: str
    summary: str = ""
    mode: int = 0o644

    def __str__(self) -> str:
        said = f"write   {self.path}  ({len(self.content)} bytes, {self.mode:04o}): {self.what}"
        return said + "".join(f"\n            {line}" for line in self.summary.splitlines())


@dataclass(frozen=True, slots=True)
class Keep:
    """Leave a file as it is, and say why."""

    path: str
    why: str

    def __str__(self) -> str:
        return f"leave   {self.path}: {self.why}"


@dataclass(frozen=True, slots=True)
class Remove:
    """Remove a file, or a folder with what it holds where `whole`, or else an empty one."""

    path: str
    what: str
    whole: bool = False

    def __str__(self) -> str:
        return f"remove  {self.path}: {self.what}"


@dataclass(frozen=True, slots=True)
class RunProgram:
    """Run a program. Where it `may_fail`, the rest is done all the same."""

    arguments: tuple[str, ...]
    what: str
    may_fail: bool = False

    def __str__(self) -> str:
        return f"run     {' '.join(self.arguments)}: {self.what}"


Step: TypeAlias = Write | Keep | Remove | RunProgram


@dataclass(frozen=True, slots=True)
class Plan:
    """Steps in their order, and what to tell beside them."""

    steps: tuple[Step, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Manifest:
    """What an earlier `install` did: for each file the hashes that are its own, units it enabled, folders it made."""

    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()

    def encoded(self) -> bytes:
        """Return it as a file's content."""
        content = {
            "version": MANIFEST_VERSION,
            "files": dict(sorted(self.files.items())),
            "units": self.units,
            "folders": self.folders,
        }
        return (json.dumps(content, indent=1) + "\n").encode()

    @classmethod
    def decoded(cls, raw: bytes, file: str = MANIFEST) -> Manifest:
        """Return the one that a `file` holds. Raises ModelServerError for a damaged one."""
        try:
            content = json.loads(raw)
            if content["version"] != MANIFEST_VERSION:
                raise ValueError(f"its version is {content['version']!r}, not {MANIFEST_VERSION}")
            files = {_path(path): tuple(map(_text, hashes)) for path, hashes in content["files"].items()}
            return cls(files, tuple(map(_unit, content["units"])), tuple(map(_folder, content["folders"])))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ModelServerError(
                f"{file}, which holds what was installed, is damaged ({error}); remove it, and what was written "
                "counts as your own"
            ) from None


@dataclass(frozen=True, slots=True)
class Facts:
    """How the system is that is to be installed to.

    files: hash of every file that is there of those that may be written. absent: folders around them that are not
        there.
    by_id: for each name below /dev/serial/by-id the device it leads to. rules: text of the udev rules there are.
    rmem_max: the kernel's limit of receive buffers, bytes, 0 where it is not known.
    programs: those that can be run, with their paths.
    realtime: whether the service may be scheduled before others without taking the machine along.
    is_live: whether it is the system that runs here, and systemd runs it. root: its root for systemctl, if another.
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


def in_root(root: str, path: str) -> str:
    """Return where an absolute path of a system is, whose root is another folder perhaps."""
    return path if root == "/" else f"{root.rstrip('/')}{path}"


def digest(content: bytes) -> str:
    """Return the hash of a file's content."""
    return hashlib.sha256(content).hexdigest()


def plan_install(
    writes: Iterable[Write], units: Iterable[str], facts: Facts, *, start: bool, notes: Iterable[str]
) -> Plan:
    """Return the steps that bring `writes` to a system and have its `units` started. What was edited stays.

    A file is written where there is none, or where the one there is what an earlier `install` wrote. What an earlier
    one wrote and this one does not is removed, but for the configuration, which is not always given anew.
    """
    writes = tuple(writes)
    steps: list[Step] = []
    owned = dict(facts.manifest.files)
    changed = set()
    for write in writes:
        there, new = facts.files.get(write.path), digest(write.content)
        if there == new:
            # not taken over where it was there before: uninstall is to leave it
            if write.path in owned:
                owned[write.path] = (new,)
            steps.append(Keep(write.path, f"it is so already ({write.what})"))
        elif there is None or there in owned.get(write.path, ()):
            owned[write.path] = (new,) if there is None else (new, there)
            changed.add(write.path)
            steps.append(write)
        else:
            steps.append(Keep(write.path, f"it was edited, or is not from here; what was to be written: {write.what}"))
    for path in sorted(set(owned) - {write.path for write in writes}):
        there = facts.files.get(path)
        if path.startswith(f"{CONFIGURATION}/") or (there is not None and there not in owned[path]):
            continue
        del owned[path]
        if there is not None:
            changed.add(path)
            steps.append(Remove(path, "it was installed, and is not wanted any more"))
    units = tuple(units)
    gone = [unit for unit in facts.manifest.units if unit not in units]
    made = {folder for path in (*changed, MANIFEST) for folder in folders_around(path)} & facts.absent
    manifest = Manifest(owned, units, tuple(sorted({*facts.manifest.folders, *made})))
    # before anything it tells of: what an interrupted installation has written can be taken back
    steps.insert(0, Write(MANIFEST, manifest.encoded(), "what `modelserver uninstall` takes back"))
    steps += _after_files(facts, changed)
    if gone:
        steps.append(_systemctl(facts, "units that are not wanted any more", "disable", *_now(facts), *gone))
    steps.append(_systemctl(facts, "they start with the machine", "enable", *units))
    if start and facts.is_live:
        steps.append(_systemctl(facts, "they start now, with what was written", "restart", *units))
    return Plan(tuple(steps), tuple(notes))


def plan_uninstall(facts: Facts, *, purge: bool) -> Plan:
    """Return the steps that take an installation back; with `purge` also what was edited, and the state.

    Raises ModelServerError where nothing was installed.
    """
    manifest = facts.manifest
    if not manifest.files:
        raise ModelServerError(
            f"there is nothing to take back: {in_root(facts.root, MANIFEST)} tells of no installation"
        )
    steps: list[Step] = []
    if manifest.units:
        ended = _systemctl(facts, "they end, and start no more", "disable", *_now(facts), *manifest.units)
        steps.append(RunProgram(ended.arguments, ended.what, may_fail=True))
    removed = set()
    for path, hashes in sorted(manifest.files.items()):
        there = facts.files.get(path)
        if there is None:
            continue
        if there in hashes or purge:
            removed.add(path)
            steps.append(Remove(path, "as it was installed" if there in hashes else "installed, and edited since"))
        else:
            steps.append(Keep(path, "it was edited since; remove it yourself, or with --purge"))
    steps.append(Remove(MANIFEST, "what was installed"))
    if purge:
        steps += [Remove(path, "what the service kept", whole=True) for path in STATE]
    # those within others first
    for folder in sorted(manifest.folders, reverse=True):
        steps.append(Remove(folder, "the folder, where nothing is left in it"))
    steps += _after_files(facts, removed)
    notes = []
    if SYSCTL in removed:
        notes.append("the kernel's limit of receive buffers is as it was set until the machine starts anew")
    if not purge:
        notes.append(f"what the service kept is still in {in_root(facts.root, STATE[0])}; --purge removes it too")
    return Plan(tuple(steps), tuple(notes))


def _after_files(facts: Facts, changed: Iterable[str]) -> list[Step]:
    """Return the commands by which a system that runs takes note of files that have changed."""
    if not facts.is_live:
        return []
    changed = set(changed)
    steps: list[Step] = []
    if RULES in changed and "udevadm" in facts.programs:
        udevadm = facts.programs["udevadm"]
        steps.append(RunProgram((udevadm, "control", "--reload"), "the rules for serial ports count", may_fail=True))
        trigger = (udevadm, "trigger", "--subsystem-match=tty", "--action=change")
        steps.append(RunProgram(trigger, "also for what is plugged in", may_fail=True))
    if SYSCTL in changed and "sysctl" in facts.programs and SYSCTL not in facts.files:
        load = (facts.programs["sysctl"], "--quiet", "--load", SYSCTL)
        steps.append(RunProgram(load, "the limit counts from now on", may_fail=True))
    if any(path.startswith(f"{UNITS}/") for path in changed):
        steps.append(_systemctl(facts, "systemd reads the units", "daemon-reload"))
    return steps


def folders_around(path: str) -> list[str]:
    """Return the folders around a file, the outermost first."""
    parts = path.split("/")[:-1]
    return ["/".join(parts[:n]) for n in range(2, len(parts) + 1)]


def _systemctl(facts: Facts, what: str, *arguments: str) -> RunProgram:
    program = facts.programs.get("systemctl", "systemctl")
    return RunProgram((program, *(() if facts.root == "/" else (f"--root={facts.root}",)), *arguments), what)


def _now(facts: Facts) -> tuple[str, ...]:
    return ("--now",) if facts.is_live else ()


def _path(path: Any) -> str:
    """Return a path of the manifest, which decides what is removed: one below a folder that is installed to."""
    below = (f"{CONFIGURATION}/", f"{UNITS}/modelserver")
    is_own = isinstance(path, str) and (path in (RULES, SYSCTL) or path.startswith(below))
    if not is_own or not {"..", "."}.isdisjoint(path.split("/")):
        raise ValueError(f"{path!r} is no file of this installation")
    return str(path)


def _unit(name: Any) -> str:
    if not isinstance(name, str) or not name.startswith("modelserver") or "/" in name:
        raise ValueError(f"{name!r} is no unit of this installation")
    return name


def _folder(path: Any) -> str:
    # only ever removed where it is empty
    if not isinstance(path, str) or not (path == "/etc" or path.startswith("/etc/")) or ".." in path.split("/"):
        raise ValueError(f"{path!r} is no folder of this installation")
    return path


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no hash")
    return value
