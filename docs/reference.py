"""Generate the site's API reference from docstrings, one page per package folder (a MkDocs hook).

A room is a folder with an `__init__.py`. Its page shows the docstring of the room, which says what
it is for and in which order to read it, then the public names of each of its modules. Rooms are
found on the disk, so a new one needs no entry here.
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Any

from markdown import Extension, Markdown
from markdown.inlinepatterns import SimpleTextInlineProcessor
from mkdocs.structure.files import File, Files

from grounded.findings import catalogue
from grounded.findings.numbers import bare

ROOT = Path(__file__).resolve().parent.parent
SOURCES = {"grounded": ROOT, "grounded_trials": ROOT / "trials", "grounded_cli": ROOT / "cli"}
TITLES = {
    "grounded": "grounded, the method",
    "grounded_trials": "grounded_trials, the disk",
    "grounded_cli": "grounded_cli, the commands",
}


def rooms(package: str) -> list[str]:
    """Return the import names of a package's rooms, the package itself first."""
    source = SOURCES[package]
    folders = sorted(path.parent for path in (source / package).rglob("__init__.py"))
    return [".".join(folder.relative_to(source).parts) for folder in folders]


def modules(room: str) -> list[str]:
    """Return the import names of a room's public modules."""
    folder = SOURCES[room.partition(".")[0]].joinpath(*room.split("."))
    stems = sorted(path.stem for path in folder.glob("*.py"))
    return [f"{room}.{stem}" for stem in stems if not stem.startswith("_")]


def purpose(room: str) -> str:
    """Return a room's docstring as Markdown; turn its lines `name   what it is` into a list."""
    text = inspect.getdoc(import_module(room)) or ""
    listed = re.sub(r"^([\w./]+(?:, [\w./]+)*) {2,}(.+)$", r"- `\1`: \2", text, flags=re.M)
    return re.sub(r"^(?!- )(.+)\n(?=- )", r"\1\n\n", listed, flags=re.M)


def door(package: str) -> list[str]:
    """Return a list of the names in a package's `__all__`, linked to their definitions."""
    found = import_module(package)
    lines = []
    for name in getattr(found, "__all__", ()):
        value = getattr(found, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            first = (inspect.getdoc(value) or "").partition("\n")[0]
            lines.append(f"- [`{name}`][{value.__module__}.{value.__qualname__}]: {first}")
    return ["## The front door", "\n".join(lines)] if lines else []


def page(room: str) -> str:
    """Return the page of a room in Markdown, for mkdocstrings to fill in."""
    opening = [f"# {TITLES.get(room, room)}", purpose(room)]
    front = door(room) if room in SOURCES else []
    return "\n\n".join(opening + front + [f"::: {module}" for module in modules(room)]) + "\n"


# What Markdown would read in an entry: slots and clauses are no links, a bar is no cell.
PLAIN = str.maketrans({sign: f"&#{ord(sign)};" for sign in "[]|*<>"})


def findings() -> str:
    """Return the page of all findings, from the catalogue, in Markdown."""
    parts = [
        "# Findings",
        "Whatever a command tells is a finding: `findings` in its JSON document, with a code, a "
        "weight, what it is about and facts with units. Scripts read codes and facts; sentences "
        "may change. `grounded explain CODE` prints an entry. Text in brackets appears where its "
        "facts, in `< >`, are known.",
    ]
    for area, entries in catalogue.AREAS.items():
        rows = [f"## {area}", "| code | weight | says | remedy |\n|---|---|---|---|"]
        for name, one in entries.items():
            code = f"{area}.{name}"
            cells = [f"`{code}`", one.weight, bare(one.short), bare(one.remedy)]
            rows[-1] += "\n| " + " | ".join(cell.translate(PLAIN) for cell in cells) + " |"
        parts += rows
    return "\n\n".join(parts) + "\n"


class PlainMaths(Extension):
    """Keep x_t and [W][m] as text: they are indices and shapes, not emphasis and links."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Match such text after code and before links and emphasis."""
        for name, pattern, priority in (
            ("shapes", r"((?:\[[^\]\[.`]*\] ?){2,})", 189.5),
            ("underscores", "(_)", 65),
        ):
            md.inlinePatterns.register(SimpleTextInlineProcessor(pattern), name, priority)


def on_config(config: Any) -> Any:
    """Add the reference to the navigation."""
    config.markdown_extensions.append(PlainMaths())
    for package in SOURCES:
        pages = [{room: f"reference/{room}.md"} for room in rooms(package)]
        config.nav.append({f"Reference: {package}": pages})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    files.append(File.generated(config, "findings.md", content=findings()))
    for package in SOURCES:
        for room in rooms(package):
            files.append(File.generated(config, f"reference/{room}.md", content=page(room)))
    return files
