"""`modelserver doctor`: findings as text and JSON, exit codes, and checks of a vehicle file on the machine."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support_samples import GEOMETRY, VEHICLE, write_vehicle
from support_signing import ALLOWED, write_test_key
from support_wire import EXAMPLES

from modelserver.config.vehicle_file import load_config
from modelserver.errors import Problem, Severity
from modelserver.messages import Health
from modelserver.server import diagnostics
from modelserver.server.diagnostics import (
    BusFacts,
    Diagnosis,
    DiagnosisLevel,
    NetworkInterface,
)
from modelserver.version import __version__
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES, UdpAddress
from msdrivers.settings import read_drivers
from mstools.cli import main
from mstools.commands import doctor, status
from mstools.commands.doctor import diagnose_connections, diagnose_vehicle_file

LO = NetworkInterface("lo", loopback=True)
WELL = BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,), True, True, RECEIVE_BUFFER_BYTES, 0)
Run = Callable[..., tuple[int, str, str]]


def make_health(pid: int, host: str = "pc", version: str = __version__) -> Health:
    return replace(EXAMPLES["health_t"][0], pid=pid, host=host, version=version)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return the command, on a machine without problems except those in `facts` and `answers`."""

    def command(
        *arguments: object, facts: BusFacts = WELL, daemons: tuple[Health, ...] = (make_health(1),)
    ) -> tuple[int, str, str]:
        monkeypatch.setattr(diagnostics, "read_bus_facts", lambda url, delivery=None: facts)

        class Listener:
            def __init__(self, bus: object, prefix: str, handlers: dict[str, Callable[[Health], None]]):
                for each in daemons:
                    handlers["MODELSERVER_HEALTH"](each)

            def listen(self, seconds: float, until: Callable[[], bool]) -> bool:
                return until()

        monkeypatch.setattr(status, "DaemonListener", Listener)
        monkeypatch.setattr(diagnostics, "is_clock_synchronized", lambda: True)
        with pytest.raises(SystemExit) as ended:
            main(["doctor", *map(str, arguments)])
        output = capsys.readouterr()
        return int(ended.value.code or 0), output.out, output.err

    return command


def test_given_a_machine_that_is_well_then_that_is_reported_and_exits_0(run: Run) -> None:
    code, out, _ = run()
    assert code == 0
    assert out.splitlines()[-1] == "no problem found"
    assert "modelserver" in out.splitlines()[0]


@pytest.mark.parametrize(
    ("facts", "code", "words"),
    [
        (BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,), True, True, 1000), 1, "1 warning"),
        (BusFacts(DEFAULT_URL, UdpAddress(), None, (LO,)), 3, "$ sudo ip link set lo up multicast on"),
        (BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,), False), 3, "1 error"),
    ],
)
def test_given_something_to_fix_then_command_and_exit_code_report(
    run: Run, facts: BusFacts, code: int, words: str
) -> None:
    found, out, _ = run(facts=facts)
    assert found == code
    assert words in out


@pytest.mark.parametrize(
    ("daemons", "expected", "words", "command"),
    [
        ((), 0, "none publishes health reports", "modelserver run -c vehicle.yaml"),
        ((make_health(1, "a"),), 0, "one answers: process 1 on 'a'", ""),
        ((make_health(1, "a", "9"),), 1, "process 1 on 'a' is version '9'", "sudo systemctl restart modelserver"),
        (
            (make_health(1, "a"), make_health(2, "b")),
            3,
            "2 answer at once: process 1 on 'a', process 2 on 'b'",
            "kill 2",
        ),
        ((make_health(1, "\x1b[31m\n" * 99),), 0, r"one answers: process 1 on '\x1b[31m\n\x1b", ""),
    ],
)
def test_given_daemons_then_there_is_one_of_this_version(
    run: Run, daemons: tuple[Health, ...], expected: int, words: str, command: str
) -> None:
    code, out, _ = run(daemons=daemons)
    assert code == expected
    assert words in out
    assert not command or f"$ {command}" in out
    assert all(line.isprintable() and len(line) < 400 for line in out.splitlines())


@pytest.mark.parametrize("url", ["udpm://nonsense", "udpm://10.0.0.1:7667", "udpm://239.255.76.67", "x://"])
def test_given_a_wrong_url_then_that_is_the_error_and_nothing_is_reported_of_routes(run: Run, url: str) -> None:
    code, out, _ = run("--url", url)
    assert code == 3
    assert f"error    bus       {url}" in out
    assert "route" not in out
    assert "sudo" not in out


def test_given_json_then_scripts_get_every_finding(run: Run) -> None:
    code, out, _ = run("--json", facts=BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,), False))
    data = json.loads(out)
    assert (code, data["exit_code"]) == (3, 3)
    found = next(each for each in data["findings"] if each["subject"] == "own message")
    assert found["level"] == "error"
    assert "iptables" in found["command"]


def test_given_a_vehicle_file_then_it_is_looked_at_too(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("-c", write_vehicle(tmp_path, VEHICLE))
    assert code == 0
    assert "loads, and its geometry" in out
    assert f"{tmp_path / 'state'} may be written" in out


@pytest.mark.parametrize("text", [VEHICLE.replace("vehicle:", "vehicel:"), "[", f"{VEHICLE}x: 1\n"])
def test_given_a_vehicle_file_that_is_wrong_then_it_is_an_error_that_check_explains(
    run: Run, tmp_path: Path, text: str
) -> None:
    path = write_vehicle(tmp_path, text)
    code, out, _ = run("-c", path)
    assert code == 3
    assert f"$ modelserver check {path}" in out
    assert "own message" in out


def test_given_a_geometry_for_the_vehicle_file_then_that_is_reported(run: Run, tmp_path: Path) -> None:
    path = write_vehicle(tmp_path).parent / "geometry.yaml"
    code, out, _ = run("-c", path)
    assert code == 3
    assert f"{path} has 1 error, the first: this is a geometry file, not a vehicle file" in out


def test_given_no_such_vehicle_file_then_that_is_reported(run: Run, tmp_path: Path) -> None:
    code, out, err = run("-c", tmp_path / "vehicel.yaml")
    assert (code, out) == (2, "")
    assert "does not exist" in err
    assert run("-c", tmp_path / "vehicle.yaml" / "x")[0] == 2
    code, _, err = run("-c", tmp_path)
    assert (code, "is a directory" in err) == (2, True)


def test_given_a_key_file_that_others_may_read_then_the_vehicle_file_has_an_error(run: Run, tmp_path: Path) -> None:
    path = write_vehicle(tmp_path, VEHICLE + ALLOWED)
    code, out, _ = run("-c", path)
    assert (code, "there is no key file" in out) == (3, True)
    key = write_test_key(tmp_path)
    assert run("-c", path)[0] == 0
    key.chmod(0o644)
    code, out, _ = run("-c", path)
    assert (code, "is open to others" in out) == (3, True)


def test_given_a_vehicle_file_that_may_not_be_read_then_it_is_a_finding(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_vehicle(tmp_path, VEHICLE)

    def raise_permission_error(file: Path) -> None:
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr("mstools.commands.check.check_vehicle", raise_permission_error)
    code, out, _ = run("-c", path)
    assert code == 3
    assert f"{path} cannot be read: Permission denied" in out
    assert f"$ sudo chmod a+r {path}" in out


def test_given_findings_with_odd_words_then_they_are_escaped() -> None:
    text = doctor.describe([Diagnosis(DiagnosisLevel.ERROR, "x\x1b", "y\n\x1b[2J", "z\x07", "rm\r")])
    assert all(line.isprintable() for line in text.split("\n"))


# --- the vehicle file ---------------------------------------------------------------------------------------


def test_given_a_geometry_that_is_missing_then_the_vehicle_file_is_an_error(run: Run, tmp_path: Path) -> None:
    path = write_vehicle(tmp_path, VEHICLE, GEOMETRY)
    Path(load_config(path).geometry).unlink()
    assert run("-c", path)[0] == 3


@pytest.mark.parametrize(
    ("severities", "level"),
    [
        ([], DiagnosisLevel.OK),
        ([Severity.NOTE], DiagnosisLevel.OK),
        ([Severity.NOTE, Severity.WARNING], DiagnosisLevel.WARNING),
        ([Severity.WARNING, Severity.ERROR, Severity.ERROR], DiagnosisLevel.ERROR),
    ],
)
def test_given_problems_of_a_file_then_the_gravest_counts(severities: list[Severity], level: DiagnosisLevel) -> None:
    found = diagnose_vehicle_file([Problem(each, f"it is {each}") for each in severities], Path("v.yaml"))
    assert found.level is level
    assert bool(found.command) == (level is not DiagnosisLevel.OK)


def lines(sections: dict[str, dict[str, Any]], networks: Sequence[NetworkInterface] = ()) -> list[Diagnosis]:
    drivers, problems = read_drivers(sections)
    assert not problems
    return list(diagnose_connections(drivers.values(), networks))


def test_given_a_serial_port_then_who_may_use_it_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from msdrivers.links import serial_port

    port = tmp_path / "ttyX"
    sections = {"gps": {"device": "nmea", "port": str(port)}}
    (found,) = lines(sections)
    assert (found.level, found.subject, found.command) == (
        DiagnosisLevel.WARNING,
        "driver gps",
        "modelserver driver --list",
    )
    port.write_text("")
    assert lines(sections)[0].level is DiagnosisLevel.OK
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    hint = "it belongs to group dialout: sudo usermod -aG dialout ann, then log in again"
    monkeypatch.setattr(serial_port, "explain_permission", lambda path: hint)
    (found,) = lines(sections)
    assert (found.level, found.why) == (DiagnosisLevel.ERROR, hint)
    assert found.command == f"ls -l {port}"


def test_given_a_port_in_use_then_it_is_worth_knowing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from msdrivers.links import serial_port

    port = tmp_path / "ttyX"
    port.write_text("")
    monkeypatch.setattr(serial_port, "find_access_problem", lambda path: "in use by process 3 (minicom)")
    (found,) = lines({"gps": {"device": "nmea", "port": str(port)}})
    assert (found.level, "minicom" in found.observed) == (DiagnosisLevel.NOTE, True)


def test_given_a_can_network_then_it_must_be_there_and_up() -> None:
    raptor = Path(__file__).resolve().parents[3] / "config" / "raptor" / "vehicle.yaml"
    config = load_config(raptor)
    section = {"wheels": config.drivers["wheels"]}
    grades = [
        lines(section, networks)[0].level
        for networks in ((), (NetworkInterface("can0", up=False),), (NetworkInterface("can0"), LO))
    ]
    assert grades == [DiagnosisLevel.WARNING, DiagnosisLevel.ERROR, DiagnosisLevel.OK]
    assert lines(section, (NetworkInterface("can0", up=False),))[0].command.startswith(
        "sudo ip link set can0 up type can"
    )
    trying = {"wheels": {**config.drivers["wheels"], "can": "239.74.163.2:4000", "interface": "udp_multicast"}}
    assert lines(trying)[0].level is DiagnosisLevel.OK
