"""Parse OMG IDL definitions (ros2idl, omgidl) to message types.

The text contains modules, structs, typedefs, enums and constants. With ros2idl several files follow
each other, each after a line of '=' and a line "IDL: package/msg/Type". Annotations and comments
are skipped. Unions, maps and optional members are not plain CDR and are refused.

Every token is read once and resolved names are cached, so the time is linear in the length of the
text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from grounded_trials.formats.bad import BadSchema
from grounded_trials.formats.messages import (
    COUNT_LIMIT,
    DEPTH_LIMIT,
    NUMBERS,
    Array,
    Field,
    Number,
    Struct,
    Text,
    Type,
)

# An unterminated comment or text extends to the end, so that nothing is scanned twice.
_TOKEN = re.compile(
    r"//[^\n]*|/\*.*?(?:\*/|\Z)|^[^\S\n]*#[^\n]*|^={3,}\s*\nIDL:[^\n]*"
    r'|"(?:[^"\\]|\\.)*(?:"|\\?\Z)|\'(?:[^\'\\]|\\.)*(?:\'|\\?\Z)'
    r"|@?[A-Za-z_]\w*(?:::\w+)*|::\w+(?:::\w+)*|[-+]?[\d.]\w*|\S",
    re.DOTALL | re.MULTILINE,
)
_SKIPPED = ("//", "/*", "#", "===")
_NUMBERS = {name: number for name, number in NUMBERS.items() if "int" in name} | {
    "boolean": Number("b1"),
    "octet": Number("u1"),
    "char": Number("u1"),
    "short": Number("i2"),
    "long": Number("i4"),
    "long long": Number("i8"),
    "unsigned short": Number("u2"),
    "unsigned long": Number("u4"),
    "unsigned long long": Number("u8"),
    "float": Number("f4"),
    "double": Number("f8"),
}
_REFUSED = ("union", "map", "bitset", "bitmask", "any", "interface", "valuetype")
MODULE_LIMIT = 16  # modules inside modules
NAME_LIMIT = 256  # characters of a module's name


def parse_idl(text: str, name: str) -> Struct:
    """Return the message type `name` (with / or :: between its parts) of an IDL text.

    Raises:
        BadSchema: if the text is damaged, or uses an unsupported feature.
    """
    tokens = [t for t in _TOKEN.findall(text) if not t.lstrip().startswith(_SKIPPED)]
    try:
        return _Parser(tokens).read(name.replace("/", "::"))
    except (IndexError, ValueError, RecursionError) as error:
        raise BadSchema("decode", what="definition", why="damaged", at=str(error)[:80]) from None


@dataclass
class _Definition:
    """A struct, typedef, enum or const as tokens, and the scope in which its names are resolved."""

    kind: str
    scope: tuple[str, ...]
    parts: list[list[str]] = field(default_factory=list)  # a struct's members; else the value
    base: str = ""  # base type of a struct


class _Parser:
    def __init__(self, tokens: list[str]) -> None:
        self.tokens, self.pos = tokens, 0
        self.defined: dict[str, _Definition] = {}
        self.found: dict[tuple[str, tuple[str, ...]], str] = {}
        self.built: dict[str, Struct] = {}
        self.aliases: dict[str, Type] = {}  # resolved typedefs
        self.counts: dict[str, int] = {}  # resolved constants

    def read(self, name: str) -> Struct:
        while self.pos < len(self.tokens):
            self.definition(())
        if name not in self.defined or self.defined[name].kind != "struct":
            raise BadSchema("decode", what="definition", why="lacks", at=name[:80])
        return self.struct(name, 0)

    def take(self) -> str:
        token = self.tokens[self.pos]
        self.pos += 1
        return token

    def expect(self, wanted: str) -> None:
        token = self.take()
        if token != wanted:
            raise BadSchema("decode", what="definition", why="unexpected", at=token[:40])

    def until(self, end: str) -> list[str]:
        """Return the tokens up to `end`, without annotations."""
        found: list[str] = []
        while (token := self.take()) != end:
            if token.startswith("@"):
                self.annotation(token)
            else:
                found.append(token)
        return found

    def annotation(self, token: str) -> None:
        if token in ("@optional", "@mutable"):
            raise BadSchema("decode", what="definition", why="refused", at=token)
        if self.pos < len(self.tokens) and self.tokens[self.pos] == "(":
            depth = 0
            while True:
                depth += {"(": 1, ")": -1}.get(self.take(), 0)
                if depth == 0:
                    return

    def definition(self, scope: tuple[str, ...]) -> None:
        token = self.take()
        if token.startswith("@"):
            self.annotation(token)
        elif token == "module":
            inner = (*scope, self.take())
            if len(inner) > MODULE_LIMIT or len(inner[-1]) > NAME_LIMIT:
                raise BadSchema("decode", what="definition", why="nested", at=inner[-1][:40])
            self.expect("{")
            while self.tokens[self.pos] != "}":
                self.definition(inner)
            self.pos += 1
        elif token == "struct":
            self.open_struct(scope)
        elif token == "enum":
            self.define(self.take(), _Definition(token, scope))
            self.until("}")
        elif token == "typedef":
            written = self.until(";")
            at = written.index("[") if "[" in written else len(written)
            parts = [written[: at - 1] + written[at:]]
            self.define(written[at - 1], _Definition(token, scope, parts))
        elif token == "const":
            written = self.until(";")
            at = written.index("=")
            self.define(written[at - 1], _Definition(token, scope, [written[at + 1 :]]))
        elif token in _REFUSED:
            raise BadSchema("decode", what="definition", why="refused", at=token)
        elif token != ";":
            raise BadSchema("decode", what="definition", why="unexpected", at=token[:40])

    def define(self, name: str, definition: _Definition) -> None:
        self.defined["::".join((*definition.scope, name))] = definition

    def open_struct(self, scope: tuple[str, ...]) -> None:
        name, opened = self.take(), _Definition("struct", scope)
        if self.tokens[self.pos] == ";":  # a forward declaration
            return
        if self.tokens[self.pos] == ":":
            self.pos += 1
            opened.base = self.take()
        self.expect("{")
        while True:
            while self.tokens[self.pos].startswith("@"):
                self.annotation(self.take())
            if self.tokens[self.pos] == "}":
                break
            opened.parts.append(self.until(";"))
        self.pos += 1
        self.define(name, opened)
        opened.scope = (*scope, name)

    def struct(self, name: str, depth: int) -> Struct:
        if name not in self.built:
            self.check_depth(name, depth)
            opened = self.defined[name]
            fields: list[Field] = []
            if opened.base:
                base = self.find(opened.base, opened.scope)
                fields += self.struct(base, depth + 1).fields
            for written in opened.parts:
                fields += self.member(written, opened.scope, depth)
            # ROS gives a struct without members a dummy member of one byte.
            fields = [f for f in fields if f.name != "structure_needs_at_least_one_member"]
            self.built[name] = Struct(name.replace("::", "/"), tuple(fields))
        return self.built[name]

    def check_depth(self, name: str, depth: int) -> None:
        if depth > DEPTH_LIMIT:
            raise BadSchema("decode", what="definition", why="nested", at=name[:80])

    def member(self, written: list[str], scope: tuple[str, ...], depth: int) -> list[Field]:
        kind, rest = self.type(written, scope, depth)
        fields, at = [], 0
        while at < len(rest):
            name, at = rest[at], at + 1
            counts: list[str] = []
            while at < len(rest) and rest[at] == "[":
                counts.append(rest[at + 1])
                at += 3
            fields.append(Field(name, self.array(kind, counts, scope)))
            at += 1  # the comma
        return fields

    def array(self, kind: Type, counts: list[str], scope: tuple[str, ...]) -> Type:
        """Return nested arrays, with the first count outermost."""
        self.check_depth("[...]", len(counts))
        for text in reversed(counts):
            count = self.count(text, scope, 0)
            if not 0 <= count <= COUNT_LIMIT:
                raise BadSchema("decode", what="definition", why="long", at=str(count)[:20])
            kind = Array(kind, count)
        return kind

    def count(self, text: str, scope: tuple[str, ...], depth: int) -> int:
        """Return the value of a number, or of the constant of that name."""
        if not text[:1].isalpha():
            return int(text)
        self.check_depth(text, depth)
        name = self.find(text, scope)
        if name not in self.counts:
            constant = self.defined[name]
            if constant.kind != "const":
                raise BadSchema("decode", what="definition", why="unexpected", at=name[:80])
            self.counts[name] = self.count("".join(constant.parts[0]), constant.scope, depth + 1)
        return self.counts[name]

    def type(
        self, written: list[str], scope: tuple[str, ...], depth: int
    ) -> tuple[Type, list[str]]:
        """Return the type at the front of the tokens, and the tokens after it."""
        first = written[0]
        self.check_depth(first, depth)
        if first in ("string", "wstring"):
            after = 4 if len(written) > 1 and written[1] == "<" else 1
            return Text(1 if first == "string" else 0), written[after:]
        if first == "sequence":
            item, rest = self.type(written[2:], scope, depth + 1)
            return Array(item), rest[3:] if rest[0] == "," else rest[1:]
        for words in (3, 2, 1):
            number = _NUMBERS.get(" ".join(written[:words]))
            if number and written[words : words + 1] != ["double"]:
                return number, written[words:]
        if first in _REFUSED or first in ("long", "wchar"):
            raise BadSchema("decode", what="definition", why="refused", at=first)
        name = self.find(first, scope)
        definition = self.defined[name]
        if definition.kind == "enum":
            return Number("u4"), written[1:]
        if definition.kind == "struct":
            return self.struct(name, depth + 1), written[1:]
        if name not in self.aliases:
            kind, rest = self.type(definition.parts[0], definition.scope, depth + 1)
            self.aliases[name] = self.array(kind, rest[1::3], definition.scope)
        return self.aliases[name], written[1:]

    def find(self, name: str, scope: tuple[str, ...]) -> str:
        """Return the full name of a definition, resolved from the innermost scope outwards."""
        if (name, scope) not in self.found:
            for i in range(len(scope), -1, -1):
                full = "::".join((*scope[:i], name.removeprefix("::")))
                if full in self.defined:
                    self.found[name, scope] = full
                    break
            else:
                raise BadSchema("decode", what="definition", why="lacks", at=name[:80])
        return self.found[name, scope]
