"""The plan of an installation: files of others are not touched, and own files are removed again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.errors import ModelServerError
from mstools.commands.install import (
    CONFIGURATION,
    MANIFEST,
    RULES,
    STATE,
    SYSCTL,
    UNITS,
    VEHICLE,
    KeepFile,
    Manifest,
    Plan,
    RemovePath,
    RunProgram,
    SystemFacts,
    WriteFile,
    digest,
    parent_folders,
    plan_install,
    plan_removal,
)

SERVICE = f"{UNITS}/modelserver.service"
PATHS = (VEHICLE, f"{CONFIGURATION}/maps/geometry.yaml", SERVICE, RULES, SYSCTL)
PROGRAMS = {name: f"/usr/bin/{name}" for name in ("systemctl", "udevadm", "sysctl")}


class Disk:
    """A simulated disk to execute plans on: files by path, and their folders."""

    def __init__(self, files: Mapping[str, bytes] | None = None):
        self.files = dict(files or {})
        self.folders = {folder for path in self.files for folder in parent_folders(path)} | {"/etc"}
        self.ran: list[str] = []

    def facts(self) -> SystemFacts:
        raw = self.files.get(MANIFEST)
        around = {folder for path in (*PATHS, MANIFEST) for folder in parent_folders(path)}
        return SystemFacts(
            files={path: digest(content) for path, content in self.files.items()},
            absent=frozenset(around - self.folders),
            manifest=Manifest() if raw is None else Manifest.decode(raw),
            programs=PROGRAMS,
        )

    def execute(self, plan: Plan) -> None:
        for step in plan.steps:
            if isinstance(step, WriteFile):
                self.files[step.path] = step.content
                self.folders.update(parent_folders(step.path))
            elif isinstance(step, RemovePath):
                held = [path for path in (*self.files, *self.folders) if path.startswith(f"{step.path}/")]
                if step.is_recursive or not held:
                    self.files.pop(step.path, None)
                    self.folders.discard(step.path)
            elif isinstance(step, RunProgram):
                self.ran.append(" ".join(step.arguments))

    def install(self, contents: Mapping[str, bytes], units: tuple[str, ...] = ("modelserver.service",)) -> Plan:
        writes = [WriteFile(path, content, "a file") for path, content in contents.items()]
        plan = plan_install(writes, units, self.facts())
        self.execute(plan)
        return plan

    def remove(self, purge: bool = False) -> Plan:
        plan = plan_removal(self.facts(), purge=purge)
        self.execute(plan)
        return plan


def list_unchanged(plan: Plan) -> list[str]:
    return [step.path for step in plan.steps if isinstance(step, KeepFile)]


def test_given_an_empty_system_then_all_is_written_and_started_in_order() -> None:
    disk = Disk()
    disk.install(dict.fromkeys(PATHS, b"x"))
    assert set(disk.files) == {*PATHS, MANIFEST}
    assert disk.ran == [
        "/usr/bin/udevadm control --reload",
        "/usr/bin/udevadm trigger --subsystem-match=tty --action=change",
        f"/usr/bin/sysctl --quiet --load {SYSCTL}",
        "/usr/bin/systemctl daemon-reload",
        "/usr/bin/systemctl enable modelserver.service",
        "/usr/bin/systemctl restart modelserver.service",
    ]


def test_given_the_same_again_then_nothing_is_written_and_it_is_started_again() -> None:
    disk = Disk()
    disk.install(dict.fromkeys(PATHS, b"x"))
    before = dict(disk.files)
    disk.ran.clear()
    assert set(list_unchanged(disk.install(dict.fromkeys(PATHS, b"x")))) == set(PATHS)
    assert disk.files == before
    assert disk.ran == [
        "/usr/bin/systemctl enable modelserver.service",
        "/usr/bin/systemctl restart modelserver.service",
    ]


def test_given_an_upgrade_then_what_was_not_edited_is_replaced() -> None:
    disk = Disk()
    disk.install({VEHICLE: b"old", SERVICE: b"old"})
    disk.files[VEHICLE] = b"edited"
    plan = disk.install({VEHICLE: b"new", SERVICE: b"new"})
    assert (disk.files[VEHICLE], disk.files[SERVICE], list_unchanged(plan)) == (b"edited", b"new", [VEHICLE])
    assert list_unchanged(disk.remove()) == [VEHICLE]
    assert disk.files == {VEHICLE: b"edited"}


def test_given_a_driver_that_is_not_wanted_any_more_then_its_unit_ends() -> None:
    disk = Disk()
    disk.install({SERVICE: b"x"}, ("modelserver.service", "modelserver-driver@gps.service"))
    disk.ran.clear()
    disk.install({SERVICE: b"x"}, ("modelserver.service",))
    assert "/usr/bin/systemctl disable --now modelserver-driver@gps.service" in disk.ran


def test_given_a_file_that_is_not_wanted_any_more_then_it_goes_unless_it_was_edited() -> None:
    disk = Disk()
    disk.install(dict.fromkeys(PATHS, b"x"))
    disk.files[RULES] = b"edited"
    disk.install({SERVICE: b"x"})
    assert set(disk.files) == {SERVICE, RULES, MANIFEST, *(path for path in PATHS if path.startswith(CONFIGURATION))}
    disk.remove()
    assert disk.files == {RULES: b"edited"}


def test_given_an_interrupted_installation_then_it_can_be_undone() -> None:
    disk = Disk()
    writes = [WriteFile(path, b"x", "a file") for path in PATHS]
    plan = plan_install(writes, ("modelserver.service",), disk.facts())
    disk.execute(replace(plan, steps=plan.steps[:3]))
    assert len(disk.files) == 3
    disk.remove()
    assert (disk.files, disk.folders) == ({}, {"/etc"})


def test_given_a_purge_then_what_was_edited_and_the_state_go_too() -> None:
    disk = Disk()
    disk.install({VEHICLE: b"x"})
    disk.files |= {VEHICLE: b"edited", f"{STATE[1]}/origin.json": b"{}"}
    plan = disk.remove(purge=True)
    assert VEHICLE not in disk.files
    assert [step.path for step in plan.steps if isinstance(step, RemovePath) and step.is_recursive] == list(STATE)


def test_given_another_system_then_nothing_is_started_and_systemctl_works_on_it() -> None:
    facts = SystemFacts(programs=PROGRAMS, is_live=False, root="/mnt/image")
    plan = plan_install([WriteFile(RULES, b"x", "rules")], ("modelserver.service",), facts)
    commands = [" ".join(step.arguments) for step in plan.steps if isinstance(step, RunProgram)]
    assert commands == ["/usr/bin/systemctl --root=/mnt/image enable modelserver.service"]


def test_given_nothing_installed_then_there_is_nothing_to_remove() -> None:
    with pytest.raises(ModelServerError, match="nothing to remove"):
        plan_removal(SystemFacts(), purge=True)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{}",
        b'{"version": 2, "files": {}, "units": [], "folders": []}',
        b"\xff",
        b"[" * 100_000,
    ],
)
def test_given_a_damaged_record_then_it_is_rejected(content: bytes) -> None:
    with pytest.raises(ModelServerError, match="is damaged"):
        Manifest.decode(content)


CONTENTS = st.dictionaries(st.sampled_from(PATHS), st.sampled_from([b"1", b"2", b"3"]))


@given(CONTENTS, st.lists(CONTENTS, min_size=1, max_size=3), CONTENTS, st.booleans())
def test_given_any_course_then_what_is_not_ours_is_as_it_was_and_what_is_ours_is_gone(
    before: dict[str, bytes], installed: list[dict[str, bytes]], edited: dict[str, bytes], purge: bool
) -> None:
    disk = Disk(before)
    folders = set(disk.folders)
    for contents in installed:
        disk.install(contents)
        # what was there is never written over
        assert all(disk.files[path] == content for path, content in before.items())
    wanted = {path for contents in installed for path in contents if path.startswith(CONFIGURATION)} | set(
        installed[-1]
    )
    ours = wanted - set(before)
    manifest = json.loads(disk.files[MANIFEST])
    assert set(manifest["files"]) == ours
    disk.files |= dict.fromkeys(edited, b"edited")
    if not ours:
        return
    disk.remove(purge)
    expected = before | dict.fromkeys(edited, b"edited")
    if purge:
        expected = {path: content for path, content in expected.items() if path not in ours}
    assert disk.files == expected
    if not edited:
        assert disk.folders == folders
