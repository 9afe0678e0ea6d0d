"""`modelserver doctor` on state and journal: whether the service may use them, and the command that fixes it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from support_samples import VEHICLE, write_vehicle

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.server.diagnostics import Diagnosis, DiagnosisLevel
from mstools.commands import doctor as diagnosis
from mstools.commands.doctor import diagnose_directory, diagnose_storage, diagnose_vehicle


class Usage(NamedTuple):
    total: int
    used: int
    free: int


@pytest.fixture(autouse=True)
def _without_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)


@pytest.fixture
def set_free(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Return a function that sets the free bytes of disks."""
    return lambda free: monkeypatch.setattr(diagnosis.shutil, "disk_usage", lambda path: Usage(10**12, 0, free))


def deny_access(monkeypatch: pytest.MonkeyPatch, *paths: Path) -> None:
    """Deny access to paths and their content; root may access anything else."""
    access = os.access

    def may(path: str | Path, mode: int) -> bool:
        return not any(Path(path) in (each, *each.parents) for each in paths) and access(path, mode)

    monkeypatch.setattr(os, "access", may)


def configure(folder: Path, more: str) -> VehicleConfig:
    return load_config(write_vehicle(folder, VEHICLE + more))


def journal(config: VehicleConfig, given: str = "") -> Diagnosis:
    (found,) = [each for each in diagnose_storage(config, given) if each.subject == "journal"]
    return found


# --- state ----------------------------------------------------------------------------------------------------------


def state(directory: Path) -> Diagnosis:
    return diagnose_directory("state", directory, "")


def test_given_a_place_for_the_state_then_it_is_found_out_whether_it_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_free: Callable[[int], None]
) -> None:
    assert state(tmp_path / "new" / "deeper").level is DiagnosisLevel.OK
    assert not (tmp_path / "new").exists()
    with monkeypatch.context() as patch:
        deny_access(patch, tmp_path / "mine", tmp_path)
        found = state(tmp_path / "mine")
    assert (found.level, f"sudo mkdir -p {tmp_path / 'mine'}" in found.command) == (DiagnosisLevel.WARNING, True)
    set_free(10**6)
    assert (state(tmp_path).level, "1 MB free" in state(tmp_path).observed) == (DiagnosisLevel.WARNING, True)


def test_given_no_home_directory_then_the_state_has_no_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "get_state_directory", lambda given: None)
    found = next(iter(diagnose_storage(configure(tmp_path, ""))))
    assert (found.level, found.observed) == (DiagnosisLevel.WARNING, "there is no home directory")


# --- journal --------------------------------------------------------------------------------------------------------


def test_given_no_journal_then_it_is_reported_why(tmp_path: Path) -> None:
    found = journal(configure(tmp_path, ""))
    assert (found.level, "only under systemd" in found.observed) == (DiagnosisLevel.OK, True)
    found = journal(configure(tmp_path, "journal: {megabytes: 0}\n"))
    assert (found.level, found.observed) == (DiagnosisLevel.OK, "no journal is recorded (journal.megabytes: 0)")


def test_given_a_journals_directory_then_it_is_found_out_whether_it_can_be_made_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_free: Callable[[int], None]
) -> None:
    set_free(10**11)
    box = tmp_path / "black box"
    config = configure(tmp_path, "journal: {directory: black box, megabytes: 100}\n")
    found = journal(config)
    assert (found.level, found.observed) == (
        DiagnosisLevel.OK,
        f"{box} may be written, 100.0 GB free",
    )
    assert not box.exists()
    with monkeypatch.context() as patch:
        deny_access(patch, tmp_path)
        found = journal(config)
    assert (found.level, found.observed) == (DiagnosisLevel.WARNING, f"{box} may not be written by this user")
    assert found.command == f"sudo mkdir -p '{box}' && sudo chown -R {os.geteuid()} '{box}'"
    assert found.why == "no journal is recorded"


def test_given_less_room_than_the_journal_may_take_then_that_is_reported(
    tmp_path: Path, set_free: Callable[[int], None]
) -> None:
    box = tmp_path / "box"
    box.mkdir()
    config = configure(tmp_path, "journal: {directory: box, megabytes: 1000}\n")
    set_free(800_000_000)
    found = journal(config)
    assert (found.level, found.observed) == (
        DiagnosisLevel.WARNING,
        f"{box} has 800 MB free, and may take 1049 MB more",
    )
    assert found.command == f"du -xh --max-depth=2 {box} | sort -h | tail"
    # its existing segments need no further space
    with (box / "journal-00000000.lcm").open("wb") as file:
        file.truncate(900_000_000)
    assert journal(config).level is DiagnosisLevel.OK


# --- the installed unit ---------------------------------------------------------------------------------------------


def test_given_the_units_vehicle_file_then_its_own_state_directory_is_looked_at(tmp_path: Path) -> None:
    given = tmp_path / "var"
    given.mkdir()
    text = VEHICLE.replace("state_directory: state\n", "")
    assert text != VEHICLE
    config = load_config(write_vehicle(tmp_path, text))
    found = {each.subject: each for each in diagnose_storage(config, str(given))}
    assert str(given) in found["state"].observed
    assert f"{given / 'journal-cart'} may be written" in found["journal"].observed


def test_given_a_user_who_may_not_look_into_the_units_state_then_the_command_is_roots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_vehicle(tmp_path, VEHICLE.replace("state_directory: state\n", ""))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(diagnosis, "VEHICLE", str(path))
    monkeypatch.setattr(diagnosis, "UNITS", str(tmp_path))
    # the unit's command is root's only where the unit is installed, and not for the unit itself
    (tmp_path / "modelserver.service").write_text("")
    (found,) = diagnose_vehicle(load_config(path), path)
    assert (found.level, found.command) == (DiagnosisLevel.NOTE, f"sudo modelserver doctor -c {path}")
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    assert {each.subject for each in diagnose_vehicle(load_config(path), path)} == {"state", "journal"}
