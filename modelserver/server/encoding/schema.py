"""Schema of stored types: nodes built from annotations, description and fingerprint, self-describing documents.

A build reads what a build with the same schema wrote, on any Python, numpy or machine. The description holds the fields
of every record in order with their types, and the members of every enumeration; its SHA-256 is the fingerprint. It
depends only on the declarations: classes and alternatives are sorted by name, so import order, hash seeds and the
formatting of annotations do not matter.

The fields of a class are found by the first rule that applies:
- NamedTuple, dataclass: as declared, rebuilt without the constructor, so that no bit changes;
- a class with `__slots__`, all annotated in its body, none of them a function: the same;
- any other: the parameters of its constructor, each an attribute of the same name. Where that is a property, its return
  type is used, so that a lazy value is evaluated.

Document: magic (8) | fingerprint (32) | length of the description (4) | description, deflated | tokens
"""

from __future__ import annotations

import collections.abc
import dataclasses
import hashlib
import inspect
import json
import struct
import types
import typing
import zlib
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, Literal

import numpy as np

from modelserver.errors import RecordingError
from modelserver.server.encoding import nodes
from modelserver.server.encoding.tokens import EncodingError, TokenReader, TokenWriter

_SCALARS: Final[Mapping[Any, str]] = {
    type(None): "None", bool: "bool", int: "int", float: "float", str: "str", bytes: "bytes",
}  # fmt: skip

_SEQUENCES: Final = (tuple, list, collections.abc.Iterable, collections.abc.Sequence)

MAX_DIFFERENCES: Final = 5
"""Differences between two schemas in one message."""

MAX_DIFFERENCE_LENGTH: Final = 300
"""Characters of one difference."""

_OWN: Final = "modelserver."


class SchemaError(TypeError):
    """A declared type cannot be stored; the message names the type and the field."""


class _IntArray:
    pass


class _FloatArray:
    pass


_ARRAYS: Final = {int: _IntArray, float: _FloatArray}
"""Replaces `array` in annotations: before Python 3.12 it takes no element type."""

_TYPECODES: Final[Mapping[Any, str]] = {_IntArray: "q", _FloatArray: "d"}


def _get_hints(declared: Any) -> dict[str, Any]:
    return typing.get_type_hints(declared, localns={"array": _ARRAYS})


def _expand_alias(hint: Any) -> Any:
    """Expand a type alias (PEP 695): since numpy 2.5 NDArray is one."""
    alias = typing.get_origin(hint) or hint
    if not hasattr(alias, "__value__") or not hasattr(alias, "__type_params__"):
        return hint
    arguments = typing.get_args(hint)
    return alias.__value__[arguments] if arguments else alias.__value__


def _get_name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}".removeprefix(_OWN)


class Schema:
    """Encoder and decoder of the types reachable from `roots`.

    Parameters
    ----------
    roots: annotation of each root by name.
    implementations: classes that implement a protocol.
    omitted: fields that are not stored; they get their default on decoding.

    Raises
    ------
    SchemaError: a type cannot be stored.
    """

    def __init__(
        self,
        roots: Mapping[str, Any],
        implementations: Mapping[Any, Sequence[type]] | None = None,
        omitted: Mapping[type, frozenset[str]] | None = None,
    ):
        self._implementations = implementations or {}
        self._omitted = omitted or {}
        self._records: dict[type, nodes.RecordNode] = {}
        self._enums: dict[type, nodes.EnumNode] = {}
        self._undefined: list[nodes.RecordNode] = []
        self._roots = {name: self._make_node(annotation, f"root {name}") for name, annotation in sorted(roots.items())}
        while self._undefined:
            self._define(self._undefined.pop())
        records = sorted(self._records.values(), key=lambda record: record.text)
        for index, record in enumerate(records):
            if index and record.text == records[index - 1].text:
                raise SchemaError(f"two classes are named {record.text}")
            record.index = index
        description = {
            "records": {record.text: [[name, node.text] for name, node in record.fields.items()] for record in records},
            "enums": {node.text: node.describe() for node in self._enums.values()},
            "roots": {name: node.text for name, node in self._roots.items()},
        }
        self.description: Final = json.dumps(description, sort_keys=True, separators=(",", ":"))
        """The schema as JSON text."""
        self.fingerprint: Final = hashlib.sha256(self.description.encode()).digest()

    def encode(self, root: str, value: object, pause: Callable[[], object] = lambda: None) -> bytes:
        """Encode a value; `pause` is called about every 0.2 ms.

        Raises EncodingError, which names the field, for a value that does not have its declared type.
        """
        out = TokenWriter(pause)
        try:
            self._roots[root].encode(value, out)
        except EncodingError:
            raise
        except TypeError as error:
            raise EncodingError(f"{root} is {error}") from error
        return out.close()

    def decode(self, root: str, data: bytes) -> Any:
        """Decode a value. Raises RecordingError for invalid data."""
        source = TokenReader(data)
        try:
            value = self._roots[root].decode(source.take(), source)
            source.close()
        except RecordingError:
            raise
        except StopIteration:
            raise RecordingError("it ends early") from None
        except (Exception, RecursionError) as error:
            raise RecordingError(f"{type(error).__name__}: {str(error)[:MAX_DIFFERENCE_LENGTH]}") from error
        return value

    def check_same(self, fingerprint: bytes, description: str) -> None:
        """Raise RecordingError, which names the differences, if the writer had another schema."""
        if fingerprint == self.fingerprint:
            return
        try:
            found = list_differences(json.loads(description), json.loads(self.description))
        except (ValueError, TypeError, AttributeError, RecursionError):
            found = []
        more = f"; and {len(found) - MAX_DIFFERENCES} more" if len(found) > MAX_DIFFERENCES else ""
        raise RecordingError(
            "it was written by a build with other types: "
            + ("; ".join(found[:MAX_DIFFERENCES]) + more or "their description is damaged")
        )

    # --- from annotations to nodes ---

    def _make_node(self, hint: Any, place: str) -> nodes.TypeNode:
        hint = _expand_alias(hint)
        origin, arguments = typing.get_origin(hint), typing.get_args(hint)
        if hint in _SCALARS:
            return nodes.Scalar([_SCALARS[hint]])
        if hint in self._implementations:
            classes = sorted(self._implementations[hint], key=_get_name)
            return nodes.AnyRecord([self._get_record(cls, place) for cls in classes], f"any {_get_name(hint)}")
        if origin in (typing.Union, types.UnionType):
            return self._make_union(arguments, place)
        if origin is Literal:
            return nodes.Scalar(sorted({_SCALARS[type(value)] for value in arguments}), arguments)
        if origin is typing.ClassVar or hint is Any:
            raise SchemaError(f"{place}: {hint} cannot be stored; declare what it holds")
        if origin is type:
            return nodes.ClassNode([self._get_record(cls, place) for cls in self._find_classes(arguments[0], place)])
        if origin in _SEQUENCES:
            if origin is tuple and arguments[-1:] != (...,):
                return nodes.TupleNode([self._make_node(each, place) for each in arguments], fixed=True)
            return nodes.TupleNode([self._make_node(arguments[0], place)], list if origin is list else tuple)
        if origin in (dict, collections.abc.Mapping):
            key, element = (self._make_node(each, place) for each in arguments)
            return nodes.MappingNode(key, element, mutable=origin is dict)
        if hint in _TYPECODES:
            return nodes.ArrayNode(_TYPECODES[hint])
        if origin is np.ndarray:
            (scalar,) = typing.get_args(arguments[1])
            return nodes.NumpyArray(np.dtype(scalar).name)
        if hint is complex:
            return nodes.Complex()
        if isinstance(hint, type) and issubclass(hint, Enum):
            return self._enums.setdefault(hint, nodes.EnumNode(hint, _get_name(hint)))
        if isinstance(hint, type) and origin is None:
            return self._get_record(hint, place)
        raise SchemaError(f"{place}: {hint} cannot be stored")

    def _find_classes(self, hint: Any, place: str) -> list[type]:
        if hint in self._implementations:
            return sorted(self._implementations[hint], key=_get_name)
        found = typing.get_args(hint) or (hint,)
        if not all(isinstance(each, type) for each in found):
            raise SchemaError(f"{place}: type[{hint}] cannot be stored")
        return sorted(found, key=_get_name)

    def _make_union(self, arguments: Sequence[Any], place: str) -> nodes.TypeNode:
        alternatives = [self._make_node(each, place) for each in arguments if each is not type(None)]
        records = [record for node in alternatives if isinstance(node, nodes.AnyRecord) for record in node.records]
        inner: nodes.TypeNode
        if len(alternatives) == 1:
            inner = alternatives[0]
        elif all(isinstance(node, nodes.Scalar) for node in alternatives):
            return nodes.Scalar(sorted({_SCALARS[each] for each in arguments}))
        elif all(isinstance(node, nodes.AnyRecord) for node in alternatives):
            inner = nodes.AnyRecord(sorted(records, key=lambda record: record.text))
        else:
            raise SchemaError(
                f"{place}: a union of {' and '.join(node.text for node in alternatives)} cannot be stored"
            )
        if len(alternatives) == len(arguments):
            return inner
        if isinstance(inner, nodes.Scalar):
            return nodes.Scalar(sorted({*inner.names, "None"}))
        return nodes.OptionalNode(inner)

    def _get_record(self, cls: type, place: str) -> nodes.RecordNode:
        found = self._records.get(cls)
        if found is None:
            if cls.__module__ == "builtins" or getattr(cls, "_is_protocol", False):
                raise SchemaError(f"{place}: {cls} cannot be stored; declare what it holds")
            found = self._records[cls] = nodes.RecordNode(cls, _get_name(cls))
            self._undefined.append(found)
        return found

    def _define(self, record: nodes.RecordNode) -> None:
        cls, name = record.cls, record.text
        omitted = self._omitted.get(cls, frozenset())
        slots = _find_slots(cls)
        fields: Sequence[str]
        if issubclass(cls, tuple) and hasattr(cls, "_fields"):
            hints = _get_hints(cls)
            fields = cls._fields
            record.build = cls._make  # type: ignore[attr-defined]
        elif dataclasses.is_dataclass(cls):
            hints = _get_hints(cls)
            fields = [each.name for each in dataclasses.fields(cls) if each.name not in omitted]
            defaults = [each for each in dataclasses.fields(cls) if each.name in omitted]
            record.get_values, record.build = _make_getter(fields), _make_builder(cls, fields, defaults)
        elif (
            slots and not slots - set(hints := _get_hints(cls)) and not any(_is_function(hints[each]) for each in slots)
        ):
            fields = sorted(slots)
            record.get_values, record.build = _make_getter(fields), _make_builder(cls, fields)
        else:
            hints = _get_hints(inspect.getattr_static(cls, "__init__"))
            fields = list(inspect.signature(cls).parameters)
            for each in fields:
                found = inspect.getattr_static(cls, each, None)
                if isinstance(found, property) and found.fget is not None:
                    hints[each] = _get_hints(found.fget).get("return", Any)
            missing = [each for each in fields if each not in hints]
            if missing:
                raise SchemaError(f"{name}: its constructor's {missing[0]} has no type, so it cannot be stored")
            record.get_values, record.build = _make_getter(fields), lambda values: cls(*values)
            record.constructed = True
        record.fields = {each: self._make_node(hints[each], f"{name}.{each}") for each in fields}


def _is_function(hint: Any) -> bool:
    found = (hint, *typing.get_args(hint))
    return any(collections.abc.Callable in (each, typing.get_origin(each)) for each in found)


def _find_slots(cls: type) -> set[str]:
    found = [base.__dict__.get("__slots__", ()) for base in cls.__mro__]
    return {slot for slots in found for slot in ((slots,) if isinstance(slots, str) else slots)}


def _make_getter(fields: Sequence[str]) -> Callable[[Any], Sequence[Any]]:
    """Return a function that returns the values of an instance's fields."""
    if not fields:
        return lambda value: ()
    get = attrgetter(*fields)
    return get if len(fields) > 1 else lambda value: (get(value),)


def _make_builder(
    cls: type, fields: Sequence[str], defaults: Sequence[dataclasses.Field[Any]] = ()
) -> Callable[[Sequence[Any]], Any]:
    """Return a function that builds an instance from the values of its fields bit for bit, without the constructor."""
    put = object.__setattr__

    def build(values: Sequence[Any]) -> Any:
        made: object = object.__new__(cls)
        for name, value in zip(fields, values, strict=True):
            put(made, name, value)
        for each in defaults:
            factory = each.default_factory
            put(made, each.name, each.default if factory is dataclasses.MISSING else factory())
        return made

    return build


def list_differences(then: Any, now: Any) -> list[str]:
    """List the differences between the descriptions of the writer and of this build, in words."""
    found = []
    for name, fields in sorted(then["records"].items()):
        ours = now["records"].get(name)
        if ours is None:
            found.append(f"{name}: this build has no such type")
        elif fields != ours:
            was, own = dict(fields), dict(ours)
            changed = [f"{name}.{field}: this build has no such field" for field in was.keys() - own]
            changed += [f"{name}.{field}: the writer had no such field" for field in own.keys() - was]
            changed += [
                f"{name}.{field}: written as {was[field]}, this build has {own[field]}"
                for field in was.keys() & own
                if was[field] != own[field]
            ]
            found += sorted(changed) or [f"{name}: its fields are in another order"]
    found += [f"{name}: the writer had no such type" for name in sorted(now["records"]) if name not in then["records"]]
    for name, members in sorted(then["enums"].items()):
        ours = now["enums"].get(name)
        if ours is not None and members != ours:
            member = min(key for key in {**members, **ours} if members.get(key) != ours.get(key))
            found.append(f"{name}: member {member} was {members.get(member)}, is {ours.get(member)}")
    for name, text in sorted(then["roots"].items()):
        if now["roots"].get(name) != text:
            found.append(f"{name}: written as {text}, this build has {now['roots'].get(name)}")
    return [each[:MAX_DIFFERENCE_LENGTH] for each in found]


MAGIC: Final = b"MSvalue1"

MAX_DESCRIPTION_BYTES: Final = 1 << 20
"""Inflated bytes; this build needs some 20,000."""

_HEAD: Final = struct.Struct(">8s32sI")


@lru_cache(maxsize=4)
def _deflate(description: str) -> bytes:
    return zlib.compress(description.encode(), 9)


def write_document(schema: Schema, root: str, value: object, pause: Callable[[], object] = lambda: None) -> bytes:
    """Encode a value with the description of its types. Raises EncodingError; `pause`: see `Schema.encode`."""
    description = _deflate(schema.description)
    head = _HEAD.pack(MAGIC, schema.fingerprint, len(description))
    return b"".join((head, description, schema.encode(root, value, pause)))


def read_document(schema: Schema, root: str, data: bytes) -> Any:
    """Decode a document of `write_document`.

    Raises RecordingError, which names types and fields where the schema of the writer differs from this build's.
    """
    if len(data) < _HEAD.size:
        raise RecordingError("it ends early")
    magic, fingerprint, length = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise RecordingError("it is no document of this format")
    if length > len(data) - _HEAD.size:
        raise RecordingError("it ends early")
    if fingerprint != schema.fingerprint:
        schema.check_same(fingerprint, _inflate(data[_HEAD.size : _HEAD.size + length]))
    return schema.decode(root, data[_HEAD.size + length :])


def _inflate(data: bytes) -> str:
    reader = zlib.decompressobj()
    try:
        text = reader.decompress(data, MAX_DESCRIPTION_BYTES)
        return "" if reader.unconsumed_tail else text.decode()
    except (zlib.error, UnicodeDecodeError):
        return ""
