"""Contents of the files of an installation: systemd units, drop-ins, udev rules, limits. Pure."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final
from urllib.parse import parse_qs, urlsplit

from modelserver.errors import ModelServerError, find_nearest_names, quote
from modelserver.wire.provider import group_of
from mstools.deployment import plan as planning
from mstools.terminal.problems import ProblemCollector, make_error

BY_ID: Final = "/dev/serial/by-id/"
DEVICE_FOLDER: Final = "/dev/modelserver/"
REALTIME: Final = f"{planning.UNITS}/{planning.SERVICE}.d/50-realtime.conf"

CREDENTIAL: Final = f"{planning.UNITS}/{planning.SERVICE}.d/60-key.conf"

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


@dataclass(frozen=True, slots=True)
class SerialDriver:
    """A driver on a serial port: its name, and the port of the vehicle file."""

    name: str
    port: str


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


def check_program(program: str) -> None:
    """Raise ConfigError for a command path that cannot be written in a unit."""
    if not _UNIT_PATH.fullmatch(program):
        fix = "install to a folder whose path has only letters, digits and ._+@-"
        raise make_error(f"{program!r} cannot be written in a unit", "this installation", fix)


def check_drivers(wanted: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the drivers that `wanted` selects: all, none, or names with commas. Raises ConfigError with all problems.

    A driver named `all` or `none` can only be selected together with others.
    """
    known = tuple(known)
    names = tuple(dict.fromkeys(name.strip() for name in wanted.split(",") if name.strip()))
    if names in (("all",), ()):
        names = known
    elif names == ("none",):
        names = ()
    gathered = ProblemCollector()
    for name in names:
        if name in ("all", "none") and name not in known:
            others = ",".join(each for each in names if each not in ("all", "none"))
            why = f"{name} is combined with other names in {quote(wanted, 80)}, and means "
            why += "every driver" if name == "all" else "no driver at all"
            fix = f"--drivers {name}, or only the names" + (f": --drivers {others}" if others else "")
            gathered.add("--drivers", why, fix)
        elif name not in known:
            near = find_nearest_names(name, known)
            offer = f"did you mean {near[0]}?" if near else f"it has: {', '.join(known) or 'none'}"
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
) -> list[planning.WriteFile]:
    """Return the units of this installation.

    `program` is the path of its command, `url` that of the bus; `hosts` are those of the drivers' devices.
    """
    check_program(program)
    group, bus = loopback_group(url), bus_addresses(url)
    places = {"MODELSERVER": program, "GROUP": group, "IP": ip, "ADDRESSES": _join_addresses(bus)}
    places["DEVICES"] = _join_addresses((*bus, *host_addresses(hosts)))
    wanted = {planning.SERVICE: "the service"}
    wanted |= {planning.DRIVER: "one driver, by its name"} if drivers else {}
    wanted |= {planning.LOOPBACK: "multicast on the loopback interface"} if group else {}
    writes = []
    for name, what in wanted.items():
        text = re.sub("@([A-Z]+)@", lambda place: places[place[1]], templates[name])
        summary = "\n".join(line for line in text.splitlines() if line.startswith("ExecStart="))
        writes.append(planning.WriteFile(f"{planning.UNITS}/{name}", text.encode(), what, summary))
    return writes


def list_configuration(sources: Mapping[str, bytes], secret: Container[str] = ()) -> list[planning.WriteFile]:
    """Return the vehicle's files. `sources` are by their paths relative to the vehicle file, which is vehicle.yaml.

    Those in `secret` are readable by root only.
    """
    writes = []
    for path, content in sources.items():
        what, mode = "the vehicle file" if path == "vehicle.yaml" else "of the vehicle", 0o644
        if path in secret:
            what, mode = "the key of signed commands", 0o600
        writes.append(planning.WriteFile(f"{planning.CONFIGURATION}/{path}", content, what, mode=mode))
    return writes


def render_sysctl(wanted: int, facts: planning.SystemFacts) -> list[planning.WriteFile]:
    """Return the file that raises the kernel's limit of receive buffers, nothing where it is high enough."""
    if facts.rmem_max >= wanted and planning.SYSCTL not in facts.files:
        return []
    line = f"net.core.rmem_max = {wanted}"
    text = f"# ModelServer: receive buffers for bursts on the bus.\n{line}\n"
    return [planning.WriteFile(planning.SYSCTL, text.encode(), "receive buffers for bursts on the bus", line)]


def render_realtime_drop_in(facts: planning.SystemFacts) -> list[planning.WriteFile]:
    """Return the drop-in for real-time scheduling of the service's loop, nothing where that is not possible.

    With two busy programs on two cores, ticks were up to 20 ms late without it, whatever the nice level, and 0.1 ms
    with it.
    """
    if not facts.realtime:
        return []
    lines = "CPUSchedulingPolicy=rr\nCPUSchedulingPriority=1\n"
    text = f"# Written by `modelserver install` where the machine supports it.\n[Service]\n{lines}"
    return [planning.WriteFile(REALTIME, text.encode(), "real-time scheduling of the loop", lines)]


def render_credential_drop_in(key_file: str) -> list[planning.WriteFile]:
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
    return [planning.WriteFile(CREDENTIAL, text.encode(), "the key of signed commands", line)]


def render_udev_rules(
    drivers: Iterable[SerialDriver], given: Mapping[str, str], facts: planning.SystemFacts
) -> tuple[list[planning.WriteFile], list[str]]:
    """Return the udev rules that give each driver's device a name of its own, and notes on them.

    `given` are names below /dev/serial/by-id by driver, which take precedence over the found ones. Raises
    ModelServerError.
    """
    lines, notes = [], []
    drivers = list(drivers)
    check_serial(given, drivers)
    for driver in drivers:
        own = f"{DEVICE_FOLDER}{driver.name}"
        device = given.get(driver.name, "") or (driver.port if driver.port.startswith(BY_ID) else "")
        device = device or next((name for name, port in sorted(facts.by_id.items()) if port == driver.port), "")
        link = f'SYMLINK+="modelserver/{driver.name}"'
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
        else:
            fix = f"plug it in, or: --serial {driver.name}={BY_ID}..."
            notes.append(f"no device id is known for driver {driver.name} (port {driver.port}); {fix}")
            continue
        if driver.port != own and not driver.port.startswith(BY_ID):
            notes.append(f"driver {driver.name}: set port: {own} in the vehicle file; {driver.port} may change")
    if not lines:
        return [], notes
    text = "# ModelServer: the devices of the vehicle file, by their ids.\n" + "".join(f"{line}\n" for line in lines)
    summary = "\n".join(f"{DEVICE_FOLDER}{line.rpartition('/')[2].rstrip(chr(34))}" for line in lines)
    return [planning.WriteFile(planning.RULES, text.encode(), "names for the serial devices", summary)], notes


def check_serial(given: Mapping[str, str], drivers: Iterable[SerialDriver]) -> None:
    """Raise ConfigError for invalid devices of --serial. `given` are names by driver."""
    known = [each.name for each in drivers]
    gathered = ProblemCollector()
    for name, device in given.items():
        if name not in known:
            near = find_nearest_names(name, known)
            offer = f"did you mean {near[0]}?" if near else f"there are: {', '.join(known) or 'none'}"
            gathered.add("--serial", f"{quote(name, 40)} is not a driver on a serial port; {offer}")
        with gathered.collect("--serial"):
            _check_device(device.removeprefix(BY_ID))
    gathered.raise_any()


def _check_device(device: str) -> None:
    if not _DEVICE_NAME.fullmatch(device):
        raise ModelServerError(f"{quote(device)} is not a name below {BY_ID}: only letters, digits and #+-.:=@_")
