"""What `modelserver doctor` says of state, journal and key: whether the service may use them, and what mends it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from support_samples import VEHICLE, write_vehicle
from support_signing import ALLOWED, write_test_key

from modelserver.config import VehicleConfig, load_config
from modelserver.keys import read_keys
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel
from mstools.deployment import doctor_files
from mstools.deployment.doctor_files import file_findings, kept_findings, key_findings, state_findings


class Usage(NamedTuple):
    total: int
    used: int
    free: int


@pytest.fixture(autouse=True)
def _desk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    monkeypatch.setattr(doctor_files, "CREDENTIAL", str(tmp_path / "60-key.conf"))


@pytest.fixture
def roomy(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """A function that makes disks have so many bytes of room."""
    return lambda free: monkeypatch.setattr(doctor_files.shutil, "disk_usage", lambda path: Usage(10**12, 0, free))


def closed(monkeypatch: pytest.MonkeyPatch, *paths: Path) -> None:
    """Make paths such as this user may not use, and what lies in them; root may else do anything."""
    access = os.access

    def may(path: str | Path, mode: int) -> bool:
        return not any(Path(path) in (each, *each.parents) for each in paths) and access(path, mode)

    monkeypatch.setattr(os, "access", may)


def configured(folder: Path, more: str) -> VehicleConfig:
    return load_config(write_vehicle(folder, VEHICLE + more))


def journal(config: VehicleConfig, given: str = "") -> Diagnosis:
    (found,) = [each for each in kept_findings(config, given) if each.subject == "journal"]
    return found


def key(config: VehicleConfig, unit: bool = False) -> Diagnosis:
    (found,) = key_findings(config, unit)
    return found


# --- state ----------------------------------------------------------------------------------------------------------


def state(directory: Path | None) -> Diagnosis:
    (found,) = state_findings(directory)
    return found


def test_given_a_place_for_the_state_then_it_is_found_out_whether_it_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, roomy: Callable[[int], None]
) -> None:
    assert state(tmp_path / "new" / "deeper").grade is DiagnosisLevel.OK
    assert not (tmp_path / "new").exists()
    assert state(None).grade is DiagnosisLevel.WARNING
    (tmp_path / "file").write_text("")
    assert (state(tmp_path / "file" / "x").grade, state(tmp_path / "file").grade) == (DiagnosisLevel.WARNING,) * 2
    with monkeypatch.context() as patch:
        closed(patch, tmp_path / "mine")
        found = state(tmp_path / "mine")
    assert (found.grade, f"sudo mkdir -p {tmp_path / 'mine'}" in found.command) == (DiagnosisLevel.WARNING, True)
    roomy(10**6)
    assert (state(tmp_path).grade, "1 MB of room" in state(tmp_path).seen) == (DiagnosisLevel.WARNING, True)


def test_given_a_file_system_that_is_read_only_then_that_is_what_is_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class ReadOnly:
        f_flag = os.ST_RDONLY

    closed(monkeypatch, tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda path: ReadOnly)
    found = state(tmp_path)
    assert "read-only" in found.seen
    assert found.command == f'sudo mount -o remount,rw "$(findmnt -no TARGET -T {tmp_path})"'


# --- journal --------------------------------------------------------------------------------------------------------


def test_given_no_journal_then_it_is_said_why(tmp_path: Path) -> None:
    found = journal(configured(tmp_path, ""))
    assert (found.grade, "on a desk; under systemd one is" in found.seen) == (DiagnosisLevel.OK, True)
    found = journal(configured(tmp_path, "journal: {megabytes: 0}\n"))
    assert (found.grade, found.seen) == (DiagnosisLevel.OK, "none is kept (journal.megabytes: 0)")


def test_given_a_journals_directory_then_it_is_found_out_whether_it_can_be_made_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, roomy: Callable[[int], None]
) -> None:
    roomy(10**11)
    box = tmp_path / "black box"
    config = configured(tmp_path, "journal: {directory: black box, megabytes: 100}\n")
    found = journal(config)
    assert (found.grade, found.seen) == (
        DiagnosisLevel.OK,
        f"{box} may be written; 0 of 100 MB are used, 100.0 GB free",
    )
    assert not box.exists()
    with monkeypatch.context() as patch:
        closed(patch, tmp_path)
        found = journal(config)
    assert (found.grade, found.seen) == (DiagnosisLevel.WARNING, f"{box} may not be written by this user")
    assert found.command == f"sudo mkdir -p '{box}' && sudo chown -R {os.geteuid()} '{box}'"
    assert found.why == "nothing is recorded of what happens"
    box.mkdir()
    (box / "lock").write_text("")
    with monkeypatch.context() as patch:
        # what another user's run has left there
        closed(patch, box / "lock")
        assert journal(config).command == found.command
    (box / "lock").unlink()
    box.rmdir()
    box.write_text("in the way")
    found = journal(config)
    assert (found.seen, found.command) == (f"{box} is no folder", f"mv '{box}' '{box}'.aside")
    # the command mends it
    subprocess.run(["sh", "-c", found.command], check=True)
    assert journal(config).grade is DiagnosisLevel.OK


def test_given_less_room_than_the_journal_may_take_then_that_is_told(
    tmp_path: Path, roomy: Callable[[int], None]
) -> None:
    box = tmp_path / "box"
    box.mkdir()
    config = configured(tmp_path, "journal: {directory: box, megabytes: 1000}\n")
    roomy(800_000_000)
    found = journal(config)
    assert (found.grade, found.seen) == (
        DiagnosisLevel.WARNING,
        f"{box} has 800 MB of room left, and may take 1049 MB more",
    )
    assert found.why.endswith("make room, or write megabytes: 572 under journal")
    assert found.command == f"du -xh --max-depth=2 {box} | sort -h | tail"
    # what it has taken already needs no more room
    with (box / "journal-00000000.lcm").open("wb") as file:
        file.truncate(900_000_000)
    assert journal(config).grade is DiagnosisLevel.OK
    roomy(100_000_000)
    (box / "journal-00000000.lcm").unlink()
    assert journal(config).why.endswith("make room")


# --- the installed unit ---------------------------------------------------------------------------------------------


def test_given_the_units_vehicle_file_then_its_own_state_directory_is_looked_at(tmp_path: Path) -> None:
    given = tmp_path / "var"
    given.mkdir()
    text = VEHICLE.replace("state_directory: state\n", "")
    assert text != VEHICLE
    config = load_config(write_vehicle(tmp_path, text))
    found = {each.subject: each for each in kept_findings(config, str(given))}
    assert str(given) in found["state"].seen
    assert f"{given / 'journal-cart'} may be written; 0 of 1024 MB" in found["journal"].seen


def test_given_a_place_where_the_unit_may_not_write_then_it_is_said_though_this_user_may(tmp_path: Path) -> None:
    config = configured(tmp_path, "journal: {directory: box}\n")
    found = {each.subject: each for each in kept_findings(config, str(tmp_path / "var"))}
    assert [each.grade for each in found.values()] == [DiagnosisLevel.WARNING] * 2
    assert found["journal"].seen == f"{tmp_path / 'box'} lies where the unit may not write"
    assert "leave journal.directory out of the vehicle file" in found["journal"].why
    assert "state_directory" in found["state"].why


def test_given_a_user_who_may_not_look_into_the_units_state_then_the_command_is_roots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load_config(write_vehicle(tmp_path, VEHICLE.replace("state_directory: state\n", "")))
    closed(monkeypatch, tmp_path / "var")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    (found,) = kept_findings(config, str(tmp_path / "var"))
    assert (found.grade, found.command) == (
        DiagnosisLevel.NOTE,
        "sudo modelserver doctor -c /etc/modelserver/vehicle.yaml",
    )


def test_given_a_vehicle_file_then_it_is_the_units_where_that_is_installed_and_not_what_runs_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_vehicle(tmp_path, VEHICLE)
    monkeypatch.setattr(doctor_files, "VEHICLE", str(path))
    monkeypatch.setattr(doctor_files, "UNITS", str(tmp_path))
    assert not doctor_files.is_of_unit(path)
    (tmp_path / "modelserver.service").write_text("")
    assert doctor_files.is_of_unit(path)
    assert not doctor_files.is_of_unit(tmp_path / "another.yaml")
    assert {each.subject for each in file_findings(load_config(path), path)} == {"state", "journal"}
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/modelserver")
    assert not doctor_files.is_of_unit(path)


# --- the key --------------------------------------------------------------------------------------------------------


def test_given_no_key_file_then_nothing_is_said(tmp_path: Path) -> None:
    assert list(key_findings(configured(tmp_path, ""))) == []


def test_given_a_key_file_that_is_well_then_it_is_said_and_no_secret_with_it(tmp_path: Path) -> None:
    config = configured(tmp_path, ALLOWED)
    secret = read_keys(write_test_key(tmp_path))[0].secret.hex()
    found = key(config)
    assert (found.grade, "1 key" in found.seen) == (DiagnosisLevel.OK, True)
    assert secret not in str(found)


def test_given_no_file_of_that_name_then_the_command_makes_one(tmp_path: Path) -> None:
    found = key(configured(tmp_path, ALLOWED))
    assert (found.grade, "there is no key file" in found.seen) == (DiagnosisLevel.ERROR, True)
    assert found.command == f"sudo modelserver key new {tmp_path / 'commands.key'}"


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o660])
def test_given_a_key_that_is_open_to_others_then_the_command_closes_it(tmp_path: Path, mode: int) -> None:
    path = write_test_key(tmp_path)
    path.chmod(mode)
    found = key(configured(tmp_path, ALLOWED))
    assert (found.grade, found.command) == (DiagnosisLevel.ERROR, f"sudo chmod 600 {path}")
    assert "is open to others" in found.seen


def test_given_a_key_in_a_folder_that_others_may_write_then_the_command_closes_the_folder(tmp_path: Path) -> None:
    write_test_key(tmp_path)
    config = configured(tmp_path, ALLOWED)
    tmp_path.chmod(0o777)
    found = key(config)
    assert (found.grade, found.command) == (DiagnosisLevel.ERROR, f"sudo chmod o-w {tmp_path}")
    tmp_path.chmod(0o770)
    found = key(config)
    assert (found.grade, found.command) == (DiagnosisLevel.WARNING, f"sudo chmod g-w {tmp_path}")
    tmp_path.chmod(0o700)
    assert key(config).grade is DiagnosisLevel.OK


@pytest.mark.parametrize("content", ["", "name\n", "name zz\n", "a 00\n", "# nothing\n"])
def test_given_a_file_that_holds_no_key_then_another_is_made_beside_it(tmp_path: Path, content: str) -> None:
    path = write_test_key(tmp_path)
    path.write_text(content)
    found = key(configured(tmp_path, ALLOWED))
    assert (found.grade, found.command) == (
        DiagnosisLevel.ERROR,
        f"sudo mv {path} {path}.aside && sudo modelserver key new {path}",
    )


def test_given_a_folder_in_its_place_then_it_is_put_aside(tmp_path: Path) -> None:
    (tmp_path / "commands.key").mkdir()
    assert key(configured(tmp_path, ALLOWED)).command.startswith("sudo mv ")


def test_given_a_key_that_this_user_may_not_read_then_who_runs_the_service_is_to_own_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modelserver.errors import KeyFileError

    path = write_test_key(tmp_path)
    config = configured(tmp_path, ALLOWED)

    def refused(path: str) -> None:
        raise KeyFileError(f"the key file {path!r} cannot be read: Permission denied")

    closed(monkeypatch, path)
    monkeypatch.setattr(doctor_files, "read_keys", refused)
    found = key(config)
    assert (found.grade, found.command) == (DiagnosisLevel.ERROR, f"sudo chown {os.geteuid()} {path}")
    # but for the one whom systemd hands it to
    Path(doctor_files.CREDENTIAL).write_text(f"[Service]\nLoadCredential=commands.key:{path}\n")
    assert (key(config).grade, "handed to the service by systemd" in key(config).seen) == (DiagnosisLevel.OK, True)


def test_given_the_unit_then_its_key_must_be_handed_over(tmp_path: Path) -> None:
    path = write_test_key(tmp_path)
    config = configured(tmp_path, ALLOWED)
    found = key(config, unit=True)
    assert (found.grade, found.command) == (
        DiagnosisLevel.ERROR,
        f"sudo modelserver install  # writes LoadCredential=commands.key:{path}",
    )
    Path(doctor_files.CREDENTIAL).write_text(f"[Service]\nLoadCredential=commands.key:{path}\n")
    assert key(config, unit=True).grade is DiagnosisLevel.OK
