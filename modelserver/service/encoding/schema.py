"""The schema: the annotations of stored types, walked once, as nodes that encode and decode and as a description.

A build reads what a build with the same schema wrote, whatever its Python, numpy or machine. The description holds the
fields of every record in their order with their types, and the members of every enumeration; its SHA-256 is the
fingerprint. It depends on the declarations alone: classes and alternatives are sorted by name, so neither the order of
imports, nor hash seeds, nor how a Python version prints an annotation enters.

How the fields of a class are found, in this order:
- NamedTuple, dataclass: as declared, rebuilt without the constructor, so that no bit is normalized again;
- a class with `__slots__`, all annotated in its body, none of them a function: the same;
- any other: the parameters of its constructor, each an attribute of the same name. Where that is a property its type is
  that of the parameter, so a value that may be a function until it is looked at is looked at.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import hashlib
import inspect
import json
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from operator import attrgetter
from typing import Any, Final, Literal

import numpy as np

from modelserver.errors import RecordingError
from modelserver.service.encoding.nodes import (
    AnyRecord,
    ArrayNode,
    Choice,
    ClassNode,
    Complex,
    EnumNode,
    FixedTuple,
    MappingNode,
    NumpyArray,
    Optional,
    RecordNode,
    Scalar,
    TupleNode,
    TypeNode,
)
from modelserver.service.encoding.tokens import EncodingError, TokenReader, TokenWriter

_SCALARS: Final[Mapping[Any, str]] = {
    type(None): "None", bool: "bool", int: "int", float: "float", str: "str", bytes: "bytes",
}  # fmt: skip

_SEQUENCES: Final = (tuple, list, collections.abc.Iterable, collections.abc.Sequence)

MOST_DIFFERENCES: Final = 5
"""Differences between two schemas that a message names."""

LONGEST_DIFFERENCE: Final = 300
"""Characters of one of them."""

_OWN: Final = "modelserver."


class SchemaError(TypeError):
    """A declared type cannot be stored; the message names the type and the field."""


class _IntArray:
    pass


class _FloatArray:
    pass


class _Arrays:
    """Stands for `array` in annotations: before Python 3.12 that takes no type of its elements."""

    def __class_getitem__(cls, element: type) -> type:
        return {int: _IntArray, float: _FloatArray}[element]


_TYPECODES: Final[Mapping[Any, str]] = {_IntArray: "q", _FloatArray: "d"}


def _hints(declared: Any) -> dict[str, Any]:
    return typing.get_type_hints(declared, localns={"array": _Arrays})


def _expand_alias(hint: Any) -> Any:
    """Return what a type alias stands for (PEP 695): since numpy 2.5 NDArray is one."""
    alias = typing.get_origin(hint) or hint
    if not hasattr(alias, "__value__") or not hasattr(alias, "__type_params__"):
        return hint
    arguments = typing.get_args(hint)
    return alias.__value__[arguments] if arguments else alias.__value__


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}".removeprefix(_OWN)


class Schema:
    """Encoders and decoders for the types that `roots` lead to, by the roots' names.

    `implementations` has the classes that may stand for a protocol. `omitted` names fields that are not stored: they
    have their default when they are read. Raises SchemaError for a type that cannot be stored.
    """

    def __init__(
        self,
        roots: Mapping[str, Any],
        implementations: Mapping[Any, Sequence[type]] | None = None,
        omitted: Mapping[type, frozenset[str]] | None = None,
    ):
        self._implementations = implementations or {}
        self._omitted = omitted or {}
        self._records: dict[type, RecordNode] = {}
        self._enums: dict[type, EnumNode] = {}
        self._undefined: list[RecordNode] = []
        self._roots = {name: self._node(annotation, f"root {name}") for name, annotation in sorted(roots.items())}
        while self._undefined:
            self._define(self._undefined.pop())
        records = sorted(self._records.values(), key=lambda record: record.text)
        for index, record in enumerate(records):
            if index and record.text == records[index - 1].text:
                raise SchemaError(f"two classes are named {record.text}")
            record.number(index)
        self.description: Final = json.dumps(self._description(records), sort_keys=True, separators=(",", ":"))
        """All of the schema as JSON text."""
        self.fingerprint: Final = hashlib.sha256(self.description.encode()).digest()

    @property
    def classes(self) -> tuple[type, ...]:
        """The classes whose instances can be stored."""
        return tuple(self._records)

    def encode(self, root: str, value: object, pause: Callable[[], object] = lambda: None) -> bytes:
        """Return a value as bytes; `pause` is called after every fifth of a millisecond or so.

        Raises EncodingError, which names the field, for a value that is not of its declared type.
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
        """Return the value in what `encode` returned. Raises RecordingError for anything else."""
        source = TokenReader(data)
        try:
            value = self._roots[root].decode(source.take(), source)
            source.close()
        except RecordingError:
            raise
        except StopIteration:
            raise RecordingError("it ends early") from None
        except (Exception, RecursionError) as error:
            raise RecordingError(f"{type(error).__name__}: {str(error)[:LONGEST_DIFFERENCE]}") from error
        return value

    def check_same(self, fingerprint: bytes, description: str) -> None:
        """Raise RecordingError, which names the types and fields, where a writer had another schema."""
        if fingerprint == self.fingerprint:
            return
        try:
            found = differences(json.loads(description), json.loads(self.description))
        except (ValueError, TypeError, AttributeError, RecursionError):
            found = []
        more = f"; and {len(found) - MOST_DIFFERENCES} more" if len(found) > MOST_DIFFERENCES else ""
        raise RecordingError(
            "it was written by a build with other types: "
            + ("; ".join(found[:MOST_DIFFERENCES]) + more or "their description is damaged")
        )

    def _description(self, records: Sequence[RecordNode]) -> dict[str, Any]:
        return {
            "records": {record.text: record.definition() for record in records},
            "enums": {node.text: node.definition() for node in self._enums.values()},
            "roots": {name: node.text for name, node in self._roots.items()},
        }

    # --- from annotations to nodes ---

    def _node(self, hint: Any, place: str) -> TypeNode:
        hint = _expand_alias(hint)
        origin, arguments = typing.get_origin(hint), typing.get_args(hint)
        if hint in _SCALARS:
            return Scalar([_SCALARS[hint]])
        if hint in self._implementations:
            classes = sorted(self._implementations[hint], key=_name)
            return AnyRecord([self._record(cls, place) for cls in classes], f"any {_name(hint)}")
        if origin in (typing.Union, types.UnionType):
            return self._union(arguments, place)
        if origin is Literal:
            return Scalar(sorted({_SCALARS[type(value)] for value in arguments}), arguments)
        if origin is typing.ClassVar or hint is Any:
            raise SchemaError(f"{place}: {hint} cannot be stored; declare what it holds")
        if origin is type:
            return ClassNode([self._record(cls, place) for cls in self._classes(arguments[0], place)])
        if origin in _SEQUENCES:
            return self._sequence(origin, arguments, place)
        if origin in (dict, collections.abc.Mapping):
            key, element = (self._node(each, place) for each in arguments)
            return MappingNode(key, element, mutable=origin is dict)
        if hint in _TYPECODES:
            return ArrayNode(_TYPECODES[hint])
        if origin is np.ndarray:
            (scalar,) = typing.get_args(arguments[1])
            return NumpyArray(np.dtype(scalar).name)
        if hint is complex:
            return Complex()
        if isinstance(hint, type) and issubclass(hint, Enum):
            return self._enums.setdefault(hint, EnumNode(hint, _name(hint)))
        if isinstance(hint, type) and origin is None:
            return self._record(hint, place)
        raise SchemaError(f"{place}: {hint} cannot be stored")

    def _sequence(self, origin: Any, arguments: tuple[Any, ...], place: str) -> TypeNode:
        if origin is tuple and arguments[-1:] != (...,):
            return FixedTuple([self._node(each, place) for each in arguments])
        return TupleNode(self._node(arguments[0], place), list if origin is list else tuple)

    def _classes(self, hint: Any, place: str) -> list[type]:
        if hint in self._implementations:
            return sorted(self._implementations[hint], key=_name)
        found = typing.get_args(hint) or (hint,)
        if not all(isinstance(each, type) for each in found):
            raise SchemaError(f"{place}: type[{hint}] cannot be stored")
        return sorted(found, key=_name)

    def _union(self, arguments: Sequence[Any], place: str) -> TypeNode:
        nodes = [(self._node(each, place), each) for each in arguments if each is not type(None)]
        nodes.sort(key=lambda pair: pair[0].text)
        inner: TypeNode
        if len(nodes) == 1:
            inner = nodes[0][0]
        elif all(isinstance(node, Scalar) for node, _ in nodes):
            return Scalar(sorted({_SCALARS[each] for each in arguments}))
        elif all(isinstance(node, (RecordNode, AnyRecord)) for node, _ in nodes):
            inner = AnyRecord([record for node, _ in nodes for record in _records_of(node)])
        else:
            inner = Choice([node for node, _ in nodes], [typing.get_origin(each) or each for _, each in nodes])
        if len(nodes) == len(arguments):
            return inner
        if isinstance(inner, Scalar):
            return Scalar(sorted({*inner.names, "None"}))
        return Optional(inner)

    def _record(self, cls: type, place: str) -> RecordNode:
        found = self._records.get(cls)
        if found is None:
            if cls.__module__ == "builtins" or getattr(cls, "_is_protocol", False):
                raise SchemaError(f"{place}: {cls} cannot be stored; declare what it holds")
            found = self._records[cls] = RecordNode(cls, _name(cls))
            self._undefined.append(found)
        return found

    def _define(self, record: RecordNode) -> None:
        cls, name = record.cls, record.text
        omitted = self._omitted.get(cls, frozenset())
        slots = _slots(cls)
        fields: Sequence[str]
        if issubclass(cls, tuple) and hasattr(cls, "_fields"):
            hints = _hints(cls)
            fields = cls._fields
            record.build = cls._make  # type: ignore[attr-defined]
        elif dataclasses.is_dataclass(cls):
            hints = _hints(cls)
            fields = [each.name for each in dataclasses.fields(cls) if each.name not in omitted]
            defaults = [each for each in dataclasses.fields(cls) if each.name in omitted]
            record.parts, record.build = _getter(fields), _Rebuild(cls, fields, defaults)
        elif slots and not slots - set(hints := _hints(cls)) and not any(_is_function(hints[each]) for each in slots):
            fields = sorted(slots)
            record.parts, record.build = _getter(fields), _Rebuild(cls, fields)
        else:
            hints = _hints(inspect.getattr_static(cls, "__init__"))
            fields = list(inspect.signature(cls).parameters)
            for each in fields:
                found = inspect.getattr_static(cls, each, None)
                if isinstance(found, property) and found.fget is not None:
                    hints[each] = _hints(found.fget).get("return", Any)
            missing = [each for each in fields if each not in hints]
            if missing:
                raise SchemaError(f"{name}: its constructor's {missing[0]} has no type, so it cannot be stored")
            record.parts, record.build = _getter(fields), _Construct(cls)
            record.constructed = True
        record.define(fields, [self._node(hints[each], f"{name}.{each}") for each in fields])


def _records_of(node: TypeNode) -> Sequence[RecordNode]:
    return node.records if isinstance(node, AnyRecord) else [node] if isinstance(node, RecordNode) else []


def _is_function(hint: Any) -> bool:
    found = (hint, *typing.get_args(hint))
    return any(collections.abc.Callable in (each, typing.get_origin(each)) for each in found)


def _slots(cls: type) -> set[str]:
    return {slot for base in cls.__mro__ for slot in _listed(base.__dict__.get("__slots__", ()))}


def _listed(slots: str | Sequence[str]) -> Sequence[str]:
    return (slots,) if isinstance(slots, str) else slots


def _getter(fields: Sequence[str]) -> Callable[[Any], Sequence[Any]]:
    """Return what takes an instance apart into the values of its fields."""
    if not fields:
        return lambda value: ()
    get = attrgetter(*fields)
    return get if len(fields) > 1 else lambda value: (get(value),)


class _Rebuild:
    """Makes an instance of its fields' values, bit for bit: no constructor has a say in them."""

    def __init__(self, cls: type, fields: Sequence[str], defaults: Sequence[dataclasses.Field[Any]] = ()):
        self._cls, self._fields, self._defaults = cls, tuple(fields), tuple(defaults)

    def __call__(self, values: Sequence[Any]) -> Any:
        made: object = object.__new__(self._cls)
        put = object.__setattr__
        for name, value in zip(self._fields, values, strict=True):
            put(made, name, value)
        for each in self._defaults:
            factory = each.default_factory
            put(made, each.name, each.default if factory is dataclasses.MISSING else factory())
        return made


class _Construct:
    def __init__(self, cls: type):
        self._cls = cls

    def __call__(self, values: Sequence[Any]) -> Any:
        return self._cls(*values)


def differences(then: Any, now: Any) -> list[str]:
    """Return in words what differs between two descriptions: of the writer, and of this build."""
    found = []
    for name, fields in sorted(then["records"].items()):
        ours = now["records"].get(name)
        if ours is None:
            found.append(f"{name}: this build has no such type")
        elif fields != ours:
            found += _field_differences(name, dict(fields), dict(ours))
    found += [f"{name}: the writer had no such type" for name in sorted(now["records"]) if name not in then["records"]]
    for name, members in sorted(then["enums"].items()):
        ours = now["enums"].get(name)
        if ours is not None and members != ours:
            changed = sorted(key for key in {**members, **ours} if members.get(key) != ours.get(key))
            found.append(f"{name}: member {changed[0]} was {members.get(changed[0])}, is {ours.get(changed[0])}")
    for name, text in sorted(then["roots"].items()):
        if now["roots"].get(name) != text:
            found.append(f"{name}: written as {text}, this build has {now['roots'].get(name)}")
    return [each[:LONGEST_DIFFERENCE] for each in found]


def _field_differences(name: str, then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    missing = [f"{name}.{field}: this build has no such field" for field in then if field not in now]
    added = [f"{name}.{field}: the writer had no such field" for field in now if field not in then]
    changed = [
        f"{name}.{field}: written as {text}, this build has {now[field]}"
        for field, text in then.items()
        if field in now and now[field] != text
    ]
    return missing + added + changed or [f"{name}: its fields are in another order"]
