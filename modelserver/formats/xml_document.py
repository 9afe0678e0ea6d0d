"""Parse XML safely: no entity is expanded, no file or network is read, and every problem has its line.

A DOCTYPE with declarations of its own, or with a reference to a DTD, is rejected before parsing (external entities,
exponential expansion), and again after it, for encodings in which the first search cannot see it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from lxml import etree

from modelserver.errors import Location, quote
from modelserver.formats.reading import label, suggest_known_key
from modelserver.geometry.builder import ModelBuilder

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_WHITESPACE = re.compile(rb"\s*")

_DOCTYPE_FIX = "remove the DOCTYPE line, or leave it bare: <!DOCTYPE MiroConfigDocument>"


def parse(content: bytes, builder: ModelBuilder, file: str) -> Element | None:
    """Parse XML; return the root element, or None, with an error in `builder`, if it is rejected."""
    if b"\0" in content:
        # UTF-16 would hide a DOCTYPE
        builder.add_error(
            "the file holds NUL bytes: it is binary, or UTF-16", Location(file, 1), "save it as UTF-8 text"
        )
        return None
    if _is_doctype_rejected(content, builder, file):
        return None
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False
    )
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        # the first entry is the cause; the exception's own log is shared with other parsers
        log: Any = parser.error_log
        line, message = (log[0].line, log[0].message) if len(log) else (error.lineno or 0, str(error))
        builder.add_error(
            f"the XML is not well-formed: {message.strip()}",
            Location(file, line),
            "close every element and quote every value; an editor that knows XML shows the place",
        )
        return None
    except ValueError as error:
        builder.add_error(f"the XML cannot be read: {error}", Location(file), "save it as UTF-8 text")
        return None
    dtd: Any = root.getroottree().docinfo.internalDTD
    if dtd is not None and (dtd.external_id or dtd.system_url or list(dtd.iterentities()) or list(dtd.iterelements())):
        builder.add_error(
            "the DOCTYPE declares entities or names a DTD, which is rejected", Location(file), _DOCTYPE_FIX
        )
        return None
    return root


def _is_doctype_rejected(content: bytes, builder: ModelBuilder, file: str) -> bool:
    start = _find_doctype(content)
    if start < 0:
        return False
    declaration = re.compile(rb"[^>\[]*").match(content, start)
    assert declaration is not None
    names_dtd = re.search(rb"\s(?:SYSTEM|PUBLIC)\b", declaration[0])
    if not names_dtd and content[declaration.end() : declaration.end() + 1] != b"[":
        return False
    what = "names a DTD outside the file" if names_dtd else "has declarations of its own (entities)"
    builder.add_error(
        f"the DOCTYPE {what}, which is rejected: such files can read other files or grow without bound",
        Location(file, content.count(b"\n", 0, start) + 1, "DOCTYPE"),
        _DOCTYPE_FIX,
    )
    return True


def _find_doctype(content: bytes) -> int:
    """Return the offset of the DOCTYPE before the first element, -1 for none."""
    at = 3 if content.startswith(b"\xef\xbb\xbf") else 0
    while True:
        space = _WHITESPACE.match(content, at)
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


def get_tag(element: Element) -> str:
    """Return the element's name without a namespace."""
    return str(element.tag).rpartition("}")[2]


def iterate_children(element: Element) -> Iterator[Element]:
    """Return the elements inside, without comments and processing instructions."""
    return element.iterchildren(etree.Element)


def get_line(element: Element) -> int:
    """Return the line of an element; libxml2 is off by up to one beyond line 65535."""
    # stubs miss that sourceline is a number or None
    number: Any = element.sourceline
    return int(number or 0)


class NamedParameters:
    """The children `<parameter name=... value=...>` of one element, by name; unknown and duplicate ones are reported.

    `place` names the element for problems, e.g. `body Raptor, frame CG`.
    """

    __slots__ = ("builder", "element", "elements", "file", "place")

    def __init__(self, element: Element, known: tuple[str, ...], builder: ModelBuilder, file: str, place: str):
        self.element = element
        self.builder = builder
        self.file = file
        self.place = place
        self.elements: dict[str, Element] = {}
        given = {(child.get("name") or "").strip() for child in iterate_children(element)}
        for child in iterate_children(element):
            name = (child.get("name") or "").strip()
            if child.tag != "parameter" and get_tag(child) != "parameter":
                builder.add_warning(
                    f"unexpected element <{label(get_tag(child))}>; ignored",
                    Location(file, get_line(child), place),
                    "write <parameter name=... value=.../>",
                    tuple(suggest_known_key(get_tag(child), ("parameter",))),
                )
            elif name in self.elements:
                builder.add_error(
                    f"parameter {name} is given twice (first on line {get_line(self.elements[name])})",
                    Location(file, get_line(child), place),
                    "remove one of the two",
                )
            elif name not in known:
                # a name that is present already is not what was meant
                near = suggest_known_key(name, tuple(each for each in known if each not in given))
                builder.add_warning(
                    f"unknown parameter {quote(name)}; ignored" if name else "a parameter without a name; ignored",
                    Location(file, get_line(child), place),
                    f"write {near[0]}" if near else f"known here: {', '.join(known)}",
                    near,
                )
            else:
                self.elements[name] = child

    def read_text(self, name: str) -> str | None:
        """Return the trimmed value of a parameter; None if it is absent or, with an error, has no value."""
        child = self.elements.get(name)
        if child is None:
            return None
        value = child.get("value")
        if value is None:
            self.builder.add_error(
                f"parameter {name} has no value", self.locate(name), f'write <parameter name="{name}" value="..."/>'
            )
            return None
        return value.strip()

    def locate(self, name: str = "") -> Location:
        """Return the place of a parameter, or of the element if it is absent or not named."""
        child = self.elements.get(name)
        if child is None:
            return Location(self.file, get_line(self.element), self.place)
        return Location(self.file, get_line(child), f"{self.place}, {name}" if self.place else name)
