"""Encoding of values: every bit survives, and differences of another build's types are named."""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Flag, IntEnum, StrEnum
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import pytest

from modelserver.errors import RecordingError
from modelserver.server.journal import encoding
from modelserver.server.journal.encoding import EncodingError, decode_value, encode_value


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


@pytest.fixture(autouse=True)
def own_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the classes of this file be stored, as those of an installed measurement."""
    monkeypatch.setattr(encoding, "_list_installed", lambda: frozenset({__name__.partition(".")[0]}))


def back(value: Everything) -> Everything:
    found: Everything = decode_value(encode_value(value))
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
        marks=Marks.A | Marks.B, pairs=(("a", 1.0), ("b", -2.0)), named=MappingProxyType({"z": 1, "a": 2}),
        own={("x", "y"): 2.5},
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
    data = encode_value(shared)
    assert len(data) < len(encode_value(apart)) / 40
    assert len({id(each) for each in decode_value(data)}) == 1
    assert decode_value(data) == shared


def test_given_numbers_of_numpy_then_they_are_stored_as_numbers_of_the_same_bits() -> None:
    found = back(Everything(number=np.float64(0.1), flag=np.True_, count=np.int64(3)))  # type: ignore[arg-type]
    assert (found.number, found.flag, found.count) == (0.1, True, 3)
    assert type(found.number) is float


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (Everything(plain=Plain(lambda: 1)), "Plain.first is of builtins.function, which cannot be stored"),  # type: ignore[arg-type]
        (Everything(count=object()), "Everything.count is of builtins.object, which"),  # type: ignore[arg-type]
        (Everything(named={"a": {1}}), "Everything.named is of builtins.set, which"),  # type: ignore[dict-item]
        (Everything(matrix=np.zeros(2, np.float32)), "Everything.matrix is of numpy.ndarray, which"),  # type: ignore[arg-type]
        (Everything(either=Circle(radius=struct)), "Circle.radius is of builtins.module, which"),  # type: ignore[arg-type]
        (struct.Struct("b"), "the value is of _struct.Struct, which"),
    ],
)
def test_given_a_value_that_cannot_be_stored_then_the_error_names_the_field(value: object, words: str) -> None:
    with pytest.raises(EncodingError, match="cannot be stored") as raised:
        encode_value(value)
    assert words in str(raised.value)


# --- another build's types ------------------------------------------------------------------------------------------


NAME = f"{__name__}:Circle"
FIELDS = "radius: float\ncenter: complex"


def test_given_a_class_then_its_definition_names_its_fields_with_their_types() -> None:
    assert encoding._get_layout(Circle).text == FIELDS
    assert encoding._get_layout(Plain).text == "first: int\nsecond: tuple[str, ...]"
    assert encoding._get_layout(Track).text == "_times: array[int]\nname: str"
    assert encoding._get_layout(Color).text == "GREEN: 2\nRED: 1"


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (NAME, FIELDS.replace("float", "int"), "Circle.radius: written as int, this build has float"),
        (NAME, "center: complex", "Circle.radius: the writer had no such field"),
        (NAME, FIELDS + "\ncolor: int", "Circle.color: this build has no such field"),
        (NAME, "center: complex\nradius: float", "Circle: its fields are in another order"),
        (f"{__name__}:Other", "", "Other: this build has no such type"),
        ("modelserver.core.none:Other", "", "Other: this build has no such type"),
        (f"{__name__}:Color", "GREEN: 3\nRED: 1", "Color.GREEN: written as 3, this build has 2"),
        (NAME, 7, "Circle: its fields are others"),
    ],
)
def test_given_a_build_with_other_types_then_the_error_names_the_field(name: str, text: object, words: str) -> None:
    with pytest.raises(RecordingError, match="it was written by a build with other types") as raised:
        decode_value(stream(DEFINE, name, text, RECORD, 1.0, 2.0))
    assert words in str(raised.value)


@pytest.mark.parametrize("is_described", [True, False])
def test_given_the_same_types_then_the_value_is_read(is_described: bool) -> None:
    assert decode_value(encode_value(Circle(2.0), is_described=is_described)) == Circle(2.0)


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
        decode_value(data)


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "subprocess:Popen",
        "builtins:int",
        "modelserver.server.persistence:FileLock",
        "",
        ":",
        "modelserver:x",
    ],
)
def test_given_a_name_that_is_no_class_of_a_state_then_it_is_rejected(name: str) -> None:
    with pytest.raises(RecordingError, match="is no class of a state"):
        decode_value(stream(DEFINE, name, "", RECORD))


def stream(*tokens: object) -> bytes:
    import msgspec

    data = msgspec.msgpack.encode(tokens)
    return struct.pack(">I", len(data)) + data


INT, _, TUPLE, _, DICT, _, COMPLEX, ARRAY, NDARRAY, ENUM, CLASS, DEFINE = range(12)
RECORD = 16
COLOR = (DEFINE, f"{__name__}:Color", "GREEN: 2\nRED: 1")


@pytest.mark.parametrize(
    "tokens",
    [
        (TUPLE, 1 << 62, 1.0, 2.0),
        (TUPLE, (1 << 64) - 1),
        (TUPLE, 2, TUPLE, 0, TUPLE, 1 << 40),
        (TUPLE, -1),
        (TUPLE, None),
        (DICT, 1 << 40, "a", 1.0),
        (DICT, 2, "a", 1.0, "a", 2.0),
        (DICT, 1, DICT, 0, None),
        (NDARRAY, "float64", "C", 2, 1 << 40, 1 << 40, b""),
        (NDARRAY, "float64", "C", 2, 0, 1 << 40, b""),
        (NDARRAY, "float64", "C", 100, *([1] * 100), b"12345678"),
        (NDARRAY, "float64", "C", 1, -1, b""),
        (NDARRAY, "object", "C", 1, 1, b"12345678"),
        (ARRAY, "q", b"123"),
        (ARRAY, "u", 7),
        (COMPLEX, "1", "2"),
        (INT, b"\1" * 100_000),
        (INT, 1.0),
        (*COLOR, ENUM, 0, 7),
        (*COLOR, ENUM, 1, 1),
        (*COLOR, CLASS, 99),
        (*COLOR, CLASS, -1),
        (RECORD,),
        (15,),
        (-1,),
        (1 << 63,),
        (None, None),
    ],
)
def test_given_counts_and_references_that_lie_then_nothing_is_allocated_for_them(tokens: tuple[object, ...]) -> None:
    with pytest.raises(RecordingError):
        decode_value(stream(*tokens))


class Holder:
    """Its constructor may walk over all that it is given."""

    def __init__(self, rows: tuple[tuple[tuple[int, ...], ...], ...]):
        raise AssertionError("it was given all of it")


@pytest.mark.parametrize("before", [(DEFINE, f"{__name__}:Holder", None, RECORD), (DICT, 1)], ids=["record", "key"])
def test_given_references_that_multiply_then_nobody_walks_over_all_of_them(before: tuple[object, ...]) -> None:
    text = encoding._get_layout(Holder).text
    inner = (TUPLE, 1000, TUPLE, 1000, *map(float, range(1000)), *[-1] * 999)
    # a thousand rows that are one row of a thousand rows that are one: 10^9 numbers in 12 kB
    bomb = (TUPLE, 1000, *inner, *[-2] * 999)
    with pytest.raises(RecordingError, match="of more than"):
        decode_value(stream(*(text if each is None else each for each in before), *bomb, None))
