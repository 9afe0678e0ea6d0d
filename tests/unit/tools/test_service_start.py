"""A start that fails for its files: with a service manager it reports and waits, without one it ends at once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import typer
from support_samples import VEHICLE, write_vehicle

from modelserver.errors import BusError, ConfigError, Location, ModelServerError, Problem, Severity
from modelserver.server.supervision import FAILED_START_S, Notifier
from mstools.cli import main
from mstools.commands import driver
from mstools.commands.driver import format_status, wait_on_error

RAPTOR = Path(__file__).parents[3] / "config" / "raptor"
CONFIG = Path("/none/vehicle.yaml")
PROBLEMS = [
    Problem(Severity.WARNING, "hardly meant", Location("v.yaml", 1)),
    Problem(Severity.ERROR, "sensers is no key", Location("v.yaml", 4), "write sensors"),
    Problem(Severity.ERROR, "no frame"),
]


@pytest.fixture(autouse=True)
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the seconds of each wait; waits end at once."""
    found: list[float] = []
    monkeypatch.setattr(driver.time, "sleep", found.append)
    return found


class Manager:
    """A service manager that records its notifications."""

    def __init__(self, is_active: bool = True):
        self.notifications: list[str] = []
        self.notifier = (
            Notifier(lambda datagram: self.notifications.append(datagram.decode())) if is_active else Notifier(None)
        )

    def fail(self, error: Exception) -> None:
        with wait_on_error(CONFIG, self.notifier):
            raise error


def missing(path: Path) -> OSError:
    return FileNotFoundError(2, "No such file or directory", str(path))


@pytest.mark.parametrize(
    ("error", "code", "status", "printed"),
    [
        (ConfigError(PROBLEMS), 1, "v.yaml:4: sensers is no key (and 1 more)", "fix:     write sensors"),
        (missing(CONFIG), 1, "cannot be read: No such file", f"{CONFIG}: error: the vehicle file cannot be read"),
        (typer.BadParameter("'gsp' is no driver"), 2, "'gsp' is no driver", "'gsp' is no driver"),
        (ModelServerError("it names no drivers"), 1, "it names no drivers", "it names no drivers"),
    ],
)
def test_given_a_manager_then_an_error_is_printed_reported_and_waits(
    capsys: pytest.CaptureFixture[str], waits: list[float], error: Exception, code: int, status: str, printed: str
) -> None:
    manager = Manager()
    with pytest.raises(typer.Exit) as ended:
        manager.fail(error)
    assert ended.value.exit_code == code
    assert printed in capsys.readouterr().err
    (notification,) = manager.notifications
    assert notification.startswith("STATUS=start failed, waiting for the file to be fixed: ")
    assert status in notification
    # otherwise systemd would end it before the wait is over
    assert "\nEXTEND_TIMEOUT_USEC=60000000" in notification
    assert waits == [FAILED_START_S]


@pytest.mark.parametrize("error", [ConfigError(PROBLEMS), missing(CONFIG), typer.BadParameter("x"), BusError("x")])
def test_given_no_manager_then_errors_propagate(waits: list[float], error: Exception) -> None:
    manager = Manager(is_active=False)
    with pytest.raises(type(error)):
        manager.fail(error)
    assert not waits


@pytest.mark.parametrize("error", [missing(Path("/another")), OSError("no file"), ZeroDivisionError()])
def test_given_an_error_that_is_not_of_a_file_then_it_propagates(waits: list[float], error: Exception) -> None:
    manager = Manager()
    with pytest.raises(type(error)):
        manager.fail(error)
    assert (manager.notifications, waits) == ([], [])


def test_given_a_start_that_goes_well_then_nothing_is_reported(waits: list[float]) -> None:
    manager = Manager()
    with wait_on_error(CONFIG, manager.notifier):
        pass
    assert (manager.notifications, waits) == ([], [])


def test_given_problems_without_an_error_then_there_is_a_line_all_the_same() -> None:
    assert "is wrong" in format_status(PROBLEMS[:1])


@pytest.mark.parametrize(
    ("vehicle", "geometry"),
    [
        (VEHICLE.replace("vehicle:", "vehicel:"), ""),
        (VEHICLE, "bodies: ["),
        (VEHICLE, None),
        (f"{VEHICLE}commands: {{reload: true, key_file: k}}\n", ""),
    ],
    ids=["vehicle file", "geometry", "geometry missing", "key"],
)
def test_given_the_service_then_it_waits_where_it_could_not_start_with_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: list[float], vehicle: str, geometry: str | None
) -> None:
    path = write_vehicle(tmp_path, vehicle, *([geometry] if geometry else []))
    if geometry is None:
        (tmp_path / "geometry.yaml").unlink()
    monkeypatch.setenv("NOTIFY_SOCKET", "@no listener")
    with pytest.raises(SystemExit) as ended:
        main(["run", "-c", str(path)])
    assert ended.value.code == 1
    assert waits == [FAILED_START_S]


def test_given_a_driver_whose_dbc_file_is_wrong_then_it_waits_for_that_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: list[float]
) -> None:
    shutil.copytree(RAPTOR, tmp_path / "raptor")
    (tmp_path / "raptor" / "raptor.dbc").write_text("BO_ x\n")
    monkeypatch.setenv("NOTIFY_SOCKET", "@no listener")
    with pytest.raises(SystemExit) as ended:
        main(["driver", "wheels", "-c", str(tmp_path / "raptor" / "vehicle.yaml")])
    assert (ended.value.code, waits) == (1, [FAILED_START_S])


@pytest.mark.parametrize(
    ("drivers", "code"),
    [("", 1), ("drivers: {imu: {device: gx1, port: /dev/x}}\n", 2), ("drivers: {gps: {device: nmae}}\n", 1)],
    ids=["no drivers", "another", "wrong"],
)
def test_given_a_driver_then_it_waits_as_the_service_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: list[float], drivers: str, code: int
) -> None:
    path = write_vehicle(tmp_path, VEHICLE + drivers)
    monkeypatch.setenv("NOTIFY_SOCKET", "@no listener")
    with pytest.raises(SystemExit) as ended:
        main(["driver", "gps", "-c", str(path)])
    assert (ended.value.code, waits) == (code, [FAILED_START_S])
