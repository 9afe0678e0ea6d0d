"""`modelserver install`: install the service and its drivers under systemd."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import ConfigError, Severity, quote
from modelserver.files.regular import read_regular
from modelserver.formats.registry import MAX_BYTES as LARGEST_FILE
from mstools.deployment import files as install_files
from mstools.deployment.installation import check_installation, get_command_path, get_examples_folder
from mstools.deployment.plan import (
    CONFIGURATION,
    LOOPBACK,
    RULES,
    SERVICE,
    STATE,
    SYSCTL,
    UNITS,
    VEHICLE,
    Plan,
    SystemFacts,
    WriteFile,
    digest,
    path_in_root,
    plan_install,
)
from mstools.deployment.steps import (
    check_root_user,
    execute_plan,
    find_installed_vehicle,
    print_plan,
    read_facts,
    read_manifest,
)
from mstools.terminal.problems import ProblemCollector

if TYPE_CHECKING:
    from modelserver.config.vehicle_file import VehicleConfig
    from msdrivers.settings import DriverSettings

DROP_INS = (install_files.REALTIME, install_files.CREDENTIAL)

RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Root of another system, e.g. an image; nothing is started.")
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Only print what would be done.")]


def command(
    vehicle: Annotated[
        Path | None,
        typer.Option("--vehicle", "-c", metavar="FILE", help="The vehicle file. Default: the installed one."),
    ] = None,
    drivers: Annotated[
        str, typer.Option("--drivers", metavar="NAMES", help="Drivers to start: all, none, or names with commas.")
    ] = "all",
    serial: Annotated[
        list[str] | None,
        typer.Option("--serial", metavar="NAME=ID", help="A driver's device below /dev/serial/by-id. May be repeated."),
    ] = None,
    start: Annotated[bool, typer.Option("--start/--no-start", help="Start the installed units.")] = True,
    dry_run: DryRunOption = False,
    root: RootOption = Path("/"),
) -> None:
    """Install the service and its drivers under systemd, and start them.

    Copies the vehicle file and the files it names to /etc/modelserver, writes units, udev rules for serial devices by
    their ids and the kernel's limit for receive buffers, and enables the units at boot. An edited file is not replaced,
    and is listed. Repeat it after an upgrade. `modelserver uninstall` removes it.

    \b
    Examples:
      modelserver install --vehicle vehicle.yaml --dry-run
      sudo /opt/modelserver/bin/modelserver install --vehicle vehicle.yaml --drivers gps,imu
    """
    root = root.resolve()
    if not dry_run:
        check_root_user(root, f"{get_command_path()} install ...")
    show_or_apply(make_plan(vehicle, drivers, parse_serial(serial), start, root), root, dry_run)


def show_or_apply(plan: Plan, root: Path, dry_run: bool) -> None:
    """Print a plan, or execute it."""
    if dry_run:
        print_plan(plan, root)
        typer.echo("nothing was done")
    else:
        execute_plan(plan, root)


def make_plan(vehicle: Path | None, drivers: str, serial: Mapping[str, str], start: bool, root: Path) -> Plan:
    """Return the plan of an installation.

    Raises ConfigError with all problems; ModelServerError, OSError.
    """
    gathered = ProblemCollector()
    with gathered.collect("this installation"):
        check_installation()
    found = find_installed_vehicle(root)
    if vehicle is None and found is None:
        there = path_in_root(str(root), CONFIGURATION)
        why = f"there is no vehicle file in {there} yet, and none is given"
        gathered.add("--vehicle", why, f"--vehicle FILE; examples are in {get_examples_folder()}")
    given = None if vehicle is None else _load_vehicle(vehicle, gathered)
    copied: list[WriteFile] = []
    if given is not None:
        with gathered.collect(str(vehicle)):
            copied = install_files.list_configuration(sources_of(given), {key_of(given)})
    made = given
    # the vehicle file in force: an edited one is not replaced
    if found is not None and (vehicle is None or (given is not None and not _is_unmodified(found, vehicle, root))):
        made = _load_vehicle(found, gathered)
        with gathered.collect(str(found)):
            _check_geometry(made, root)
    known = made.config.drivers if made is not None else _read_driver_names(vehicle or found)
    names = tuple(known or ())
    if known is not None:
        with gathered.collect("--drivers"):
            names = install_files.check_drivers(drivers, known)
    if made is not None:
        with gathered.collect("commands.key_file"):
            install_files.render_credential_drop_in(get_installed_key(made))
        with gathered.collect("--serial"):
            install_files.check_serial(serial, made.serial_of(names))
    gathered.raise_any()
    assert made is not None
    facts = read_facts([*(each.path for each in copied), RULES, SYSCTL, *_list_unit_paths(), *DROP_INS], root)
    return _build_plan(copied, made, names, serial, start, facts)


def _load_vehicle(vehicle: Path, gathered: ProblemCollector) -> CheckedVehicle | None:
    made: list[CheckedVehicle] = []
    with gathered.collect(str(vehicle)):
        made.append(CheckedVehicle.load(vehicle))
    return made[0] if made else None


def _read_driver_names(vehicle: Path | None) -> Iterable[str] | None:
    """Return the drivers of a wrong vehicle file; None if they cannot be read."""
    from modelserver.config.vehicle_file import load_partly

    with contextlib.suppress(ConfigError, OSError):
        config = None if vehicle is None else load_partly(vehicle)[0]
        return None if config is None else config.drivers
    return None


def _check_geometry(made: CheckedVehicle | None, root: Path) -> None:
    if made is not None:
        geometry = Path(made.config.geometry).resolve()
        inside = Path("/") / geometry.relative_to(root) if geometry.is_relative_to(root) else geometry
        install_files.check_visible([(str(inside), "the geometry")], f"copy it to {CONFIGURATION}", str(made.path))


def _build_plan(
    copied: Iterable[WriteFile],
    made: CheckedVehicle,
    names: tuple[str, ...],
    serial: Mapping[str, str],
    start: bool,
    facts: SystemFacts,
) -> Plan:
    from modelserver.wire.channels import DEFAULT_URL
    from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

    url = made.config.lcm.url or DEFAULT_URL
    group = install_files.loopback_group(url)
    ip = facts.programs.get("ip", "/usr/sbin/ip")
    rules, notes = install_files.render_udev_rules(made.serial_of(names), serial, facts)
    writes = [
        *copied,
        *install_files.render_units(read_templates(), get_command_path(), url, ip, bool(names), made.hosts_of(names)),
        *install_files.render_realtime_drop_in(facts),
        *install_files.render_credential_drop_in(get_installed_key(made)),
        *rules,
        *install_files.render_sysctl(RECEIVE_BUFFER_BYTES, facts),
    ]
    units = (*((LOOPBACK,) if group else ()), SERVICE, *(f"modelserver-driver@{name}.service" for name in names))
    if set(install_files.NETWORK) & set(install_files.bus_addresses(url)):
        notes.append(
            "the units may use this machine's and private addresses only (IPAddressAllow); if the vehicle's network "
            "is another one: sudo systemctl edit modelserver, and there [Service] IPAddressAllow=NETWORK"
        )
    if made.config.state_directory:
        notes.append("the vehicle file sets state_directory; without it the state is in the unit's directory")
    if made.config.journal.directory:
        notes.append(
            "the vehicle file sets journal.directory, which the unit can write only inside "
            f"{STATE[0]}; without it (megabytes only) the journal is written there"
        )
    if facts.is_live and os.geteuid() != 0:
        notes.append("run as root, this also checks for real-time scheduling and adds the drop-in for it")
    if not facts.is_live and facts.root == "/":
        notes.append("systemd does not run this system: the units are enabled, and nothing is started")
    return plan_install(writes, units, facts, start=start, notes=notes)


@dataclass(frozen=True, slots=True)
class CheckedVehicle:
    """A vehicle file without errors, and its valid drivers."""

    path: Path
    config: VehicleConfig
    drivers: Mapping[str, DriverSettings]

    @classmethod
    def load(cls, vehicle: Path) -> CheckedVehicle:
        """Load and check a vehicle file. Raises ConfigError, GeometryError, OSError."""
        from modelserver.config.vehicle_file import load_config
        from msdrivers.settings import SourceMap, read_drivers
        from mstools.commands.check import check_vehicle

        _, problems = check_vehicle(str(vehicle))
        errors = [problem for problem in problems if problem.severity is Severity.ERROR]
        if errors:
            raise ConfigError(errors)
        config = load_config(vehicle)
        return cls(vehicle, config, read_drivers(config.drivers, SourceMap(str(vehicle)))[0])

    def hosts_of(self, names: Iterable[str]) -> list[str]:
        """Return the hosts of the named drivers' network devices."""
        from msdrivers.line_settings import MULTICAST, split_address, split_group

        found = []
        for name in names:
            line = self.drivers[name].line
            if address := getattr(line, "address", ""):
                found.append(split_address(address)[0])
            elif getattr(line, "interface", "") == MULTICAST:
                found.append(split_group(getattr(line, "channel", ""))[0])
        return found

    def serial_of(self, names: Iterable[str]) -> list[install_files.SerialDriver]:
        """Return the named drivers with serial ports."""
        ports = ((name, getattr(self.drivers[name].line, "port", "")) for name in names)
        return [install_files.SerialDriver(name, port) for name, port in ports if port]


def sources_of(made: CheckedVehicle) -> dict[str, bytes]:
    """Return a vehicle's files by path relative to the vehicle file, which itself is vehicle.yaml.

    Raises ConfigError for files outside the folder of the vehicle file and for unreadable ones; OSError.
    """
    import yaml

    vehicle = made.path
    text = vehicle.read_bytes()
    raw = yaml.safe_load(text)
    named = [str(raw["geometry"])]
    named += [dbc for each in made.drivers.values() if (dbc := getattr(each.device_settings, "dbc", ""))]
    # systemd passes a key file outside the folder as a credential
    named += [key] if (key := key_of(made)) and not Path(key).is_absolute() else []
    found = {"vehicle.yaml": text}
    folder = vehicle.resolve().parent
    gathered = ProblemCollector()
    for name in dict.fromkeys(named):
        path = Path(name)
        if path.is_absolute():
            with gathered.collect(str(vehicle)):
                seen = [(str(path), "a file that it names")]
                install_files.check_visible(seen, "put it beside the vehicle file", str(vehicle))
            continue
        whole = os.path.normpath(folder / path)
        relative = os.path.relpath(whole, folder)
        if Path(whole).parent != folder and folder not in Path(whole).parents:
            gathered.add(str(vehicle), f"it names {quote(name)}, outside its folder", "put it beside the vehicle file")
        elif relative in found or relative == "installed.json":
            gathered.add(str(vehicle), f"it names {quote(name)}, a reserved name", "rename the file")
        else:
            with gathered.collect(whole):
                found[relative] = read_regular(whole, LARGEST_FILE)
    gathered.raise_any()
    return found


def key_of(made: CheckedVehicle) -> str:
    """Return the key file as written in the vehicle file; empty for none."""
    import yaml

    commands = yaml.safe_load(made.path.read_bytes()).get("commands") or {}
    return str(commands.get("key_file") or "")


def get_installed_key(made: CheckedVehicle) -> str:
    """Return the path of the installed key file; empty for none."""
    key = key_of(made)
    return os.path.normpath(os.path.join(CONFIGURATION, key)) if key else ""


def parse_serial(given: Iterable[str] | None) -> dict[str, str]:
    """Return the devices of --serial by driver. Raises typer.BadParameter, a usage error."""
    found = {}
    for each in given or ():
        name, sign, device = each.partition("=")
        if not (name and sign and device):
            raise typer.BadParameter(f"{quote(each)} is not NAME=ID", param_hint="--serial")
        found[name] = device
    return found


def read_templates() -> dict[str, str]:
    """Return the unit templates of the package or the source tree."""
    folder = get_examples_folder() / "systemd"
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.service"))}


def _is_unmodified(found: Path, vehicle: Path, root: Path) -> bool:
    """Return whether the installed vehicle file equals an earlier installation's, or the given one."""
    there = digest(found.read_bytes())
    return there in read_manifest(root).files.get(VEHICLE, ()) or there == digest(vehicle.read_bytes())


def _list_unit_paths() -> list[str]:
    return [f"{UNITS}/{name}" for name in read_templates()]
