"""Parse XML safely: no entity is expanded, no file or network is read, and every problem has its line.

A DOCTYPE with declarations of its own, or with a reference to a DTD, is rejected before parsing (external entities,
exponential expansion), and again after it, for encodings in which the first search cannot see it.

ROS's own parser (TinyXML) reads a URDF that breaks some rules of XML without effect on its elements: what it reads is
read here, too, with a warning.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from lxml import etree

from modelserver.errors import Location
from modelserver.formats.common import ElementReader
from modelserver.geometry.builder import ModelBuilder

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_BEFORE_DOCTYPE = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s+|<\?(?s:.*?)\?>|<!--(?s:.*?)-->)*+")

_NO_ELEMENT = re.compile(r"<!--.*?-->|<\?.*?\?>", re.DOTALL)
_BARE_AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[0-9A-Fa-f]+);)")
_PASSED_OVER = frozenset({"NS_ERR_UNDEFINED_NAMESPACE", "ERR_LT_IN_ATTRIBUTE", "ERR_DOCUMENT_END"})
"""Errors of libxml2 that TinyXML does not have: an undeclared prefix, < in a value, text after the last element."""

_DOCTYPE_FIX = "remove the DOCTYPE line, or leave it bare: <!DOCTYPE MiroConfigDocument>"


def parse(content: bytes, builder: ModelBuilder, file: str) -> Element | None:
    """Parse XML; return the root element, or None, with an error in `builder`, if it is rejected."""
    at = ElementReader(builder, file)
    if b"\0" in content:
        # UTF-16 would hide a DOCTYPE
        at.error("the file holds NUL bytes: it is binary, or UTF-16", "save it as UTF-8 text", 1)
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
        what = f"the XML is not well-formed: {message.strip()}"
        root = _read_as_ros(content)
        if root is None:
            fix = "close every element and quote every value; an editor that knows XML shows the place"
            at.error(what, fix, line)
            return None
        at.warning(f"{what}; it is read as ROS does", "correct it: other programs reject it", line)
    except ValueError as error:
        at.error(f"the XML cannot be read: {error}", "save it as UTF-8 text")
        return None
    dtd: Any = root.getroottree().docinfo.internalDTD
    if dtd is not None and (dtd.external_id or dtd.system_url or list(dtd.iterentities()) or list(dtd.iterelements())):
        at.error("the DOCTYPE declares entities or names a DTD, which is rejected", _DOCTYPE_FIX)
        return None
    return root


def _read_as_ros(content: bytes) -> Element | None:
    """Return the root of a URDF whose flaws ROS's parser passes over; None if it has others, or is no URDF."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    # what is no element: its flaws do not count, its lines do
    text = _NO_ELEMENT.sub(lambda found: "\n" * found[0].count("\n"), text)
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, recover=True)
    try:
        root: Any = etree.fromstring(_BARE_AMPERSAND.sub("&amp;", text).encode(), parser)
    except (etree.XMLSyntaxError, ValueError):
        return None
    entries: Any = parser.error_log
    if root is None or get_tag(root) != "robot" or any(each.type_name not in _PASSED_OVER for each in entries):
        return None
    found: Element = root
    return found


def _is_doctype_rejected(content: bytes, builder: ModelBuilder, file: str) -> bool:
    before = _BEFORE_DOCTYPE.match(content)
    start = 0 if before is None else before.end()
    if not content.startswith(b"<!DOCTYPE", start):
        return False
    declaration = re.compile(rb"[^>\[]*").match(content, start)
    assert declaration is not None
    names_dtd = re.search(rb"\s(?:SYSTEM|PUBLIC)\b", declaration[0])
    if not names_dtd and content[declaration.end() : declaration.end() + 1] != b"[":
        return False
    what = "names a DTD outside the file" if names_dtd else "has declarations of its own (entities)"
    message = f"the DOCTYPE {what}, which is rejected: such files can read other files or grow without bound"
    line = content.count(b"\n", 0, start) + 1
    builder.add_error(message, Location(file, line, "DOCTYPE"), _DOCTYPE_FIX)
    return True


def get_tag(element: Element) -> str:
    """Return the element's name without a namespace."""
    return str(element.tag).rpartition("}")[2]


def get_name(element: Element) -> str:
    return (element.get("name") or "").strip()


def iterate_children(element: Element) -> Iterator[Element]:
    """Return the elements inside, without comments and processing instructions."""
    return element.iterchildren(etree.Element)


def get_line(element: Element) -> int:
    """Return the line of an element; libxml2 is off by up to one beyond line 65535."""
    # stubs miss that sourceline is a number or None
    number: Any = element.sourceline
    return int(number or 0)
