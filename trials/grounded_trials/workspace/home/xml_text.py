"""An XML file whose numbers are changed: comments, order and layout of its elements stay."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from grounded_trials.plain_file import unreadable

Element = ElementTree.Element
# what may stand before the root: declaration, comments, document type
_PROLOGUE = re.compile(rb"(?:\s+|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>)*", re.DOTALL)


class XmlText:
    """An XML file, with its root."""

    def __init__(self, data: bytes, name: str) -> None:
        """Parse a file.

        Raises:
            GroundedError: if it is not XML.
        """
        self.data = data
        kept = ElementTree.TreeBuilder(insert_comments=True, insert_pis=True)
        try:
            parser = ElementTree.XMLParser(target=kept)
            self.root = ElementTree.fromstring(data, parser)
        except (ElementTree.ParseError, ValueError) as error:
            raise unreadable(name, f"it is no XML: {error}") from None
        self._before = self._text()

    @property
    def changed(self) -> bool:
        """Whether anything of it was changed."""
        return self._text() != self._before

    def written(self, comment: str = "") -> bytes:
        """Return the file with all changes, and with a comment before its root."""
        found = _PROLOGUE.match(self.data)
        head = self.data[: found.end()] if found else b""
        end = self.data.rfind(b"</" + self.root.tag.encode())
        tail = self.data[self.data.index(b">", end) + 1 :] if end >= 0 else b"\n"
        new = (comment + self._text()).replace("\n", "\r\n" if b"\r\n" in self.data else "\n")
        return head + new.encode() + tail

    def _text(self) -> str:
        return ElementTree.tostring(self.root, encoding="unicode").replace(" />", "/>")


def set_or_remove(element: Element, name: str, value: str | None) -> None:
    """Set an attribute, whether or not the element has it; None removes it."""
    if value is None:
        element.attrib.pop(name, None)
    else:
        element.set(name, value)


def first_child(element: Element, tag: str) -> Element:
    """Insert an empty element as the first child of another, on a line of its own."""
    new = ElementTree.Element(tag)
    new.tail = element.text
    element.insert(0, new)
    return new


def commented(lines: list[str]) -> str:
    """Return lines as an XML comment, in which two hyphens must not stand together."""
    inside = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{inside}\n-->\n"
