"""OMG IDL definitions (ros2idl, omgidl) to message types.

The text holds modules, structs, typedefs, enums and constants; with ros2idl several files follow
each other, each after a line of '=' and a line "IDL: package/msg/Type". Annotations and comments
are stepped over. Unions, maps and optional members are not plain CDR and are refused.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from grounded_trials.formats.messages import Array, Field, Number, Struct, Text, Type
from grounded_trials.formats.protobuf_schema import BadSchema

_TOKEN = re.compile(
    r'//[^\n]*|/\*.*?\*/|^\s*#[^\n]*|^={3,}\s*\nIDL:[^\n]*|"(?:[^"\\]|\\.)*"|\'(?:[^\'\\]|\\.)*\''
    r"|@?[A-Za-z_]\w*(?:::\w+)*|::\w+(?:::\w+)*|[-+]?[\d.]\w*|\S",
    re.DOTALL | re.MULTILINE,
)
_SKIPPED = ("//", "/*", "#", "===")
_NUMBERS = {
    "boolean": "b1",
    "octet": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "uint16": "u2",
    "long": "i4",
    "int32": "i4",
    "uint32": "u4",
    "long long": "i8",
    "int64": "i8",
    "uint64": "u8",
    "unsigned short": "u2",
    "unsigned long": "u4",
    "unsigned long long": "u8",
    "float": "f4",
    "double": "f8",
}
_REFUSED = ("union", "map", "bitset", "bitmask", "any", "interface", "valuetype")
DEPTH_LIMIT, COUNT_LIMIT = 64, 10**8


@dataclass
class _Open:
    """A struct as written: its base, its members' tokens, and where names are looked up from."""

    scope: tuple[str, ...]
    base: str
    members: list[list[str]] = field(default_factory=list)


def parse_idl(text: str, name: str) -> Struct:
    """The message type `name` (with / or :: between its parts) of an IDL text.

    Raises:
        BadSchema: if it is damaged, or uses what can't be read.
    """
    tokens = [t for t in _TOKEN.findall(text) if not t.lstrip().startswith(_SKIPPED)]
    try:
        return _Parser(tokens).read(name.replace("/", "::"))
    except (IndexError, ValueError, RecursionError) as error:
        raise BadSchema(f"its IDL definition is damaged: {error}") from None


class _Parser:
    def __init__(self, tokens: list[str]) -> None:
        self.tokens, self.pos = tokens, 0
        self.structs: dict[str, _Open] = {}
        self.types: dict[str, tuple[tuple[str, ...], list[str]]] = {}  # typedefs, as written
        self.enums: set[str] = set()
        self.constants: dict[str, str] = {}
        self.built: dict[str, Struct] = {}

    def read(self, name: str) -> Struct:
        while self.pos < len(self.tokens):
            self.definition(())
        if name not in self.structs:
            raise BadSchema(f"its IDL definition has no struct '{name}'")
        return self.struct(name, 0)

    def take(self) -> str:
        token = self.tokens[self.pos]
        self.pos += 1
        return token

    def expect(self, wanted: str) -> None:
        token = self.take()
        if token != wanted:
            raise BadSchema(f"its IDL definition has '{token[:40]}' where '{wanted}' should be")

    def until(self, end: str) -> list[str]:
        """Tokens up to `end`, without annotations."""
        found: list[str] = []
        while (token := self.take()) != end:
            if token.startswith("@"):
                self.annotation(token)
            else:
                found.append(token)
        return found

    def annotation(self, token: str) -> None:
        if token in ("@optional", "@mutable"):
            raise BadSchema(f"its IDL definition uses {token}, which is not plain CDR")
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
            self.expect("{")
            while self.tokens[self.pos] != "}":
                self.definition(inner)
            self.pos += 1
        elif token == "struct":
            self.open_struct(scope)
        elif token == "enum":
            self.enums.add("::".join((*scope, self.take())))
            self.until("}")
        elif token == "typedef":
            written = self.until(";")
            at = written.index("[") if "[" in written else len(written)
            alias = written[at - 1]
            self.types["::".join((*scope, alias))] = (scope, written[: at - 1] + written[at:])
        elif token == "const":
            written = self.until(";")
            at = written.index("=")
            self.constants["::".join((*scope, written[at - 1]))] = "".join(written[at + 1 :])
        elif token in _REFUSED:
            raise BadSchema(f"its IDL definition has a {token}, which can't be read")
        elif token != ";":
            raise BadSchema(f"its IDL definition has '{token[:40]}' where a definition should be")

    def open_struct(self, scope: tuple[str, ...]) -> None:
        name, base = self.take(), ""
        if self.tokens[self.pos] == ";":  # a forward declaration
            return
        if self.tokens[self.pos] == ":":
            self.pos += 1
            base = self.take()
        self.expect("{")
        opened = _Open((*scope, name), base)
        while True:
            while self.tokens[self.pos].startswith("@"):
                self.annotation(self.take())
            if self.tokens[self.pos] == "}":
                break
            opened.members.append(self.until(";"))
        self.pos += 1
        self.structs["::".join((*scope, name))] = opened

    def struct(self, name: str, depth: int) -> Struct:
        if name not in self.built:
            if depth > DEPTH_LIMIT:
                raise BadSchema(f"its IDL definition of '{name}' contains itself")
            opened = self.structs[name]
            fields: list[Field] = []
            if opened.base:
                fields += self.struct(self.find(opened.base, opened.scope), depth + 1).fields
            for written in opened.members:
                fields += self.member(written, opened.scope, depth)
            # ROS gives a struct without members one byte, under a name that nobody uses.
            fields = [f for f in fields if f.name != "structure_needs_at_least_one_member"]
            self.built[name] = Struct(name.replace("::", "/"), tuple(fields))
        return self.built[name]

    def member(self, written: list[str], scope: tuple[str, ...], depth: int) -> list[Field]:
        kind, rest = self.type(written, scope, depth)
        fields, at = [], 0
        while at < len(rest):
            name, at = rest[at], at + 1
            counts: list[int] = []
            while at < len(rest) and rest[at] == "[":
                counts.append(self.count(rest[at + 1], scope))
                at += 3
            inner = kind
            for count in reversed(counts):
                inner = Array(inner, count)
            fields.append(Field(name, inner))
            at += 1  # the comma
        return fields

    def type(
        self, written: list[str], scope: tuple[str, ...], depth: int
    ) -> tuple[Type, list[str]]:
        """The type at the front of the tokens, and the tokens after it."""
        first = written[0]
        if first in ("string", "wstring"):
            after = 4 if len(written) > 1 and written[1] == "<" else 1
            return Text(1 if first == "string" else 0), written[after:]
        if first == "sequence":
            item, rest = self.type(written[2:], scope, depth)
            return Array(item), rest[3:] if rest[0] == "," else rest[1:]
        for words in (3, 2, 1):
            number = _NUMBERS.get(" ".join(written[:words]))
            if number:
                if written[words : words + 1] == ["double"]:
                    break
                return Number(number), written[words:]
        if first in _REFUSED or first in ("long", "wchar"):
            raise BadSchema(f"its IDL definition uses {first}, which can't be read")
        name = self.find(first, scope)
        if name in self.enums:
            return Number("u4"), written[1:]
        if name in self.types:
            if depth > DEPTH_LIMIT:
                raise BadSchema(f"its IDL definition of '{name}' contains itself")
            inner_scope, tokens = self.types[name]
            kind, rest = self.type(tokens, inner_scope, depth + 1)
            for i in reversed(range(0, len(rest), 3)):
                kind = Array(kind, self.count(rest[i + 1], inner_scope))
            return kind, written[1:]
        return self.struct(name, depth + 1), written[1:]

    def find(self, name: str, scope: tuple[str, ...]) -> str:
        """The full name that a name means, looked up from the inside out."""
        for i in range(len(scope), -1, -1):
            full = "::".join((*scope[:i], name.removeprefix("::")))
            if full in self.structs or full in self.types or full in self.enums:
                return full
        raise BadSchema(f"its IDL definition uses '{name}', which it does not define")

    def count(self, text: str, scope: tuple[str, ...]) -> int:
        for i in range(len(scope), -1, -1):
            text = self.constants.get("::".join((*scope[:i], text)), text)
        count = int(text)
        if not 0 <= count <= COUNT_LIMIT:
            raise BadSchema(f"its IDL definition has an array of {count} items")
        return count
