"""`modelserver install`: the service and its drivers under systemd, as an administrator would do it by hand."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import ConfigError, Severity, shown
from modelserver.formats.content import MAX_BYTES as LARGEST_FILE
from modelserver.regular_files import read_regular
from mstools.deployment import files as install_files
from mstools.deployment.place import check_installation, examples, program
from mstools.deployment.plan import (
    CONFIGURATION,
    LOOPBACK,
    RULES,
    SERVICE,
    STATE,
    SYSCTL,
    UNITS,
    VEHICLE,
    Facts,
    Plan,
    Write,
    digest,
    in_root,
    plan_install,
)
from mstools.deployment.steps import carry_out, check_may, configuration_there, read_facts, read_manifest, show
from mstools.terminal.gathered import Gathered

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from msdrivers.settings import DriverSettings

DROP_INS = (install_files.REALTIME, install_files.CREDENTIAL)

RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Another system's root, e.g. of an image; nothing is started.")
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")]


def command(
    vehicle: Annotated[
        Path | None,
        typer.Option("--vehicle", "-c", metavar="FILE", help="The vehicle file; without, the one that is installed."),
    ] = None,
    drivers: Annotated[
        str, typer.Option("--drivers", metavar="NAMES", help="Drivers to start: all, none, or names with commas.")
    ] = "all",
    serial: Annotated[
        list[str] | None,
        typer.Option("--serial", metavar="NAME=ID", help="A driver's device below /dev/serial/by-id. May be repeated."),
    ] = None,
    start: Annotated[bool, typer.Option("--start/--no-start", help="Start what was installed.")] = True,
    dry_run: DryRunOption = False,
    root: RootOption = Path("/"),
) -> None:
    """Install the service and its drivers under systemd, and start them.

    Copies the vehicle file and what it names to /etc/modelserver, writes units, udev rules for serial devices by their
    ids and the kernel's limit for receive buffers, and has all of it start with the machine. A file that was edited
    stays as it is, and is told. Do it again after an upgrade. `modelserver uninstall` takes it back.

    \b
    Examples:
      modelserver install --vehicle vehicle.yaml --dry-run
      sudo /opt/modelserver/bin/modelserver install --vehicle vehicle.yaml --drivers gps,imu
    """
    root = root.resolve()
    if not dry_run:
        check_may(root, f"{program()} install ...")
    show_or_do(planned(vehicle, drivers, serial_of(serial), start, root), root, dry_run)


def show_or_do(plan: Plan, root: Path, dry_run: bool) -> None:
    """Print a plan, or carry it out."""
    if dry_run:
        show(plan, root)
        typer.echo("nothing was done")
    else:
        carry_out(plan, root)


def planned(vehicle: Path | None, drivers: str, serial: Mapping[str, str], start: bool, root: Path) -> Plan:
    """Return what there is to do.

    Raises ConfigError with everything that stands in the way; ModelServerError, OSError.
    """
    gathered = Gathered()
    with gathered.of("this installation"):
        check_installation()
    found = configuration_there(root)
    if vehicle is None and found is None:
        there = in_root(str(root), CONFIGURATION)
        why = f"there is no vehicle file in {there} yet, and none is given"
        gathered.add("--vehicle", why, f"--vehicle FILE; examples are in {examples()}")
    given = None if vehicle is None else _made(vehicle, gathered)
    copied: list[Write] = []
    if given is not None:
        with gathered.of(str(vehicle)):
            copied = install_files.configuration(sources_of(given), {key_of(given)})
    made = given
    # the one that will be in force: one that was edited stays
    if found is not None and (vehicle is None or (given is not None and not _is_ours(found, vehicle, root))):
        made = _made(found, gathered)
        with gathered.of(str(found)):
            _check_geometry(made, root)
    known = made.config.drivers if made is not None else _names_in(vehicle or found)
    names = tuple(known or ())
    if known is not None:
        with gathered.of("--drivers"):
            names = install_files.check_drivers(drivers, known)
    if made is not None:
        with gathered.of("commands.key_file"):
            install_files.credential(installed_key(made))
        with gathered.of("--serial"):
            install_files.check_serial(serial, made.serial_of(names))
    gathered.check()
    assert made is not None
    facts = read_facts([*(each.path for each in copied), RULES, SYSCTL, *_units(), *DROP_INS], root)
    return _plan(copied, made, names, serial, start, facts)


def _made(vehicle: Path, gathered: Gathered) -> CheckedVehicle | None:
    made: list[CheckedVehicle] = []
    with gathered.of(str(vehicle)):
        made.append(CheckedVehicle.of(vehicle))
    return made[0] if made else None


def _names_in(vehicle: Path | None) -> Iterable[str] | None:
    """Return the drivers in a vehicle file of which something is wrong; None where they cannot be made out."""
    from modelserver.config import load_partly

    with contextlib.suppress(ConfigError, OSError):
        config = None if vehicle is None else load_partly(vehicle)[0]
        return None if config is None else config.drivers
    return None


def _check_geometry(made: CheckedVehicle | None, root: Path) -> None:
    if made is not None:
        geometry = Path(made.config.geometry).resolve()
        inside = Path("/") / geometry.relative_to(root) if geometry.is_relative_to(root) else geometry
        install_files.check_seen([(str(inside), "the geometry")], f"copy it to {CONFIGURATION}", str(made.path))


def _plan(
    copied: Iterable[Write],
    made: CheckedVehicle,
    names: tuple[str, ...],
    serial: Mapping[str, str],
    start: bool,
    facts: Facts,
) -> Plan:
    from modelserver.wire.channels import DEFAULT_URL
    from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

    url = made.config.lcm.url or DEFAULT_URL
    group = install_files.loopback_group(url)
    ip = facts.programs.get("ip", "/usr/sbin/ip")
    rules, notes = install_files.rules(made.serial_of(names), serial, facts)
    writes = [
        *copied,
        *install_files.units(templates(), program(), url, ip, bool(names), made.hosts_of(names)),
        *install_files.realtime(facts),
        *install_files.credential(installed_key(made)),
        *rules,
        *install_files.limits(RECEIVE_BUFFER_BYTES, facts),
    ]
    units = (*((LOOPBACK,) if group else ()), SERVICE, *(f"modelserver-driver@{name}.service" for name in names))
    if set(install_files.NETWORK) & set(install_files.bus_addresses(url)):
        notes.append(
            "the units speak with this machine and with private networks alone (IPAddressAllow); where the vehicle's "
            "own is another: sudo systemctl edit modelserver, and there [Service] IPAddressAllow=NETWORK"
        )
    if made.config.state_directory:
        notes.append("the vehicle file sets state_directory; without it the state goes where the unit may write")
    if made.config.journal.directory:
        notes.append(
            "the vehicle file sets journal.directory, where the unit may not write unless it lies in "
            f"{STATE[0]}; without it (megabytes alone) the journal is kept there"
        )
    if facts.is_live and os.geteuid() != 0:
        notes.append("root is also told whether the service can be scheduled in real time, and the drop-in for that")
    if not facts.is_live and facts.root == "/":
        notes.append("systemd does not run this system: the units are enabled, and nothing is started")
    return plan_install(writes, units, facts, start=start, notes=notes)


@dataclass(frozen=True, slots=True)
class CheckedVehicle:
    """A vehicle file that was found well, and those of its drivers that are."""

    path: Path
    config: VehicleConfig
    drivers: Mapping[str, DriverSettings]

    @classmethod
    def of(cls, vehicle: Path) -> CheckedVehicle:
        """Return a vehicle file with everything in it checked. Raises ConfigError, GeometryError, OSError."""
        from modelserver.config import load_config
        from msdrivers.settings import Place, read_drivers
        from mstools.commands.check import checked_vehicle

        _, problems = checked_vehicle(str(vehicle))
        errors = [problem for problem in problems if problem.severity is Severity.ERROR]
        if errors:
            raise ConfigError(errors)
        config = load_config(vehicle)
        return cls(vehicle, config, read_drivers(config.drivers, Place(str(vehicle)))[0])

    def hosts_of(self, names: Iterable[str]) -> list[str]:
        """Return the hosts of those of the named drivers whose devices are on the network."""
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
        """Return those of the named drivers that are on serial ports."""
        ports = ((name, getattr(self.drivers[name].line, "port", "")) for name in names)
        return [install_files.SerialDriver(name, port) for name, port in ports if port]


def sources_of(made: CheckedVehicle) -> dict[str, bytes]:
    """Return a vehicle's files by their paths relative to the vehicle file, which itself is vehicle.yaml.

    Raises ConfigError for those outside the folder of the vehicle file, which would not be found again, and those that
    cannot be read; OSError.
    """
    import yaml

    vehicle = made.path
    text = vehicle.read_bytes()
    raw = yaml.safe_load(text)
    named = [str(raw["geometry"])]
    named += [dbc for each in made.drivers.values() if (dbc := getattr(each.station, "dbc", ""))]
    # systemd reads one that lies elsewhere, and hands it over
    named += [key] if (key := key_of(made)) and not Path(key).is_absolute() else []
    found = {"vehicle.yaml": text}
    folder = vehicle.resolve().parent
    gathered = Gathered()
    for name in dict.fromkeys(named):
        path = Path(name)
        if path.is_absolute():
            with gathered.of(str(vehicle)):
                seen = [(str(path), "a file that it names")]
                install_files.check_seen(seen, "put it beside the vehicle file", str(vehicle))
            continue
        whole = os.path.normpath(folder / path)
        relative = os.path.relpath(whole, folder)
        if Path(whole).parent != folder and folder not in Path(whole).parents:
            gathered.add(str(vehicle), f"it names {shown(name)}, outside its folder", "put it beside the vehicle file")
        elif relative in found or relative == "installed.json":
            gathered.add(str(vehicle), f"it names {shown(name)}, a name that is taken", "give the file another one")
        else:
            with gathered.of(whole):
                found[relative] = read_regular(whole, LARGEST_FILE)
    gathered.check()
    return found


def key_of(made: CheckedVehicle) -> str:
    """Return the key file that a vehicle file names, as it stands there; empty for none."""
    import yaml

    commands = yaml.safe_load(made.path.read_bytes()).get("commands") or {}
    return str(commands.get("key_file") or "")


def installed_key(made: CheckedVehicle) -> str:
    """Return where the key file is once it is installed; empty for none."""
    key = key_of(made)
    return os.path.normpath(os.path.join(CONFIGURATION, key)) if key else ""


def serial_of(given: Iterable[str] | None) -> dict[str, str]:
    """Return the devices that --serial gave by driver. Raises typer.BadParameter, a usage error."""
    found = {}
    for each in given or ():
        name, sign, device = each.partition("=")
        if not (name and sign and device):
            raise typer.BadParameter(f"{shown(each)} is not of the form NAME=ID", param_hint="--serial")
        found[name] = device
    return found


def templates() -> dict[str, str]:
    """Return the units as they are in the package, or beside it in a source tree."""
    folder = examples() / "systemd"
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.service"))}


def _is_ours(found: Path, vehicle: Path, root: Path) -> bool:
    """Return whether the vehicle file that is installed is as an earlier installation wrote it, or as the one given."""
    there = digest(found.read_bytes())
    return there in read_manifest(root).files.get(VEHICLE, ()) or there == digest(vehicle.read_bytes())


def _units() -> list[str]:
    return [f"{UNITS}/{name}" for name in templates()]
