"""Encoding of a run's state and events, so that a replay continues from a segment bit for bit. No code in the bytes.

A value is flattened to a stream of tokens: None, bool, int, float, text, bytes. A token that is no int stands for
itself, an int for what follows:

    -1 - n        the n-th tuple, list, mapping, array or record before it: shared values are written once
    INT           the int, or its bytes beyond 64 bits        TEXT          the bytes of text with lone surrogates
    TUPLE, LIST   count, elements                             DICT, PROXY   count, keys and elements in turn
    COMPLEX       real, imaginary                             ARRAY         type code, bytes
    NDARRAY       type, order, dimensions, shape, bytes       ENUM, CLASS   number of the class; ENUM: value
    DEFINE        name and description of the next class      16 + n        record of the n-th class: its fields

The stream is a sequence of blocks, each a length (4 bytes, big-endian) and a flat MessagePack array. A float is its 8
bytes, so that NaN payloads and signed zeros survive. Arrays are little-endian, as all machines of this project.

The fields of a class are those of a NamedTuple, a dataclass, or of annotated `__slots__`; of any other class the
parameters of its constructor, each an attribute of the same name. Only the last are rebuilt by their constructor. A
build reads what a build with the same fields wrote; else the error names them (an event has a CRC of the names only).

Safe against hostile input: the bytes name classes of `PACKAGES` only, which neither read nor write anything, and memory
is bounded by the number of bytes.
"""

from __future__ import annotations

import dataclasses
import inspect
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from functools import lru_cache
from importlib import import_module
from itertools import islice
from math import prod
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import CoreState
from modelserver.errors import RecordingError
from modelserver.estimation.filter.measurements import REGISTRY

HISTORY_S: Final = 2.0
"""Seconds of the pose history that are written; all of it would be fifty times as much."""

BLOCK_TOKENS: Final = 500
"""Approximate number of tokens in a block: 0.2 ms of work, after which the writer pauses."""

MAX_BLOCK_BYTES: Final = 32 << 20
"""Greater than the longest array or text of a state."""

MAX_DIMENSIONS: Final = 8
MAX_DIMENSION_LENGTH: Final = 1 << 24
"""Limit for empty arrays, which may claim any dimension."""

MAX_WALKED: Final = 5_000_000
"""Limit of the values in an argument of a constructor or in a key, references counted in full: they cost one byte each,
and a walk over them costs the work of all."""

MAX_INT_BYTES: Final = 4096
"""Bytes of an integer."""

MAX_ERROR_LENGTH: Final = 300
"""Characters of what is wrong with the bytes."""

_OWN: Final = "modelserver."

PACKAGES: Final = frozenset({
    "config", "core", "dynamics", "earth", "errors", "estimation", "geometry", "joints", "messages", "query",
    "transforms",
})  # fmt: skip
"""Packages of modelserver whose classes a state may hold; besides them those of installed measurements."""

INT, TEXT, TUPLE, LIST, DICT, PROXY, COMPLEX, ARRAY, NDARRAY, ENUM, CLASS, DEFINE = range(12)
RECORD: Final = 16

_PLAIN: Final = frozenset({type(None), bool, float, str, bytes})
_SCALARS: Final = _PLAIN | {int}
_LENGTH: Final = struct.Struct(">I")
_INT64: Final = range(-(1 << 63), 1 << 64)
_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder().decode


class EncodingError(TypeError):
    """A value cannot be stored; the message names its class and field."""


class _Layout(NamedTuple):
    """How instances of a class are stored. `text` describes its fields or members, one in a line."""

    cls: type
    text: str
    fields: tuple[str, ...]
    get: Callable[[Any], Sequence[Any]]
    build: Callable[[list[Any]], Any]
    is_constructed: bool = False


@lru_cache(maxsize=1024)
def _get_layout(cls: type) -> _Layout:
    """Return the layout of a class. Raises TypeError if it has none."""
    if issubclass(cls, Enum):
        text = "\n".join(f"{name}: {member.value!r}" for name, member in sorted(cls.__members__.items()))
        return _Layout(cls, text, (), tuple, lambda values: cls(values[0]))
    hints: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        hints |= inspect.get_annotations(base)
    named = [vars(base).get("__slots__", ()) for base in cls.__mro__]
    slots = [slot for each in named for slot in ((each,) if isinstance(each, str) else each)]
    build: Callable[[list[Any]], Any] = getattr(cls, "_make", lambda values: cls(*values))
    is_constructed = False
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        fields = tuple(cls._fields)
    elif dataclasses.is_dataclass(cls):
        fields = tuple(each.name for each in dataclasses.fields(cls))
        build = _make_builder(cls, fields)
    elif slots and not set(slots) - set(hints) and not any("Callable" in str(hints[each]) for each in slots):
        fields = tuple(sorted(slots))
        build = _make_builder(cls, fields)
    else:
        parameters = inspect.signature(cls).parameters
        fields, is_constructed = tuple(parameters), True
        hints = {name: each.annotation for name, each in parameters.items()}
    text = "\n".join(f"{name}: {_format_hint(hints[name])}" for name in fields)
    get = attrgetter(*fields) if len(fields) > 1 else lambda value: [getattr(value, name) for name in fields]
    return _Layout(cls, text, fields, get, build, is_constructed)


def _format_hint(hint: Any) -> str:
    """Return an annotation as in the source; a NamedTuple has it as a forward reference."""
    return str(getattr(hint, "__forward_arg__", getattr(hint, "__qualname__", hint)))


def _make_builder(cls: type, fields: Sequence[str]) -> Callable[[list[Any]], Any]:
    """Return a function that builds an instance from the values of its fields bit for bit, without the constructor."""

    def build(values: list[Any]) -> Any:
        made: object = object.__new__(cls)
        for name, value in zip(fields, values, strict=True):
            object.__setattr__(made, name, value)
        return made

    return build


class _Writer:
    """Flattens one value. `pause` is called after each block; `is_described`: write descriptions, not their CRC."""

    def __init__(self, pause: Callable[[], object], is_described: bool):
        self._tokens: list[Any] = []
        self._places: dict[int, int] = {}
        self._classes: dict[type, int] = {}
        self._alive: list[object] = []  # so that identities stay unique
        self._blocks: list[bytes] = []
        self._pause, self._is_described = pause, is_described

    def close(self) -> bytes:
        self._flush()
        return b"".join(self._blocks)

    def write(self, value: Any) -> None:
        cls = type(value)
        if cls in _PLAIN:
            self._tokens.append(value)
        elif cls is int:
            self._tokens += (INT, value)
        elif (place := self._places.get(id(value))) is not None:
            self._tokens.append(~place)
        elif isinstance(value, (np.bool_, np.integer, np.float64)):
            # stored as Python numbers with the same bits
            self.write(value.item())
        elif isinstance(value, Enum):
            self._tokens += (ENUM, self._define(cls), value._value_)
        elif isinstance(value, type):
            self._tokens += (CLASS, self._define(value))
        elif cls is complex:
            self._tokens += (COMPLEX, value.real, value.imag)
        else:
            self._write_shared(cls, value)
            self._places[id(value)] = len(self._alive)
            self._alive.append(value)

    def _write_shared(self, cls: type, value: Any) -> None:
        tokens, write = self._tokens, self.write
        if cls is tuple or cls is list:
            tokens += (TUPLE if cls is tuple else LIST, len(value))
            for each in value:
                write(each)
        elif cls is dict or cls is MappingProxyType:
            tokens += (DICT if cls is dict else PROXY, len(value))
            for pair in value.items():
                write(pair[0])
                write(pair[1])
        elif cls is array:
            tokens += (ARRAY, value.typecode, value.tobytes())
        elif cls is np.ndarray and value.dtype in (np.float64, np.int64):
            # the order (C or Fortran) affects sums
            order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
            tokens += (NDARRAY, value.dtype.name, order, value.ndim, *value.shape, value.tobytes(order))
        else:
            tokens.append(RECORD + self._define(cls))
            layout = _get_layout(cls)
            name = ""
            try:
                for name, each in zip(layout.fields, layout.get(value), strict=True):  # noqa: B007 - for the error
                    write(each)
            except EncodingError:
                raise
            except TypeError as error:
                raise EncodingError(f"{cls.__qualname__}.{name} is {error}") from error
        if len(tokens) > BLOCK_TOKENS:
            self._flush()

    def _define(self, cls: type) -> int:
        """Return the number of a class; the first time its definition precedes the token that is written next."""
        number = self._classes.get(cls)
        if number is None:
            package = cls.__module__.removeprefix(_OWN).partition(".")[0]
            if package not in PACKAGES and package not in _list_installed():
                raise TypeError(f"of {cls.__module__}.{cls.__qualname__}, which cannot be stored")
            number = self._classes[cls] = len(self._classes)
            text = _get_layout(cls).text
            name = f"{cls.__module__}:{cls.__qualname__}"
            self._tokens += (DEFINE, name, text if self._is_described else zlib.crc32(text.encode()))
            if self._is_described:
                self._pause()  # the layouts of a state together take 4 ms the first time
        return number

    def _flush(self) -> None:
        tokens = self._tokens
        if not tokens:
            return
        try:
            data = _encode(tokens)
        except (OverflowError, UnicodeEncodeError):
            data = _encode([part for token in tokens for part in _split_token(token)])
        self._blocks += (_LENGTH.pack(len(data)), data)
        tokens.clear()
        self._pause()


def _split_token(token: Any) -> tuple[Any, ...]:
    """Return the tokens for one that MessagePack may not be able to represent."""
    if type(token) is int and token not in _INT64:
        return (token.to_bytes(token.bit_length() // 8 + 1, "little", signed=True),)
    if type(token) is str and any("\ud800" <= each <= "\udfff" for each in token):
        return TEXT, token.encode("utf-8", "surrogatepass")
    return (token,)


def _list_installed() -> frozenset[str]:
    return frozenset(each.__module__.partition(".")[0] for each in REGISTRY.values()) - {"modelserver"}


class _StateReader:
    """Reads the value of a stream. `weight` is the number of values so far, references counted in full."""

    def __init__(self, data: bytes):
        self._tokens = _iterate_tokens(memoryview(data))
        self._take: Callable[[], Any] = self._tokens.__next__
        self._known: list[tuple[Any, int]] = []
        self._classes: list[_Layout] = []
        self._weight = 0

    def close(self) -> None:
        if next(self._tokens, self) is not self:
            raise ValueError("excess data after the value")

    def read(self) -> Any:
        """Read a value. Raises any exception for invalid data."""
        token = self._take()
        self._weight += 1
        if type(token) is not int:
            return token
        if token < 0:
            value, weight = self._known[~token]
            self._weight += weight
            return value
        if token == DEFINE:
            self._define(self._take(), self._take())
            return self.read()
        if token == INT:
            return self._read_int()
        if token == TEXT:
            return self._take().decode("utf-8", "surrogatepass")
        if token == COMPLEX:
            return complex(self._take(), self._take())
        if token == ENUM:
            return self._classes[_to_count(self._take())].build([self._take()])
        if token == CLASS:
            return self._classes[_to_count(self._take())].cls
        before = self._weight
        value = self._read_shared(token)
        self._known.append((value, self._weight - before))
        return value

    def _read_shared(self, token: int) -> Any:
        if token in (TUPLE, LIST):
            found = [self.read() for _ in range(_to_count(self._take()))]
            return tuple(found) if token == TUPLE else found
        if token in (DICT, PROXY):
            mapping: dict[Any, Any] = {}
            count = _to_count(self._take())
            for _ in range(count):
                before = self._weight
                key = self.read()
                self._check_walked(before)
                mapping[key] = self.read()
            if len(mapping) != count:
                raise ValueError("a duplicate key")
            return mapping if token == DICT else MappingProxyType(mapping)
        if token == ARRAY:
            return array(self._take(), self._take())
        if token == NDARRAY:
            return self._read_ndarray()
        layout = self._classes[token - RECORD] if token >= RECORD else None
        if layout is None:
            raise ValueError(f"the unknown token {token}")
        before, name = self._weight, ""
        values = []
        try:
            for name in layout.fields:  # noqa: B007 - for the error
                values.append(self.read())
            if layout.is_constructed:
                self._check_walked(before)
            return layout.build(values)
        except (ValueError, TypeError) as error:
            raise RecordingError(f"{layout.cls.__qualname__}.{name}: {error}") from error

    def _check_walked(self, before: int) -> None:
        if self._weight - before > MAX_WALKED:
            raise ValueError(f"of more than {MAX_WALKED} values")

    def _read_int(self) -> int:
        value = self._take()
        if type(value) is bytes and len(value) <= MAX_INT_BYTES:
            return int.from_bytes(value, "little", signed=True)
        if type(value) is not int:
            raise ValueError("no integer")
        return value

    def _read_ndarray(self) -> Any:
        name, order, dimensions = self._take(), self._take(), _to_count(self._take())
        if name not in ("float64", "int64") or order not in ("C", "F") or dimensions > MAX_DIMENSIONS:
            raise ValueError(f"an array of {dimensions} dimensions of {name}")
        *shape, data = islice(self._tokens, dimensions + 1)
        if prod(map(_to_count, shape)) * 8 != len(data) or max(shape, default=0) > MAX_DIMENSION_LENGTH:
            raise ValueError(f"an array of shape {shape} with {len(data)} bytes")
        return np.frombuffer(data, name).copy().reshape(shape, order=order)

    def _define(self, name: str, text: str | int) -> None:
        """Process the definition of a class. Raises RecordingError where this build has it otherwise."""
        module, _, qualname = name.partition(":")
        package = module.removeprefix(_OWN).partition(".")[0]
        if package not in (PACKAGES if module.startswith(_OWN) else _list_installed()):
            raise RecordingError(f"{name[:MAX_ERROR_LENGTH]} is no class of a state")
        found: Any
        try:
            found = import_module(module)
            for each in qualname.split("."):
                found = vars(found)[each]
        except (ImportError, KeyError, TypeError):
            found = None
        if not isinstance(found, type):
            self._reject(f"{name}: this build has no such type")
        layout = _get_layout(found)
        if text not in (layout.text, zlib.crc32(layout.text.encode())):
            self._reject(f"{name}{_describe_difference(text, layout.text)}")
        self._classes.append(layout)

    def _reject(self, difference: str) -> None:
        raise RecordingError(f"it was written by a build with other types: {difference[:MAX_ERROR_LENGTH]}")


def _to_count(token: Any) -> int:
    if type(token) is not int or token < 0:
        raise ValueError(f"{type(token).__name__} where a count belongs")
    return token


def _describe_difference(then: object, now: str) -> str:
    """Describe how the fields or members of a class in the writer's build differ from this build's."""
    if not isinstance(then, str):
        return ": its fields are others"
    was, own = (dict(line.partition(": ")[::2] for line in text.split("\n") if line) for text in (then, now))
    for name in sorted({*was, *own}):
        if name not in own:
            return f".{name}: this build has no such field"
        if name not in was:
            return f".{name}: the writer had no such field"
        if was[name] != own[name]:
            return f".{name}: written as {was[name]}, this build has {own[name]}"
    return ": its fields are in another order"


def _iterate_tokens(data: memoryview) -> Iterator[Any]:
    at = 0
    while at < len(data):
        (size,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if not 0 < size <= min(len(data) - at, MAX_BLOCK_BYTES):
            raise ValueError(f"a block of {size} bytes, of which {len(data) - at} are there")
        block = data[at : at + size]
        if not _holds_array(block):
            raise ValueError("a block is no array of scalars")
        tokens = _decode(block)
        if not _SCALARS.issuperset(map(type, tokens)):
            raise ValueError("a block holds more than scalars")
        yield from tokens
        at += size


def _holds_array(block: memoryview) -> bool:
    """Return whether a block is a MessagePack array that is not longer than its bytes: each element takes one."""
    head = block[0]
    if 0x90 <= head <= 0x9F:
        return (head & 0x0F) < len(block)
    size = {0xDC: 2, 0xDD: 4}.get(head, 0)
    return 0 < size < len(block) and int.from_bytes(block[1 : 1 + size], "big") <= len(block) - 1 - size


def encode_value(value: object, pause: Callable[[], object] = lambda: None, is_described: bool = True) -> bytes:
    """Encode a value; `pause` is called about every 0.2 ms. Raises EncodingError, which names the field."""
    out = _Writer(pause, is_described)
    try:
        out.write(value)
    except EncodingError:
        raise
    except TypeError as error:
        raise EncodingError(f"the value is {error}") from error
    return out.close()


def decode_value(data: bytes) -> Any:
    """Decode a value. Raises RecordingError for invalid data."""
    source = _StateReader(data)
    try:
        value = source.read()
        source.close()
    except RecordingError:
        raise
    except StopIteration:
        raise RecordingError("it ends early") from None
    except (Exception, RecursionError) as error:
        raise RecordingError(f"{type(error).__name__}: {str(error)[:MAX_ERROR_LENGTH]}") from error
    return value


class RunState(NamedTuple):
    """State from which a run can be continued."""

    config: VehicleConfig
    state: CoreState


def detach(state: CoreState) -> CoreState:
    """Copy the histories of poses and joints, which share growing lists with their successors.

    All else is immutable and may be encoded while the loop continues. Of the poses the last `HISTORY_S` are copied.
    """
    view = state.view
    view = view._replace(history=view.history.copy_recent(HISTORY_S), joints=view.joints.detach())
    return state._replace(view=view)


def encode_run(run: RunState, pause: Callable[[], object] = lambda: None) -> bytes:
    """Encode a run, without the sections of drivers, which the service does not use and which may hold anything."""
    return encode_value((dataclasses.replace(run.config, drivers={}), run.state), pause)


def decode_run(data: bytes) -> RunState:
    """Decode a run. Raises RecordingError."""
    found = decode_value(data)
    if type(found) is not tuple or list(map(type, found)) != [VehicleConfig, CoreState]:
        raise RecordingError("it is no state of a run")
    return RunState(*found)
