"""`modelserver doctor` on state, journal and key: whether the service may use them, and the command that fixes it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from support_samples import VEHICLE, write_vehicle
from support_signing import ALLOWED, write_test_key

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.key_files import read_keys
from modelserver.server.diagnostics import Diagnosis, DiagnosisLevel
from mstools.commands import doctor as diagnosis
from mstools.commands.doctor import diagnose_files, diagnose_keys, diagnose_state, diagnose_storage


class Usage(NamedTuple):
    total: int
    used: int
    free: int


@pytest.fixture(autouse=True)
def _without_systemd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    monkeypatch.setattr(diagnosis, "CREDENTIAL", str(tmp_path / "60-key.conf"))


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


def key(config: VehicleConfig, unit: bool = False) -> Diagnosis:
    (found,) = diagnose_keys(config, unit)
    return found


# --- state ----------------------------------------------------------------------------------------------------------


def state(directory: Path | None) -> Diagnosis:
    (found,) = diagnose_state(directory)
    return found


def test_given_a_place_for_the_state_then_it_is_found_out_whether_it_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_free: Callable[[int], None]
) -> None:
    assert state(tmp_path / "new" / "deeper").level is DiagnosisLevel.OK
    assert not (tmp_path / "new").exists()
    assert state(None).level is DiagnosisLevel.WARNING
    (tmp_path / "file").write_text("")
    assert (state(tmp_path / "file" / "x").level, state(tmp_path / "file").level) == (DiagnosisLevel.WARNING,) * 2
    with monkeypatch.context() as patch:
        deny_access(patch, tmp_path / "mine")
        found = state(tmp_path / "mine")
    assert (found.level, f"sudo mkdir -p {tmp_path / 'mine'}" in found.command) == (DiagnosisLevel.WARNING, True)
    set_free(10**6)
    assert (state(tmp_path).level, "1 MB free" in state(tmp_path).observed) == (DiagnosisLevel.WARNING, True)


def test_given_a_file_system_that_is_read_only_then_that_is_what_is_fixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class ReadOnly:
        f_flag = os.ST_RDONLY

    deny_access(monkeypatch, tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda path: ReadOnly)
    found = state(tmp_path)
    assert "read-only" in found.observed
    assert found.command == f'sudo mount -o remount,rw "$(findmnt -no TARGET -T {tmp_path})"'


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
        f"{box} may be written; 0 of 100 MB are used, 100.0 GB free",
    )
    assert not box.exists()
    with monkeypatch.context() as patch:
        deny_access(patch, tmp_path)
        found = journal(config)
    assert (found.level, found.observed) == (DiagnosisLevel.WARNING, f"{box} may not be written by this user")
    assert found.command == f"sudo mkdir -p '{box}' && sudo chown -R {os.geteuid()} '{box}'"
    assert found.why == "no journal is recorded"
    box.mkdir()
    (box / "lock").write_text("")
    with monkeypatch.context() as patch:
        # what another user's run has left there
        deny_access(patch, box / "lock")
        assert journal(config).command == found.command
    (box / "lock").unlink()
    box.rmdir()
    box.write_text("in the way")
    found = journal(config)
    assert (found.observed, found.command) == (f"{box} is not a folder", f"mv '{box}' '{box}'.aside")
    # the command fixes it
    subprocess.run(["sh", "-c", found.command], check=True)
    assert journal(config).level is DiagnosisLevel.OK


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
    assert found.why.endswith("free space, or set journal.megabytes: 572")
    assert found.command == f"du -xh --max-depth=2 {box} | sort -h | tail"
    # its existing segments need no further space
    with (box / "journal-00000000.lcm").open("wb") as file:
        file.truncate(900_000_000)
    assert journal(config).level is DiagnosisLevel.OK
    set_free(100_000_000)
    (box / "journal-00000000.lcm").unlink()
    assert journal(config).why.endswith("free space")


# --- the installed unit ---------------------------------------------------------------------------------------------


def test_given_the_units_vehicle_file_then_its_own_state_directory_is_looked_at(tmp_path: Path) -> None:
    given = tmp_path / "var"
    given.mkdir()
    text = VEHICLE.replace("state_directory: state\n", "")
    assert text != VEHICLE
    config = load_config(write_vehicle(tmp_path, text))
    found = {each.subject: each for each in diagnose_storage(config, str(given))}
    assert str(given) in found["state"].observed
    assert f"{given / 'journal-cart'} may be written; 0 of 1024 MB" in found["journal"].observed


def test_given_a_place_where_the_unit_may_not_write_then_it_is_reported_though_this_user_may(tmp_path: Path) -> None:
    config = configure(tmp_path, "journal: {directory: box}\n")
    found = {each.subject: each for each in diagnose_storage(config, str(tmp_path / "var"))}
    assert [each.level for each in found.values()] == [DiagnosisLevel.WARNING] * 2
    assert found["journal"].observed == f"the unit may not write in {tmp_path / 'box'}"
    assert "leave journal.directory out of the vehicle file" in found["journal"].why
    assert "state_directory" in found["state"].why


def test_given_a_user_who_may_not_look_into_the_units_state_then_the_command_is_roots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load_config(write_vehicle(tmp_path, VEHICLE.replace("state_directory: state\n", "")))
    deny_access(monkeypatch, tmp_path / "var")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    (found,) = diagnose_storage(config, str(tmp_path / "var"))
    assert (found.level, found.command) == (
        DiagnosisLevel.NOTE,
        "sudo modelserver doctor -c /etc/modelserver/vehicle.yaml",
    )


def test_given_a_vehicle_file_then_it_is_the_units_where_that_is_installed_and_not_what_runs_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_vehicle(tmp_path, VEHICLE)
    monkeypatch.setattr(diagnosis, "VEHICLE", str(path))
    monkeypatch.setattr(diagnosis, "UNITS", str(tmp_path))
    assert not diagnosis.is_unit_file(path)
    (tmp_path / "modelserver.service").write_text("")
    assert diagnosis.is_unit_file(path)
    assert not diagnosis.is_unit_file(tmp_path / "another.yaml")
    assert {each.subject for each in diagnose_files(load_config(path), path)} == {"state", "journal"}
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/modelserver")
    assert not diagnosis.is_unit_file(path)


# --- the key --------------------------------------------------------------------------------------------------------


def test_given_no_key_file_then_nothing_is_reported(tmp_path: Path) -> None:
    assert list(diagnose_keys(configure(tmp_path, ""))) == []


def test_given_a_key_file_that_is_well_then_it_is_reported_and_no_secret_with_it(tmp_path: Path) -> None:
    config = configure(tmp_path, ALLOWED)
    secret = read_keys(write_test_key(tmp_path))[0].secret.hex()
    found = key(config)
    assert (found.level, "1 key" in found.observed) == (DiagnosisLevel.OK, True)
    assert secret not in str(found)


def test_given_no_file_of_that_name_then_the_command_makes_one(tmp_path: Path) -> None:
    found = key(configure(tmp_path, ALLOWED))
    assert (found.level, "there is no key file" in found.observed) == (DiagnosisLevel.ERROR, True)
    assert found.command == f"sudo modelserver key new {tmp_path / 'commands.key'}"


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o660])
def test_given_a_key_that_is_open_to_others_then_the_command_closes_it(tmp_path: Path, mode: int) -> None:
    path = write_test_key(tmp_path)
    path.chmod(mode)
    found = key(configure(tmp_path, ALLOWED))
    assert (found.level, found.command) == (DiagnosisLevel.ERROR, f"sudo chmod 600 {path}")
    assert "is open to others" in found.observed


def test_given_a_key_in_a_folder_that_others_may_write_then_the_command_closes_the_folder(tmp_path: Path) -> None:
    write_test_key(tmp_path)
    config = configure(tmp_path, ALLOWED)
    tmp_path.chmod(0o777)
    found = key(config)
    assert (found.level, found.command) == (DiagnosisLevel.ERROR, f"sudo chmod o-w {tmp_path}")
    tmp_path.chmod(0o770)
    found = key(config)
    assert (found.level, found.command) == (DiagnosisLevel.WARNING, f"sudo chmod g-w {tmp_path}")
    tmp_path.chmod(0o700)
    assert key(config).level is DiagnosisLevel.OK


@pytest.mark.parametrize("content", ["", "name\n", "name zz\n", "a 00\n", "# nothing\n"])
def test_given_a_file_that_holds_no_key_then_another_is_made_beside_it(tmp_path: Path, content: str) -> None:
    path = write_test_key(tmp_path)
    path.write_text(content)
    found = key(configure(tmp_path, ALLOWED))
    assert (found.level, found.command) == (
        DiagnosisLevel.ERROR,
        f"sudo mv {path} {path}.aside && sudo modelserver key new {path}",
    )


def test_given_a_folder_in_its_place_then_it_is_put_aside(tmp_path: Path) -> None:
    (tmp_path / "commands.key").mkdir()
    assert key(configure(tmp_path, ALLOWED)).command.startswith("sudo mv ")


def test_given_a_key_that_this_user_may_not_read_then_who_runs_the_service_is_to_own_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modelserver.errors import KeyFileError

    path = write_test_key(tmp_path)
    config = configure(tmp_path, ALLOWED)

    def fail(path: str) -> None:
        raise KeyFileError(f"the key file {path!r} cannot be read: Permission denied")

    deny_access(monkeypatch, path)
    monkeypatch.setattr(diagnosis, "read_keys", fail)
    found = key(config)
    assert (found.level, found.command) == (DiagnosisLevel.ERROR, f"sudo chown {os.geteuid()} {path}")
    # unless systemd passes it to the service
    Path(diagnosis.CREDENTIAL).write_text(f"[Service]\nLoadCredential=commands.key:{path}\n")
    assert (key(config).level, "passed to the service by systemd" in key(config).observed) == (DiagnosisLevel.OK, True)


def test_given_the_unit_then_its_key_must_be_handed_over(tmp_path: Path) -> None:
    path = write_test_key(tmp_path)
    config = configure(tmp_path, ALLOWED)
    found = key(config, unit=True)
    assert (found.level, found.command) == (
        DiagnosisLevel.ERROR,
        f"sudo modelserver install  # writes LoadCredential=commands.key:{path}",
    )
    Path(diagnosis.CREDENTIAL).write_text(f"[Service]\nLoadCredential=commands.key:{path}\n")
    assert key(config, unit=True).level is DiagnosisLevel.OK
