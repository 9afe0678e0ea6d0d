"""`modelserver install`: the service and its drivers under systemd, as an administrator would do it by hand."""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import ConfigError, ModelServerError, Severity, shown
from mstools import install_files
from mstools.install_plan import (
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
    plan_install,
)
from mstools.install_steps import carry_out, check_may, configuration_there, read_facts, read_manifest, show

if TYPE_CHECKING:
    from modelserver.config import VehicleConfig
    from msdrivers.settings import DriverSettings

ELSEWHERE = (
    "Install to a folder that all may read: sudo python3 -m venv /opt/modelserver && sudo /opt/modelserver/bin/pip "
    "install modelserver, then sudo /opt/modelserver/bin/modelserver install"
)

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
        show(plan)
        typer.echo("nothing was done")
    else:
        carry_out(plan, root)


def planned(vehicle: Path | None, drivers: str, serial: Mapping[str, str], start: bool, root: Path) -> Plan:
    """Return what there is to do. Raises ModelServerError, ConfigError, GeometryError, OSError."""
    check_installation()
    found = configuration_there(root)
    if vehicle is None and found is None:
        raise ModelServerError(
            f"name the vehicle file: --vehicle FILE; there is none in {CONFIGURATION} yet, and examples are in "
            f"{examples()}"
        )
    given = None if vehicle is None else Made.of(vehicle)
    copied = [] if given is None else install_files.configuration(sources_of(given), {key_of(given)})
    # the one that will be in force: one that was edited stays
    if given is not None and (found is None or _is_ours(found, given.path, root)):
        made = given
    else:
        assert found is not None
        made = Made.of(found)
        geometry = Path(made.config.geometry).resolve()
        inside = Path("/") / geometry.relative_to(root) if geometry.is_relative_to(root) else geometry
        install_files.check_seen([(str(inside), "the geometry")], f"Copy it to {CONFIGURATION}")
    names = install_files.check_drivers(drivers, made.config.drivers)
    broken = [name for name in names if name not in made.drivers]
    if broken:
        raise ModelServerError(f"driver {broken[0]} is not described well: modelserver check {made.path}")
    facts = read_facts([*(each.path for each in copied), RULES, SYSCTL, *_units(), *DROP_INS], root)
    return _plan(copied, made, names, serial, start, facts)


def _plan(
    copied: Iterable[Write], made: Made, names: tuple[str, ...], serial: Mapping[str, str], start: bool, facts: Facts
) -> Plan:
    from modelserver.wire.channels import DEFAULT_URL
    from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

    group = install_files.loopback_group(made.config.lcm.url or DEFAULT_URL)
    ip = facts.programs.get("ip", "/usr/sbin/ip")
    rules, notes = install_files.rules(made.serial_of(names), serial, facts)
    writes = [
        *copied,
        *install_files.units(templates(), program(), group, ip, drivers=bool(names)),
        *install_files.realtime(facts),
        *install_files.credential(installed_key(made)),
        *rules,
        *install_files.limits(RECEIVE_BUFFER_BYTES, facts),
    ]
    units = (*((LOOPBACK,) if group else ()), SERVICE, *(f"modelserver-driver@{name}.service" for name in names))
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
class Made:
    """A vehicle file that was found well, and those of its drivers that are."""

    path: Path
    config: VehicleConfig
    drivers: Mapping[str, DriverSettings]

    @classmethod
    def of(cls, vehicle: Path) -> Made:
        """Return a vehicle file with everything in it checked. Raises ConfigError, GeometryError, OSError."""
        from modelserver.config import load_config
        from modelserver.service.daemon import load_vehicle
        from msdrivers.settings import Place, read_drivers

        config = load_config(vehicle)
        load_vehicle(config, str(vehicle)).gate(0, str(vehicle))
        drivers, problems = read_drivers(config.drivers, Place(str(vehicle)))
        if any(problem.severity is Severity.ERROR for problem in problems):
            raise ConfigError(problems)
        return cls(vehicle, config, drivers)

    def serial_of(self, names: Iterable[str]) -> list[install_files.SerialDriver]:
        """Return those of the named drivers that are on serial ports."""
        ports = ((name, getattr(self.drivers[name].line, "port", "")) for name in names)
        return [install_files.SerialDriver(name, port) for name, port in ports if port]


def sources_of(made: Made) -> dict[str, bytes]:
    """Return a vehicle's files by their paths relative to the vehicle file, which itself is vehicle.yaml.

    Raises ModelServerError for one outside the folder of the vehicle file, which would not be found again; OSError.
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
    for name in dict.fromkeys(named):
        path = Path(name)
        if path.is_absolute():
            install_files.check_seen([(str(path), f"a file that {vehicle} names")], "Put it beside the vehicle file")
            continue
        whole = os.path.normpath(folder / path)
        if Path(whole).parent != folder and folder not in Path(whole).parents:
            raise ModelServerError(f"{vehicle} names {shown(name)}, outside its folder; put it beside the vehicle file")
        relative = os.path.relpath(whole, folder)
        if relative in found or relative == "installed.json":
            raise ModelServerError(f"{vehicle} names {shown(name)}, a name that is taken; give the file another one")
        found[relative] = Path(whole).read_bytes()
    return found


def key_of(made: Made) -> str:
    """Return the key file that a vehicle file names, as it stands there; empty for none."""
    import yaml

    commands = yaml.safe_load(made.path.read_bytes()).get("commands") or {}
    return str(commands.get("key_file") or "")


def installed_key(made: Made) -> str:
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


def program() -> str:
    """Return the path of this installation's command."""
    return os.path.join(os.path.dirname(os.path.abspath(sys.executable)), "modelserver")


def check_installation() -> None:
    """Raise ModelServerError where the units would not see this installation, or could not read it."""
    package = str(Path(str(files("modelserver"))).resolve())
    paths = [
        (program(), "the command of this installation"),
        (os.path.realpath(sys.executable), "its Python"),
        (sys.base_prefix, "its Python's library"),
        (package, "its package"),
    ]
    install_files.check_seen(paths, ELSEWHERE)
    if not os.path.isfile(program()):
        raise ModelServerError(f"there is no {program()}: this is not an installation of the package. {ELSEWHERE}")
    for path, what in paths:
        closed = closed_to_others(path)
        if closed:
            raise ModelServerError(
                f"{what} is {path}, and the service's user may not read {closed}: chmod -R o+rX {closed}"
            )


def closed_to_others(path: str) -> str:
    """Return which part of a path keeps other users from it, empty where none does."""
    for part in (*reversed(Path(path).parents), Path(path)):
        mode = part.stat().st_mode
        needed = stat.S_IXOTH if stat.S_ISDIR(mode) else stat.S_IROTH
        if not mode & needed:
            return str(part)
    return ""


def templates() -> dict[str, str]:
    """Return the units as they are in the package, or beside it in a source tree."""
    folder = examples() / "systemd"
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.service"))}


def examples() -> Path:
    """Return the folder of vehicle files and units that comes with the package."""
    installed = Path(str(files("modelserver"))) / "share" / "config"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[2] / "config"


def _is_ours(found: Path, vehicle: Path, root: Path) -> bool:
    """Return whether the vehicle file that is installed is as an earlier installation wrote it, or as the one given."""
    there = digest(found.read_bytes())
    return there in read_manifest(root).files.get(VEHICLE, ()) or there == digest(vehicle.read_bytes())


def _units() -> list[str]:
    return [f"{UNITS}/{name}" for name in templates()]
