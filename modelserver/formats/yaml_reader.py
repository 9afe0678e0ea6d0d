"""Typed reading of YAML nodes: each method returns a value, or None with the problem reported at its line."""

from __future__ import annotations

from modelserver.errors import Location, shown
from modelserver.formats import numbers
from modelserver.formats.spelling import nearest_keys
from modelserver.formats.yaml_nodes import NodeKind, YamlNode
from modelserver.geometry.builder import ModelBuilder


class NodeReader:
    """Reads nodes of one file into plain values; `place` in each method says where, e.g. `body Raptor`."""

    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file

    def at(self, node: YamlNode, place: str) -> Location:
        """Return the place of a node."""
        return Location(self.file, node.line, place)

    def error(self, message: str, node: YamlNode, place: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report an error at a node."""
        self.builder.error(message, Location(self.file, node.line, place), fix, nearest)

    def fields(self, node: YamlNode, place: str, known: tuple[str, ...]) -> dict[str, YamlNode]:
        """Return the values of a mapping by key, without those that are nothing; unknown and double keys are errors.

        The value of a misspelled key is that of the key that is meant, so that it is examined, and not missing.
        """
        found: dict[str, YamlNode] = {}
        first: dict[str, int] = {}
        pairs = self.named(node, place)
        given = {name for name, _, _ in pairs}
        for name, key, value in pairs:
            if name not in known:
                # one that is given already is not what was meant
                near = nearest_keys(name, tuple(each for each in known if each not in given))
                self.error(
                    f"unknown key {shown(name)}",
                    key,
                    place,
                    f"write {near[0]}" if near else f"keys here are {', '.join(known)}",
                    near,
                )
                if near and not value.is_nothing:
                    found.setdefault(near[0], value)
            elif name in first:
                self.error(f"{name} is given twice (first on line {first[name]})", key, place, "remove one of the two")
            else:
                first[name] = key.line
                if not value.is_nothing:
                    found[name] = value
        return found

    def named(self, node: YamlNode, place: str) -> list[tuple[str, YamlNode, YamlNode]]:
        """Return key text, key and value of each pair of a mapping, in order."""
        if node.is_nothing:
            return []
        if node.kind is not NodeKind.MAPPING:
            what = node.kind.value
            self.error(f"expected a mapping (key: value), got {what}", node, place, "write key: value, one a line")
            return []
        pairs = []
        for key, value in node.pairs:
            if key.kind is not NodeKind.SCALAR:
                self.error(f"a key is a name, got {key.kind.value}", key, place, "write name: value")
            elif key.text == "<<" and key.plain:
                self.error("merge keys (<<) are not read", key, place, "use templates; see docs/geometry-files.md")
            else:
                pairs.append((key.text.strip(), key, value))
        return pairs

    def text(self, node: YamlNode | None, place: str, key: str) -> str:
        """Return a scalar's text with white space folded, empty where it is absent or wrong."""
        if node is None:
            return ""
        if node.kind is not NodeKind.SCALAR:
            self.error(
                f"{key} is a text, got {node.kind.value}", node, place, f"write {key}: some text, in quotes if need be"
            )
            return ""
        return node.text.strip()

    def numbers(self, node: YamlNode, count: int, place: str, key: str, unit: str) -> list[float] | None:
        """Return a list of `count` numbers."""
        fix = f"write {key}: [{', '.join(['number'] * count)}]" + (f", in {unit}" if unit else "")
        if node.kind is not NodeKind.LIST:
            got = shown(node.text, 40) if node.kind is NodeKind.SCALAR else node.kind.value
            self.error(f"{key} is a list of {count} numbers, got {got}", node, place, fix)
            return None
        values = []
        wrong = False
        for item in node.items:
            value = self.number(item, place, key, fix)
            if value is None:
                wrong = True
            else:
                values.append(value)
        if wrong:
            return None
        if len(values) != count:
            plural = "" if len(values) == 1 else "s"
            self.error(f"{key} has {len(values)} number{plural}, not {count}", node, place, fix)
            return None
        return values

    def number(self, node: YamlNode, place: str, key: str, fix: str) -> float | None:
        """Return one number."""
        if node.kind is not NodeKind.SCALAR:
            self.error(f"{key}: expected a number, got {node.kind.value}", node, place, fix)
            return None
        try:
            if not node.plain:
                raise ValueError(f"{shown(node.text, 40)} is a text in quotes, not a number")
            return numbers.parse(node.text)
        except ValueError as error:
            self.error(f"{key}: {error}", node, place, fix)
            return None

    def rows(
        self, node: YamlNode, shapes: tuple[int, ...], width: int, place: str, key: str
    ) -> list[list[float]] | None:
        """Return rows of `width` numbers; as many as one of `shapes` says."""
        wanted = " or ".join(str(shape) for shape in shapes)
        fix = f"write {key}: [[...], ...] with {wanted} rows of {width} numbers"
        if node.kind is not NodeKind.LIST:
            self.error(f"{key} is a list of rows, got {node.kind.value}", node, place, fix)
            return None
        if len(node.items) not in shapes:
            self.error(f"{key} has {len(node.items)} rows, not {wanted}", node, place, fix)
            return None
        rows = [
            self.numbers(item, width, place, f"{key} row {number}", "") for number, item in enumerate(node.items, 1)
        ]
        if any(row is None for row in rows):
            return None
        return [row for row in rows if row is not None]
