"""The files that an installation consists of: units with this installation's paths in them, rules, limits. Pure."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final, NoReturn
from urllib.parse import parse_qs, urlsplit

from modelserver.errors import ConfigError, Location, ModelServerError, Problem, Severity, nearest_names, shown
from modelserver.wire.multicast import group_of
from mstools.deployment.plan import CONFIGURATION, DRIVER, LOOPBACK, RULES, SERVICE, SYSCTL, UNITS, Facts, Write

BY_ID: Final = "/dev/serial/by-id/"
OWN_NAMES: Final = "/dev/modelserver/"
REALTIME: Final = f"{UNITS}/{SERVICE}.d/50-realtime.conf"

CREDENTIAL: Final = f"{UNITS}/{SERVICE}.d/60-key.conf"

HIDDEN: Final = {
    "/root": "ProtectHome",
    "/home": "ProtectHome",
    "/run/user": "ProtectHome",
    "/tmp": "PrivateTmp",
    "/var/tmp": "PrivateTmp",
}
"""Folders that the hardened units do not see, and by which of their settings."""

INSTANCE: Final = re.compile(r"[A-Za-z0-9_.:][A-Za-z0-9_.:-]*")
"""A driver's name that is the same as an instance of a unit, without systemd's escapes."""

_DEVICE_NAME: Final = re.compile(r"[A-Za-z0-9#+.:=@_-]+")
"""What udev puts into names of devices (its white list)."""


@dataclass(frozen=True, slots=True)
class SerialDriver:
    """A driver on a serial port: its name, and the port as the vehicle file gives it."""

    name: str
    port: str


def hidden_by(path: str) -> str:
    """Return which setting of the units hides a path from the service, empty where none does."""
    return next((why for folder, why in HIDDEN.items() if path == folder or path.startswith(f"{folder}/")), "")


def check_seen(paths: Iterable[tuple[str, str]], fix: str, whose: str = "this installation") -> None:
    """Raise ConfigError where the service would not see some of the paths; they are given each with what it is.

    `whose` they are is the place that the error names, `fix` what to do about it.
    """
    unseen = [(path, what, hidden_by(path)) for path, what in paths if hidden_by(path)]
    if unseen:
        which = ", ".join(f"{what} is {path}" for path, what, _ in unseen)
        why = " and ".join(f"{setting}=yes" for setting in dict.fromkeys(setting for *_, setting in unseen))
        _refuse(f"{which}, which the hardened units do not see ({why})", whose, fix)


def check_program(program: str) -> None:
    """Raise ConfigError for the path of a command that cannot stand in a unit."""
    if not re.fullmatch(r"/[A-Za-z0-9/._+@-]+", program):
        fix = "install to a folder without blanks and the like"
        _refuse(f"{program!r} cannot stand in a unit", "this installation", fix)


def check_drivers(wanted: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the drivers that `wanted` names: all, none, or names with commas. Raises ConfigError, with all problems.

    A driver that is called all or none can be named beside others alone.
    """
    known = tuple(known)
    names = tuple(dict.fromkeys(name.strip() for name in wanted.split(",") if name.strip()))
    if names in (("all",), ()):
        names = known
    elif names == ("none",):
        names = ()
    problems = []
    for name in names:
        if name in ("all", "none") and name not in known:
            others = ",".join(each for each in names if each not in ("all", "none"))
            why = f"{name} stands beside other names in {shown(wanted, 80)}, and means "
            why += "every driver" if name == "all" else "no driver at all"
            fix = f"--drivers {name}, or only the names" + (f": --drivers {others}" if others else "")
            problems.append(_problem(why, "--drivers", fix))
        elif name not in known:
            near = nearest_names(name, known)
            offer = f"did you mean {near[0]}?" if near else f"it has: {', '.join(known) or 'none'}"
            problems.append(_problem(f"the vehicle file has no driver {shown(name, 40)}; {offer}", "--drivers"))
        elif not INSTANCE.fullmatch(name):
            why = f"driver {shown(name, 40)} cannot be the name of a unit"
            fix = "rename it in the vehicle file with letters, digits, _ . : and - only"
            problems.append(_problem(why, "--drivers", fix))
    if problems:
        raise ConfigError(problems)
    return names


def _refuse(why: str, whose: str, fix: str = "") -> NoReturn:
    raise ConfigError([_problem(why, whose, fix)])


def _problem(why: str, whose: str, fix: str = "") -> Problem:
    return Problem(Severity.ERROR, why, Location(whose), fix)


def loopback_group(url: str) -> str:
    """Return the multicast group of a bus that stays on this machine, empty for one that leaves it or needs none."""
    parts = urlsplit(url)
    ttl = parse_qs(parts.query).get("ttl", ["0"])[-1]
    if parts.scheme != "udpm" or ttl.strip() not in ("", "0"):
        return ""
    return group_of(url)


LOCAL: Final = "localhost"
NETWORK: Final = ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16")
"""The networks that a vehicle's own is one of (RFC 1918, RFC 3927): a bus with a ttl has its other machines there."""

ANYWHERE: Final = "any"


def bus_addresses(url: str) -> tuple[str, ...]:
    """Return the addresses that a bus at `url` is of, as IPAddressAllow of systemd takes them."""
    parts = urlsplit(url)
    if parts.scheme == "file":
        return (LOCAL,)
    if parts.scheme == "tcpq":
        return (LOCAL, *host_addresses([parts.hostname or LOCAL]))
    if parts.scheme != "udpm" or not group_of(url):
        return (ANYWHERE,)
    return (LOCAL, group_of(url), *(() if loopback_group(url) else NETWORK))


def host_addresses(hosts: Iterable[str]) -> tuple[str, ...]:
    """Return the addresses of hosts, in their order; any for a name, which may be another's tomorrow."""
    found = []
    for host in hosts:
        if host == LOCAL:
            continue
        try:
            found.append(str(ip_address(host)))
        except ValueError:
            found.append(ANYWHERE)
    return tuple(found)


def allowed(addresses: Iterable[str]) -> str:
    """Return addresses as a unit has them: each once, or any alone."""
    found = tuple(dict.fromkeys(addresses))
    return ANYWHERE if ANYWHERE in found else " ".join(found)


def units(
    templates: Mapping[str, str],
    program: str,
    url: str,
    ip: str,
    drivers: bool,
    hosts: Iterable[str] = (),
) -> list[Write]:
    """Return the units with what is this installation's in them.

    `program` is the path of its command, `url` that of the bus; `hosts` are those of the drivers' devices.
    """
    check_program(program)
    group, bus = loopback_group(url), bus_addresses(url)
    places = {
        "@MODELSERVER@": program,
        "@GROUP@": group,
        "@IP@": ip,
        "@ADDRESSES@": allowed(bus),
        "@DEVICES@": allowed((*bus, *host_addresses(hosts))),
    }
    wanted = {SERVICE: "the service"}
    wanted |= {DRIVER: "one driver, by its name"} if drivers else {}
    wanted |= {LOOPBACK: "multicast on the loopback interface"} if group else {}
    writes = []
    for name, what in wanted.items():
        text = templates[name]
        for place, value in places.items():
            text = text.replace(place, value)
        summary = "\n".join(line for line in text.splitlines() if line.startswith("ExecStart="))
        writes.append(Write(f"{UNITS}/{name}", text.encode(), what, summary))
    return writes


def configuration(sources: Mapping[str, bytes], secret: Container[str] = ()) -> list[Write]:
    """Return the vehicle's files. `sources` are by their paths relative to the vehicle file, which is vehicle.yaml.

    Those that are `secret` are for root alone.
    """
    writes = []
    for path, content in sources.items():
        what = "the vehicle file" if path == "vehicle.yaml" else "of the vehicle"
        if path in secret:
            writes.append(Write(f"{CONFIGURATION}/{path}", content, "the key of signed commands", mode=0o600))
        else:
            writes.append(Write(f"{CONFIGURATION}/{path}", content, what))
    return writes


def limits(wanted: int, facts: Facts) -> list[Write]:
    """Return the file that raises the kernel's limit of receive buffers, nothing where it is high enough without."""
    if facts.rmem_max >= wanted and SYSCTL not in facts.files:
        return []
    line = f"net.core.rmem_max = {wanted}"
    text = f"# ModelServer: bursts on the bus fit into the buffer that LCM asks for.\n{line}\n"
    return [Write(SYSCTL, text.encode(), "room for bursts on the bus", line)]


def realtime(facts: Facts) -> list[Write]:
    """Return the drop-in by which the service's loop goes before other programs, nothing where that cannot be.

    With two programs beside it that took all they got on two cores, ticks were up to 20 ms late without, nice or not,
    and 0.1 ms with it.
    """
    if not facts.realtime:
        return []
    lines = "CPUSchedulingPolicy=rr\nCPUSchedulingPriority=1\n"
    text = f"# Written by `modelserver install`, where the machine can do it.\n[Service]\n{lines}"
    return [Write(REALTIME, text.encode(), "the loop goes before other programs", lines)]


def credential(key_file: str) -> list[Write]:
    """Return the drop-in by which systemd hands the file of keys to the service, nothing for a vehicle without one.

    The service's user may not read what is root's alone, and a key is. Raises ModelServerError for a path that cannot
    stand in a unit.
    """
    if not key_file:
        return []
    if not re.fullmatch(r"/[A-Za-z0-9/._+@-]+", key_file):
        raise ModelServerError(f"the key file {shown(key_file)} cannot stand in a unit: blanks and the like; rename it")
    line = f"LoadCredential={key_file.rpartition('/')[2]}:{key_file}"
    about = "# Written by `modelserver install`: the file stays root's, and is read as the service starts."
    text = f"{about}\n[Service]\n{line}\n"
    return [Write(CREDENTIAL, text.encode(), "the key that commands are signed with", line)]


def rules(drivers: Iterable[SerialDriver], given: Mapping[str, str], facts: Facts) -> tuple[list[Write], list[str]]:
    """Return the udev rules that give each driver's device a name of its own, and what to tell of them.

    `given` are names below /dev/serial/by-id by driver, which go before what is found. Raises ModelServerError.
    """
    lines, notes = [], []
    drivers = list(drivers)
    check_serial(given, drivers)
    for driver in drivers:
        own = f"{OWN_NAMES}{driver.name}"
        device = given.get(driver.name, "") or _id_of(driver.port, facts)
        known = _known_rule(driver.name, facts.rules)
        if device:
            lines.append(_rule(driver.name, device.removeprefix(BY_ID)))
        elif known:
            lines.append(known)
        else:
            fix = f"plug it in, or: --serial {driver.name}={BY_ID}..."
            notes.append(f"no device is known by its id for driver {driver.name} (port {driver.port}); {fix}")
            continue
        if driver.port != own and not driver.port.startswith(BY_ID):
            notes.append(f"driver {driver.name}: write port: {own} into the vehicle file; {driver.port} may change")
    if not lines:
        return [], notes
    text = "# ModelServer: the devices of the vehicle file, by their ids.\n" + "".join(f"{line}\n" for line in lines)
    summary = "\n".join(f"{OWN_NAMES}{line.rpartition('/')[2].rstrip(chr(34))}" for line in lines)
    return [Write(RULES, text.encode(), "names for the serial devices", summary)], notes


def check_serial(given: Mapping[str, str], drivers: Iterable[SerialDriver]) -> None:
    """Raise ConfigError for every device of --serial that cannot be. `given` are names by driver."""
    known = [each.name for each in drivers]
    problems = []
    for name, device in given.items():
        if name not in known:
            near = nearest_names(name, known)
            offer = f"did you mean {near[0]}?" if near else f"there are: {', '.join(known) or 'none'}"
            why = f"it names {shown(name, 40)}, which is no driver on a serial port here; {offer}"
            problems.append(_problem(why, "--serial"))
        if not _DEVICE_NAME.fullmatch(device.removeprefix(BY_ID)):
            problems.append(_problem(_odd(device.removeprefix(BY_ID)), "--serial"))
    if problems:
        raise ConfigError(problems)


def _odd(device: str) -> str:
    return f"{shown(device)} is no name below {BY_ID}: letters, digits and #+-.:=@_ only"


def _id_of(port: str, facts: Facts) -> str:
    """Return the name below /dev/serial/by-id of a port, empty where there is none."""
    if port.startswith(BY_ID):
        return port.removeprefix(BY_ID)
    return next((name for name, device in sorted(facts.by_id.items()) if device == port), "")


def _rule(name: str, device: str) -> str:
    if not _DEVICE_NAME.fullmatch(device):
        raise ModelServerError(_odd(device))
    # the link by id was made by systemd's own rules, from vendor, product and serial number
    match = f'SUBSYSTEM=="tty", SYMLINK=="{BY_ID.removeprefix("/dev/")}{device}"'
    # ModemManager would speak to it otherwise, and some devices never recover from that
    return f'{match}, ENV{{ID_MM_DEVICE_IGNORE}}="1", SYMLINK+="modelserver/{name}"'


def _known_rule(name: str, text: str) -> str:
    ending = f'SYMLINK+="modelserver/{name}"'
    return next((line for line in text.splitlines() if line.startswith("SUBSYSTEM") and line.endswith(ending)), "")
