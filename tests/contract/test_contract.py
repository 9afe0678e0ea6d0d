"""The wire contract: generated code, fingerprints and comments belong to the .lcm files."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support_wire import EXAMPLES

import mslcm
from modelserver import errors, messages
from modelserver.geometry import names
from modelserver.messages import Origin, PoseAnswer, Quality
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire import fields
from modelserver.wire.channels import CHANNELS
from modelserver.wire.codec import encode, get_type_names
from mstools.commands.status import find_type_files

ROOT = Path(__file__).resolve().parents[2]
TYPES = ROOT / "lcmtypes"
NAMES = sorted(path.stem for path in TYPES.glob("*.lcm"))
ONE_PACKET = 1472
"""Bytes of UDP payload that one Ethernet frame holds: more is fragmented by IP."""


def script(name: str) -> ModuleType:
    """Import a script of tools/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    return script("generate_types")


@pytest.fixture(scope="module")
def package_folder(generator: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("generated")
    generator.generate(TYPES, folder)
    return folder


def test_given_the_modules_that_are_imported_then_they_are_those_of_the_lcm_files(
    generator: ModuleType, package_folder: Path
) -> None:
    lock = generator.read_lock((TYPES / "contract.lock").read_text(encoding="utf-8"))
    fresh = {f"lcmtypes/mslcm/{path.name}": path.read_text("utf-8") for path in (package_folder / "mslcm").glob("*.py")}
    fresh |= script("message_generator").generate(TYPES, lock)
    assert [path for path, text in fresh.items() if (ROOT / path).read_text("utf-8") != text] == [], "run: make types"


def test_given_lcm_files_when_regenerated_then_contract_lock_is_the_same(
    generator: ModuleType, package_folder: Path
) -> None:
    fingerprints = generator.read_fingerprints(package_folder, NAMES)
    lock = (TYPES / "contract.lock").read_text(encoding="utf-8")
    assert lock == generator.format_lock(fingerprints), "a type changed: run make types, and read contract.lock"
    assert generator.read_lock(lock) == fingerprints


def test_given_the_installed_package_then_its_fingerprints_are_those_of_contract_lock(generator: ModuleType) -> None:
    lock = generator.read_lock((TYPES / "contract.lock").read_text(encoding="utf-8"))
    assert {name: getattr(mslcm, name)._get_packed_fingerprint().hex() for name in NAMES} == lock


def test_given_two_types_then_their_fingerprints_differ(generator: ModuleType) -> None:
    # LCM leaves the type's own name out of the fingerprint: equal fields would make two types one on the bus.
    lock = generator.read_lock((TYPES / "contract.lock").read_text(encoding="utf-8"))
    assert len(set(lock.values())) == len(lock) == len(NAMES)


def test_given_type_files_then_the_tools_find_all_of_them() -> None:
    assert [path.stem for path in find_type_files()] == NAMES


def test_given_the_channels_then_each_carries_a_type_of_the_contract() -> None:
    assert {channel.type_name for channel in CHANNELS} <= set(NAMES)
    assert all(len(channel.name) <= 63 and channel.name.isupper() for channel in CHANNELS)


# --- comments -----------------------------------------------------------------------------------------------


def find_uncommented(text: str) -> list[str]:
    """Return the structs, fields and constants of an .lcm file that have no comment on the line above.

    Above, not beside: lcm-gen gives a comment at the end of a line to the field that comes next.
    """
    missing = []
    above = ""
    for line in map(str.strip, text.splitlines()):
        code, _, beside = line.partition("//")
        if code and (beside or ("{" not in code and "}" not in code and not above.startswith("//"))):
            missing.append(line)
        above = line
    return [line for line in missing if not line.startswith("package")]


@pytest.mark.parametrize("name", NAMES)
def test_given_a_type_then_it_and_each_of_its_fields_have_a_comment(name: str) -> None:
    text = (TYPES / f"{name}.lcm").read_text(encoding="utf-8")
    assert find_uncommented(text) == []
    assert f"struct {name}\n{{" in text


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("package a;\n\n// What.\nstruct b\n{\n    // Meters.\n    double c;\n}\n", []),
        ("package a;\n\nstruct b\n{\n}\n", ["struct b"]),
        ("// What.\nstruct b\n{\n    double c;\n    // Meters.\n    double d;\n}\n", ["double c;"]),
        ("// What.\nstruct b\n{\n    // Meters.\n    double c;\n    double d;\n}\n", ["double d;"]),
        ("// What.\nstruct b\n{\n    // C.\n    double c; // meters\n}\n", ["double c; // meters"]),
        ("// What.\nstruct b\n{\n    // C.\n\n    double c;\n}\n", ["double c;"]),
    ],
)
def test_given_a_field_without_comment_then_the_check_names_it(text: str, missing: list[str]) -> None:
    assert find_uncommented(text) == missing


# --- constants in .lcm and Python----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "wire", "prefix"),
    [
        (errors.Status, mslcm.reply_header_t, ""),
        (messages.Policy, mslcm.time_query_t, ""),
        (messages.Invalid, mslcm.pose_transform_t, ""),
        (messages.Quality, mslcm.pose_transform_t, ""),
        (messages.Unmet, mslcm.get_transformation_reply_t, ""),
        (messages.Direction, mslcm.wheels_t, ""),
        (messages.OrientationReference, mslcm.imu_t, "REFERENCE_"),
        (messages.YawSource, mslcm.imu_t, "YAW_"),
        (messages.FixType, mslcm.gps_t, "FIX_"),
        (messages.Mode, mslcm.localization_mode_t, ""),
        (messages.Phase, mslcm.navigation_state_t, ""),
        (messages.Verdict, mslcm.decision_t, ""),
        (messages.DriverPhase, mslcm.driver_health_t, ""),
        (messages.VehicleMode, mslcm.vehicle_status_t, "MODE_"),
    ],
)
def test_given_an_enumeration_then_the_wire_has_the_same_numbers(kind: Any, wire: Any, prefix: str) -> None:
    def on_wire(name: str) -> str:
        return name if name.startswith(prefix) else prefix + name

    assert {on_wire(each.name): getattr(wire, on_wire(each.name)) for each in kind} == {
        on_wire(each.name): int(each) for each in kind
    }


def test_given_all_enumerations_then_no_constant_of_a_type_is_left_out() -> None:
    known = {
        mslcm.reply_header_t: len(errors.Status),
        mslcm.time_query_t: len(messages.Policy),
        mslcm.pose_transform_t: len(messages.Invalid) + len(messages.Quality),
        mslcm.get_transformation_reply_t: len(messages.Unmet),
        mslcm.wheels_t: len(messages.Direction),
        mslcm.imu_t: len(messages.OrientationReference) + len(messages.YawSource),
        mslcm.gps_t: len(messages.FixType),
        mslcm.localization_mode_t: len(messages.Mode),
        mslcm.navigation_state_t: len(messages.Phase),
        mslcm.decision_t: len(messages.Verdict),
        mslcm.driver_health_t: len(messages.DriverPhase),
        mslcm.vehicle_status_t: len(messages.VehicleMode),
    }
    assert known == {wire: sum(name.isupper() for name in vars(wire)) for wire in known}


# --- sizes --------------------------------------------------------------------------------------------------


def test_given_frame_names_of_63_characters_when_a_pose_is_encoded_then_one_packet_holds_it() -> None:
    name = "B" * 31 + ":" + "F" * 31
    transformation = Transformation(name, name, Pose((1.0, 2.0, 3.0)), np.eye(6), 1, 0, 1, 1, "sha256:" + "0" * 64)
    answer = PoseAnswer(transformation, Origin(5e5, 5e6, 100.0, 18, True, 1), Quality(0), 1.0, 0.1, 10.0)
    # LCM puts 8 bytes and the channel's name before a message.
    overhead = 8 + 63 + 1
    for type_name in ("pose_transform_t", "pose_vector_t"):
        assert len(encode(answer, type_name)) + overhead < ONE_PACKET


def test_given_the_samples_of_further_sources_when_encoded_then_one_packet_holds_each() -> None:
    for type_name in ("absolute_pose_t", "relative_pose_t", "range_t", "measurement_t", "localization_mode_t"):
        assert all(len(encode(value, type_name)) + 72 < ONE_PACKET for value in EXAMPLES[type_name])


def test_given_names_and_frames_as_long_as_geometry_allows_then_the_wire_takes_them() -> None:
    assert names.MAX_LENGTH * 2 + 1 == fields.MAX_FRAME_NAME


def test_given_a_wheel_when_built_then_it_has_the_file_of_each_type() -> None:
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed")
    hook = script("wheel_hook").WheelHook(str(ROOT), {}, None, None, "", "wheel")
    build_data: dict[str, Any] = {"force_include": {}}
    hook.initialize("standard", build_data)
    assert build_data["force_include"] == {
        str(ROOT / "lcmtypes" / f"{name}.lcm"): f"mslcm/lcm/{name}.lcm" for name in NAMES
    }


def test_given_the_codec_then_every_type_of_the_core_is_known() -> None:
    assert set(get_type_names()) <= set(NAMES)
