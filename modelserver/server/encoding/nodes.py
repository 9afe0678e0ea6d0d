"""Nodes of the schema: encode a value of each declared type to tokens, and decode it. `schema` builds them.

    scalar               the token itself
    enum member          its value
    complex              real, imaginary
    record               index of its class in the schema, then its fields; or -1 - n: the n-th record written so far
    tuple, list, mapping count, then its elements; or -1 - n: the n-th of this type
    array                its elements, little-endian, as bytes; for numpy after its order and shape
    class                its index in the schema
    X | None             None, or X

Safe against hostile input: the bytes name no class, an index selects among the classes that the declared type allows.
Work is bounded: a count by the remaining tokens, objects by the tokens (one each at most).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import cached_property
from itertools import repeat
from math import prod
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from modelserver.errors import RecordingError
from modelserver.server.encoding.tokens import BLOCK_TOKENS, EncodingError, TokenReader, TokenWriter

MAX_DIMENSIONS: Final = 8
MAX_DIMENSION_LENGTH: Final = 1 << 24
"""Limit for empty arrays, which may claim any dimension."""

MAX_CONSTRUCTED_VALUES: Final = 5_000_000
"""Limit of the values passed to a constructor, references counted in full: they cost one byte each."""

MAX_INT_BYTES: Final = 4096
"""Bytes of an integer."""


class TypeNode(ABC):
    """Encoder and decoder of one declared type.

    `text` is its canonical description, part of the schema; `types` are those whose values are tokens unchanged.
    """

    text: str
    types: frozenset[type] = frozenset()

    @abstractmethod
    def encode(self, value: Any, out: TokenWriter) -> None:
        """Write a value. Raises TypeError for a value of another type."""

    @abstractmethod
    def decode(self, head: Any, source: TokenReader) -> Any:
        """Read a value after its first token, `head`.

        Raises ValueError or TypeError for invalid tokens, RecordingError where the field is known, StopIteration at the
        end of the stream.
        """

    def describe_mismatch(self, value: object) -> str:
        return f"{_type_name_of(value)}, declared as {self.text}"


def _type_name_of(value: object) -> str:
    return "None" if value is None else type(value).__qualname__


_SCALAR_TYPES: Final[Mapping[str, type]] = MappingProxyType(
    {"None": type(None), "bool": bool, "int": int, "float": float, "str": str, "bytes": bytes}
)


class Scalar(TypeNode):
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
        self.types = frozenset() if values else self._types

    def encode(self, value: Any, out: TokenWriter) -> None:
        # numpy scalars are stored as Python scalars with the same bits
        plain = value.item() if isinstance(value, (np.bool_, np.integer, np.float64)) else value
        if type(plain) not in self._types or (self._values and plain not in self._values):
            raise TypeError(self.describe_mismatch(value))
        out.tokens.append(plain)

    def decode(self, head: Any, source: TokenReader) -> Any:
        return head if type(head) in self.types else self.convert(head)

    def convert(self, token: Any) -> Any:
        """Convert a token that is not the value itself. Raises ValueError."""
        if type(token) is bytes and bytes not in self._types:
            if str in self._types:
                token = token.decode("utf-8", "surrogatepass")
            elif int in self._types:
                if len(token) > MAX_INT_BYTES:
                    raise ValueError(f"an integer of {len(token)} bytes")
                token = int.from_bytes(token, "little", signed=True)
        if type(token) not in self._types or (self._values and token not in self._values):
            raise ValueError(self.describe_mismatch(token))
        return token

    def accepts(self, tokens: Sequence[Any]) -> bool:
        """Return whether all tokens are valid values without conversion."""
        return bool(self.types) and self.types.issuperset(map(type, tokens))


class Complex(TypeNode):
    """A complex number."""

    text = "complex"

    def encode(self, value: Any, out: TokenWriter) -> None:
        if not isinstance(value, complex):
            raise TypeError(self.describe_mismatch(value))
        out.tokens += (value.real, value.imag)

    def decode(self, head: Any, source: TokenReader) -> Any:
        imag = source.take()
        if type(head) is not float or type(imag) is not float:
            raise ValueError("no complex number")
        return complex(head, imag)


class EnumNode(TypeNode):
    """A member of an enumeration or of flags."""

    def __init__(self, cls: type[Enum], name: str):
        self.cls, self.text = cls, name

    def describe(self) -> dict[str, Any]:
        """Return the description for the schema: names and values."""
        return {name: member.value for name, member in sorted(self.cls.__members__.items())}

    def encode(self, value: Any, out: TokenWriter) -> None:
        if type(value) is not self.cls:
            raise TypeError(self.describe_mismatch(value))
        out.tokens.append(value._value_)

    def decode(self, head: Any, source: TokenReader) -> Any:
        return self.cls(head)


class AnyRecord(TypeNode):
    """A union of records, or a protocol with its implementations."""

    def __init__(self, records: Sequence[RecordNode], text: str = ""):
        self.records = records
        self.text = text or " | ".join(sorted(record.text for record in records))

    @cached_property
    def _by_class(self) -> dict[type, RecordNode]:
        return {record.cls: record for record in self.records}

    @cached_property
    def _by_index(self) -> dict[int, RecordNode]:
        return {record.index: record for record in self.records}

    def encode(self, value: Any, out: TokenWriter) -> None:
        record = self._by_class.get(type(value))
        if record is None:
            raise TypeError(self.describe_mismatch(value))
        record.encode(value, out)

    def decode(self, head: Any, source: TokenReader) -> Any:
        if type(head) is not int:
            raise ValueError(f"{_type_name_of(head)} where a {self.text} belongs")
        if head >= 0:
            record = self._by_index.get(head)
            if record is None:
                raise ValueError(f"class {head} where a {self.text} belongs")
            return record.decode_fields(source)
        value, weight = _resolve_reference(source.records, head)
        if type(value) not in self._by_class:
            raise ValueError(f"a reference to {_type_name_of(value)} where a {self.text} belongs")
        source.weight += weight
        return value


def _resolve_reference(known: Sequence[tuple[Any, int]], head: int) -> tuple[Any, int]:
    if ~head >= len(known):
        raise ValueError("a forward reference")
    return known[~head]


class RecordNode(AnyRecord):
    """A class with declared fields: a NamedTuple, a dataclass, or another class whose fields `schema` found.

    `get_values` returns the values of the fields of an instance, `build` makes an instance of them. `constructed`: by
    the constructor of the class, which iterates over its arguments; their number is bounded, with references counted.
    """

    def __init__(self, cls: type, name: str):
        super().__init__([self], name)
        self.cls = cls
        self.index = -1
        """Index of the class in the schema."""
        self.fields: Mapping[str, TypeNode] = {}
        self.get_values: Callable[[Any], Sequence[Any]] = tuple
        self.build: Callable[[list[Any]], Any] = cls
        self.constructed = False

    @cached_property
    def _plan(self) -> list[tuple[str, frozenset[type], Callable[[Any, TokenWriter], None]]]:
        return [(name, node.types, node.encode) for name, node in self.fields.items()]

    def encode(self, value: Any, out: TokenWriter) -> None:
        place = out.records.get(id(value))
        if place is not None:
            out.tokens.append(~place)
            return
        if type(value) is not self.cls:
            raise TypeError(self.describe_mismatch(value))
        out.tokens.append(self.index)
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
        out.remember(out.records, value)
        if len(out.tokens) > BLOCK_TOKENS:
            out.flush()

    def decode_fields(self, source: TokenReader) -> Any:
        """Read the fields and build the instance."""
        before = source.weight
        source.weight += len(self.fields)
        name = ""
        values = []
        take = source.take
        try:
            for name, node in self.fields.items():  # noqa: B007 - for the error
                values.append(node.decode(take(), source))
        except (ValueError, TypeError) as error:
            raise RecordingError(f"{self.text}.{name}: {error}") from error
        weight = source.weight - before
        if self.constructed and weight > MAX_CONSTRUCTED_VALUES:
            raise ValueError(f"{self.text} of more than {MAX_CONSTRUCTED_VALUES} values")
        value = self.build(values)
        source.records.append((value, weight))
        return value


class ClassNode(TypeNode):
    """One of several classes (not an instance)."""

    def __init__(self, records: Sequence[RecordNode]):
        self._records = records
        self.text = f"class of {' | '.join(sorted(record.text for record in records))}"

    def encode(self, value: Any, out: TokenWriter) -> None:
        for record in self._records:
            if value is record.cls:
                out.tokens.append(record.index)
                return
        raise TypeError(f"{value!r:.60}, declared as {self.text}")

    def decode(self, head: Any, source: TokenReader) -> Any:
        for record in self._records:
            if type(head) is int and record.index == head:
                return record.cls
        raise ValueError(f"no {self.text}")


class OptionalNode(TypeNode):
    """X or None."""

    def __init__(self, inner: TypeNode):
        self.inner = inner
        self.text = f"{inner.text} | None"

    def encode(self, value: Any, out: TokenWriter) -> None:
        if value is None:
            out.tokens.append(None)
        else:
            self.inner.encode(value, out)

    def decode(self, head: Any, source: TokenReader) -> Any:
        return None if head is None else self.inner.decode(head, source)


class _Shared(TypeNode):
    """A type with references: a value is written once, and its number from then on. `classes`: those of its values."""

    classes: tuple[type, ...]

    def encode(self, value: Any, out: TokenWriter) -> None:
        places = out.others.setdefault(self, {})
        place = places.get(id(value))
        if place is not None:
            out.tokens.append(~place)
            return
        if type(value) not in self.classes:
            raise TypeError(self.describe_mismatch(value))
        self.encode_content(value, out)
        out.remember(places, value)

    def decode(self, head: Any, source: TokenReader) -> Any:
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

    @abstractmethod
    def encode_content(self, value: Any, out: TokenWriter) -> None:
        """Write a new value; the first token is not negative."""

    @abstractmethod
    def decode_content(self, head: int, source: TokenReader) -> Any:
        """Read a value after its first token."""


class TupleNode(_Shared):
    """A tuple or list of any length of one type; or, `fixed`, a tuple with a type for each position."""

    def __init__(
        self, nodes: Sequence[TypeNode], cls: type[tuple[Any, ...]] | type[list[Any]] = tuple, fixed: bool = False
    ):
        self._cls, self.classes = cls, (cls,)
        self._nodes = nodes if fixed else repeat(nodes[0])
        self._count = len(nodes) if fixed else None
        scalars = [node for node in nodes if isinstance(node, Scalar)]
        alike = len(scalars) == len(nodes) and len({node.text for node in nodes}) == 1
        self._scalar = scalars[0] if alike else None
        texts = ", ".join(node.text for node in nodes)
        self.text = f"({texts})" if fixed else f"{cls.__name__} of ({texts})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        if self._count is not None and len(value) != self._count:
            raise TypeError(f"{len(value)} values, declared as {self.text}")
        out.tokens.append(len(value))
        if self._scalar is not None and self._scalar.accepts(value):
            out.tokens += value
        else:
            for each, node in zip(value, self._nodes):  # noqa: B905 - one node may stand for all
                node.encode(each, out)

    def decode_content(self, head: int, source: TokenReader) -> Any:
        if self._count is not None and head != self._count:
            raise ValueError(f"{head} values, declared as {self.text}")
        source.weight += head
        scalar = self._scalar
        if scalar is not None:
            found = source.many(head)
            if not scalar.accepts(found):
                found = [scalar.convert(token) for token in found]
        else:
            found = [node.decode(source.take(), source) for _, node in zip(range(head), self._nodes)]  # noqa: B905
        return found if self._cls is list else tuple(found)


class MappingNode(_Shared):
    """A mapping, in its order. One that is declared as Mapping is read-only after decoding."""

    def __init__(self, key: TypeNode, element: TypeNode, mutable: bool):
        self._key, self._element, self._mutable = key, element, mutable
        self.classes = (dict,) if mutable else (dict, MappingProxyType)
        self.text = f"{'dict' if mutable else 'mapping'} of ({key.text}) to ({element.text})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        out.tokens.append(len(value))
        for key, each in value.items():
            self._key.encode(key, out)
            self._element.encode(each, out)

    def decode_content(self, head: int, source: TokenReader) -> Any:
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

    classes = (array,)

    def __init__(self, typecode: str):
        self._typecode, self._stored = typecode, np.dtype(typecode).newbyteorder("<")
        self.text = f"array({typecode})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        if value.typecode != self._typecode:
            raise TypeError(f"array({value.typecode}), declared as {self.text}")
        out.tokens += (len(value), np.asarray(value).astype(self._stored, copy=False).tobytes())

    def decode_content(self, head: int, source: TokenReader) -> Any:
        data = source.take()
        if type(data) is not bytes or len(data) != head * self._stored.itemsize:
            raise ValueError(f"no {self.text} of {head} elements")
        return array(self._typecode, np.frombuffer(data, self._stored).astype(self._typecode).tobytes())


class NumpyArray(_Shared):
    """A numpy array: dimensions, order (C or Fortran, which affects sums), shape, bytes."""

    classes = (np.ndarray,)

    def __init__(self, dtype: str):
        self._dtype = np.dtype(dtype)
        self._stored = self._dtype.newbyteorder("<")
        self.text = f"ndarray({dtype})"

    def encode_content(self, value: Any, out: TokenWriter) -> None:
        if value.dtype != self._dtype:
            raise TypeError(f"ndarray({value.dtype}), declared as {self.text}")
        fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        data = value.astype(self._stored, copy=False).tobytes("F" if fortran else "C")
        out.tokens += (value.ndim, fortran, *value.shape, data)

    def decode_content(self, head: int, source: TokenReader) -> Any:
        if head > MAX_DIMENSIONS:
            raise ValueError(f"an array of {head} dimensions")
        fortran, *shape, data = source.many(head + 2)
        if type(fortran) is not bool or type(data) is not bytes or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError(f"no {self.text}")
        if prod(shape) * self._stored.itemsize != len(data) or max(shape, default=0) > MAX_DIMENSION_LENGTH:
            raise ValueError(f"an array of shape {shape} with {len(data)} bytes")
        flat = np.frombuffer(data, self._stored).astype(self._dtype)
        return flat.reshape(shape, order="F" if fortran else "C")
