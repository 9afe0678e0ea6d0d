"""`modelserver install`: install the service and its drivers under systemd, or remove them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import ConfigError, ModelServerError, Severity, quote
from modelserver.files import read_regular
from modelserver.formats import MAX_BYTES as LARGEST_FILE
from mstools import deployment
from mstools.terminal.options import option
from mstools.terminal.output import ProblemCollector

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
        sudo = f"sudo {deployment.get_command_path()} install {words}"
        raise ModelServerError(f"this changes /etc and needs root: {sudo} (to see what it would do: --dry-run)")
    if remove:
        plan = deployment.plan_removal(deployment.read_facts((), root), purge=purge)
    else:
        plan = make_plan(vehicle, drivers, parse_serial(serial), root, start)
    deployment.execute_plan(plan, root, dry_run)


def make_plan(
    vehicle: Path | None, drivers: str, serial: Mapping[str, str], root: Path, start: bool
) -> deployment.Plan:
    """Return the plan of an installation.

    Raises ConfigError with all problems; ModelServerError, OSError.
    """
    from modelserver.config.vehicle_file import KEY_HINT
    from modelserver.server.vehicle import find_unsigned_drive

    gathered = ProblemCollector()
    with gathered.collect("this installation"):
        deployment.check_installation()
    found = deployment.path_in_root(root, deployment.VEHICLE)
    is_installed = found.is_file()
    if vehicle is None and not is_installed:
        there = deployment.path_in_root(root, deployment.CONFIGURATION)
        why = f"there is no vehicle file in {there} yet, and none is given"
        gathered.add("--vehicle", why, f"--vehicle FILE; examples are in {deployment.get_examples_folder()}")
    made: CheckedVehicle | None = None
    copied: list[deployment.WriteFile] = []
    if vehicle is not None:
        with gathered.collect(str(vehicle)):
            made = CheckedVehicle.load(vehicle)
            copied = deployment.list_configuration(made.read_files(), made.key_file)
    # the vehicle file in force: an edited one is not replaced
    if is_installed and (vehicle is None or (made is not None and not _is_unmodified(found, vehicle, root))):
        made = None
        with gathered.collect(str(found)):
            made = CheckedVehicle.load(found)
            geometry = Path(made.config.geometry).resolve()
            inside = Path("/") / geometry.relative_to(root) if geometry.is_relative_to(root) else geometry
            fix = f"copy it to {deployment.CONFIGURATION}"
            deployment.check_visible([(str(inside), "the geometry")], fix, str(found))
    names: tuple[str, ...] = ()
    if made is not None:
        names = tuple(made.config.drivers)
        with gathered.collect("--drivers"):
            names = deployment.check_drivers(drivers, made.config.drivers)
        with gathered.collect("commands.key_file"):
            deployment.render_credential_drop_in(made.installed_key)
        if made.config.commands.drive != "unsigned" and (text := find_unsigned_drive(made.config)):
            gathered.add("commands.drive", text, f"{KEY_HINT}; or write drive: unsigned to accept it")
        with gathered.collect("--serial"):
            deployment.check_serial(serial, made.serial_of(names))
        for key, given in made.get_state_folders().items():
            if not deployment.is_unit_state(given):
                why = f"the unit cannot write {quote(given)}, only {deployment.STATE[0]}"
                name = key.rpartition("_" if "_" in key else ".")[0]
                fix = f"write {key}: {name}, a folder below it, or leave it out"
                gathered.add(key, why, fix)
    gathered.raise_any()
    assert made is not None
    return _build_plan(copied, made, names, serial, root, start)


def _build_plan(
    copied: list[deployment.WriteFile],
    made: CheckedVehicle,
    names: tuple[str, ...],
    serial: Mapping[str, str],
    root: Path,
    start: bool,
) -> deployment.Plan:
    from modelserver.wire.channels import DEFAULT_URL
    from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

    templates = read_templates()
    units = (f"{deployment.UNITS}/{name}" for name in templates)
    drop_ins = (deployment.REALTIME, deployment.CREDENTIAL)
    paths = [*(each.path for each in copied), deployment.RULES, deployment.SYSCTL, *units, *drop_ins]
    facts = deployment.read_facts(paths, root)
    url = made.config.lcm.url or DEFAULT_URL
    ip = facts.programs.get("ip", "/usr/sbin/ip")
    rules, notes = deployment.render_udev_rules(made.serial_of(names), serial, facts)
    writes = [
        *copied,
        *deployment.render_units(templates, deployment.get_command_path(), url, ip, bool(names), made.hosts_of(names)),
        *deployment.render_realtime_drop_in(facts),
        *deployment.render_credential_drop_in(made.installed_key),
        *rules,
        *deployment.render_sysctl(RECEIVE_BUFFER_BYTES, facts),
    ]
    started = [deployment.LOOPBACK] if deployment.loopback_group(url) else []
    started += [deployment.SERVICE, *(f"modelserver-driver@{name}.service" for name in names)]
    if set(deployment.NETWORK) & set(deployment.bus_addresses(url)):
        notes.append(
            "the units may use this machine's and private addresses only (IPAddressAllow); if the vehicle's network "
            "is another one: sudo systemctl edit modelserver, and there [Service] IPAddressAllow=NETWORK"
        )
    return deployment.plan_install(writes, started, facts, notes, start)


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
        return os.path.normpath(os.path.join(deployment.CONFIGURATION, self.key_file)) if self.key_file else ""

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
                    deployment.check_visible([(name, "a file that it names")], fix, subject)
            elif folder not in whole.parents:
                gathered.add(subject, f"it names {quote(name)}, outside its folder", fix)
            elif relative in found or relative == "installed.json":
                gathered.add(subject, f"it names {quote(name)}, a reserved name", "rename the file")
            else:
                with gathered.collect(str(whole)):
                    found[relative] = read_regular(whole, LARGEST_FILE)
        gathered.raise_any()
        return found


def parse_serial(given: Iterable[str] | None) -> dict[str, str]:
    """Return the devices of --serial by driver. Raises typer.BadParameter, a usage error."""
    found = {}
    for each in given or ():
        name, _, found[name] = each.partition("=")
        if not (name and found[name]):
            raise typer.BadParameter(f"{quote(each)} is not NAME=ID", param_hint="--serial")
    return found


def read_templates() -> dict[str, str]:
    folder = deployment.get_examples_folder() / "systemd"
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.service"))}


def _is_unmodified(found: Path, vehicle: Path, root: Path) -> bool:
    """Return whether the installed vehicle file equals an earlier installation's, or the given one."""
    earlier = deployment.read_manifest(root).files.get(deployment.VEHICLE, ())
    return deployment.digest(found.read_bytes()) in (*earlier, deployment.digest(vehicle.read_bytes()))
