"""What a file is, by what stands in it."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_samples import GEOMETRY, VEHICLE

from modelserver.files import EXAMINED_BYTES, FileKind, detect_file_kind, find_geometry_path

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("path", sorted((ROOT / "config").rglob("vehicle.yaml")), ids=lambda path: path.parent.name)
def test_given_the_vehicle_files_of_this_project_then_they_are_known(path: Path) -> None:
    assert detect_file_kind(path.read_bytes()) is FileKind.VEHICLE
    assert (path.parent / find_geometry_path(path.read_bytes())).is_file()


@pytest.mark.parametrize("path", sorted((ROOT / "config").rglob("geometry.yaml")), ids=lambda path: path.parent.name)
def test_given_the_geometry_files_of_this_project_then_they_are_known(path: Path) -> None:
    assert detect_file_kind(path.read_bytes()) is FileKind.GEOMETRY


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"", FileKind.EMPTY),
        (b"\xef\xbb\xbf \n\t\n", FileKind.EMPTY),
        (b"# a\n\n   # b", FileKind.COMMENTS),
        (GEOMETRY.encode(), FileKind.GEOMETRY),
        (VEHICLE.encode(), FileKind.VEHICLE),
        (b"vehicle: x\nsensors: {}\n", FileKind.VEHICLE),
        (b"vehicle: x\n", FileKind.OTHER),
        (b"vehicle: x\nbase_frame: A:B\nbodies: {}\n", FileKind.VEHICLE),
        (b"vehicle: x\nbodies: {}\n", FileKind.OTHER),
        (b"modelserver : 'geometry/2'\n", FileKind.GEOMETRY),
        (b"a: 1\n  vehicle: 2\n  base_frame: 3\n", FileKind.OTHER),
        (b"  <a/>", FileKind.XML),
        (b"<!-- x --><robot name='r'>", FileKind.URDF),
        (b"<config><section><parameter name='UpdateRateHz' value='1'/></section></config>", FileKind.MIRO_PROCESS),
        (b"<config><section><parameter name='BodyName' value='A'/></section></config>", FileKind.XML),
        # a geometry with mistyped names is left to its reader, which reports them
        (b"<config><section><parameter name='FrameName'/></section></config>", FileKind.XML),
        (b"<config><section><config_group/><parameter/></section></config>", FileKind.XML),
        (b"\xed\xa1\xda\x01rest", FileKind.LOG),
        (b"PK\3\4\0\0", FileKind.BINARY),
        ("vehicle: x".encode("utf-16"), FileKind.OTHER),
    ],
)
def test_given_a_file_then_its_kind_is_detected_from_its_content(content: bytes, kind: FileKind) -> None:
    assert detect_file_kind(content) is kind


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"geometry: a/b.yaml # c\n", "a/b.yaml"),
        (b"vehicle: x\ngeometry: 'a.xml'\n", "a.xml"),
        (b"geometry:\n", ""),
        (b"# geometry: a\n", ""),
    ],
)
def test_given_a_vehicle_file_then_the_geometry_that_it_names_is_found(content: bytes, name: str) -> None:
    assert find_geometry_path(content) == name


@given(st.binary(max_size=200))
def test_given_any_bytes_then_they_are_of_some_kind(content: bytes) -> None:
    assert detect_file_kind(content) in FileKind
    assert isinstance(find_geometry_path(content), str)


def test_given_a_long_file_of_comments_then_it_is_not_taken_for_nothing() -> None:
    assert detect_file_kind(b"# a\n" * EXAMINED_BYTES + b"x: 1") is FileKind.OTHER
