"""`modelserver install` on a system of their own: a folder."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from modelserver import extras
from modelserver.config import vehicle_file
from modelserver.errors import ConfigError, ModelServerError, Severity
from modelserver.key_files import generate_key, write_key
from mstools.cli import main
from mstools.commands import install
from mstools.commands.check import check_vehicle
from mstools.commands.install import (
    SYSCTL,
    SystemFacts,
    check_drivers,
    check_serial,
    check_visible,
    find_hiding_setting,
    loopback_group,
    render_credential_drop_in,
    render_realtime_drop_in,
    render_sysctl,
    render_udev_rules,
    render_units,
)

RAPTOR = Path(__file__).parents[3] / "config" / "raptor"
OWN_KEY = "commands.key"
NOTE, WARNING = Severity.NOTE, Severity.WARNING
TEMPLATES = install.read_templates()

Output = tuple[int, str, str]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Output]:
    """Return a function that runs a command on a system below a folder, with a valid installation."""
    monkeypatch.setattr(install, "check_installation", lambda: None)
    monkeypatch.setattr(install, "get_command_path", lambda: "/opt/modelserver/bin/modelserver")
    # there may be no systemd here; other tests check its commands
    monkeypatch.setattr(install.shutil, "which", lambda name, path: "/bin/true")
    root = tmp_path / "root"
    (root / "etc").mkdir(parents=True)

    def command(*words: str) -> Output:
        try:
            main([*words, "--root", str(root)])
        except SystemExit as ended:
            code = ended.code
        out, err = capsys.readouterr()
        assert isinstance(code, int)
        return code, out, err

    return command


@pytest.fixture
def vehicle(tmp_path: Path) -> Path:
    folder = tmp_path / "given"
    shutil.copytree(RAPTOR, folder)
    (folder / "vehicle.yaml").rename(folder / "raptor.yaml")
    return folder / "raptor.yaml"


def tree(root: Path) -> dict[str, bytes | None]:
    return {str(path.relative_to(root)): path.read_bytes() if path.is_file() else None for path in root.rglob("*")}


def test_given_a_dry_run_then_all_is_reported_and_nothing_done(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path
) -> None:
    code, out, _ = run("install", "--vehicle", str(vehicle), "--dry-run", "--serial", "gps=usb-X_1-if00")
    assert code == 0
    for words in (
        f"write   {tmp_path}/root/etc/modelserver/vehicle.yaml",
        "ExecStart=/opt/modelserver/bin/modelserver run -c /etc/modelserver/vehicle.yaml",
        "/dev/modelserver/gps",
        "enable modelserver-loopback.service modelserver.service modelserver-driver@gps.service",
        "nothing was done",
    ):
        assert words in out
    assert tree(tmp_path / "root") == {"etc": None}


def test_given_an_installation_then_a_removal_leaves_nothing_of_it(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path
) -> None:
    assert run("install", "--vehicle", str(vehicle), "--drivers", "gps,wheels")[0] == 0
    there = tree(tmp_path / "root")
    assert there["etc/modelserver/vehicle.yaml"] == vehicle.read_bytes()
    assert there["etc/modelserver/raptor.dbc"] == (RAPTOR / "raptor.dbc").read_bytes()
    unit = there["etc/systemd/system/modelserver.service"] or b""
    assert b"ExecStart=/opt/modelserver/bin/modelserver run" in unit
    assert not re.search(rb"@[A-Z]+@", unit)
    assert run("install", "--remove")[0] == 0
    assert tree(tmp_path / "root") == {"etc": None}


@pytest.mark.parametrize(
    ("named", "where"),
    [(OWN_KEY, f"/etc/modelserver/{OWN_KEY}"), ("", "")],
    ids=["beside it", "elsewhere"],
)
def test_given_a_key_then_systemd_hands_it_over_and_nobody_else_may_read_it(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path, named: str, where: str
) -> None:
    named = named or str(tmp_path / "rover.key")
    where = where or named
    secret = write_key_file(vehicle.parent / named)
    with vehicle.open("a") as file:
        file.write(f"commands: {{reload: true, key_file: {named}}}\n")
    code, out, err = run("install", "--vehicle", str(vehicle), "--drivers", "none")
    assert code == 0, err
    assert secret not in out
    root = tmp_path / "root"
    drop_in = (root / "etc/systemd/system/modelserver.service.d/60-key.conf").read_text()
    assert f"LoadCredential={where.rpartition('/')[2]}:{where}\n" in drop_in
    copied = root / "etc/modelserver/commands.key"
    assert copied.exists() == (named == OWN_KEY)
    if copied.exists():
        assert stat.S_IMODE(copied.stat().st_mode) == 0o600
        assert secret in copied.read_text()
    assert run("install", "--remove")[0] == 0
    assert tree(root) == {"etc": None}


def write_key_file(path: Path) -> str:
    key = generate_key()
    write_key(path, key)
    return key.secret.hex()


def test_given_a_key_file_whose_name_a_unit_would_take_for_something_else_then_it_is_rejected() -> None:
    with pytest.raises(ModelServerError, match="cannot be written in a unit"):
        render_credential_drop_in("/etc/my keys/%n")


@pytest.mark.slow
def test_given_an_edited_vehicle_file_then_it_stays_and_counts(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path
) -> None:
    run("install", "--vehicle", str(vehicle))
    installed = tmp_path / "root" / "etc" / "modelserver" / "vehicle.yaml"
    edited = installed.read_text().replace("  gps: # the Sokkia", "  receiver: # the Sokkia")
    installed.write_text(edited)
    code, out, err = run("install", "--vehicle", str(vehicle))
    assert code == 0, err
    assert f"leave   {installed}: edited" in out
    assert "modelserver-driver@receiver.service" in out
    assert installed.read_text() == edited
    # without a file the one that is installed counts
    assert "modelserver-driver@receiver.service" in run("install", "--dry-run")[1]


def test_given_no_vehicle_file_then_it_is_reported_where_examples_are(run: Callable[..., Output]) -> None:
    code, _, err = run("install")
    assert code == 1
    assert "no vehicle file in" in err
    assert "fix:     --vehicle FILE; examples are in" in err


def test_given_a_wrong_vehicle_file_then_nothing_is_installed(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path
) -> None:
    vehicle.write_text(vehicle.read_text().replace("Raptor:CG", "Raptor:GC"))
    code, _, err = run("install", "--vehicle", str(vehicle))
    assert code == 1
    assert "body Raptor has no frame 'GC'" in err
    assert tree(tmp_path / "root") == {"etc": None}


def test_given_a_geometry_outside_the_folder_then_it_is_rejected(run: Callable[..., Output], vehicle: Path) -> None:
    (vehicle.parent / "geometry.yaml").rename(vehicle.parent.parent / "other.yaml")
    vehicle.write_text(vehicle.read_text().replace("geometry: geometry.yaml", "geometry: ../other.yaml"))
    code, _, err = run("install", "--vehicle", str(vehicle))
    assert code == 1
    assert "outside its folder\n    fix:     put it beside the vehicle file" in err


def test_given_a_user_without_rights_then_the_command_with_sudo_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    for command in (["install"], ["install", "--remove", "--purge"]):
        with pytest.raises(SystemExit):
            main(command)
        assert f"needs root: sudo {install.get_command_path()} {' '.join(command)}" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--purge"], ["--remove", "--vehicle", "x.yaml"], ["--remove", "--no-start"]])
def test_given_options_that_exclude_each_other_then_it_is_wrong_usage(
    run: Callable[..., Output], tmp_path: Path, words: list[str]
) -> None:
    assert run("install", *words)[0] == 2
    assert tree(tmp_path / "root") == {"etc": None}


def test_given_a_command_that_fails_then_it_is_reported_which_and_what_it_reported(
    run: Callable[..., Output], vehicle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(install.shutil, "which", lambda name, path: "/bin/false")
    code, _, err = run("install", "--vehicle", str(vehicle))
    assert code == 1
    assert "/bin/false --root=" in err
    assert "failed" in err


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("/root/python/bin/python", "ProtectHome"),
        ("/home/me/venv/bin/python", "ProtectHome"),
        ("/tmp/venv", "PrivateTmp"),
        ("/opt/modelserver", ""),
        ("/homes/me", ""),
        ("/usr/bin/python3", ""),
    ],
)
def test_given_a_path_then_it_is_known_what_hides_it(path: str, why: str) -> None:
    assert find_hiding_setting(path) == why


def test_given_an_installation_that_the_units_do_not_see_then_it_is_rejected_with_the_way_out() -> None:
    with pytest.raises(ModelServerError, match=r"its Python is /root/x, which .*ProtectHome=yes.*/opt/modelserver"):
        check_visible([("/usr/bin/x", "a"), ("/root/x", "its Python")], install.make_install_hint())


def test_given_several_paths_that_the_units_do_not_see_then_one_error_names_all_and_what_works() -> None:
    with pytest.raises(ConfigError) as caught:
        check_visible([("/root/x", "its Python"), ("/tmp/y", "its package")], install.make_install_hint())
    (problem,) = caught.value.problems
    assert problem.message == (
        "its Python is /root/x, its package is /tmp/y, which the hardened units cannot access "
        "(ProtectHome=yes and PrivateTmp=yes)"
    )
    # the first python3 in the PATH may be the same again
    assert "sudo /usr/bin/python3 -m venv --clear /opt/modelserver" in problem.fix


@pytest.mark.parametrize("port", ["/dev/ttyTHS1", "/dev/ttymxc0", "/dev/ttyAMA10", "/dev/ttySC0", "/dev/ttyS0"])
def test_given_a_uart_of_the_board_then_nobody_is_asked_to_plug_it_in(port: str) -> None:
    assert render_udev_rules({"gps": port}, {}, SystemFacts()) == ([], [])
    writes, _ = render_udev_rules({"gps": port}, {"gps": "usb-A"}, SystemFacts())
    assert len(writes) == 1


@pytest.mark.parametrize("page", ["README.md", "docs/deployment.md"])
def test_given_the_documentation_then_it_names_the_same_way_as_the_advice(page: str) -> None:
    text = (Path(__file__).parents[3] / page).read_text(encoding="utf-8")
    way = "sudo /usr/bin/python3 -m venv --clear /opt/modelserver"
    assert way in install.make_install_hint()
    # the README has the Debian package only
    assert way in text or page == "README.md"
    assert "-m venv" not in text.replace(way, "").replace("python3 -m venv .venv", "")


def test_given_an_installation_then_everything_that_is_wrong_with_it_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text("")
    python.parent.chmod(0o700)
    monkeypatch.setattr(install.sys, "executable", str(python))
    monkeypatch.setattr(install.sys, "base_prefix", "/home/me/python")
    monkeypatch.setattr(install, "HIDDEN_FOLDERS", {"/home": "ProtectHome"})
    monkeypatch.setattr(install, "files", lambda name: tmp_path)
    with pytest.raises(ConfigError) as caught:
        install.check_installation()
    output = "\n".join(problem.message for problem in caught.value.problems)
    assert "its Python's library is /home/me/python, which the hardened units cannot access" in output
    assert f"there is no {tmp_path}/bin/modelserver" in output
    assert {problem.file for problem in caught.value.problems} == {"this installation"}


def test_given_several_problems_then_all_are_reported_and_nothing_is_done(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(install, "check_installation", lambda: check_visible([("/root/x", "its Python")], "go"))
    good = vehicle.read_text()
    vehicle.write_text(good.replace("Raptor:CG", "Raptor:GC"))
    words = ("install", "--vehicle", str(vehicle), "--dry-run", "--drivers", "none,gsp,imu")
    code, out, err = run(*words)
    assert (code, out) == (1, "")
    for output in (
        "this installation: error: its Python is /root/x",
        "body Raptor has no frame 'GC'",
    ):
        assert output in err
    # what needs a vehicle file that is well: further ones
    vehicle.write_text(good.replace("geometry: geometry.yaml", "geometry: ../other.yaml"))
    (vehicle.parent / "geometry.yaml").rename(vehicle.parent.parent / "other.yaml")
    code, _, err = run(*words, "--serial", "gsp=x", "--serial", "imu=a b")
    assert code == 1
    for output in (
        "names '../other.yaml', outside its folder",
        "the vehicle file has no driver 'gsp'; did you mean gps?",
        "the vehicle file has no driver 'none'",
        "--serial: error: 'gsp' is not a driver on a serial port; did you mean gps?",
        "--serial: error: 'a b' is not a name below /dev/serial/by-id/",
        "its Python is /root/x",
    ):
        assert output in err
    assert tree(tmp_path / "root") == {"etc": None}


def test_given_a_vehicle_file_that_is_not_there_or_no_yaml_then_the_other_problems_are_reported_too(
    run: Callable[..., Output], vehicle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(install, "check_installation", lambda: check_visible([("/root/x", "its Python")], "go"))
    vehicle.write_text("[")
    for file in (vehicle, vehicle.parent / "none.yaml"):
        code, _, err = run("install", "--vehicle", str(file), "--dry-run")
        assert code == 1
        assert f"{file}" in err
        assert "its Python is /root/x" in err


def test_given_another_root_then_paths_are_reported_within_it(
    run: Callable[..., Output], vehicle: Path, tmp_path: Path
) -> None:
    root = tmp_path / "root"
    code, _, err = run("install", "--remove")
    assert f"nothing to remove: {root}/etc/modelserver/installed.json" in err
    run("install", "--vehicle", str(vehicle))
    code, out, _ = run("install", "--remove", "--dry-run")
    assert code == 0
    assert f"the service's state is still in {root}/var/lib/modelserver" in out
    reported = [line.split()[1].rstrip(":") for line in out.splitlines() if line.startswith(("remove", "leave"))]
    assert reported
    assert all(path.startswith(f"{root}/etc") for path in reported)
    (root / "etc/modelserver/installed.json").write_text("{")
    assert (
        f"{root}/etc/modelserver/installed.json: the record of the installation is damaged"
        in run("install", "--remove")[2]
    )


@pytest.mark.parametrize(
    ("url", "group"),
    [
        ("udpm://239.255.76.67:7667?ttl=0", "239.255.76.67"),
        ("udpm://239.1.2.3:7667", "239.1.2.3"),
        ("udpm://?ttl=0", "239.255.76.67"),
        ("udpm://", "239.255.76.67"),
        ("udpm://239.255.76.67:7667?ttl=1", ""),
        ("udpm://239.255.76.67:7667?recv_buf_size=9&ttl=2", ""),
        ("tcpq://127.0.0.1:7700", ""),
        ("memq://", ""),
        ("udpm://$(reboot):7667", "239.255.76.67"),
    ],
)
def test_given_a_bus_then_it_has_a_group_on_loopback_where_it_stays_on_the_machine(url: str, group: str) -> None:
    assert loopback_group(url) == group


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [("all", ("gps", "imu")), ("none", ()), ("imu", ("imu",)), ("imu, gps,imu", ("imu", "gps")), ("", ("gps", "imu"))],
)
def test_given_names_of_drivers_then_they_are_taken(wanted: str, expected: tuple[str, ...]) -> None:
    assert check_drivers(wanted, ["gps", "imu"]) == expected


@pytest.mark.parametrize(
    ("wanted", "known", "output"),
    [
        ("gsp", ["gps", "imu"], "did you mean gps?"),
        ("x", [], "it has: none"),
        ("all", ["gps/1"], "cannot be a unit name"),
        ("all", ["-gps"], "cannot be a unit name"),
        ("all", ["gps%n"], "cannot be a unit name"),
        ("none,gps", ["gps", "imu"], "has no driver 'none'"),
    ],
)
def test_given_a_driver_that_cannot_be_then_it_is_reported_why(wanted: str, known: list[str], output: str) -> None:
    with pytest.raises(ModelServerError, match=output.replace("?", r"\?")):
        check_drivers(wanted, known)


@pytest.mark.parametrize(
    "program", ["bin/modelserver", "/opt/my programs/modelserver", "/opt/%h/modelserver", "/a\n/b"]
)
def test_given_a_path_that_a_unit_would_take_for_something_else_then_it_is_rejected(
    program: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(install, "get_command_path", lambda: program)
    with pytest.raises(ModelServerError, match="cannot be written in a unit"):
        install.check_installation()


@pytest.mark.parametrize(
    ("url", "hosts", "service", "driver"),
    [
        ("udpm://239.1.2.3:7667?ttl=0", (), "localhost 239.1.2.3", "localhost 239.1.2.3"),
        (
            "udpm://239.1.2.3:7667?ttl=1&recv_buf_size=9",
            ("192.168.1.10", "2001:db8::1", "192.168.1.10", "localhost"),
            "localhost 239.1.2.3 10.0.0.0/8 172.16.0.0/12 192.168.0.0/16 169.254.0.0/16",
            "localhost 239.1.2.3 10.0.0.0/8 172.16.0.0/12 192.168.0.0/16 169.254.0.0/16 192.168.1.10 2001:db8::1",
        ),
        ("udpm://239.1.2.3:7667", ("moxa.local",), "localhost 239.1.2.3", "any"),
        ("tcpq://10.0.0.7:7700", (), "localhost 10.0.0.7", "localhost 10.0.0.7"),
        ("mpudpm://239.1.2.3:7667", (), "any", "any"),
    ],
)
def test_given_a_bus_and_devices_then_the_units_speak_with_those_alone(
    url: str, hosts: tuple[str, ...], service: str, driver: str
) -> None:
    texts = {each.path: each.content.decode() for each in render_units(TEMPLATES, "/x", url, "/sbin/ip", True, hosts)}
    for name, addresses in (("modelserver.service", service), ("modelserver-driver@.service", driver)):
        text = texts[f"/etc/systemd/system/{name}"]
        assert f"\nIPAddressDeny=any\nIPAddressAllow={addresses}\n" in text
        assert not re.search("@[A-Z]+@", text)


@pytest.mark.parametrize("name", sorted(TEMPLATES))
def test_given_a_unit_then_it_is_bounded_and_hardened_as_the_others(name: str) -> None:
    settings = dict(line.split("=", 1) for line in TEMPLATES[name].splitlines() if "=" in line and line[0] != "#")
    for key in ("MemoryMax", "TasksMax", "IPAddressDeny"):
        assert settings[key]
    for key in ("ProtectKernelLogs", "ProtectClock", "ProtectHostname", "PrivateMounts", "RestrictRealtime"):
        assert settings[key] == "yes"
    assert settings["ProcSubset"] == "pid"
    assert settings["SystemCallFilter"] == "~@privileged @resources"


def test_given_a_bus_that_leaves_the_machine_and_no_drivers_then_there_is_the_service_alone() -> None:
    assert [
        each.path
        for each in render_units(
            TEMPLATES, "/opt/x/modelserver", "udpm://239.1.2.3:7667?ttl=1", "/sbin/ip", drivers=False
        )
    ] == ["/etc/systemd/system/modelserver.service"]


BY_ID = {"usb-FTDI_A1-if00-port0": "/dev/ttyUSB0"}


@pytest.mark.parametrize(
    ("port", "given", "facts", "device"),
    [
        ("/dev/serial/by-id/usb-X_1-if00", {}, SystemFacts(), "usb-X_1-if00"),
        ("/dev/ttyUSB0", {}, SystemFacts(by_id=BY_ID), "usb-FTDI_A1-if00-port0"),
        ("/dev/ttyUSB0", {"gps": "/dev/serial/by-id/usb-Y"}, SystemFacts(by_id=BY_ID), "usb-Y"),
        ("/dev/modelserver/gps", {"gps": "usb-Y"}, SystemFacts(), "usb-Y"),
    ],
)
def test_given_a_serial_driver_then_its_device_gets_a_name_by_its_id(
    port: str, given: dict[str, str], facts: SystemFacts, device: str
) -> None:
    (write,), notes = render_udev_rules({"gps": port}, given, facts)
    line = write.content.decode().splitlines()[1]
    assert line == (
        f'SUBSYSTEM=="tty", SYMLINK=="serial/by-id/{device}", ENV{{ID_MM_DEVICE_IGNORE}}="1", '
        'SYMLINK+="modelserver/gps"'
    )
    assert bool(notes) == (port == "/dev/ttyUSB0")
    # unplugged at the next installation it keeps its name
    again, _ = render_udev_rules({"gps": "/dev/ttyUSB0"}, {}, SystemFacts(rules=write.content.decode()))
    assert again == [write]


def test_given_a_device_that_nobody_knows_then_a_note_reports_what_to_do() -> None:
    writes, (note,) = render_udev_rules({"gps": "/dev/ttyUSB0"}, {}, SystemFacts())
    assert writes == []
    assert "--serial gps=/dev/serial/by-id/..." in note


@pytest.mark.parametrize("device", ['x", RUN+="/bin/sh', "a b", "a*", "../x"])
def test_given_a_device_name_that_would_be_more_than_a_name_then_it_is_rejected(device: str) -> None:
    with pytest.raises(ModelServerError, match="is not a name below"):
        render_udev_rules({"gps": f"/dev/serial/by-id/{device}"}, {"gps": device}, SystemFacts())


def test_given_an_id_for_a_driver_that_there_is_not_then_it_is_rejected() -> None:
    with pytest.raises(ModelServerError, match="is not a driver on a serial port"):
        check_serial({"imu": "usb-Y"}, {"gps": "/dev/ttyUSB0"})


def test_given_a_machine_that_can_then_the_loop_goes_before_other_programs() -> None:
    assert render_realtime_drop_in(SystemFacts()) == []
    (write,) = render_realtime_drop_in(SystemFacts(realtime=True))
    assert write.content.decode().splitlines()[1:] == ["[Service]", "CPUSchedulingPolicy=rr", "CPUSchedulingPriority=1"]


@pytest.mark.parametrize(
    ("facts", "count"),
    [
        (SystemFacts(rmem_max=212_992), 1),
        (SystemFacts(), 1),
        (SystemFacts(rmem_max=8_000_000), 0),
        # raised by an earlier installation: it stays ours
        (SystemFacts(rmem_max=4_194_304, files={SYSCTL: "x"}), 1),
    ],
)
def test_given_a_limit_then_it_is_raised_where_it_is_too_low(facts: SystemFacts, count: int) -> None:
    assert len(render_sysctl(4_194_304, facts)) == count


LOCAL, REMOTE = "udpm://239.255.76.67:7667?ttl=0", "udpm://239.255.76.67:7667?ttl=1"


def write_bus(vehicle: Path, url: str, commands: str) -> None:
    text = re.sub(r"(?m)^(lcm|commands):.*\n(?:[ #].*\n)*", "", vehicle.read_text())
    vehicle.write_text(f'{text}\nlcm: {{url: "{url}"}}\n{commands}')


@pytest.mark.slow
@pytest.mark.parametrize(
    ("url", "commands", "is_refused"),
    [
        (LOCAL, "", False),
        (REMOTE, "", True),
        (REMOTE, "commands: {drive: unsigned}\n", False),
        (REMOTE, "commands: {reload: true, key_file: commands.key}\n", False),
    ],
)
def test_given_a_vehicle_that_any_host_can_drive_then_it_is_installed_only_if_that_is_written_down(
    run: Callable[..., Output], vehicle: Path, url: str, commands: str, is_refused: bool
) -> None:
    write_bus(vehicle, url, commands)
    if "key_file" in commands:
        write_key(vehicle.parent / "commands.key", generate_key("own"))
    code, _, err = run("install", "--vehicle", str(vehicle), "--dry-run", "--serial", "gps=usb-X_1-if00")
    assert ("can drive the vehicle through driver raptor: no signature" in err) is is_refused
    assert code == (1 if is_refused else 0), err
    _, problems = check_vehicle(str(vehicle))
    found = [each.severity for each in problems if "can drive the vehicle" in each.message]
    assert found == ([] if url == LOCAL or "key_file" in commands else [NOTE if commands else WARNING])


# --- folders of state and journal -------------------------------------------------------------------------------


def write_state_folders(folder: Path, state: str, journal: str) -> Path:
    """Write a copy of the Raptor's files with these folders; return the vehicle file."""
    shutil.copytree(RAPTOR, folder)
    vehicle = folder / "vehicle.yaml"
    text = vehicle.read_text()
    assert "state_directory" not in text
    assert "journal:" not in text
    added = f"state_directory: {state}\njournal: {{directory: {journal}, megabytes: 256}}\n"
    vehicle.write_text(text + added)
    return vehicle


def test_given_a_vehicle_of_new_then_it_is_installed_as_it_is(run: Callable[..., Output], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["new", str(tmp_path / "rover"), "--yes"])
    assert not ended.value.code
    code, output, errors = run("install", "--vehicle", str(tmp_path / "rover" / "vehicle.yaml"))
    assert (code, errors) == (0, "")
    assert "state_directory" not in output
    assert "journal.directory" not in output


def test_given_the_installed_vehicle_file_then_relative_folders_are_the_units_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert vehicle_file.files.INSTALLED_FOLDER == install.CONFIGURATION
    assert install.STATE[0] == vehicle_file.files.STATE_FOLDER
    vehicle = write_state_folders(tmp_path / "etc", "state", "journal")
    beside = vehicle_file.load_config(vehicle)
    assert (beside.state_directory, beside.journal.directory) == (f"{tmp_path}/etc/state", f"{tmp_path}/etc/journal")
    monkeypatch.setattr(vehicle_file.files, "INSTALLED_FOLDER", str(tmp_path / "etc"))
    monkeypatch.setattr(vehicle_file.files, "STATE_FOLDER", "/var/lib/none")
    installed = vehicle_file.load_config(vehicle)
    assert (installed.state_directory, installed.journal.directory) == ("/var/lib/none/state", "/var/lib/none/journal")
    assert Path(installed.geometry).parent == tmp_path / "etc"
    absolute = vehicle_file.load_config(write_state_folders(tmp_path / "b", "/data/state", "/data/journal"))
    assert (absolute.state_directory, absolute.journal.directory) == ("/data/state", "/data/journal")


@pytest.mark.parametrize("folder", ["/data/x", "~/x", "../x", "/var/lib/modelserver2"])
def test_given_folders_that_the_unit_cannot_write_then_each_is_rejected_and_the_advice_is_a_fix(
    run: Callable[..., Output], tmp_path: Path, folder: str
) -> None:
    vehicle = write_state_folders(tmp_path / "a", f'"{folder}"', f'"{folder}"')
    code, _, errors = run("install", "--vehicle", str(vehicle))
    assert code != 0
    advice = re.findall(r"write (state_directory|journal\.directory): (\w+), a folder below it", errors)
    assert advice == [("state_directory", "state"), ("journal.directory", "journal")]
    fixed = write_state_folders(tmp_path / "b", advice[0][1], advice[1][1])
    code, _, errors = run("install", "--vehicle", str(fixed))
    assert (code, errors) == (0, "")


@pytest.mark.parametrize("folder", ["state", "a/b", "/var/lib/modelserver", "/var/lib/modelserver/a", "./a/../b"])
def test_given_folders_below_the_state_directory_then_they_are_accepted(
    run: Callable[..., Output], tmp_path: Path, folder: str
) -> None:
    code, _, errors = run("install", "--vehicle", str(write_state_folders(tmp_path / "a", folder, folder)))
    assert (code, errors) == (0, "")


# --- from a clone -----------------------------------------------------------------------------------------------


def explain_missing_system() -> str:
    """Return why the advice cannot be followed here without changing this machine, empty where it can."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        return "needs root and unshare"
    if not Path("/usr/bin/python3").exists() or find_spec("hatchling") is None:
        return "needs /usr/bin/python3 and hatchling"
    version = subprocess.run(
        ["/usr/bin/python3", "-c", "import sys, ensurepip; print(*sys.version_info[:2])"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout
    return (
        "" if version.split() == [str(each) for each in sys.version_info[:2]] else "/usr/bin/python3 is another version"
    )


@pytest.mark.slow
@pytest.mark.skipif(bool(explain_missing_system()), reason=explain_missing_system())
def test_given_a_clone_that_the_units_cannot_access_then_the_advice_in_one_command_installs_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The advice is run as it is, in a mount namespace with an /opt of its own; dependencies are those of the tests."""
    source = Path(__file__).parents[3]
    clone = {"url": source.as_uri(), "dir_info": {"editable": True}}
    monkeypatch.setattr(extras, "read_installation", lambda: ("pip", clone))
    monkeypatch.setattr(install, "HIDDEN_FOLDERS", {os.path.dirname(sys.executable): "ProtectHome"})
    with pytest.raises(ConfigError) as caught:
        install.check_installation()
    fixes = {problem.fix for problem in caught.value.problems}
    (command,) = (fix.partition("install the units from there: ")[2] for fix in fixes if "/opt" in fix)
    root, sudo = tmp_path / "root", tmp_path / "bin" / "sudo"
    sudo.parent.mkdir()
    sudo.write_text('#!/bin/sh\nexec "$@"\n')
    sudo.chmod(0o755)
    root.mkdir()
    assert command.endswith(" install --vehicle FILE")
    command = command.replace("FILE", f"{RAPTOR}/vehicle.yaml --root {root}")
    packages = str(Path(pytest.__file__).parents[1])
    environment = {
        "PATH": f"{sudo.parent}:/usr/sbin:/usr/bin:/sbin:/bin",
        "PYTHONPATH": packages,
        "HOME": str(tmp_path),
    }
    environment |= {"PIP_NO_DEPS": "1", "PIP_NO_BUILD_ISOLATION": "0", "PIP_NO_INDEX": "1", "PIP_QUIET": "1"}
    script = f"mount -t tmpfs tmpfs /opt && {command}"
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-ec", script],
        capture_output=True,
        text=True,
        timeout=120,
        env=environment,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done
    unit = (root / "etc/systemd/system/modelserver.service").read_text()
    assert "\nExecStart=/opt/modelserver/bin/modelserver run " in unit
    assert not Path("/opt/modelserver").exists()
