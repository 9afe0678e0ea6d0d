"""LCM messages as JSON, with schemas that Foxglove reads."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

import mslcm
from modelserver.errors import WireError
from modelserver.messages import ImuSample, SensorHeader
from modelserver.wire.codec import encode, get_type_names
from mstools.foxglove.lcm_json import decode_to_json, make_json_type

PLAIN = ("boolean", "integer", "number", "string")


def find_problems(schema: Any, path: str) -> list[str]:
    """Return what Foxglove rejects in a schema: other than one plain type, arrays of arrays (parseJsonSchema.ts)."""
    if schema["type"] == "object":
        return [each for name, field in schema["properties"].items() for each in find_problems(field, f"{path}.{name}")]
    if schema["type"] == "array":
        items = schema["items"]
        return [path] if items["type"] == "array" else find_problems(items, f"{path}[]")
    return [] if schema["type"] in PLAIN else [path]


def find_mismatch(value: Any, schema: Any, path: str) -> list[str]:
    """Return where a value is not of its schema; null is a number."""
    if schema["type"] == "object":
        assert value.keys() == schema["properties"].keys(), path
        return [
            each
            for name, field in schema["properties"].items()
            for each in find_mismatch(value[name], field, f"{path}.{name}")
        ]
    if schema["type"] == "array":
        return [each for item in value for each in find_mismatch(item, schema["items"], f"{path}[]")]
    kinds: dict[str, tuple[type, ...]] = {
        "boolean": (bool,),
        "integer": (int,),
        "number": (float, int, type(None)),
        "string": (str,),
    }
    return [] if isinstance(value, kinds[schema["type"]]) else [path]


def test_given_the_types_then_all_but_those_of_bytes_have_a_schema_that_foxglove_reads() -> None:
    made = {name: make_json_type(name) for name in get_type_names()}
    assert {name for name, each in made.items() if each is None} == {"model_snapshot_t", "signed_t"}
    for name, each in made.items():
        if each is not None:
            assert find_problems(each.schema, name) == []
            assert each.schema["title"] == name
            message = getattr(mslcm, name)()
            assert find_mismatch(decode_to_json(name, message.encode()), each.schema, name) == []


@pytest.mark.parametrize(
    "field", [{"type": ["number", "null"]}, {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}]
)
def test_given_a_schema_that_foxglove_rejects_then_the_check_finds_it(field: Any) -> None:
    assert find_problems({"type": "object", "properties": {"a": field}}, "x") == ["x.a"]


def test_given_numbers_that_json_does_not_have_then_they_are_null() -> None:
    message = mslcm.navigation_state_t()
    message.latitude_deg, message.height, message.longitude_deg = math.nan, -math.inf, 11.5
    found = decode_to_json("navigation_state_t", message.encode())
    assert (found["latitude_deg"], found["height"], found["longitude_deg"]) == (None, None, 11.5)
    json.dumps(found, allow_nan=False)


def test_given_matrices_then_they_are_arrays_row_by_row() -> None:
    message = mslcm.pose_transform_t()
    message.h_transform = [[float(4 * row + column) for column in range(4)] for row in range(4)]
    assert decode_to_json("pose_transform_t", message.encode())["h_transform"] == list(map(float, range(16)))


def test_given_a_damaged_message_then_it_is_rejected_at_each_length() -> None:
    sample = ImuSample(
        SensorHeader(1_750_000_000_000_000, "imu", 3, 0),
        angular_velocity=(0.1, 0.2, 0.3),
        specific_force=(0.0, 0.0, 9.8),
    )
    data = encode(sample)
    header: Any = decode_to_json("imu_t", data)["header"]
    assert (header["source"], header["seq"]) == ("imu", 3)
    for end in range(len(data)):
        with pytest.raises(WireError):
            decode_to_json("imu_t", data[:end])
    for wrong in (data + b"\0", b"another!" + data[8:]):
        with pytest.raises(WireError):
            decode_to_json("imu_t", wrong)
    with pytest.raises(WireError, match="holds bytes"):
        decode_to_json("signed_t", mslcm.signed_t().encode())
