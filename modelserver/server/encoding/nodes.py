"""Nodes of the schema: encode a value of each declared type to tokens, and decode it. `schema` builds them.

    scalar               the token itself
    enum member          its value
    complex              real, imaginary
    record               index of its class in the schema, then its fields; or -1 - n: the n-th record written so far
    tuple, list, mapping count, then its elements; or -1 - n: the n-th of this type
    array                its elements, little-endian, as bytes; for numpy after its order and shape
    class                its index in the schema
    X | None             None, or X
    other unions         where the first token is ambiguous, the number of the alternative comes first

Safe against hostile input: the bytes name no class, an index selects among the classes that the declared type allows.
Work is bounded: a count by the remaining tokens, objects by the tokens (one each at most).
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import cached_property
from math import prod
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np

from modelserver.errors import RecordingError
from modelserver.server.encoding.tokens import (
    BLOCK_TOKENS,
    EncodingError,
    TokenReader,
    TokenWriter,
    int_of,
    text_of,
)

MAX_DIMENSIONS: Final = 8
MAX_DIMENSION_LENGTH: Final = 1 << 24
"""Limit for empty arrays, which may claim any dimension."""

MAX_CONSTRUCTED_VALUES: Final = 5_000_000
"""Limit of the values passed to a constructor, references counted in full: they cost one byte each."""

_IS_BIG_ENDIAN: Final = sys.byteorder != "little"


class TypeNode(Protocol):
    """Encoder and decoder of one declared type. `text` is its canonical description, part of the schema."""

    @property
    def text(self) -> str:
        """The type as the schema describes it."""
        ...

    def encode(self, value: Any, out: TokenWriter) -> None:
        """Write a value. Raises TypeError for a value of another type."""
        ...

    def decode(self, head: Any, source: TokenReader) -> Any:
        """Read a value after its first token, `head`.

        Raises ValueError or TypeError for invalid tokens, RecordingError where the field is known, StopIteration at the
        end of the stream.
        """
        ...


def _type_name_of(value: object) -> str:
    return "None" if value is None else type(value).__qualname__


class Scalar:
    """None, bool, int, float, str, bytes, or a union of them; `values`: those of a Literal."""

    def __init__(self, names: Sequence[str], values: Sequence[object] = ()):
        self.names = frozenset(names)
        self.text = " | ".join(sorted(names))
        if values:
            self.text += "(" + ", ".join(sorted(map(repr, values))) + ")"
        self._values = frozenset(values)
        types = {_SCALAR_TYPES[name] for name in names}
        # as in annotations, an int is a valid float, and a bool a valid int; each keeps its type
        if float in types:
            types.add(int)
        if int in types:
            types.add(bool)
        self._types = frozenset(types)

    @property
    def types(self) -> frozenset[type]:
        """The types whose values are tokens without conversion; empty for a Literal."""
        return frozenset() if self._values else self._types

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        # numpy scalars are stored as Python scalars with the same bits
        plain = value.item() if isinstance(value, (np.bool_, np.integer, np.float64)) else value
        if type(plain) not in self._types or (self._values and plain not in self._values):
            raise TypeError(f"{_type_name_of(value)}, declared as {self.text}")
        out.tokens.append(plain)

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        return head if type(head) in self._types and not self._values else self.convert(head)

    def convert(self, token: Any) -> Any:
        """Convert a token that is not the value itself. Raises ValueError."""
        if type(token) is bytes and bytes not in self._types:
            if int in self._types and str not in self._types:
                token = int_of(token)
            elif str in self._types:
                token = text_of(token)
        if type(token) not in self._types or (self._values and token not in self._values):
            raise ValueError(f"{_type_name_of(token)}, declared as {self.text}")
        return token

    def accepts(self, tokens: Sequence[Any]) -> bool:
        """Return whether all tokens are valid values without conversion."""
        return not self._values and self._types.issuperset(map(type, tokens))


_SCALAR_TYPES: Final[Mapping[str, type]] = MappingProxyType(
    {"None": type(None), "bool": bool, "int": int, "float": float, "str": str, "bytes": bytes}
)


class Complex:
    """A complex number."""

    text = "complex"

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        if not isinstance(value, complex):
            raise TypeError(f"{_type_name_of(value)}, declared as complex")
        out.tokens += (value.real, value.imag)

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        imag = source.take()
        if type(head) is not float or type(imag) is not float:
            raise ValueError("no complex number")
        return complex(head, imag)


class EnumNode:
    """A member of an enumeration or of flags."""

    def __init__(self, cls: type[Enum], name: str):
        self.cls, self.text = cls, name

    def describe(self) -> dict[str, Any]:
        """Return the description for the schema: names and values."""
        return {name: member.value for name, member in sorted(self.cls.__members__.items())}

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        if type(value) is not self.cls:
            raise TypeError(f"{_type_name_of(value)}, declared as {self.text}")
        out.tokens.append(value._value_)

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        return self.cls(head)


class RecordNode:
    """A class with declared fields: a NamedTuple, a dataclass, or another class whose fields `schema` found.

    `get_values` returns the values of the fields of an instance, `build` makes an instance of them. `constructed`: by
    the constructor of the class, which iterates over its arguments; their number is bounded, with references counted.
    """

    def __init__(self, cls: type, name: str):
        self.cls, self.text = cls, name
        self.index = -1
        self.names: tuple[str, ...] = ()
        self.nodes: tuple[TypeNode, ...] = ()
        self.get_values: Callable[[Any], Sequence[Any]] = tuple
        self.build: Callable[[list[Any]], Any] = cls
        self.constructed = False
        self._plan: tuple[tuple[str, frozenset[type], Callable[[Any, TokenWriter], None]], ...] = ()
        self._allowed: dict[int, RecordNode] = {}

    def set_index(self, index: int) -> None:
        """Set the index of the class in the schema."""
        self.index = index
        self._allowed = {index: self}

    def define(self, names: Sequence[str], nodes: Sequence[TypeNode]) -> None:
        """Set the fields."""
        self.names, self.nodes = tuple(names), tuple(nodes)
        self._plan = tuple(
            (name, node.types if isinstance(node, Scalar) else frozenset(), node.encode)
            for name, node in zip(names, nodes, strict=True)
        )

    def describe(self) -> list[list[str]]:
        """Return the description for the schema: names and types of the fields."""
        return [[name, node.text] for name, node in zip(self.names, self.nodes, strict=True)]

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        place = out.records.get(id(value))
        if place is not None:
            out.tokens.append(~place)
            return
        if type(value) is not self.cls:
            raise TypeError(f"{_type_name_of(value)}, declared as {self.text}")
        out.tokens.append(self.index)
        self._encode_fields(value, out)
        out.remember(out.records, value)
        if len(out.tokens) > BLOCK_TOKENS:
            out.flush()

    def _encode_fields(self, value: Any, out: TokenWriter) -> None:
        append = out.tokens.append
        name = ""
        try:
            for (name, types, encode), part in zip(self._plan, self.get_values(value), strict=True):  # noqa: B007 - for the error
                if type(part) in types:
                    append(part)
                else:
                    encode(part, out)
        except EncodingError:
            raise
        except TypeError as error:
            raise EncodingError(f"{self.text}.{name} is {error}") from error

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        return decode_record(head, source, self._allowed)

    def decode_fields(self, source: TokenReader) -> Any:
        """Read the fields and build the instance."""
        before = source.weight
        source.weight += len(self.nodes)
        values = self._decode_values(source)
        weight = source.weight - before
        if self.constructed and weight > MAX_CONSTRUCTED_VALUES:
            raise ValueError(f"{self.text} of more than {MAX_CONSTRUCTED_VALUES} values")
        value = self.build(values)
        source.records.append((value, weight))
        return value

    def _decode_values(self, source: TokenReader) -> list[Any]:
        name = ""
        values = []
        take = source.take
        try:
            for name, node in zip(self.names, self.nodes, strict=True):  # noqa: B007 - for the error
                values.append(node.decode(take(), source))
        except (ValueError, TypeError) as error:
            raise RecordingError(f"{self.text}.{name}: {error}") from error
        return values


def decode_record(head: Any, source: TokenReader, allowed: Mapping[int, RecordNode]) -> Any:
    """Read a record of one of the allowed classes by index. Raises ValueError for any other."""
    if type(head) is not int:
        raise ValueError(f"{_type_name_of(head)} where a {_join_names(allowed)} belongs")
    if head >= 0:
        record = allowed.get(head)
        if record is None:
            raise ValueError(f"class {head} where a {_join_names(allowed)} belongs")
        return record.decode_fields(source)
    value, weight = _resolve_reference(source.records, head)
    if not any(type(value) is record.cls for record in allowed.values()):
        raise ValueError(f"a reference to {_type_name_of(value)} where a {_join_names(allowed)} belongs")
    source.weight += weight
    return value


def _join_names(allowed: Mapping[int, RecordNode]) -> str:
    return " | ".join(record.text for record in allowed.values())


def _resolve_reference(known: Sequence[tuple[Any, int]], head: int) -> tuple[Any, int]:
    if ~head >= len(known):
        raise ValueError("a forward reference")
    return known[~head]


class AnyRecord:
    """A union of records, or a protocol with its implementations."""

    def __init__(self, records: Sequence[RecordNode], text: str = ""):
        self._by_class = {record.cls: record for record in records}
        self.records = records
        self.text = text or " | ".join(sorted(record.text for record in records))

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        record = self._by_class.get(type(value))
        if record is None:
            raise TypeError(f"{_type_name_of(value)}, declared as {self.text}")
        record.encode(value, out)

    @cached_property
    def _by_index(self) -> dict[int, RecordNode]:
        return {record.index: record for record in self.records}

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        return decode_record(head, source, self._by_index)


class ClassNode:
    """One of several classes (not an instance)."""

    def __init__(self, records: Sequence[RecordNode]):
        self._by_class = {record.cls: record for record in records}
        self.text = f"class of {' | '.join(sorted(record.text for record in records))}"

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        record = self._by_class.get(value)
        if record is None:
            raise TypeError(f"{value!r:.60}, declared as {self.text}")
        out.tokens.append(record.index)

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        for cls, record in self._by_class.items():
            if type(head) is int and record.index == head:
                return cls
        raise ValueError(f"no {self.text}")


class OptionalNode:
    """X or None."""

    def __init__(self, inner: TypeNode):
        self.inner = inner
        self.text = f"{inner.text} | None"

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        if value is None:
            out.tokens.append(None)
        else:
            self.inner.encode(value, out)

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        return None if head is None else self.inner.decode(head, source)


class UnionNode:
    """A union whose first token is ambiguous: the number of the alternative comes first.

    `types`: for each alternative the type of its values.
    """

    def __init__(self, nodes: Sequence[TypeNode], types: Sequence[type]):
        self.nodes, self._types = tuple(nodes), tuple(types)
        self.text = " | ".join(f"({node.text})" for node in nodes)

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        for number, cls in enumerate(self._types):
            if type(value) is cls:
                out.tokens.append(number)
                self.nodes[number].encode(value, out)
                return
        raise TypeError(f"{_type_name_of(value)}, declared as {self.text}")

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        if type(head) is not int or not 0 <= head < len(self.nodes):
            raise ValueError(f"no {self.text}")
        return self.nodes[head].decode(source.take(), source)


class _Shared:
    """A type with references: a value is written once, and its number from then on."""

    text: str
    types: tuple[type, ...]

    def encode(self, value: Any, out: TokenWriter) -> None:
        """See `TypeNode`."""
        places = out.others.setdefault(self, {})
        place = places.get(id(value))
        if place is not None:
            out.tokens.append(~place)
            return
        if type(value) not in self.types:
            raise TypeError(f"{_type_name_of(value)}, declared as {self.text}")
        self.encode_content(value, out)
        out.remember(places, value)

    def decode(self, head: Any, source: TokenReader) -> Any:
        """See `TypeNode`."""
        if type(head) is not int:
            raise ValueError(f"{_type_name_of(head)} where a {self.text} belongs")
        known = source.others.setdefault(self, [])
        if head < 0:
            value, weight = _resolve_reference(known, head)
            source.weight += weight
            return value
        before = source.weight
        value = self.decode_content(head, source)
        known.append((value, source.weight - before))
        return value

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """Write a new value; the first token is not negative."""
        raise NotImplementedError

    def decode_content(self, head: int, source: TokenReader) -> Any:
        """Read a value after its first token."""
        raise NotImplementedError


class TupleNode(_Shared):
    """A tuple of any length of one type; or a list."""

    def __init__(self, element: TypeNode, cls: type[tuple[Any, ...]] | type[list[Any]] = tuple):
        self._element, self._cls, self.types = element, cls, (cls,)
        self.text = f"{cls.__name__} of ({element.text})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """See `_Shared`."""
        out.tokens.append(len(value))
        if isinstance(self._element, Scalar) and self._element.accepts(value):
            out.tokens += value
        else:
            for each in value:
                self._element.encode(each, out)

    def decode_content(self, head: int, source: TokenReader) -> Any:
        """See `_Shared`."""
        source.weight += head
        element = self._element
        if isinstance(element, Scalar):
            found = source.many(head)
            if not element.accepts(found):
                found = [element.convert(token) for token in found]
        else:
            found = [element.decode(source.take(), source) for _ in range(head)]
        return found if self._cls is list else tuple(found)


class FixedTuple(_Shared):
    """A tuple with a type for each position."""

    types = (tuple,)

    def __init__(self, nodes: Sequence[TypeNode]):
        self._nodes = tuple(nodes)
        self._count = len(self._nodes)
        scalars = [node for node in nodes if isinstance(node, Scalar)]
        alike = len(scalars) == self._count > 0 and len({node.text for node in scalars}) == 1
        self._alike = scalars[0] if alike else None
        self.text = "(" + ", ".join(node.text for node in nodes) + ")"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """See `_Shared`."""
        if len(value) != self._count:
            raise TypeError(f"{len(value)} values, declared as {self.text}")
        out.tokens.append(self._count)
        if self._alike is not None and self._alike.accepts(value):
            out.tokens += value
        else:
            for node, each in zip(self._nodes, value, strict=True):
                node.encode(each, out)

    def decode_content(self, head: int, source: TokenReader) -> Any:
        """See `_Shared`."""
        if head != self._count:
            raise ValueError(f"{head} values, declared as {self.text}")
        source.weight += head
        if self._alike is not None:
            found = source.many(head)
            return tuple(found if self._alike.accepts(found) else [self._alike.convert(token) for token in found])
        return tuple([node.decode(source.take(), source) for node in self._nodes])


class MappingNode(_Shared):
    """A mapping, in its order. One that is declared as Mapping is read-only after decoding."""

    def __init__(self, key: TypeNode, element: TypeNode, mutable: bool):
        self._key, self._element, self._mutable = key, element, mutable
        self.types = (dict,) if mutable else (dict, MappingProxyType)
        self.text = f"{'dict' if mutable else 'mapping'} of ({key.text}) to ({element.text})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """See `_Shared`."""
        out.tokens.append(len(value))
        for key, each in value.items():
            self._key.encode(key, out)
            self._element.encode(each, out)

    def decode_content(self, head: int, source: TokenReader) -> Any:
        """See `_Shared`."""
        source.weight += 2 * head
        found = {}
        for _ in range(head):
            key = self._key.decode(source.take(), source)
            found[key] = self._element.decode(source.take(), source)
        if len(found) != head:
            raise ValueError("a duplicate key")
        return found if self._mutable else MappingProxyType(found)


class ArrayNode(_Shared):
    """An array of the standard library: number of elements, then their bytes."""

    types = (array,)

    def __init__(self, typecode: str):
        self._typecode = typecode
        self.text = f"array({typecode})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """See `_Shared`."""
        if value.typecode != self._typecode:
            raise TypeError(f"array({value.typecode}), declared as {self.text}")
        out.tokens += (len(value), _to_little_endian(value).tobytes())

    def decode_content(self, head: int, source: TokenReader) -> Any:
        """See `_Shared`."""
        data = source.take()
        found = array(self._typecode)
        if type(data) is not bytes or len(data) != head * found.itemsize:
            raise ValueError(f"no {self.text} of {head} elements")
        found.frombytes(data)
        return _to_little_endian(found)


def _to_little_endian(values: array[Any]) -> array[Any]:
    if not _IS_BIG_ENDIAN:
        return values
    swapped = values[:]
    swapped.byteswap()
    return swapped


class NumpyArray(_Shared):
    """A numpy array: dimensions, order (C or Fortran, which affects sums), shape, bytes."""

    types = (np.ndarray,)

    def __init__(self, dtype: str):
        self._dtype = np.dtype(dtype)
        self._stored = self._dtype.newbyteorder("<")
        self.text = f"ndarray({dtype})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """See `_Shared`."""
        if value.dtype != self._dtype:
            raise TypeError(f"ndarray({value.dtype}), declared as {self.text}")
        fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        data = value.astype(self._stored, copy=False).tobytes("F" if fortran else "C")
        out.tokens += (value.ndim, fortran, *value.shape, data)

    def decode_content(self, head: int, source: TokenReader) -> Any:
        """See `_Shared`."""
        if head > MAX_DIMENSIONS:
            raise ValueError(f"an array of {head} dimensions")
        fortran, *shape, data = source.many(head + 2)
        if type(fortran) is not bool or type(data) is not bytes or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError(f"no {self.text}")
        if prod(shape) * self._stored.itemsize != len(data) or max(shape, default=0) > MAX_DIMENSION_LENGTH:
            raise ValueError(f"an array of shape {shape} with {len(data)} bytes")
        flat = np.frombuffer(data, self._stored).astype(self._dtype)
        return flat.reshape(shape, order="F" if fortran else "C")
