"""LCM messages of this project as JSON objects, and the JSON schemas of their types.

Names are those of the .lcm files. JSON has no nan and no infinity: they become null. Foxglove reads schemas whose
fields have one plain type and whose arrays have one dimension (foxglove/studio, packages/mcap-support/src,
parseJsonSchema.ts), so a matrix is an array, row by row, and a number that may be null is declared as a number. Readers
whose numbers are doubles, as Foxglove's, round integers beyond 2^53.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import cache
from itertools import chain
from math import isfinite
from typing import Any, Final, NamedTuple

import mslcm
from modelserver.errors import WireError

_JSON_TYPES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("int8_t", "int16_t", "int32_t", "int64_t"), "integer"),
    **dict.fromkeys(("float", "double"), "number"),
    "boolean": "boolean",
    "string": "string",
}
"""By LCM's types; `byte` is none: a block of bytes has no fields to show."""


class JsonType(NamedTuple):
    """A wire type as JSON: its schema, and the function that makes an object of a message of lcm-gen's class."""

    schema: Mapping[str, object]
    convert: Callable[[Any], dict[str, object]]


def make_schema(title: str = "", /, **fields: object) -> dict[str, object]:
    """Return the JSON schema of an object; a text is the name of a plain type."""
    properties = {name: {"type": field} if isinstance(field, str) else field for name, field in fields.items()}
    schema: dict[str, object] = {"type": "object", "properties": properties}
    return {"title": title} | schema if title else schema


def make_array_schema(items: object) -> dict[str, object]:
    return {"type": "array", "items": {"type": items} if isinstance(items, str) else items}


@cache
def make_json_type(name: str) -> JsonType | None:
    """Return the wire type `name` as JSON; None where it holds bytes."""
    kind = getattr(mslcm, name)
    schemas: dict[str, object] = {}
    fields: list[tuple[str, Callable[[Any], object]]] = []
    for field, typename, dimensions in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
        schema: object = _JSON_TYPES.get(typename)
        convert: Callable[[Any], object] = convert_number if schema == "number" else _return_unchanged
        if schema is None:
            nested = None if typename == "byte" else make_json_type(typename.removeprefix("mslcm."))
            if nested is None:
                return None
            schema, convert = nested
        if dimensions is not None:
            schema, convert = make_array_schema(schema), _make_array_function(convert, len(dimensions))
        schemas[field] = schema
        fields.append((field, convert))

    def convert_message(message: Any) -> dict[str, object]:
        return {field: convert(getattr(message, field)) for field, convert in fields}

    return JsonType(make_schema(name, **schemas), convert_message)


def decode_to_json(name: str, data: bytes) -> dict[str, object]:
    """Return the object of a message of the wire type `name`, see `make_json_type`. Raises WireError."""
    made = make_json_type(name)
    if made is None:
        raise WireError("malformed", f"{name} holds bytes")
    try:
        message = getattr(mslcm, name).decode(data)
        # lcm-gen checks neither a text that ends early nor bytes behind the message
        if message.encode() != data:
            raise WireError("malformed", f"{len(data)} bytes are no {name} as it is encoded")
        return made.convert(message)
    except WireError:
        raise
    except (ValueError, struct.error, IndexError, OverflowError, MemoryError) as error:
        raise WireError("truncated", f"{len(data)} bytes are no whole {name}: {error}") from None


def convert_number(value: float) -> float | None:
    """Return a number for JSON: None for nan and infinities."""
    return value if isfinite(value) else None


def _return_unchanged(value: object) -> object:
    return value


def _make_array_function(convert: Callable[[Any], object], dimensions: int) -> Callable[[Any], object]:
    def convert_array(values: Any) -> list[object]:
        for _ in range(dimensions - 1):
            values = chain.from_iterable(values)
        if convert is convert_number:
            # in place, since most of what is exported are arrays of numbers
            return [value if isfinite(value) else None for value in values]
        return [convert(value) for value in values]

    return convert_array
