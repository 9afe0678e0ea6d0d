"""Generate the values, the codec and the page of the wire from the .lcm files.

An .lcm file declares a message once: its fields, their meaning (the comment above each) and, in comment lines that
begin with `@`, what Python needs beyond that:

    struct:  @value NAME [tuple]       the value class: a frozen dataclass, or a NamedTuple
             @part                     only a part of other messages: no message of its own
             @codec fields [value]     its codec is written by hand in modelserver.wire.fields; its value class as well
             @answer NAME TEXT         of a reply: what is behind the header is a value of its own, None unless it is OK
             @order NAME ...           the order of the fields in the value, where it is another one
             @verify                   `wire.fields.verify_TYPE(value)` checks what concerns several fields
    field:   @as NAME                  its name in the value
             @of EXPRESSION [CLASS]    a part of an attribute, which is a CLASS or a tuple of such parts
             @pose                     seven numbers that are a Pose
             @word                     a str, the name of one of the constants above it, which count from 0
             @default EXPRESSION       its default in the value
             @optional                 None in Python where the first number is nan
             @partial                  with @optional, of three numbers: None only where all are nan
             @none NUMBER              None in Python for this number
             @enum NAME [PREFIX]       a member of an enumeration, made of the constants above without their prefix
             @flags NAME               a set of flags of `messages.values`
             @check NAME [ARGUMENTS]   `wire.fields.check_NAME(value, field, ...)` on reading
             @check_all NAME           the same for an array as a whole
             @max NUMBER               of a count: more entries are malformed, and cannot be sent
             @limit NUMBER             of a count: more entries are malformed; a number may be MAX_... of `wire.fields`
             @least NUMBER             of a count: fewer entries are malformed
             @property NAME            of a count: a property of the value has it
             @rows NAME [CLASS]        of a count: arrays of this length are columns; the value has a tuple of rows
             @triangle COUNT           of a count: the lower triangle of a matrix of so many rows
             @empty_nan                an empty tuple in Python where the first number is nan
             @if_ok NAME               read only if the reply's status is OK, else None

The value has no field for the count of an array. Consecutive fields of fixed size are packed and unpacked together,
those of nested messages included.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

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
        return self.options.get("if_ok") or self.options.get("as") or re.split(r"\W", self.of)[0] or self.name

    @property
    def of(self) -> str:
        """Where it is in an attribute, and the class of the attribute; empty for an attribute of its own."""
        return self.options.get("of", "")

    @property
    def rows(self) -> str:
        """Of a count, the attribute that has the arrays as its columns; empty for none."""
        return self.options.get("rows", "").partition(" ")[0]

    @property
    def words(self) -> str:
        return f"{self.name.upper()}_WORDS"

    @property
    def is_optional(self) -> bool:
        """Whether it may be None in Python."""
        return not {"optional", "none", "if_ok"}.isdisjoint(self.options)

    @property
    def is_variable(self) -> bool:
        """Whether its length is another field's value."""
        return any(not each.isdigit() for each in self.dimensions)

    @property
    def size(self) -> int:
        """Number of entries of an array of fixed size, 1 for a scalar."""
        return math.prod(map(int, self.dimensions))


@dataclass(frozen=True)
class Struct:
    """A message type."""

    name: str
    comment: str
    options: Mapping[str, str]
    fields: tuple[Field, ...]

    @property
    def base(self) -> str:
        return self.name.removesuffix("_t")

    @property
    def value(self) -> str:
        """The name of its value class; empty for none."""
        return self.options.get("value", "").partition(" ")[0]

    @property
    def is_tuple(self) -> bool:
        return self.options.get("value", "").endswith(" tuple")

    @property
    def codec(self) -> str:
        """The module of a codec written by hand; empty for a generated one."""
        return self.options.get("codec", "")

    @property
    def order(self) -> list[str]:
        """The attributes in their order, empty for that of the fields."""
        return self.options.get("order", "").split()

    def count_of(self, name: str) -> Field | None:
        is_counted = any(name in each.dimensions for each in self.fields)
        return next((each for each in self.fields if is_counted and each.name == name), None)

    @property
    def answer(self) -> Struct | None:
        """Of a reply, what is behind its header, if that is a value of its own."""
        name, _, about = self.options.get("answer", "").partition(" ")
        return Struct(self.name, about, {"value": f"{name} tuple"}, self.fields[1:]) if name else None

    def columns(self, count: Field) -> list[Field]:
        return [each for each in self.fields if count.name in each.dimensions]


_CONSTANT = re.compile(r"const\s+\w+\s+(\w+)\s*=\s*(-?\d+);")
_FIELD = re.compile(r"(\w+)\s+(\w+)((?:\[\w+\])*);")
_OPTION = re.compile(r"@(\w+)([^@]*)")


def _read_comments(lines: Iterable[str]) -> tuple[str, dict[str, str]]:
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
            parts += self._write_classes(struct)
        return parts

    def _write_enumeration(self, each: Field) -> list[str]:
        name, _, prefix = each.options.get("enum", "").partition(" ")
        if not each.constants or not name or name in self.names or name == "Status":
            return []
        self.names.append(name)
        about = each.comment.partition(": one of")[0].partition(". ")[0].rstrip(".:")
        lines = [f"class {name}(IntEnum):", _docstring(f"{about}."), ""]
        for constant in each.constants:
            # with the prefix where only a number would be left
            plain = constant.name.removeprefix(prefix)
            lines.append(f"    {plain if plain.isidentifier() else constant.name} = {constant.value}")
        return ["\n".join(lines)]

    def _write_classes(self, struct: Struct) -> list[str]:
        """Return the class of a struct, behind those of its rows and of its answer."""
        parts: list[str] = []
        attributes = dict[str, tuple[str, str]]()
        answer = struct.answer
        for each in struct.fields:
            count = struct.count_of(each.name)
            if answer is not None and each in answer.fields:
                continue
            if count is not None and "rows" in count.options:
                name, _, row = count.options["rows"].partition(" ")
                columns = struct.columns(count)
                if row:
                    entries = [
                        (each.value_name, self.annotation(each, element=True), self.default(each)) for each in columns
                    ]
                    parts.append(self._write_class(row, False, f"One row of `{name}` of {struct.value}.", entries))
                element = row or f"tuple[{', '.join(self.annotation(column, element=True) for column in columns)}]"
                attributes[name] = (f"tuple[{element}, ...]", count.options.get("default", ""))
            elif count is None and not any((rows := struct.count_of(one)) and rows.rows for one in each.dimensions):
                name = each.value_name
                kind = each.of.partition(" ")[2] or self.annotation(each)
                if name in attributes and not each.of.endswith(kind):
                    kind = f"tuple[{attributes[name][0]}, {kind}]"
                attributes[name] = (kind, self.default(each))
        if answer is not None:
            parts += self._write_classes(answer)
            attributes["answer"] = (f"{answer.value} | None", "None")
        ordered = [(name, *attributes[name]) for name in struct.order or attributes]
        lines = [self._write_class(struct.value, struct.is_tuple, struct.comment, ordered)]
        for each in struct.fields:
            if "property" in each.options:
                counted = struct.columns(each)[0].value_name
                lines += ["", "    @property", f"    def {each.options['property']}(self) -> int:"]
                lines.append(f"        return len(self.{counted})")
        return [*parts, "\n".join(lines)]

    def _write_class(self, name: str, is_tuple: bool, text: str, attributes: Iterable[tuple[str, str, str]]) -> str:
        self.names.append(name)
        lines = [f"class {name}(NamedTuple):" if is_tuple else f"@dataclass(frozen=True, slots=True)\nclass {name}:"]
        lines += [_docstring(text), ""]
        lines += [f"    {each}: {kind}" + (f" = {default}" if default else "") for each, kind, default in attributes]
        return "\n".join(lines)

    def default(self, each: Field) -> str:
        """Return the expression of a field's default, empty for none."""
        if "default" in each.options:
            given = each.options["default"]
            enumeration = each.options.get("enum", "").partition(" ")[0]
            return "NAN" if given == "nan" else f"{enumeration}.{given}" if enumeration and given.isupper() else given
        return "None" if each.is_optional else ""

    def annotation(self, each: Field, element: bool = False) -> str:
        """Return the type of a field in Python, of one entry for an `element` of an array."""
        name = self._scalar(each)
        if each.type == "byte":
            return "bytes"
        if each.dimensions and not element and "pose" not in each.options:
            is_vector = name == "float" and len(each.dimensions) == 1 and not each.is_variable and each.size in VECTORS
            name = VECTORS[each.size] if is_vector else f"tuple[{name}, ...]"
        return f"{name} | None" if each.is_optional else name

    def _scalar(self, each: Field) -> str:
        if "enum" in each.options or "flags" in each.options:
            return (each.options.get("enum") or each.options["flags"]).partition(" ")[0]
        if each.type in self._structs:
            return self._structs[each.type].value
        if "word" in each.options or "pose" in each.options:
            return "str" if "word" in each.options else "Pose"
        return {"boolean": "bool", "string": "str", "double": "float", "float": "float"}.get(each.type, "int")


# --- codec --------------------------------------------------------------------------------------------------

Atom: TypeAlias = tuple[str, str]
"""A part of a message: a struct code and the expression of its numbers; an empty code for an expression of bytes."""


class _Codecs:
    """Writes the module of the codec."""

    def __init__(self, structs: Mapping[str, Struct]) -> None:
        self.structs = structs
        self._formats: dict[str, str] = {}

    def struct_of(self, code: str) -> str:
        return self._formats.setdefault(code, f"_S{len(self._formats)}")

    def formats(self) -> str:
        return "\n".join(f'{name} = struct.Struct(">{code}")' for code, name in self._formats.items())

    def write_constants(self, struct: Struct) -> list[str]:
        """Return the words of fields that are words in Python, and the bytes in place of an answer."""
        lines = [
            f"{each.words} = {tuple(constant.name.lower() for constant in each.constants)}"
            for each in struct.fields
            if "word" in each.options
        ]
        if struct.answer is not None:
            pieces = [self._write_nothing(each) for each in struct.answer.fields if not each.is_variable]
            lines.append(f"NO_{struct.base.upper()} = {' + '.join(pieces)}")
        return lines

    def _write_nothing(self, each: Field) -> str:
        if each.type in self.structs:
            return f"NO_{self.structs[each.type].base.upper()}"
        return 'pack_text("")' if each.type == "string" else f"bytes({each.size * SIZES[CODES[each.type]]})"

    # writing

    def write_packer(self, struct: Struct) -> str:
        """Return the function that packs a value without the fingerprint."""
        atoms: list[Atom] = []
        limits: list[str] = []
        if struct.answer is None:
            self._collect(struct, "value", atoms, limits)
        else:
            atoms.append(("", "pack_reply_header(value.header)"))
            nothing = f"pack_reply_header(value.header) + NO_{struct.base.upper()}"
            limits += ["if value.answer is None:", f"    return {nothing}"]
            self._collect(struct.answer, "value.answer", atoms, limits)
        lines = [
            f"def pack_{struct.base}(value: {struct.value}) -> bytes:",
            f'    """Return the bytes of a {struct.name} without the fingerprint."""',
            *(f"    {limit}" for limit in limits),
        ]
        pieces: list[str] = []
        for has_code, group in itertools.groupby(atoms, lambda atom: bool(atom[0])):
            codes, expressions = zip(*group, strict=True)
            pieces += [f"{self.struct_of(''.join(codes))}.pack({', '.join(expressions)})"] if has_code else expressions
        if len(pieces) == 1 and not pieces[0].startswith("*"):
            return "\n".join([*lines, f"    return {pieces[0]}"])
        if len(pieces) <= 12 and not any(piece.startswith("*") for piece in pieces):
            return "\n".join([*lines, f'    return b"{"%b" * len(pieces)}" % ({", ".join(pieces)})'])
        return "\n".join([*lines, f'    return b"".join(({", ".join(pieces)}))'])

    def _collect(self, struct: Struct, value: str, atoms: list[Atom], limits: list[str]) -> None:
        for each in struct.fields:
            count = struct.count_of(each.name)
            if count is None:
                self._collect_field(struct, each, value, atoms, limits)
                continue
            counted = self._length(struct, count, value)
            if "max" in count.options:
                limits.append(f'check_outgoing({counted}, {count.options["max"]}, "{count.name}")')
            atoms.append((CODES[each.type], counted))

    def _length(self, struct: Struct, count: Field, value: str) -> str:
        if "triangle" in count.options:
            rows = self._triangle_rows(struct, count, value)
            return f"{rows} * ({rows} + 1) // 2"
        return f"len({value}.{count.rows or struct.columns(count)[0].value_name})"

    def _triangle_rows(self, struct: Struct, count: Field, value: str) -> str:
        rows = struct.count_of(count.options["triangle"])
        assert rows is not None
        return self._length(struct, rows, value)

    def _collect_field(self, struct: Struct, each: Field, value: str, atoms: list[Atom], limits: list[str]) -> None:
        expression = f"{value}.{each.of.partition(' ')[0] or each.value_name}"
        count = struct.count_of(each.dimensions[0]) if each.dimensions else None
        if count is not None and count.rows:
            number = [other.name for other in struct.columns(count)].index(each.name)
            entry = f"each.{each.value_name}" if " " in count.options["rows"] else f"each[{number}]"
            expression = f"[{entry} for each in {value}.{count.rows}]"
        code = CODES.get(each.type, "")
        if each.type in self.structs:
            self._collect_nested(each, expression, atoms, limits)
        elif each.type == "string":
            atoms.append(("", f"*map(pack_text, {expression})" if each.dimensions else f"pack_text({expression})"))
        elif each.type == "byte":
            atoms.append(("", expression) if count is not None else (f"{each.size}s", expression))
        elif count is not None:
            if "triangle" in count.options:
                atoms.append(("", f"pack_triangle({expression}, {self._triangle_rows(struct, count, value)})"))
            elif "empty_nan" in each.options:
                atoms.append(("", f"pack_matrix({expression}, {self._length(struct, count, value)})"))
            else:
                is_first = count.rows or struct.columns(count)[0] is each
                more = "" if is_first else f", {self._length(struct, count, value)}"
                atoms.append(("", f'pack_numbers("{code}", {expression}{more})'))
        elif "pose" in each.options:
            atoms.append((f"{each.size}{code}", f"*{expression}.xyz, *{expression}.wxyz"))
        elif each.dimensions:
            may_lack = {"optional", "empty_nan"} & each.options.keys()
            atoms.append((f"{each.size}{code}", f"*({expression} or NAN{each.size})" if may_lack else f"*{expression}"))
        elif "word" in each.options:
            atoms.append((code, f"{each.words}.index({expression})"))
        elif "none" in each.options:
            atoms.append((code, f"{each.options['none']} if {expression} is None else {expression}"))
        else:
            atoms.append((code, expression))

    def _collect_nested(self, each: Field, expression: str, atoms: list[Atom], limits: list[str]) -> None:
        nested = self.structs[each.type]
        packer = f"pack_{nested.base}"
        if each.dimensions:
            atoms.append(("", f"*map({packer}, {expression})"))
        elif "if_ok" in each.options:
            atoms.append(("", f"NO_{nested.base.upper()} if {expression} is None else {packer}({expression})"))
        elif nested.codec:
            atoms.append(("", f"{packer}({expression})"))
        else:
            self._collect(nested, expression, atoms, limits)

    # reading

    def write_unpacker(self, struct: Struct) -> str:
        """Return the function that unpacks a value from where its fields begin."""
        reader = _Reader(self)
        if struct.answer is None:
            result = reader.read_struct(struct, "")
        else:
            nothing = f"NO_{struct.base.upper()}"
            reader.lines += ["header, at = unpack_reply_header(data, at)", "if header.status is not Status.OK:"]
            reader.lines.append(f"    return {struct.value}(header), skip_nothing(data, at, {nothing})")
            result = f"{struct.value}(header, {reader.read_struct(struct.answer, '')})"
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

    def position(self) -> str:
        return f"at + {self._offset}" if self._offset else "at"

    def flush(self) -> None:
        """Write the reading of the numbers that wait."""
        if not self._pending:
            return
        targets, begin = [], self.position()
        for code, name in self._pending:
            size = int(code[:-1] or 1)
            self._offset += size * SIZES[code[-1]]
            if len(code) == 1 or code[-1] == "s":
                targets.append(name)
            else:
                targets += [f"{name}_{n}" for n in range(size)] if size <= 9 else [f"*{name}"]
        unpacker = self._codecs.struct_of("".join(code for code, _ in self._pending))
        comma = "," if len(targets) == 1 else ""
        self.lines.append(f"{', '.join(targets)}{comma} = {unpacker}.unpack_from(data, {begin})")
        self._pending = []

    def _settle(self) -> str:
        """Flush; return the expression of the position, which starts again at 0."""
        self.flush()
        position, self._offset = self.position(), 0
        return position

    def _read(self, name: str, function: str, more: str = "") -> str:
        """Write the reading of a part of any length; return its name. `function` is a call up to the data."""
        self.lines.append(f"{name}, at = {function}data, {self._settle()}{more})")
        return name

    def read_struct(self, struct: Struct, prefix: str) -> str:
        """Write the reading of a struct; return the expression of its value."""
        arguments: dict[str, str] = {}
        parts: dict[str, list[str]] = {}
        status = ""
        for each in struct.fields:
            name = f"{prefix}{each.name}" + ("_" if each.name in ("at", "data") else "")
            if struct.count_of(each.name) is not None:
                self._read_count(each, name, prefix)
                continue
            value = self._read_field(struct, each, name, prefix, status)
            count = struct.count_of(each.dimensions[0]) if each.dimensions else None
            if count is not None and count.rows:
                columns = parts.setdefault(count.rows, [])
                columns.append(value)
                row = count.options["rows"].partition(" ")[2]
                table = ", ".join(columns)
                arguments[count.rows] = f"tuple(map({row}, {table}))" if row else f"tuple(zip({table}, strict=True))"
            elif each.of:
                of_value = parts.setdefault(each.value_name, [])
                of_value.append(value)
                arguments[each.value_name] = f"{each.of.partition(' ')[2]}({', '.join(of_value)})"
            else:
                arguments[each.value_name] = value
            if each.type == "reply_header_t":
                status = f"{name}.status"
        return f"{struct.value}({', '.join(arguments[name] for name in struct.order or arguments)})"

    def _read_count(self, each: Field, name: str, prefix: str) -> None:
        self._pending.append((CODES[each.type], name))
        self.flush()
        bounds = [each.options[name] for name in ("max", "limit", "least") if name in each.options]
        if "triangle" in each.options:
            rows = f"{prefix}{each.options['triangle']}"
            bounds = [f"{rows} * ({rows} + 1) // 2"] * 2
        arguments = ", ".join([name, f'"{each.name}"', *bounds])
        self.lines.append(f"check_count({arguments})")

    def _read_field(self, struct: Struct, each: Field, name: str, prefix: str, status: str) -> str:
        if each.type in self._codecs.structs:
            return self._read_nested(self._codecs.structs[each.type], each, name, prefix, status)
        count = f"{prefix}{each.dimensions[0]}" if each.is_variable else ""
        if each.type == "string":
            self._read(name, *(("read_each(read_text, ", f", {count}") if count else ("read_text(",)))
            return self._check_expression(each, name, plural=bool(count))
        if count:
            if each.type == "byte":
                return self._read(name, "read_bytes(", f", {count}")
            total = " * ".join(f"{prefix}{d}" for d in each.dimensions)
            self._read(name, f'read_numbers("{CODES[each.type]}", ', f", {total}")
            counting = struct.count_of(each.dimensions[0])
            if counting is not None and "triangle" in counting.options:
                return f"read_triangle({name}, {prefix}{counting.options['triangle']})"
            if "enum" in each.options:
                enumeration = each.options["enum"].partition(" ")[0]
                return f'[read_enum({enumeration}, each, "{each.name}") for each in {name}]'
            if "empty_nan" in each.options:
                return f"() if {name} and {name}[0] != {name}[0] else {name}"
            return self._check_expression(each, name, plural=True)
        if each.type == "byte":
            self._pending.append((f"{each.size}s", name))
            return name
        if each.dimensions:
            return self._read_array(each, name)
        self._pending.append((CODES[each.type], name))
        if "none" in each.options:
            return f"None if {name} == {each.options['none']} else {self._scalar(each, name)}"
        return self._scalar(each, name)

    def _read_array(self, each: Field, name: str) -> str:
        """Read numbers of fixed size."""
        self._pending.append((f"{each.size}{CODES[each.type]}", name))
        if each.size > 9:
            # a star takes the rest: nothing may follow it in the same reading
            self.flush()
            whole = self._check_expression(each, f"tuple({name})")
            absent = "None" if "optional" in each.options else "()" if "empty_nan" in each.options else ""
            return f"{absent} if {name}[0] != {name}[0] else {whole}" if absent else whole
        numbers = [f"{name}_{n}" for n in range(each.size)]
        if "pose" in each.options:
            return f"Pose(({', '.join(numbers[:3])}), ({', '.join(numbers[3:])}))"
        value = f"({', '.join(numbers)})"
        if "optional" not in each.options:
            return self._check_expression(each, value)
        known = f"read_{'partial' if 'partial' in each.options else 'known'}({value})"
        if "check" not in each.options:
            return known
        return f"None if ({name} := {known}) is None else {self._check_expression(each, name)}"

    def _scalar(self, each: Field, name: str) -> str:
        if "enum" in each.options:
            return f'read_enum({each.options["enum"].partition(" ")[0]}, {name}, "{each.name}")'
        if "word" in each.options:
            return f'read_word({each.words}, {name}, "{each.name}")'
        if "flags" in each.options:
            return f"{each.options['flags']}({name})"
        return f"bool({name})" if each.type == "boolean" else self._check_expression(each, name)

    @staticmethod
    def _check_expression(each: Field, value: str, plural: bool = False) -> str:
        if "check_all" in each.options:
            return f'check_{each.options["check_all"]}({value}, "{each.name}")'
        if "check" not in each.options:
            return value
        check, *more = each.options["check"].split()
        arguments = ", ".join([f'"{each.name}"', *more])
        if plural:
            return f"tuple([check_{check}(each, {arguments}) for each in {value}])"
        return f"check_{check}({value}, {arguments})"

    def _read_nested(self, nested: Struct, each: Field, name: str, prefix: str, status: str) -> str:
        unpacker = f"unpack_{nested.base}"
        if each.dimensions:
            return self._read(name, f"read_each({unpacker}, ", f", {prefix}{each.dimensions[0]}")
        if "if_ok" in each.options:
            position = self._settle()
            self.lines += [f"if {status} is Status.OK:", f"    {name}, at = {unpacker}(data, {position})", "else:"]
            self.lines.append(f"    {name}, at = None, skip_{nested.base}(data, {position})")
            return name
        if nested.codec:
            return self._read(name, f"{unpacker}(")
        value = self.read_struct(nested, f"{name}_")
        return f"verify_{nested.base}({value})" if "verify" in nested.options else value


# --- text ---------------------------------------------------------------------------------------------------


def _docstring(text: str) -> str:
    """Return the docstring of a class; the page of the message types has the comment of each field and constant."""
    return f'    """{" ".join(text.split())}"""'


def generate(folder: Path, fingerprints: Mapping[str, str]) -> dict[str, str]:
    """Return the text of each generated module by its path in the repository.

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
    return (
        '"""Values of the messages. Generated from lcmtypes/*.lcm by `make types`; do not edit."""\n\n'
        "from __future__ import annotations\n\n"
        "from dataclasses import dataclass\nfrom enum import IntEnum\nfrom typing import NamedTuple\n\n"
        "from modelserver.errors import Status\n"
        "from modelserver.messages.values import MET, NAN, NO_FLAGS, VALID, Invalid, PoseAnswer, Quality, Unmet\n"
        "from modelserver.transforms.pose import Pose\n"
        "from modelserver.transforms.so3 import Matrix3, Quaternion, Vector3\n\n"
        f"\n{body}\n"
    )


HAND_VALUES: Final = ("Invalid", "Quality", "Unmet")
"""Flags that no .lcm file declares."""

_WORD: Final = re.compile(r"\b[A-Za-z]\w+\b")
_HELPER: Final = re.compile(r"(check|verify|read|pack|skip)_[a-z_0-9]+|NAN\d+|MAX_[A-Z_]+|Codec")


def _codec_module(structs: Mapping[str, Struct], names: set[str], fingerprints: Mapping[str, str]) -> str:
    codecs = _Codecs(structs)
    constants: list[str] = []
    functions: list[str] = []
    table: list[str] = []
    by_hand: set[str] = set()
    for each in structs.values():
        if not each.value:
            continue
        names.add(each.value)
        if each.answer is not None:
            names.add(each.answer.value)
        if each.codec:
            by_hand |= {f"{verb}_{each.base}" for verb in ("pack", "unpack", "skip")} | {f"NO_{each.base.upper()}"}
        else:
            constants += codecs.write_constants(each)
            functions += [codecs.write_packer(each), codecs.write_unpacker(each)]
        if "part" not in each.options:
            verbs = f"pack_{each.base}, unpack_{each.base}"
            table.append(f'    Codec("{each.name}", FINGERPRINTS["{each.name}"], {each.value}, {verbs}),')
    body = "\n\n\n".join(["\n".join(constants), *functions, "\n".join(["CODECS = (", *table, ")"])])
    used = set(_WORD.findall(body))
    here = {f"{verb}_{each.base}" for verb in ("pack", "unpack", "skip") for each in structs.values()}
    helpers = ({word for word in used if _HELPER.fullmatch(word)} - here) | (by_hand & used)
    numbers = "\n".join(f'    "{name}": bytes.fromhex("{fingerprints[name]}"),' for name in sorted(fingerprints))
    return (
        '"""Codec of the messages. Generated from lcmtypes/*.lcm by `make types`; do not edit."""\n\n'
        "from __future__ import annotations\n\n"
        "import struct\nfrom collections.abc import Mapping\nfrom typing import Final\n\n"
        "from modelserver.errors import Status\n"
        f"from modelserver.messages import {', '.join(sorted(names & used))}\n"
        "from modelserver.transforms.pose import Pose\n"
        f"from modelserver.wire.fields import {', '.join(sorted(helpers))}\n\n"
        f"FINGERPRINTS: Final[Mapping[str, bytes]] = {{\n{numbers}\n}}\n"
        f'"""Of the wire types, as lcm-gen computes them."""\n\n{codecs.formats()}\n\n\n{body}\n'
    )
