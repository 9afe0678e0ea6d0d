"""Encoding by declared types: every bit survives, and differences of another build's types are named."""

from __future__ import annotations

import json
import math
import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Flag, IntEnum, StrEnum
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import pytest

from modelserver.errors import RecordingError
from modelserver.server.encoding.schema import Schema, SchemaError, read_document, write_document
from modelserver.server.encoding.tokens import EncodingError


class Color(IntEnum):
    RED = 1
    GREEN = 2


class Word(StrEnum):
    YES = "yes"


class Marks(Flag):
    A = 1
    B = 2


class Shape(Protocol):
    def area(self) -> float: ...


@dataclass(frozen=True, slots=True)
class Square:
    side: float

    def area(self) -> float:
        return self.side**2


class Circle(NamedTuple):
    radius: float
    center: complex = 0j

    def area(self) -> float:
        return math.pi * self.radius**2


@dataclass(frozen=True, slots=True)
class Halved:
    """A constructor that changes its arguments must not run on decoding."""

    value: float
    twice: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", self.value / 2.0)
        object.__setattr__(self, "twice", self.value * 2.0)


class Plain:
    """Neither slots nor fields: stored by the parameters of its constructor."""

    def __init__(self, first: int, second: tuple[str, ...] = ()):
        self.first, self.second = first, second


class Track:
    __slots__ = ("_times", "name")

    _times: array[int]
    name: str

    def __init__(self, name: str, times: array[int]):
        self.name, self._times = name, times


class Everything(NamedTuple):
    flag: bool = True
    count: int = 0
    number: float = 0.0
    text: str = ""
    data: bytes = b""
    maybe: float | None = None
    mixed: int | str | None = None
    mode: Literal["a", "b"] = "a"
    color: Color = Color.RED
    word: Word | None = None
    marks: Marks = Marks(0)
    vector: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pairs: tuple[tuple[str, float], ...] = ()
    named: Mapping[str, int] = MappingProxyType({})
    own: dict[tuple[str, str], float] = {}  # noqa: RUF012 - a NamedTuple's default
    numbers: list[float] = []  # noqa: RUF012
    shape: Shape | None = None
    either: Square | Circle | None = None
    matrix: npt.NDArray[np.float64] | None = None
    floats: array[float] = array("d")
    kind: type[Square | Circle] | None = None
    halved: Halved | None = None
    plain: Plain | None = None
    track: Track | None = None
    z: complex = 0j


def schema(root: Any = Everything) -> Schema:
    return Schema({"value": root}, {Shape: (Square, Circle)})


SCHEMA = schema()


def back(value: Everything) -> Everything:
    found: Everything = SCHEMA.decode("value", SCHEMA.encode("value", value))
    return found


def bits(value: float) -> int:
    found: int = struct.unpack("<Q", struct.pack("<d", value))[0]
    return found


def of_bits(number: int) -> float:
    found: float = struct.unpack("<d", struct.pack("<Q", number))[0]
    return found


SPECIAL = [
    0.0, -0.0, math.inf, -math.inf, 5e-324, -5e-324, 1.7976931348623157e308, 0.1 + 0.2,
    of_bits(0x7FF8000000000001), of_bits(0xFFF8DEADBEEF0001), of_bits(0x7FF4000000000001),
]  # fmt: skip


@pytest.mark.parametrize("value", SPECIAL, ids=[hex(bits(each)) for each in SPECIAL])
def test_given_any_float_when_read_back_then_every_bit_is_the_same(value: float) -> None:
    found = back(
        Everything(
            number=value,
            maybe=value,
            vector=(value, 1.0, value),
            numbers=[value],
            matrix=np.array([[value]]),
            floats=array("d", [value]),
            z=complex(value, value),
        )
    )
    assert found.matrix is not None
    assert found.maybe is not None
    read = (found.number, found.maybe, *found.vector[::2], *found.numbers, *found.floats, float(found.matrix[0, 0]))
    assert {bits(each) for each in (*read, found.z.real, found.z.imag)} == {bits(value)}


@pytest.mark.parametrize("count", [0, -1, (1 << 63) - 1, -(1 << 63), (1 << 64) - 1, 1 << 64, -(1 << 200), True])
def test_given_any_integer_when_read_back_then_it_is_the_same(count: int) -> None:
    found = back(Everything(count=count, number=count, mixed=7)).count
    assert (found, type(found)) == (count, type(count))


def test_given_every_kind_of_value_when_read_back_then_it_is_the_same() -> None:
    value = Everything(
        text="Ä\0\ud800", data=b"\0\xff", mixed="word", mode="b", color=Color.GREEN, word=Word.YES,
        marks=Marks.A | Marks.B, pairs=(("a", 1.0), ("b", -2.0)), named={"z": 1, "a": 2}, own={("x", "y"): 2.5},
        shape=Circle(1.5, 2j), either=Square(3.0), kind=Circle, track=Track("t", array("q", [1, -2])),
        plain=Plain(4, ("u",)),
    )  # fmt: skip
    found = back(value)
    same = {"matrix", "plain", "track", "floats"}
    assert {k: v for k, v in found._asdict().items() if k not in same} == {
        k: v for k, v in value._asdict().items() if k not in same
    }
    assert list(found.named) == ["z", "a"]
    assert isinstance(found.named, MappingProxyType)
    assert isinstance(found.own, dict)
    assert found.plain is not None
    assert found.track is not None
    assert (found.plain.first, found.plain.second) == (4, ("u",))
    assert (found.track.name, found.track._times) == ("t", array("q", [1, -2]))


@pytest.mark.parametrize("order", ["C", "F"])
def test_given_an_array_when_read_back_then_shape_and_order_are_the_same(order: Literal["C", "F"]) -> None:
    value = np.array(np.arange(6.0).reshape(2, 3), order=order)
    found = back(Everything(matrix=value)).matrix
    assert found is not None
    assert np.array_equal(found, value)
    assert (found.flags.f_contiguous, found.flags.c_contiguous) == (value.flags.f_contiguous, value.flags.c_contiguous)
    found[0, 0] = 9.0
    empty = back(Everything(matrix=np.zeros((0, 3)))).matrix
    assert empty is not None
    assert empty.shape == (0, 3)


def test_given_a_constructor_that_changes_its_values_then_it_is_not_called() -> None:
    value = Halved(3.0)
    assert back(Everything(halved=value)).halved == value


def test_given_shared_values_when_read_back_then_they_are_shared_and_written_once() -> None:
    row = tuple(map(float, range(100)))
    shared, apart = ((row,) * 50, tuple(tuple(map(float, range(100))) for _ in range(50)))
    rows = Schema({"value": tuple[tuple[float, ...], ...]})
    data = rows.encode("value", shared)
    assert len(data) < len(rows.encode("value", apart)) / 40
    assert len({id(each) for each in rows.decode("value", data)}) == 1
    assert rows.decode("value", data) == shared


def test_given_numbers_of_numpy_then_they_are_stored_as_numbers_of_the_same_bits() -> None:
    found = back(Everything(number=np.float64(0.1), flag=np.True_, count=np.int64(3)))  # type: ignore[arg-type]
    assert (found.number, found.flag, found.count) == (0.1, True, 3)
    assert type(found.number) is float


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (Everything(number="x"), "Everything.number is str, declared as float"),  # type: ignore[arg-type]
        (Everything(count=1.5), "Everything.count is float, declared as int"),  # type: ignore[arg-type]
        (Everything(number=(1.0,)), "Everything.number is tuple, declared as float"),  # type: ignore[arg-type]
        (Everything(mode="c"), "Everything.mode is str, declared as str('a', 'b')"),  # type: ignore[arg-type]
        (Everything(color=2), "Everything.color is int, declared as"),  # type: ignore[arg-type]
        (Everything(vector=(1.0, 2.0)), "Everything.vector is 2 values, declared as"),  # type: ignore[arg-type]
        (Everything(vector=[1.0, 2.0, 3.0]), "Everything.vector is list, declared as"),  # type: ignore[arg-type]
        (Everything(shape=Plain(1)), "Everything.shape is Plain, declared as"),  # type: ignore[arg-type]
        (Everything(matrix=np.zeros(2, np.float32)), "Everything.matrix is ndarray(float32), declared as"),  # type: ignore[arg-type]
        (Everything(either=Circle(radius=None)), "Circle.radius is None, declared as float"),  # type: ignore[arg-type]
        (Everything(plain=Plain(lambda: 1)), "Plain.first is function, declared as int"),  # type: ignore[arg-type]
    ],
)
def test_given_a_value_that_is_not_of_its_type_then_the_error_names_the_field(value: Everything, words: str) -> None:
    with pytest.raises(EncodingError, match="declared as") as raised:
        SCHEMA.encode("value", value)
    assert words in str(raised.value)


class _Bare:
    def __init__(self, value):  # type: ignore[no-untyped-def]
        self.value = value


@pytest.mark.parametrize("hint", [Any, object, set[int], Shape, _Bare, tuple[Any, ...], dict[str, Any], Square | float])
def test_given_a_type_that_cannot_be_stored_then_that_is_reported_before_anything_is_written(hint: Any) -> None:
    with pytest.raises(SchemaError):
        Schema({"value": NamedTuple("Holder", [("field", hint)])})


# --- another build's types ------------------------------------------------------------------------------------------


def written_elsewhere(changed: Mapping[str, Any], enums: Mapping[str, Any] = MappingProxyType({})) -> bytes:
    """Return the bytes of a build with other types."""
    description = json.loads(SCHEMA.description)
    description["records"] |= changed
    description["enums"] |= enums
    other = schema()
    object.__setattr__(other, "description", json.dumps({k: v for k, v in description.items() if v is not None}))
    object.__setattr__(other, "fingerprint", bytes(32))
    return write_document(other, "value", Everything())


NAME = f"{__name__}.Circle"


@pytest.mark.parametrize(
    ("changed", "enums", "words"),
    [
        (
            {NAME: [["radius", "int"], ["center", "complex"]]},
            {},
            f"{NAME}.radius: written as int, this build has float",
        ),
        ({NAME: [["center", "complex"]]}, {}, f"{NAME}.radius: the writer had no such field"),
        (
            {NAME: [["radius", "float"], ["center", "complex"], ["color", "int"]]},
            {},
            f"{NAME}.color: this build has no such field",
        ),
        ({NAME: [["center", "complex"], ["radius", "float"]]}, {}, f"{NAME}: its fields are in another order"),
        ({"x.Other": []}, {}, "x.Other: this build has no such type"),
        ({}, {f"{__name__}.Color": {"RED": 1, "GREEN": 3}}, "Color: member GREEN was 3, is 2"),
    ],
)
def test_given_a_build_with_other_types_then_the_error_names_the_field(
    changed: dict[str, Any], enums: dict[str, Any], words: str
) -> None:
    with pytest.raises(RecordingError) as raised:
        read_document(SCHEMA, "value", written_elsewhere(changed, enums))
    assert words in str(raised.value)


def test_given_a_description_that_is_damaged_or_huge_then_that_is_reported() -> None:
    data = write_document(SCHEMA, "value", Everything())
    other = data[:8] + bytes(32) + data[40:]
    for damaged in (other, other[:44] + b"\xff" * (len(other) - 44)):
        with pytest.raises(RecordingError, match="it was written by a build with other types"):
            read_document(SCHEMA, "value", damaged)
    import zlib

    bomb = zlib.compress(b"[" * (64 << 20), 9)
    with pytest.raises(RecordingError, match="their description is damaged"):
        read_document(SCHEMA, "value", data[:8] + bytes(32) + struct.pack(">I", len(bomb)) + bomb)


def test_given_the_same_types_then_the_fingerprint_is_the_same_and_another_where_a_field_is_added() -> None:
    assert schema().fingerprint == SCHEMA.fingerprint
    assert Schema({"value": Circle}).fingerprint != Schema({"value": Square}).fingerprint


# --- hostile bytes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\0", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\0\1", b"\0\0\0\1\x80", b"\0\0\0\5\xdd\xff\xff\xff\xff",
        b"\0\0\0\3\xdc\xff\xff", b"\0\0\0\2\x91\x90", b"\0\0\0\2\x91\x00", b"\0\0\0\2\x91\xff",
    ],
)  # fmt: skip
def test_given_bytes_that_are_no_stream_then_that_is_reported(data: bytes) -> None:
    with pytest.raises(RecordingError):
        SCHEMA.decode("value", data)


def stream(*tokens: object) -> bytes:
    import msgspec

    data = msgspec.msgpack.encode(tokens)
    return struct.pack(">I", len(data)) + data


@pytest.mark.parametrize(
    ("hint", "tokens"),
    [
        (tuple[int, ...], (1 << 62, 1, 2)),
        (tuple[int, ...], (1 << 63, 1, 2)),
        (tuple[int, ...], ((1 << 64) - 1,)),
        (tuple[tuple[int, ...], ...], (2, 0, 1 << 40)),
        (dict[str, int], (1 << 40, "a", 1)),
        (dict[str, int], (2, "a", 1, "a", 2)),
        (npt.NDArray[np.float64], (2, False, 1 << 40, 1 << 40, b"")),
        (npt.NDArray[np.float64], (2, False, 0, 1 << 40, b"")),
        (npt.NDArray[np.float64], (100, *([False] + [1] * 99), b"12345678")),
        (npt.NDArray[np.float64], (1, False, -1, b"")),
        (tuple[int, ...], (-1,)),
        (int, (b"\1" * 100_000,)),
        (Color, (7,)),
        (type[Square], (99,)),
        (bool, (1,)),
        (int, (1.0,)),
        (float, (None,)),
    ],
)
def test_given_counts_and_references_that_lie_then_nothing_is_allocated_for_them(
    hint: Any, tokens: tuple[object, ...]
) -> None:
    with pytest.raises(RecordingError):
        Schema({"value": hint}).decode("value", stream(*tokens))


def test_given_references_that_multiply_then_no_constructor_walks_over_all_of_them() -> None:
    class Holder:
        def __init__(self, rows: tuple[tuple[tuple[int, ...], ...], ...]):
            raise AssertionError("it was given all of it")

    Holder.__init__.__annotations__["rows"] = tuple[tuple[tuple[int, ...], ...], ...]
    inner = (1000, 1000, *range(1000), *[-1] * 999)
    # a thousand rows that are one row of a thousand rows that are one: 10^9 numbers in 4 kB
    bomb = (0, 1000, *inner, *[-1] * 999)
    with pytest.raises(RecordingError, match="of more than"):
        Schema({"value": Holder}).decode("value", stream(*bomb))
