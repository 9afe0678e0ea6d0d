"""Generate the values, the codec and the page of the wire from the .lcm files.

An .lcm file declares a message once: its fields, their meaning (the comment above each) and, in comment lines that
begin with `@`, what Python needs beyond that:

    struct:  @value NAME [tuple]       the value class: a frozen dataclass, or a NamedTuple
             @part                     only a part of other messages: no message of its own
             @codec MODULE [value]     its codec is written by hand in modelserver.wire.MODULE; its value class as well
             @order NAME ...           the order of the fields in the value, where it is another one
             @verify                   `wire.fields.verify_TYPE(value)` checks what concerns several fields
    field:   @as NAME                  its name in the value
             @default EXPRESSION       its default in the value
             @optional                 None in Python where the first number is nan
             @none NUMBER              None in Python for this number
             @enum NAME [PREFIX]       a member of an enumeration, made of the constants above without their prefix
             @flags NAME               a set of flags of `messages.flags`
             @check NAME [ARGUMENTS]   `wire.fields.check_NAME(value, field, ...)` on reading
             @check_all NAME           the same for an array as a whole
             @max NUMBER               of a count: more entries are malformed, and cannot be sent
             @limit NUMBER             of a count: more entries are malformed; a number may be MAX_... of `wire.fields`
             @least NUMBER             of a count: fewer entries are malformed
             @property NAME            of a count: a property of the value has it
             @rows NAME [CLASS]        of a count: arrays of this length are columns; the value has a tuple of rows
             @if_ok NAME               read only if the reply's status is OK, else None

The value has no field for the count of an array. Consecutive fields of fixed size are packed and unpacked together,
those of nested messages included.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

T = TypeVar("T")

CODES: Final = {
    "int8_t": "b",
    "int16_t": "h",
    "int32_t": "i",
    "int64_t": "q",
    "double": "d",
    "float": "f",
    "boolean": "b",
}
SIZES: Final = {"b": 1, "h": 2, "i": 4, "q": 8, "d": 8, "f": 4, "s": 1}
VECTORS: Final = {3: "Vector3", 4: "Quaternion", 9: "Matrix3"}
WIDTH: Final = 120


@dataclass(frozen=True)
class Constant:
    """A constant of a struct."""

    name: str
    value: int
    comment: str


@dataclass(frozen=True)
class Field:
    """A field of a struct, with the constants above it."""

    name: str
    type: str
    dimensions: tuple[str, ...]
    comment: str
    options: Mapping[str, str]
    constants: tuple[Constant, ...]

    @property
    def value_name(self) -> str:
        """Its name in the value."""
        return self.options.get("if_ok") or self.options.get("as") or self.name

    @property
    def is_variable(self) -> bool:
        """Whether its length is another field's value."""
        return any(not each.isdigit() for each in self.dimensions)

    @property
    def size(self) -> int:
        """Number of entries of an array of fixed size, 1 for a scalar."""
        size = 1
        for each in self.dimensions:
            size *= int(each)
        return size


@dataclass(frozen=True)
class Struct:
    """A message type."""

    name: str
    comment: str
    options: Mapping[str, str]
    fields: tuple[Field, ...]

    @property
    def base(self) -> str:
        """Its name without the ending."""
        return self.name.removesuffix("_t")

    @property
    def value(self) -> str:
        """The name of its value class; empty for none."""
        return self.options.get("value", "").partition(" ")[0]

    @property
    def is_tuple(self) -> bool:
        """Whether its value is a NamedTuple."""
        return self.options.get("value", "").endswith(" tuple")

    @property
    def codec(self) -> str:
        """The module of a codec written by hand; empty for a generated one."""
        return self.options.get("codec", "")

    def in_order(self, values: Mapping[str, T]) -> list[T]:
        """Return values by the name of their attribute in the order of the attributes."""
        order = self.options.get("order", "").split()
        return [values[name] for name in order] if order else list(values.values())

    def count_of(self, name: str) -> Field | None:
        """Return the field of that name if it counts the entries of an array."""
        is_counted = any(name in each.dimensions for each in self.fields)
        return next((each for each in self.fields if is_counted and each.name == name), None)

    def columns(self, count: Field) -> list[Field]:
        """Return the arrays whose length is `count`."""
        return [each for each in self.fields if count.name in each.dimensions]


_CONSTANT = re.compile(r"const\s+\w+\s+(\w+)\s*=\s*(-?\d+);")
_FIELD = re.compile(r"(\w+)\s+(\w+)((?:\[\w+\])*);")
_OPTION = re.compile(r"@(\w+)([^@]*)")


def _read_comments(lines: Iterable[str]) -> tuple[str, dict[str, str]]:
    """Return the text and the options of comment lines."""
    text, options = [], {}
    for line in lines:
        if line.startswith("@"):
            options.update((name, argument.strip()) for name, argument in _OPTION.findall(line))
        else:
            text.append(line)
    return "\n".join(text).strip(), options


def parse_struct(text: str, source: str = "") -> Struct:
    """Return the struct that an .lcm file declares.

    Raises ValueError for a line that is none of the grammar, with file and line.
    """
    comments: list[str] = []
    fields: list[Field] = []
    constants: list[Constant] = []
    name, about, options = "", "", {}
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if line.startswith("//"):
            comments.append(line[2:].removeprefix(" "))
            continue
        if found := re.fullmatch(r"struct\s+(\w+)\s*\{?", line):
            name = found[1]
            about, options = _read_comments(comments)
        elif found := _CONSTANT.fullmatch(line):
            constants.append(Constant(found[1], int(found[2]), _read_comments(comments)[0]))
        elif (found := _FIELD.fullmatch(line)) and found[1] != "package":
            comment, own = _read_comments(comments)
            dimensions = tuple(re.findall(r"\[(\w+)\]", found[3]))
            fields.append(Field(found[2], found[1], dimensions, comment, own, tuple(constants)))
            constants = []
        elif line and line not in "{}" and not line.startswith("package "):
            raise ValueError(f"{source}:{number}: {line!r} is no field, constant or comment of a struct")
        if line:
            comments = []
    return Struct(name, about, options, tuple(fields))


def read_structs(folder: Path) -> dict[str, Struct]:
    """Return the structs of the .lcm files in a folder by name."""
    structs = [parse_struct(path.read_text(encoding="utf-8"), str(path)) for path in sorted(folder.glob("*.lcm"))]
    return {each.name: each for each in structs}


# --- values -------------------------------------------------------------------------------------------------


class _Values:
    """Writes the module of value classes and enumerations."""

    def __init__(self, structs: Mapping[str, Struct]) -> None:
        self._structs = structs
        self._written: set[str] = set()
        self.names: list[str] = []

    def write(self) -> str:
        """Return the body of the module."""
        parts: list[str] = []
        for struct in self._structs.values():
            parts += self._write_struct(struct)
        return "\n\n".join(parts)

    def _write_struct(self, struct: Struct) -> list[str]:
        if struct.name in self._written:
            return []
        self._written.add(struct.name)
        parts: list[str] = []
        for each in struct.fields:
            if each.type in self._structs and self._structs[each.type].value:
                parts += self._write_struct(self._structs[each.type])
            parts += self._write_enumeration(each)
        if struct.value and not struct.codec.endswith(" value"):
            parts.append(self._write_class(struct))
        return parts

    def _write_enumeration(self, each: Field) -> list[str]:
        name, _, prefix = each.options.get("enum", "").partition(" ")
        if not each.constants or not name or name in self.names or name == "Status":
            return []
        self.names.append(name)
        lines = [f"class {name}(IntEnum):", _docstring(_first_sentence(each.comment), "    "), ""]
        for constant in each.constants:
            lines.append(f"    {_strip_prefix(constant.name, prefix)} = {constant.value}")
            if constant.comment:
                lines.append(_docstring(constant.comment, "    "))
        return ["\n".join(lines)]

    def _write_class(self, struct: Struct) -> str:
        self.names.append(struct.value)
        parts: list[str] = []
        head = f"class {struct.value}(NamedTuple):" if struct.is_tuple else f"class {struct.value}:"
        lines = [] if struct.is_tuple else ["@dataclass(frozen=True, slots=True)"]
        lines += [head, self._class_docstring(struct), ""]
        for name, annotation, default in self.attributes(struct, parts):
            lines.append(f"    {name}: {annotation}" + (f" = {default}" if default else ""))
        for each in struct.fields:
            if "property" in each.options:
                counted = struct.columns(each)[0].value_name
                lines += ["", "    @property", f"    def {each.options['property']}(self) -> int:"]
                lines += [_docstring(each.comment, "        "), f"        return len(self.{counted})"]
        return "\n\n\n".join([*parts, "\n".join(lines)])

    def _class_docstring(self, struct: Struct) -> str:
        about = struct.comment.strip()
        rows = {each.name for each in struct.fields if "rows" in each.options}
        documented = [
            (each.value_name, each.comment)
            for each in struct.fields
            if struct.count_of(each.name) is None and not rows & set(each.dimensions)
        ]
        lines = [
            f'    """{line}' if number == 0 else f"    {line}".rstrip() for number, line in enumerate(_wrap(about, 113))
        ]
        lines += ["", "    Attributes", "    ----------"]
        for name, comment in documented:
            lines.append(f"    {name}")
            lines += [f"        {line}" for line in _wrap(comment, 112)]
        return "\n".join([*lines, '    """'])

    def attributes(self, struct: Struct, rows: list[str] | None = None) -> list[tuple[str, str, str]]:
        """Return name, annotation and default of each attribute; add the row classes to `rows`."""
        return struct.in_order({each[0]: each for each in self._attributes(struct, rows)})

    def _attributes(self, struct: Struct, rows: list[str] | None) -> Iterator[tuple[str, str, str]]:
        for each in struct.fields:
            count = struct.count_of(each.name)
            if count is not None:
                if "rows" in count.options:
                    name, _, row = count.options["rows"].partition(" ")
                    if row and rows is not None:
                        rows.append(self._write_row(struct, count, row))
                    columns = ", ".join(self.annotation(column, element=True) for column in struct.columns(count))
                    yield name, f"tuple[{row or f'tuple[{columns}]'}, ...]", count.options.get("default", "")
                continue
            if any((dimension := struct.count_of(d)) and "rows" in dimension.options for d in each.dimensions):
                continue
            yield each.value_name, self.annotation(each), self.default(each)

    def _write_row(self, struct: Struct, count: Field, row: str) -> str:
        self.names.append(row)
        lines = ["@dataclass(frozen=True, slots=True)", f"class {row}:"]
        lines += [f'    """One row of `{count.options["rows"].partition(" ")[0]}` of {struct.value}.', ""]
        lines += ["    Attributes", "    ----------"]
        for each in struct.columns(count):
            lines.append(f"    {each.value_name}")
            lines += [f"        {line}" for line in _wrap(each.comment, 112)]
        lines += ['    """', ""]
        for each in struct.columns(count):
            default = self.default(each)
            lines.append(
                f"    {each.value_name}: {self.annotation(each, element=True)}" + (f" = {default}" if default else "")
            )
        return "\n".join(lines)

    def default(self, each: Field) -> str:
        """Return the expression of a field's default, empty for none."""
        if "default" in each.options:
            given = each.options["default"]
            enumeration = each.options.get("enum", "").partition(" ")[0]
            return "NAN" if given == "nan" else f"{enumeration}.{given}" if enumeration and given.isupper() else given
        return "None" if {"optional", "none", "if_ok"} & each.options.keys() and "required" not in each.options else ""

    def annotation(self, each: Field, element: bool = False) -> str:
        """Return the type of a field in Python, of one entry for an `element` of an array."""
        name = self._scalar(each)
        if each.type == "byte":
            return "bytes"
        if each.dimensions and not element:
            if each.is_variable:
                name = f"tuple[{name}, ...]"
            elif name == "float" and each.size in VECTORS and len(each.dimensions) == 1:
                name = VECTORS[each.size]
            else:
                name = f"tuple[{name}, ...]"
        return f"{name} | None" if {"optional", "none", "if_ok"} & each.options.keys() else name

    def _scalar(self, each: Field) -> str:
        if "enum" in each.options or "flags" in each.options:
            return (each.options.get("enum") or each.options["flags"]).partition(" ")[0]
        if each.type in self._structs:
            return self._structs[each.type].value
        return {"boolean": "bool", "string": "str", "double": "float", "float": "float"}.get(each.type, "int")


# --- codec --------------------------------------------------------------------------------------------------


@dataclass
class _Atoms:
    """What a message is made of, in the order of the wire: numbers of fixed size, and expressions of bytes."""

    parts: list[tuple[str, list[str]]] = field(default_factory=list)

    def numbers(self, code: str, expression: str) -> None:
        """Add numbers of fixed size."""
        if self.parts and self.parts[-1][0]:
            last, expressions = self.parts[-1]
            self.parts[-1] = (last + code, [*expressions, expression])
        else:
            self.parts.append((code, [expression]))

    def bytes(self, expression: str) -> None:
        """Add an expression of bytes, or of an unpacked sequence of them."""
        self.parts.append(("", [expression]))


class _Codecs:
    """Writes the module of the codec."""

    def __init__(self, structs: Mapping[str, Struct]) -> None:
        self.structs = structs
        self._formats: dict[str, str] = {}

    def struct_of(self, code: str) -> str:
        """Return the name of the struct.Struct of a format."""
        return self._formats.setdefault(code, f"_S{len(self._formats)}")

    def formats(self) -> str:
        """Return the definitions of the formats that were used."""
        return "\n".join(f'{name} = struct.Struct(">{code}")' for code, name in self._formats.items())

    # writing

    def write_packer(self, struct: Struct) -> str:
        """Return the function that packs a value without the fingerprint."""
        atoms = _Atoms()
        limits: list[str] = []
        self._collect(struct, "value", atoms, limits)
        lines = [
            f"def pack_{struct.base}(value: {struct.value}) -> bytes:",
            f'    """Return the bytes of a {struct.name} without the fingerprint."""',
            *(f"    {limit}" for limit in limits),
        ]
        pieces = []
        for code, expressions in atoms.parts:
            pieces += [f"{self.struct_of(code)}.pack({', '.join(expressions)})"] if code else expressions
        if len(pieces) == 1 and not pieces[0].startswith("*"):
            return "\n".join([*lines, f"    return {pieces[0]}"])
        if len(pieces) <= 12 and not any(piece.startswith("*") for piece in pieces):
            return "\n".join([*lines, f'    return b"{"%b" * len(pieces)}" % ({", ".join(pieces)})'])
        return "\n".join([*lines, f'    return b"".join(({", ".join(pieces)}))'])

    def _collect(self, struct: Struct, value: str, atoms: _Atoms, limits: list[str]) -> None:
        for each in struct.fields:
            count = struct.count_of(each.name)
            if count is not None:
                counted = f"len({self._count_expression(struct, count, value)})"
                if "max" in count.options:
                    limits.append(f'check_outgoing({counted}, {count.options["max"]}, "{count.name}")')
                atoms.numbers(CODES[each.type], counted)
                continue
            self._collect_field(struct, each, value, atoms, limits)

    def _count_expression(self, struct: Struct, count: Field, value: str) -> str:
        if "rows" in count.options:
            return f"{value}.{count.options['rows'].partition(' ')[0]}"
        return f"{value}.{struct.columns(count)[0].value_name}"

    def _collect_field(self, struct: Struct, each: Field, value: str, atoms: _Atoms, limits: list[str]) -> None:
        expression = f"{value}.{each.value_name}"
        rows = next((c for d in each.dimensions if (c := struct.count_of(d)) and "rows" in c.options), None)
        if rows is not None:
            table = self._count_expression(struct, rows, value)
            row = rows.options["rows"].partition(" ")[2]
            number = [other.name for other in struct.columns(rows)].index(each.name)
            expression = (
                f"[each.{each.value_name} for each in {table}]" if row else f"[each[{number}] for each in {table}]"
            )
        if each.type in self.structs:
            self._collect_nested(each, expression, atoms, limits)
        elif each.type == "string":
            atoms.bytes(f"*map(pack_text, {expression})" if each.dimensions else f"pack_text({expression})")
        elif each.type == "byte":
            if each.is_variable:
                atoms.bytes(expression)
            else:
                atoms.numbers(f"{each.size}s", expression)
        elif each.is_variable:
            if "empty_nan" in each.options:
                first = struct.columns(struct.count_of(each.dimensions[0]))[0].value_name  # type: ignore[arg-type]
                atoms.bytes(f"pack_matrix({expression}, len({value}.{first}))")
            else:
                atoms.bytes(f'pack_numbers("{CODES[each.type]}", {expression})')
        elif each.dimensions:
            code = f"{each.size}{CODES[each.type]}"
            atoms.numbers(
                code, f"*({expression} or NAN{each.size})" if "optional" in each.options else f"*{expression}"
            )
        elif "none" in each.options:
            atoms.numbers(CODES[each.type], f"{each.options['none']} if {expression} is None else {expression}")
        else:
            atoms.numbers(CODES[each.type], expression)

    def _collect_nested(self, each: Field, expression: str, atoms: _Atoms, limits: list[str]) -> None:
        nested = self.structs[each.type]
        packer = f"pack_{nested.base}"
        if each.dimensions:
            atoms.bytes(f"*map({packer}, {expression})")
        elif "if_ok" in each.options:
            atoms.bytes(f"NO_{nested.base.upper()} if {expression} is None else {packer}({expression})")
        elif nested.codec:
            atoms.bytes(f"{packer}({expression})")
        else:
            self._collect(nested, expression, atoms, limits)

    # reading

    def write_unpacker(self, struct: Struct) -> str:
        """Return the function that unpacks a value from where its fields begin."""
        reader = _Reader(self)
        result = reader.read_struct(struct, "")
        reader.flush()
        if "verify" in struct.options:
            result = f"verify_{struct.base}({result})"
        lines = [
            f"def unpack_{struct.base}(data: bytes, at: int) -> tuple[{struct.value}, int]:",
            f'    """Return the {struct.name} that begins at `at`, and its end. Raises WireError, struct.error."""',
            *(f"    {line}" for line in reader.lines),
            f"    return {result}, {reader.position()}",
        ]
        return "\n".join(lines)


class _Reader:
    """Writes the statements that read one message."""

    def __init__(self, codecs: _Codecs) -> None:
        self._codecs = codecs
        self.lines: list[str] = []
        self._pending: list[tuple[str, str]] = []  # code and name of numbers of fixed size
        self._offset = 0
        self._names: dict[str, str] = {}

    def position(self) -> str:
        """Return the expression of where the next field begins."""
        return f"at + {self._offset}" if self._offset else "at"

    def flush(self) -> None:
        """Write the reading of the numbers that wait."""
        if not self._pending:
            return
        code = "".join(code for code, _ in self._pending)
        targets = []
        for each, name in self._pending:
            found = re.fullmatch(r"(\d+)([a-z])", each)
            if found and found[2] != "s":
                targets += [f"{name}_{n}" for n in range(int(found[1]))] if int(found[1]) <= 9 else [f"*{name}"]
            else:
                targets.append(name)
        left = ", ".join(targets)
        comma = "," if len(targets) == 1 else ""
        self.lines.append(f"{left}{comma} = {self._codecs.struct_of(code)}.unpack_from(data, {self.position()})")
        self._offset += sum(
            (int(found[1]) if found[1] else 1) * SIZES[found[2]] for found in re.finditer(r"(\d*)([a-z])", code)
        )
        self._pending = []

    def _settle(self) -> str:
        """Flush; return the expression of the position, which starts again at 0."""
        self.flush()
        position, self._offset = self.position(), 0
        return position

    def read_struct(self, struct: Struct, prefix: str) -> str:
        """Write the reading of a struct; return the expression of its value."""
        arguments: dict[str, str] = {}
        tables: dict[str, list[str]] = {}
        status = ""
        for each in struct.fields:
            name = f"{prefix}{each.name}" + ("_" if each.name in ("at", "data") else "")
            count = struct.count_of(each.name)
            if count is not None:
                self._pending.append((CODES[each.type], name))
                self.flush()
                limit = count.options.get("max") or count.options.get("limit")
                most = f", {limit}" if limit else ""
                most += f", {count.options['least']}" if "least" in count.options else ""
                self.lines.append(f'check_count({name}, "{each.name}"{most})')
                if "rows" in count.options:
                    tables[each.name] = []
                    arguments[count.options["rows"].partition(" ")[0]] = f"@{each.name}"
                continue
            rows = next((d for d in each.dimensions if d in tables), "")
            value = self._read_field(struct, each, name, prefix, status)
            if rows:
                tables[rows].append(value)
            else:
                arguments[each.value_name] = value
            if each.type == "reply_header_t":
                status = f"{name}.status"
        made = []
        for argument in struct.in_order(arguments):
            if argument.startswith("@"):
                count = struct.count_of(argument[1:])
                assert count is not None
                row = count.options["rows"].partition(" ")[2]
                columns = ", ".join(tables[argument[1:]])
                made.append(f"tuple(map({row}, {columns}))" if row else f"tuple(zip({columns}, strict=True))")
            else:
                made.append(argument)
        return f"{struct.value}({', '.join(made)})"

    def _read_field(self, struct: Struct, each: Field, name: str, prefix: str, status: str) -> str:
        if each.type in self._codecs.structs:
            return self._read_nested(self._codecs.structs[each.type], each, name, prefix, status)
        if each.type == "string":
            if each.dimensions:
                position = self._settle()
                self.lines.append(f"{name}, at = read_texts(data, {position}, {prefix}{each.dimensions[0]})")
                return self._check_expression(each, name, plural=True)
            position = self._settle()
            self.lines.append(f"{name}, at = read_text(data, {position})")
            return self._check_expression(each, name)
        if each.is_variable:
            count = f"{prefix}{each.dimensions[0]}"
            position = self._settle()
            if each.type == "byte":
                self.lines.append(f"{name}, at = read_bytes(data, {position}, {count})")
                return name
            total = " * ".join(f"{prefix}{d}" for d in each.dimensions)
            self.lines.append(f'{name}, at = read_numbers("{CODES[each.type]}", data, {position}, {total})')
            if "enum" in each.options:
                enumeration = each.options["enum"].partition(" ")[0]
                return f'[read_enum({enumeration}, each, "{each.name}") for each in {name}]'
            if "empty_nan" in each.options:
                return f"() if {name} and {name}[0] != {name}[0] else {name}"
            return self._check_expression(each, name, plural=True)
        if each.dimensions:
            if each.type == "byte":
                self._pending.append((f"{each.size}s", name))
                return name
            self._pending.append((f"{each.size}{CODES[each.type]}", name))
            if each.size <= 9:
                numbers = [f"{name}_{n}" for n in range(each.size)]
                value = f"({', '.join(numbers)})"
                if "optional" in each.options:
                    known = f"read_{VECTORS[each.size].lower()}({value})"
                    if "check" not in each.options:
                        return known
                    return f"None if ({name} := {known}) is None else {self._check_expression(each, name)}"
                return self._check_expression(each, value)
            # a star takes the rest: nothing may follow it in the same reading
            self.flush()
            if "optional" in each.options:
                return f"None if {name}[0] != {name}[0] else {self._check_expression(each, f'tuple({name})')}"
            return self._check_expression(each, f"tuple({name})")
        self._pending.append((CODES[each.type], name))
        if "none" in each.options:
            return f"None if {name} == {each.options['none']} else {self._scalar(each, name)}"
        return self._scalar(each, name)

    def _scalar(self, each: Field, name: str) -> str:
        if "enum" in each.options:
            enumeration = each.options["enum"].partition(" ")[0]
            return f'read_enum({enumeration}, {name}, "{each.name}")'
        if "flags" in each.options:
            return f"{each.options['flags']}({name})"
        if each.type == "boolean":
            return f"bool({name})"
        return self._check_expression(each, name)

    @staticmethod
    def _check_expression(each: Field, value: str, plural: bool = False) -> str:
        if "check_all" in each.options:
            return f'check_{each.options["check_all"]}({value}, "{each.name}")'
        if "check" not in each.options:
            return value
        check, _, more = each.options["check"].partition(" ")
        arguments = f', "{each.name}"' + (f", {', '.join(more.split())}" if more else "")
        if plural:
            return f"tuple([check_{check}(each{arguments}) for each in {value}])"
        return f"check_{check}({value}{arguments})"

    def _read_nested(self, nested: Struct, each: Field, name: str, prefix: str, status: str) -> str:
        unpacker = f"unpack_{nested.base}"
        if each.dimensions:
            position = self._settle()
            self.lines.append(f"{name}, at = read_each({unpacker}, data, {position}, {prefix}{each.dimensions[0]})")
            return name
        if "if_ok" in each.options:
            position = self._settle()
            self.lines.append(f"if {status} is Status.OK:")
            self.lines.append(f"    {name}, at = {unpacker}(data, {position})")
            self.lines.append("else:")
            self.lines.append(f"    {name}, at = None, skip_{nested.base}(data, {position})")
            return name
        if nested.codec:
            position = self._settle()
            self.lines.append(f"{name}, at = {unpacker}(data, {position})")
            return name
        value = self.read_struct(nested, f"{name}_")
        if "verify" in nested.options:
            value = f"verify_{nested.base}({value})"
        return value


# --- text ---------------------------------------------------------------------------------------------------


def _strip_prefix(name: str, prefix: str) -> str:
    """Return a constant's name without the prefix; with it where only a number would be left."""
    stripped = name.removeprefix(prefix)
    return stripped if stripped.isidentifier() else name


def _first_sentence(text: str) -> str:
    return " ".join(text.split()).partition(": one of")[0].partition(". ")[0].rstrip(".:") + "."


def _wrap(text: str, width: int) -> list[str]:
    """Return the lines of a text; paragraphs and indented blocks stay."""
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        lines += [*textwrap.wrap(" ".join(paragraph.split()), width), ""] if paragraph else [""]
    return lines[:-1]


def _docstring(text: str, indent: str) -> str:
    lines = _wrap(text.strip(), WIDTH - len(indent) - 6)
    if len(lines) == 1:
        return f'{indent}"""{lines[0]}"""'
    return "\n".join([f'{indent}"""{lines[0]}', *(f"{indent}{line}".rstrip() for line in lines[1:]), f'{indent}"""'])


def generate(folder: Path, fingerprints: Mapping[str, str]) -> dict[str, str]:
    """Return the text of each generated module by its path in the repository, not formatted yet.

    Parameters
    ----------
    folder
        Where the .lcm files are.
    fingerprints
        Of each type, in hexadecimal.
    """
    structs = read_structs(folder)
    values = _Values(structs)
    return {
        "modelserver/messages/generated.py": _values_module(values.write()),
        "modelserver/wire/generated.py": _codec_module(structs, {*values.names, *HAND_VALUES}, fingerprints),
    }


def _values_module(body: str) -> str:
    # the formatter removes the imports that are not used
    return (
        '"""Values of the messages. Generated from lcmtypes/*.lcm by `make types`; do not edit."""\n\n'
        "from __future__ import annotations\n\n"
        "from dataclasses import dataclass\nfrom enum import IntEnum\nfrom typing import NamedTuple\n\n"
        "from modelserver.errors import Status\n"
        "from modelserver.messages.answers import PoseAnswer\n"
        "from modelserver.messages.flags import NAN, NO_FLAGS, VALID, Invalid, Quality\n"
        "from modelserver.transforms.so3 import Matrix3, Quaternion, Vector3\n\n"
        f"\n{body}\n"
    )


HAND_VALUES: Final = ("Invalid", "Quality")
"""Flags that no .lcm file declares."""

_WORD: Final = re.compile(r"\b[A-Za-z]\w+\b")
_HELPER: Final = re.compile(r"(check|verify|read|pack)_[a-z_0-9]+|NAN\d+|MAX_[A-Z_]+|Codec")


def _codec_module(structs: Mapping[str, Struct], names: set[str], fingerprints: Mapping[str, str]) -> str:
    codecs = _Codecs(structs)
    functions: list[str] = []
    table: list[str] = []
    of_module: dict[str, set[str]] = {}
    for each in structs.values():
        if not each.value:
            continue
        names.add(each.value)
        if each.codec:
            by_hand = {f"{verb}_{each.base}" for verb in ("pack", "unpack", "skip")} | {f"NO_{each.base.upper()}"}
            of_module.setdefault(each.codec.partition(" ")[0], set()).update(by_hand)
        else:
            functions += [codecs.write_packer(each), codecs.write_unpacker(each)]
        if "part" not in each.options:
            row = (
                f'"{each.name}"',
                f'FINGERPRINTS["{each.name}"]',
                each.value,
                f"pack_{each.base}",
                f"unpack_{each.base}",
            )
            table.append(f"    Codec({', '.join(row)}),")
    body = "\n\n\n".join([*functions, "\n".join(["CODECS = (", *table, ")"])])
    used = set(_WORD.findall(body))
    here = {f"{verb}_{each.base}" for verb in ("pack", "unpack") for each in structs.values()}
    of_module["fields"] = {word for word in used if _HELPER.fullmatch(word)} - here
    imports = "".join(
        f"from modelserver.wire.{module} import {', '.join(sorted(wanted & used))}\n"
        for module, wanted in sorted(of_module.items())
    )
    numbers = "\n".join(f'    "{name}": bytes.fromhex("{fingerprints[name]}"),' for name in sorted(fingerprints))
    return (
        '"""Codec of the messages. Generated from lcmtypes/*.lcm by `make types`; do not edit."""\n\n'
        "from __future__ import annotations\n\n"
        "import struct\nfrom collections.abc import Mapping\nfrom typing import Final\n\n"
        "from modelserver.errors import Status\n"
        f"from modelserver.messages import {', '.join(sorted(names & used))}\n"
        f"{imports}\nFINGERPRINTS: Final[Mapping[str, bytes]] = {{\n{numbers}\n}}\n"
        f'"""Of the wire types, as lcm-gen computes them."""\n\n{codecs.formats()}\n\n\n{body}\n'
    )
