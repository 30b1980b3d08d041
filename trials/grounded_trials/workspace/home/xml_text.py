"""Changes of an XML file that leave every other byte of it as it was.

Expat tells at which byte each element begins. A change replaces the bytes of one attribute's value,
or inserts an attribute or an element; nothing is written anew.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from grounded_trials.plain_file import unreadable

_ATTRIBUTE = re.compile(rb"""\s+([\w:.-]+)\s*=\s*("[^"]*"|'[^']*')""")
_NAME = re.compile(rb"<\s*([\w:.-]+)")


@dataclass(eq=False)
class Element:
    """An element, its attributes, and where its tags are in the file [bytes]."""

    tag: str
    attributes: dict[str, str]
    text: XmlText
    begin: int  # of the start tag
    children: list[Element] = field(default_factory=list)
    close: int = 0  # where the end tag begins; for <a/> the end of the tag

    def get(self, name: str) -> str:
        """Return the value of an attribute; "" without it."""
        return self.attributes.get(name, "")

    def first(self, tag: str) -> Element | None:
        """Return the first child with a tag."""
        return next((one for one in self.children if one.tag == tag), None)

    def below(self) -> Iterator[Element]:
        """Yield the element and all that are in it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.below()


class XmlText:
    """The bytes of an XML file, its elements, and the changes made to them."""

    def __init__(self, data: bytes, name: str) -> None:
        """Parse a file.

        Raises:
            GroundedError: if it is not XML.
        """
        self.data, self.name = data, name
        self._values = dict[Element, dict[str, str | None]]()  # None removes an attribute
        self._tags = dict[Element, str]()  # what they were
        self._children = list[tuple[Element, Element]]()  # new ones, each after its parent
        self._inserted = list[tuple[int, int, bytes]]()
        stack, roots = list[Element](), list[Element]()
        parser = expat.ParserCreate()

        def begin(tag: str, attributes: dict[str, str]) -> None:
            one = Element(tag, attributes, self, parser.CurrentByteIndex)
            (stack[-1].children if stack else roots).append(one)
            stack.append(one)

        def end(tag: str) -> None:
            stack.pop().close = parser.CurrentByteIndex

        parser.StartElementHandler, parser.EndElementHandler = begin, end
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise unreadable(name, f"it is no XML: {error}") from None
        self.root = roots[0]

    @property
    def changed(self) -> bool:
        """Whether anything is to be changed."""
        return bool(self._values or self._children)

    def set(self, element: Element, name: str, value: str | None) -> None:
        """Set an attribute, whether or not the element has it; None removes it."""
        self._values.setdefault(element, {})[name] = value
        if value is None:
            element.attributes.pop(name, None)
        else:
            element.attributes[name] = value

    def rename(self, element: Element, tag: str) -> None:
        """Give an element another tag."""
        self._tags.setdefault(element, element.tag)
        element.tag = tag

    def insert(self, at: int, text: str) -> None:
        """Insert text before a byte."""
        self._inserted.append((at, at, text.encode()))

    def child(self, element: Element, tag: str) -> Element:
        """Insert an empty element as the first child of another, on a line of its own."""
        new = Element(tag, {}, self, -1)
        self._children.append((element, new))
        element.children.insert(0, new)
        return new

    def written(self) -> bytes:
        """Return the file with all changes."""
        edits = [*self._inserted, *(self._of_child(*one) for one in self._children)]
        for element, values in self._values.items():
            if element.begin >= 0:
                edits += self._of_attributes(element, values)
        for element, tag in self._tags.items():
            old = re.compile(rb"(</?\s*)" + re.escape(tag.encode()) + rb"\b")
            for at in {element.begin, element.close}:
                if found := old.match(self.data, at):
                    edits.append((found.end(1), found.end(), element.tag.encode()))
        parts, at = list[bytes](), 0
        for begin, end, new in sorted(edits, key=lambda edit: edit[:2]):
            parts += [self.data[at:begin], new]
            at = end
        return b"".join([*parts, self.data[at:]])

    def _of_attributes(
        self, element: Element, values: dict[str, str | None]
    ) -> Iterator[tuple[int, int, bytes]]:
        """Yield the changes of a start tag; new attributes follow those that are there."""
        there = self._attributes(element)
        for one in there:
            name = one[1].decode()
            if name in values:
                value, quote = values[name], one[2][:1]
                yield (
                    (*one.span(), b"")
                    if value is None
                    else (
                        *one.span(2),
                        quote + value.encode() + quote,
                    )
                )
        known = {one[1].decode() for one in there}
        new = "".join(f' {n}="{v}"' for n, v in values.items() if v is not None and n not in known)
        at = self._end_of_attributes(element)
        if new:
            yield at, at, new.encode()

    def _of_child(self, parent: Element, new: Element) -> tuple[int, int, bytes]:
        """Return the change that inserts a new child."""
        line = self.data[self.data.rfind(b"\n", 0, parent.begin) + 1 : parent.begin].decode()
        space, end = line[: len(line) - len(line.lstrip())], self._end_of_tag(parent)
        values = "".join(f' {name}="{value}"' for name, value in new.attributes.items())
        text = f"\n{space}  <{new.tag}{values}/>"
        if self.data[end - 2 : end] != b"/>":
            return end, end, text.encode()
        return end - 2, end, f">{text}\n{space}</{parent.tag}>".encode()  # it has no room yet

    def _attributes(self, element: Element) -> list[re.Match[bytes]]:
        """Return the attributes of a start tag, as they stand there."""
        found, at = list[re.Match[bytes]](), self._end_of_name(element)
        while one := _ATTRIBUTE.match(self.data, at):
            found.append(one)
            at = one.end()
        return found

    def _end_of_name(self, element: Element) -> int:
        name = _NAME.match(self.data, element.begin)
        return name.end() if name else element.begin

    def _end_of_attributes(self, element: Element) -> int:
        there = self._attributes(element)
        return there[-1].end() if there else self._end_of_name(element)

    def _end_of_tag(self, element: Element) -> int:
        return self.data.index(b">", self._end_of_attributes(element)) + 1


def commented(lines: list[str]) -> str:
    """Return lines as an XML comment, in which two hyphens must not stand together."""
    inside = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{inside}\n-->\n"
