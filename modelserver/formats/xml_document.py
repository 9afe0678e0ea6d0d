"""Parsing XML from strangers: no entity is expanded, no file or network is read, every fault has its line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from lxml import etree

from modelserver.errors import Location, shown
from modelserver.formats.spelling import label, nearest_keys
from modelserver.geometry.builder import ModelBuilder

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_SPACE = re.compile(rb"\s*")

_FIX_DOCTYPE = "remove the DOCTYPE line, or leave it bare: <!DOCTYPE MiroConfigDocument>"


def parse(content: bytes, builder: ModelBuilder, file: str) -> Element | None:
    """Return the root element, or None with the problem added to `builder`."""
    if b"\0" in content:
        # UTF-16 would hide a DOCTYPE from the look below
        builder.error("the file holds NUL bytes: it is binary, or UTF-16", Location(file, 1), "save it as UTF-8 text")
        return None
    if _refused_doctype(content, builder, file):
        return None
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False
    )
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        # the first fault of this run is the cause; the exception's own log is shared with other parsers
        log: Any = parser.error_log
        line, message = (log[0].line, log[0].message) if len(log) else (error.lineno or 0, str(error))
        builder.error(
            f"the XML is not well-formed: {message.strip()}",
            Location(file, line),
            "close every element and quote every value; an editor that knows XML shows the place",
        )
        return None
    except ValueError as error:
        builder.error(f"the XML cannot be read: {error}", Location(file), "save it as UTF-8 text")
        return None
    # a second look after parsing, for encodings in which the first saw no DOCTYPE
    dtd: Any = root.getroottree().docinfo.internalDTD
    if dtd is not None and (dtd.external_id or dtd.system_url or list(dtd.iterentities()) or list(dtd.iterelements())):
        builder.error("the DOCTYPE declares entities or names a DTD, which is refused", Location(file), _FIX_DOCTYPE)
        return None
    return root


def _refused_doctype(content: bytes, builder: ModelBuilder, file: str) -> bool:
    start = _doctype(content)
    if start < 0:
        return False
    declaration = re.compile(rb"[^>\[]*").match(content, start)
    assert declaration is not None
    names_dtd = re.search(rb"\s(?:SYSTEM|PUBLIC)\b", declaration[0])
    if not names_dtd and content[declaration.end() : declaration.end() + 1] != b"[":
        return False
    what = "names a DTD outside the file" if names_dtd else "has declarations of its own (entities)"
    builder.error(
        f"the DOCTYPE {what}, which is refused: such files can read other files or grow without bound",
        Location(file, content.count(b"\n", 0, start) + 1, "DOCTYPE"),
        _FIX_DOCTYPE,
    )
    return True


def _doctype(content: bytes) -> int:
    """Return where the DOCTYPE of a document begins, -1 where it has none before its first element."""
    at = 3 if content.startswith(b"\xef\xbb\xbf") else 0
    while True:
        space = _SPACE.match(content, at)
        at = space.end() if space is not None else at
        if content.startswith(b"<?", at):
            end = content.find(b"?>", at)
        elif content.startswith(b"<!--", at):
            end = content.find(b"-->", at)
        else:
            return at if content.startswith(b"<!DOCTYPE", at) else -1
        if end < 0:
            return -1
        at = end + (3 if content.startswith(b"-->", end) else 2)


def tag(element: Element) -> str:
    """Return the element's name without a namespace."""
    return str(element.tag).rpartition("}")[2]


def children(element: Element) -> Iterator[Element]:
    """Return the elements inside, without comments and processing instructions."""
    return element.iterchildren(etree.Element)


def line(element: Element) -> int:
    """Return the line the element stands on; past line 65535 libxml2 knows it only within one."""
    # stubs miss that sourceline is a number or None
    number: Any = element.sourceline
    return int(number or 0)


class Named:
    """The children `<parameter name=... value=...>` of one element, by name; what is odd is reported.

    `place` says where they stand, e.g. `body Raptor, frame CG`.
    """

    __slots__ = ("builder", "element", "file", "found", "place")

    def __init__(self, element: Element, known: tuple[str, ...], builder: ModelBuilder, file: str, place: str):
        self.element = element
        self.builder = builder
        self.file = file
        self.place = place
        self.found: dict[str, Element] = {}
        given = {(child.get("name") or "").strip() for child in children(element)}
        for child in children(element):
            name = (child.get("name") or "").strip()
            if child.tag != "parameter" and tag(child) != "parameter":
                builder.warning(
                    f"unexpected element <{label(tag(child))}>; passed over",
                    Location(file, line(child), place),
                    "write <parameter name=... value=.../>",
                    tuple(nearest_keys(tag(child), ("parameter",))),
                )
            elif name in self.found:
                builder.error(
                    f"parameter {name} is given twice (first on line {line(self.found[name])})",
                    Location(file, line(child), place),
                    "remove one of the two",
                )
            elif name not in known:
                # one that is given already is not what was meant
                near = nearest_keys(name, tuple(each for each in known if each not in given))
                builder.warning(
                    f"unknown parameter {shown(name)}; passed over"
                    if name
                    else "a parameter without a name; passed over",
                    Location(file, line(child), place),
                    f"write {near[0]}" if near else f"known here: {', '.join(known)}",
                    near,
                )
            else:
                self.found[name] = child

    def text(self, name: str) -> str | None:
        """Return the trimmed value of a parameter, None where it is absent or, with an error, has no value."""
        child = self.found.get(name)
        if child is None:
            return None
        value = child.get("value")
        if value is None:
            self.builder.error(
                f"parameter {name} has no value", self.source(name), f'write <parameter name="{name}" value="..."/>'
            )
            return None
        return value.strip()

    def source(self, name: str = "") -> Location:
        """Return the place of a parameter, or of the whole element where it is absent or not named."""
        child = self.found.get(name)
        if child is None:
            return Location(self.file, line(self.element), self.place)
        return Location(self.file, line(child), f"{self.place}, {name}" if self.place else name)
