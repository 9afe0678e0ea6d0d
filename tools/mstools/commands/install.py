"""`modelserver install`: install the service and its drivers under systemd, or remove them.

All steps are planned before anything is executed. The state of the system comes in as `SystemFacts`, the steps go out
as a `Plan`; plan and file contents are pure. A file is replaced or removed only if its hash is one that `install` wrote
(manifest); edited files are kept. The manifest is written first, so that an interrupted installation can be undone.
Read top-down: command, plan, contents, execution.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias
from urllib.parse import parse_qs, urlsplit

import typer

from modelserver.errors import ConfigError, ModelServerError, Severity, quote
from modelserver.extras import SYSTEM_ENVIRONMENT, make_requirement, make_system_command
from modelserver.files import INSTALLED_FOLDER, STATE_FOLDER, read_regular
from modelserver.formats import MAX_BYTES as LARGEST_FILE
from modelserver.wire.provider import group_of
from mstools.terminal.options import option, parse_pairs
from mstools.terminal.output import ProblemCollector, escape, make_error, suggest_name, write_beside

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from msdrivers.settings import DriverSettings


def command(
    vehicle: Annotated[
        Path | None, option("--vehicle -c FILE", "The vehicle file. Default: the installed one.")
    ] = None,
    drivers: Annotated[str, option("--drivers NAMES", "Drivers to start: all, none, or names with commas.")] = "all",
    serial: Annotated[
        list[str] | None, option("--serial NAME=ID", "A driver's device below /dev/serial/by-id. May be repeated.")
    ] = None,
    start: Annotated[bool, option("--start/--no-start", "Start the installed units.")] = True,
    remove: Annotated[bool, option("--remove", "Stop the units, and remove what an installation wrote.")] = False,
    purge: Annotated[bool, option("--purge", "With --remove: also edited files and the service's state.")] = False,
    dry_run: Annotated[bool, option("--dry-run", "Only print what would be done.")] = False,
    root: Annotated[Path, option("--root DIR", "Root of another system, e.g. an image; nothing is started.")] = Path(
        "/"
    ),
) -> None:
    """Install the service and its drivers under systemd, and start them.

    Copies the vehicle file and the files it names to /etc/modelserver, writes units, udev rules for serial devices by
    their ids and the kernel's limit for receive buffers, and enables the units at boot. An edited file is not replaced,
    and is listed. Repeat it after an upgrade. --remove leaves edited files, which it lists, and
    the state of the service in /var/lib/modelserver.

    \b
    Examples:
      modelserver install --vehicle vehicle.yaml --dry-run
      sudo /opt/modelserver/bin/modelserver install --vehicle vehicle.yaml --drivers gps,imu
      modelserver install --remove --dry-run
    """
    if purge and not remove:
        raise typer.BadParameter("needs --remove", param_hint="--purge")
    if remove and (vehicle is not None or drivers != "all" or serial or not start):
        raise typer.BadParameter("excludes --vehicle, --drivers, --serial and --no-start", param_hint="--remove")
    root = root.resolve()
    if not dry_run and os.geteuid() != 0 and root == Path("/"):
        words = f"--remove{' --purge' if purge else ''}" if remove else "..."
        sudo = f"sudo {get_command_path()} install {words}"
        raise ModelServerError(f"this changes /etc and needs root: {sudo} (to see what it would do: --dry-run)")
    if remove:
        plan = plan_removal(read_facts((), root), purge=purge)
    else:
        plan = make_plan(vehicle, drivers, parse_pairs(serial, "NAME=ID", "--serial", str), root, start)
    execute_plan(plan, root, dry_run)


def make_plan(vehicle: Path | None, drivers: str, serial: Mapping[str, str], root: Path, start: bool) -> Plan:
    """Return the plan of an installation.

    Raises ConfigError with all problems; ModelServerError, OSError.
    """
    from modelserver.config.vehicle_file import KEY_HINT
    from modelserver.server.vehicle import find_unsigned_drive

    gathered = ProblemCollector()
    with gathered.collect("this installation"):
        check_installation()
    found = path_in_root(root, VEHICLE)
    is_installed = found.is_file()
    if vehicle is None and not is_installed:
        there = path_in_root(root, CONFIGURATION)
        why = f"there is no vehicle file in {there} yet, and none is given"
        gathered.add("--vehicle", why, f"--vehicle FILE; examples are in {get_examples_folder()}")
    made: CheckedVehicle | None = None
    copied: list[WriteFile] = []
    if vehicle is not None:
        with gathered.collect(str(vehicle)):
            made = CheckedVehicle.load(vehicle)
            copied = list_configuration(made.read_files(), made.key_file)
    # the vehicle file in force: an edited one is not replaced
    if is_installed and (vehicle is None or (made is not None and not _is_unmodified(found, vehicle, root))):
        made = None
        with gathered.collect(str(found)):
            made = CheckedVehicle.load(found)
            geometry = Path(made.config.geometry).resolve()
            inside = Path("/") / geometry.relative_to(root) if geometry.is_relative_to(root) else geometry
            fix = f"copy it to {CONFIGURATION}"
            check_visible([(str(inside), "the geometry")], fix, str(found))
    names: tuple[str, ...] = ()
    if made is not None:
        names = tuple(made.config.drivers)
        with gathered.collect("--drivers"):
            names = check_drivers(drivers, made.config.drivers)
        with gathered.collect("commands.key_file"):
            render_credential_drop_in(made.installed_key)
        if made.config.commands.drive != "unsigned" and (text := find_unsigned_drive(made.config)):
            gathered.add("commands.drive", text, f"{KEY_HINT}; or write drive: unsigned to accept it")
        with gathered.collect("--serial"):
            check_serial(serial, made.serial_of(names))
        for key, given in made.get_state_folders().items():
            if not is_unit_state(given):
                why = f"the unit cannot write {quote(given)}, only {STATE[0]}"
                name = key.rpartition("_" if "_" in key else ".")[0]
                fix = f"write {key}: {name}, a folder below it, or leave it out"
                gathered.add(key, why, fix)
    gathered.raise_any()
    assert made is not None
    return _build_plan(copied, made, names, serial, root, start)


def _build_plan(
    copied: list[WriteFile],
    made: CheckedVehicle,
    names: tuple[str, ...],
    serial: Mapping[str, str],
    root: Path,
    start: bool,
) -> Plan:
    from modelserver.wire.channels import DEFAULT_URL
    from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

    templates = read_templates()
    units = (f"{UNITS}/{name}" for name in templates)
    drop_ins = (REALTIME, CREDENTIAL)
    paths = [*(each.path for each in copied), RULES, SYSCTL, *units, *drop_ins]
    facts = read_facts(paths, root)
    url = made.config.lcm.url or DEFAULT_URL
    ip = facts.programs.get("ip", "/usr/sbin/ip")
    rules, notes = render_udev_rules(made.serial_of(names), serial, facts)
    writes = [
        *copied,
        *render_units(templates, get_command_path(), url, ip, bool(names), made.hosts_of(names)),
        *render_realtime_drop_in(facts),
        *render_credential_drop_in(made.installed_key),
        *rules,
        *render_sysctl(RECEIVE_BUFFER_BYTES, facts),
    ]
    started = [LOOPBACK] if loopback_group(url) else []
    started += [SERVICE, *(f"modelserver-driver@{name}.service" for name in names)]
    if set(NETWORK) & set(bus_addresses(url)):
        notes.append(
            "the units may use this machine's and private addresses only (IPAddressAllow); if the vehicle's network "
            "is another one: sudo systemctl edit modelserver, and there [Service] IPAddressAllow=NETWORK"
        )
    return plan_install(writes, started, facts, notes, start)


def read_templates() -> dict[str, str]:
    folder = get_examples_folder() / "systemd"
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.service"))}


@dataclass(frozen=True, slots=True)
class CheckedVehicle:
    """A vehicle file without errors, its content and its valid drivers."""

    path: Path
    content: Mapping[str, Any]
    config: VehicleConfig
    drivers: Mapping[str, DriverSettings]

    @classmethod
    def load(cls, vehicle: Path) -> CheckedVehicle:
        """Load and check a vehicle file. Raises ConfigError, GeometryError, OSError."""
        import yaml

        from mstools.commands.check import check_vehicle
        from mstools.commands.driver import load_drivers

        _, problems = check_vehicle(str(vehicle))
        if errors := [problem for problem in problems if problem.severity is Severity.ERROR]:
            raise ConfigError(errors)
        return cls(vehicle, yaml.safe_load(vehicle.read_bytes()), *load_drivers(vehicle))

    @property
    def key_file(self) -> str:
        """The key file as written in the vehicle file; empty for none."""
        return str((self.content.get("commands") or {}).get("key_file") or "")

    @property
    def installed_key(self) -> str:
        """The path of the installed key file; empty for none."""
        return os.path.normpath(os.path.join(CONFIGURATION, self.key_file)) if self.key_file else ""

    def get_state_folders(self) -> dict[str, str]:
        """Return the folders of state and journal that the file has, as written, by their keys."""
        named = {
            "state_directory": self.content.get("state_directory"),
            "journal.directory": (self.content.get("journal") or {}).get("directory"),
        }
        return {key: str(given) for key, given in named.items() if given}

    def hosts_of(self, names: Iterable[str]) -> list[str]:
        """Return the hosts of the named drivers' network devices."""
        from msdrivers.registry import MULTICAST, split_address, split_group

        found = []
        for name in names:
            line = self.drivers[name].line
            if address := getattr(line, "address", ""):
                found.append(split_address(address)[0])
            elif getattr(line, "interface", "") == MULTICAST:
                found.append(split_group(getattr(line, "channel", ""))[0])
        return found

    def serial_of(self, names: Iterable[str]) -> dict[str, str]:
        """Return the serial ports of the named drivers."""
        return {name: port for name in names if (port := getattr(self.drivers[name].line, "port", ""))}

    def read_files(self) -> dict[str, bytes]:
        """Return the vehicle's files by path relative to the vehicle file, which itself is vehicle.yaml.

        Raises ConfigError for files outside the folder of the vehicle file and for unreadable ones; OSError.
        """
        named = [str(self.content["geometry"])]
        named += [dbc for each in self.drivers.values() if (dbc := getattr(each.device_settings, "dbc", ""))]
        # systemd passes a key file outside the folder as a credential
        named += [self.key_file] if self.key_file and not Path(self.key_file).is_absolute() else []
        found = {"vehicle.yaml": self.path.read_bytes()}
        subject, folder, fix = str(self.path), self.path.resolve().parent, "put it beside the vehicle file"
        gathered = ProblemCollector()
        for name in dict.fromkeys(named):
            whole = Path(os.path.normpath(folder / name))
            relative = os.path.relpath(whole, folder)
            if Path(name).is_absolute():
                with gathered.collect(subject):
                    check_visible([(name, "a file that it names")], fix, subject)
            elif folder not in whole.parents:
                gathered.add(subject, f"it names {quote(name)}, outside its folder", fix)
            elif relative in found or relative == "installed.json":
                gathered.add(subject, f"it names {quote(name)}, a reserved name", "rename the file")
            else:
                with gathered.collect(str(whole)):
                    found[relative] = read_regular(whole, LARGEST_FILE)
        gathered.raise_any()
        return found


def _is_unmodified(found: Path, vehicle: Path, root: Path) -> bool:
    """Return whether the installed vehicle file equals an earlier installation's, or the given one."""
    earlier = read_manifest(root).files.get(VEHICLE, ())
    return digest(found.read_bytes()) in (*earlier, digest(vehicle.read_bytes()))


# --- plan

CONFIGURATION: Final = INSTALLED_FOLDER
VEHICLE: Final = f"{CONFIGURATION}/vehicle.yaml"
MANIFEST: Final = f"{CONFIGURATION}/installed.json"
UNITS: Final = "/etc/systemd/system"
RULES: Final = "/etc/udev/rules.d/90-modelserver.rules"
SYSCTL: Final = "/etc/sysctl.d/60-modelserver.conf"
STATE: Final = (STATE_FOLDER, "/var/lib/private/modelserver")
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
                {str(path): tuple(map(str, hashes)) for path, hashes in content["files"].items()},
                tuple(map(str, content["units"])),
                tuple(map(str, content["folders"])),
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
    return Path(root, path.lstrip("/"))


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def plan_install(
    writes: Iterable[WriteFile], units: Iterable[str], facts: SystemFacts, notes: Iterable[str] = (), start: bool = True
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


def parent_folders(path: str) -> set[str]:
    return {str(folder) for folder in Path(path).parents} - {"/"}


def _systemctl(facts: SystemFacts, what: str, verb: str, *units: str) -> RunProgram:
    root = () if facts.root == "/" else (f"--root={facts.root}",)
    now = ("--now",) if verb == "disable" and facts.is_live else ()
    return RunProgram((facts.programs.get("systemctl", "systemctl"), *root, verb, *now, *units), what)


BY_ID: Final = "/dev/serial/by-id/"
DEVICE_FOLDER: Final = "/dev/modelserver/"
REALTIME: Final = f"{UNITS}/{SERVICE}.d/50-realtime.conf"

CREDENTIAL: Final = f"{UNITS}/{SERVICE}.d/60-key.conf"

HIDDEN_FOLDERS: Final = {
    "/root": "ProtectHome",
    "/home": "ProtectHome",
    "/run/user": "ProtectHome",
    "/tmp": "PrivateTmp",
    "/var/tmp": "PrivateTmp",
}
"""Folders that hardened units cannot access, with the unit setting that hides them."""

INSTANCE_NAME: Final = re.compile(r"[A-Za-z0-9_.:][A-Za-z0-9_.:-]*")
"""A driver name that equals its unit instance, without systemd's escapes."""

_UNIT_PATH: Final = re.compile(r"/[A-Za-z0-9/._+@-]+")
"""A path that means itself in a unit."""

_DEVICE_NAME: Final = re.compile(r"[A-Za-z0-9#+.:=@_-]+")
"""Characters that udev allows in device names."""


def is_unit_state(folder: str) -> bool:
    """Return whether the unit can write a folder of the installed vehicle file: one in its state directory."""
    if folder.startswith("~"):
        return False
    whole = os.path.normpath(os.path.join(STATE[0], folder))
    return any(whole == state or whole.startswith(f"{state}/") for state in STATE)


def find_hiding_setting(path: str) -> str:
    """Return the unit setting that hides a path from the service, empty for none."""
    return next((why for folder, why in HIDDEN_FOLDERS.items() if path == folder or path.startswith(f"{folder}/")), "")


def check_visible(paths: Iterable[tuple[str, str]], fix: str, subject: str = "this installation") -> None:
    """Raise ConfigError for paths that the service cannot access; each is given with a description.

    `subject` is the location in the error, `fix` the remedy.
    """
    if unseen := {f"{what} is {path}": setting for path, what in paths if (setting := find_hiding_setting(path))}:
        why = " and ".join(f"{setting}=yes" for setting in dict.fromkeys(unseen.values()))
        raise make_error(f"{', '.join(unseen)}, which the hardened units cannot access ({why})", subject, fix)


def check_drivers(wanted: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the drivers that `wanted` selects: all, none, or names with commas. Raises ConfigError."""
    known = tuple(known)
    names = tuple(dict.fromkeys(name.strip() for name in wanted.split(",") if name.strip()))
    if names in (("all",), ()):
        names = known
    elif names == ("none",):
        names = ()
    gathered = ProblemCollector()
    for name in names:
        if name not in known:
            offer = suggest_name(name, known, f"it has: {', '.join(known) or 'none'}")
            gathered.add("--drivers", f"the vehicle file has no driver {quote(name, 40)}; {offer}")
        elif not INSTANCE_NAME.fullmatch(name):
            why = f"driver {quote(name, 40)} cannot be a unit name"
            fix = "rename it in the vehicle file with only letters, digits, _ . : and -"
            gathered.add("--drivers", why, fix)
    gathered.raise_any()
    return names


def loopback_group(url: str) -> str:
    """Return the multicast group of a bus on this machine only, empty for one that leaves it or needs none."""
    parts = urlsplit(url)
    ttl = parse_qs(parts.query).get("ttl", ["0"])[-1]
    if parts.scheme != "udpm" or ttl.strip() not in ("", "0"):
        return ""
    return group_of(url)


LOCAL: Final = "localhost"
NETWORK: Final = ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16")
"""Private networks (RFC 1918, RFC 3927): the vehicle's other machines, for a bus with a ttl."""

ANYWHERE: Final = "any"


def bus_addresses(url: str) -> tuple[str, ...]:
    """Return the addresses of a bus, for systemd's IPAddressAllow."""
    parts = urlsplit(url)
    if parts.scheme == "file":
        return (LOCAL,)
    if parts.scheme == "tcpq":
        return (LOCAL, *host_addresses([parts.hostname or LOCAL]))
    if parts.scheme != "udpm" or not group_of(url):
        return (ANYWHERE,)
    return (LOCAL, group_of(url), *(() if loopback_group(url) else NETWORK))


def host_addresses(hosts: Iterable[str]) -> tuple[str, ...]:
    """Return the addresses of hosts, in their order; `any` for a name, which may resolve differently later."""
    return tuple(_parse_address(host) for host in hosts if host != LOCAL)


def _parse_address(host: str) -> str:
    try:
        return str(ip_address(host))
    except ValueError:
        return ANYWHERE


def _join_addresses(addresses: Iterable[str]) -> str:
    """Return addresses for a unit: each once, or `any` alone."""
    found = dict.fromkeys(addresses)
    return ANYWHERE if ANYWHERE in found else " ".join(found)


def render_units(
    templates: Mapping[str, str],
    program: str,
    url: str,
    ip: str,
    drivers: bool,
    hosts: Iterable[str] = (),
) -> list[WriteFile]:
    """Return the units of this installation.

    `program` is the path of its command, `url` that of the bus; `hosts` are those of the drivers' devices.
    """
    group, bus = loopback_group(url), bus_addresses(url)
    places = {"MODELSERVER": program, "GROUP": group, "IP": ip, "ADDRESSES": _join_addresses(bus)}
    places["DEVICES"] = _join_addresses((*bus, *host_addresses(hosts)))
    wanted = {SERVICE: "the service"}
    wanted |= {DRIVER: "one driver, by its name"} if drivers else {}
    wanted |= {LOOPBACK: "multicast on the loopback interface"} if group else {}
    writes = []
    for name, what in wanted.items():
        text = re.sub("@([A-Z]+)@", lambda place: places[place[1]], templates[name])
        summary = "\n".join(line for line in text.splitlines() if line.startswith("ExecStart="))
        writes.append(WriteFile(f"{UNITS}/{name}", text.encode(), what, summary))
    return writes


def list_configuration(sources: Mapping[str, bytes], key: str = "") -> list[WriteFile]:
    """Return the vehicle's files. `sources` are by their paths relative to the vehicle file, which is vehicle.yaml.

    The one at `key` is readable by root only.
    """
    kinds = {"vehicle.yaml": ("the vehicle file", 0o644), key: ("the key of signed commands", 0o600)}
    return [
        WriteFile(f"{CONFIGURATION}/{path}", content, what, mode=mode)
        for path, content in sources.items()
        for what, mode in [kinds.get(path, ("of the vehicle", 0o644))]
    ]


def render_sysctl(wanted: int, facts: SystemFacts) -> list[WriteFile]:
    """Return the file that raises the kernel's limit of receive buffers, nothing where it is high enough."""
    if facts.rmem_max >= wanted and SYSCTL not in facts.files:
        return []
    line = f"net.core.rmem_max = {wanted}"
    text = f"# ModelServer: receive buffers for bursts on the bus.\n{line}\n"
    return [WriteFile(SYSCTL, text.encode(), "receive buffers for bursts on the bus", line)]


def render_realtime_drop_in(facts: SystemFacts) -> list[WriteFile]:
    """Return the drop-in for real-time scheduling of the service's loop, nothing where that is not possible.

    With two busy programs on two cores, ticks were up to 20 ms late without it, whatever the nice level, and 0.1 ms
    with it.
    """
    if not facts.realtime:
        return []
    lines = "CPUSchedulingPolicy=rr\nCPUSchedulingPriority=1\n"
    text = f"# Written by `modelserver install` where the machine supports it.\n[Service]\n{lines}"
    return [WriteFile(REALTIME, text.encode(), "real-time scheduling of the loop", lines)]


def render_credential_drop_in(key_file: str) -> list[WriteFile]:
    """Return the drop-in by which systemd passes the key file to the service, nothing for a vehicle without one.

    The service's user cannot read a file that is root's alone. Raises ModelServerError for a path that cannot be
    written in a unit.
    """
    if not key_file:
        return []
    if not _UNIT_PATH.fullmatch(key_file):
        raise ModelServerError(
            f"the key file {quote(key_file)} cannot be written in a unit: use only letters, digits and ._+@-; rename it"
        )
    line = f"LoadCredential={key_file.rpartition('/')[2]}:{key_file}"
    about = "# Written by `modelserver install`: the file stays root's, and systemd passes it to the service."
    text = f"{about}\n[Service]\n{line}\n"
    return [WriteFile(CREDENTIAL, text.encode(), "the key of signed commands", line)]


def render_udev_rules(
    ports: Mapping[str, str], given: Mapping[str, str], facts: SystemFacts
) -> tuple[list[WriteFile], list[str]]:
    """Return the udev rules that give each driver's device a name of its own, and notes on them.

    `ports` are the serial ports of the vehicle file by driver; `given` are names below /dev/serial/by-id by driver, as
    `check_serial` accepts them, and take precedence over the found ones. Raises ModelServerError.
    """
    from msdrivers.links.serial_port import BOARD_UARTS

    lines, notes = [], []
    for name, port in ports.items():
        own = f"{DEVICE_FOLDER}{name}"
        device = given.get(name, "") or (port if port.startswith(BY_ID) else "")
        device = device or next((by_id for by_id, target in sorted(facts.by_id.items()) if target == port), "")
        link = f'SYMLINK+="modelserver/{name}"'
        known = [each for each in facts.rules.splitlines() if each.startswith("SUBSYSTEM") and each.endswith(link)]
        if device:
            device = device.removeprefix(BY_ID)
            _check_device(device)
            # systemd's own rules make the link by id, from vendor, product and serial number
            match = f'SUBSYSTEM=="tty", SYMLINK=="{BY_ID.removeprefix("/dev/")}{device}"'
            # ModemManager would send data to it otherwise, from which some devices do not recover
            lines.append(f'{match}, ENV{{ID_MM_DEVICE_IGNORE}}="1", {link}')
        elif known:
            lines.append(known[0])
        elif re.fullmatch(rf"/dev/({'|'.join(BOARD_UARTS)})[0-9]+", port):
            # a UART of the board: its name is fixed
            continue
        else:
            fix = f"plug it in, or: --serial {name}={BY_ID}..."
            notes.append(f"no device id is known for driver {name} (port {port}); {fix}")
            continue
        if port != own and not port.startswith(BY_ID):
            notes.append(f"driver {name}: set port: {own} in the vehicle file; {port} may change")
    if not lines:
        return [], notes
    text = "# ModelServer: the devices of the vehicle file, by their ids.\n" + "".join(f"{line}\n" for line in lines)
    summary = "\n".join(f"{DEVICE_FOLDER}{line.rpartition('/')[2].rstrip(chr(34))}" for line in lines)
    return [WriteFile(RULES, text.encode(), "names for the serial devices", summary)], notes


def check_serial(given: Mapping[str, str], ports: Mapping[str, str]) -> None:
    """Raise ConfigError for invalid devices of --serial. `given` are names by driver, `ports` as in the rules."""
    gathered = ProblemCollector()
    for name, device in given.items():
        if name not in ports:
            offer = suggest_name(name, ports, f"there are: {', '.join(ports) or 'none'}")
            gathered.add("--serial", f"{quote(name, 40)} is not a driver on a serial port; {offer}")
        with gathered.collect("--serial"):
            _check_device(device.removeprefix(BY_ID))
    gathered.raise_any()


def _check_device(device: str) -> None:
    if not _DEVICE_NAME.fullmatch(device):
        raise ModelServerError(f"{quote(device)} is not a name below {BY_ID}: only letters, digits and #+-.:=@_")


PROGRAMS: Final = ("systemctl", "systemd-run", "udevadm", "sysctl", "ip")
SEARCH_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
COMMAND_TIMEOUT_S: Final = 120.0
"""Time limit of a command: a start waits until the service is ready."""


def make_install_hint() -> str:
    """Return how to install this version where the units and all users can access it."""
    command = make_system_command(make_requirement())
    return (
        f"install it to {SYSTEM_ENVIRONMENT}, then install the units from there: "
        f"{command} && sudo {SYSTEM_ENVIRONMENT}/bin/modelserver install --vehicle FILE"
    )


def get_command_path() -> str:
    return os.path.join(os.path.dirname(os.path.abspath(sys.executable)), "modelserver")


def get_examples_folder() -> Path:
    installed = Path(str(files("modelserver"))) / "share" / "config"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "config"


def check_installation() -> None:
    """Raise ConfigError where the units could not access or read this installation, with all problems."""
    subject, command, hint = "this installation", get_command_path(), make_install_hint()
    paths = [
        (command, "the command of this installation"),
        (os.path.realpath(sys.executable), "its Python"),
        (sys.base_prefix, "its Python's library"),
        (str(Path(str(files("modelserver"))).resolve()), "its package"),
    ]
    gathered = ProblemCollector()
    with gathered.collect(subject):
        check_visible(paths, hint)
    if not os.path.isfile(command):
        gathered.add(subject, f"there is no {command}: the package is not installed", hint)
    if not _UNIT_PATH.fullmatch(command):
        fix = "install to a folder whose path has only letters, digits and ._+@-"
        gathered.add(subject, f"{command!r} cannot be written in a unit", fix)
    gathered.raise_any()


def read_facts(paths: Iterable[str], root: Path) -> SystemFacts:
    """Return the system's state below `root`; `paths` are the files that may be written. Raises ModelServerError."""
    paths = tuple(paths)
    manifest = read_manifest(root)
    contents = {path: _read_file(path_in_root(root, path)) for path in {*paths, *manifest.files}}
    around = {folder for path in (*paths, MANIFEST) for folder in parent_folders(path)}
    programs = {name: found for name in PROGRAMS if (found := shutil.which(name, path=SEARCH_PATH))}
    is_live = root == Path("/") and os.path.isdir("/run/systemd/system")
    by_id, rmem_max = {}, 0
    with suppress(OSError):
        by_id = {link.name: os.path.realpath(link) for link in Path(BY_ID).iterdir()}
    with suppress(OSError, ValueError):
        rmem_max = int(Path("/proc/sys/net/core/rmem_max").read_text()) if root == Path("/") else 0
    return SystemFacts(
        files={path: digest(content) for path, content in contents.items() if content is not None},
        absent=frozenset(folder for folder in around if not path_in_root(root, folder).is_dir()),
        manifest=manifest,
        by_id=by_id,
        rules=(_read_file(path_in_root(root, RULES)) or b"").decode("utf-8", "replace"),
        rmem_max=rmem_max,
        programs=programs,
        realtime=is_live and can_be_realtime(programs.get("systemd-run", "")),
        is_live=is_live,
        root=str(root),
    )


def read_manifest(root: Path) -> Manifest:
    """Return what was installed below `root`; an empty manifest where nothing was. Raises ModelServerError."""
    path = path_in_root(root, MANIFEST)
    raw = _read_file(path)
    return Manifest() if raw is None else Manifest.decode(raw, str(path))


def _read_file(path: Path) -> bytes | None:
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
        case WriteFile():
            path = path_in_root(root, step.path)
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
            with write_beside(path) as draft:
                draft.write_bytes(step.content)
                draft.chmod(step.mode)
        case RemovePath():
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
