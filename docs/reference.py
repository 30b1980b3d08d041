"""Generates the site's reference: a page for every room, from its docstrings (a hook of MkDocs).

A room is a folder with an `__init__.py`. Its page opens with what the room is for and in which
order to read it, then shows the public names of each of its modules. Rooms are found, not listed: a
new one has its page at once.
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

ROOT = Path(__file__).resolve().parent.parent
SOURCES = {"grounded": ROOT, "grounded_trials": ROOT / "trials", "grounded_cli": ROOT / "cli"}
TITLES = {
    "grounded": "grounded, the method",
    "grounded_trials": "grounded_trials, the disk",
    "grounded_cli": "grounded_cli, the commands",
}


def rooms(package: str) -> list[str]:
    """The rooms of a package by their import names, the package itself first."""
    source = SOURCES[package]
    folders = sorted(path.parent for path in (source / package).rglob("__init__.py"))
    return [".".join(folder.relative_to(source).parts) for folder in folders]


def modules(room: str) -> list[str]:
    """The public modules of a room by their import names."""
    folder = SOURCES[room.partition(".")[0]].joinpath(*room.split("."))
    stems = sorted(path.stem for path in folder.glob("*.py"))
    return [f"{room}.{stem}" for stem in stems if not stem.startswith("_")]


def purpose(room: str) -> str:
    """What the docstring of a room says; its lines `name   what it is` become a list."""
    text = inspect.getdoc(import_module(room)) or ""
    listed = re.sub(r"^([\w./]+(?:, [\w./]+)*) {2,}(.+)$", r"- `\1`: \2", text, flags=re.M)
    return re.sub(r"^(?!- )(.+)\n(?=- )", r"\1\n\n", listed, flags=re.M)


def door(package: str) -> list[str]:
    """The names that a package hands out, a line each, linked to where they are defined."""
    found = import_module(package)
    lines = []
    for name in getattr(found, "__all__", ()):
        value = getattr(found, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            first = (inspect.getdoc(value) or "").partition("\n")[0]
            lines.append(f"- [`{name}`][{value.__module__}.{value.__qualname__}]: {first}")
    return ["## The front door", "\n".join(lines)] if lines else []


def page(room: str) -> str:
    """The page of a room in Markdown, for mkdocstrings to fill in."""
    opening = [f"# {TITLES.get(room, room)}", purpose(room)]
    front = door(room) if room in SOURCES else []
    return "\n\n".join(opening + front + [f"::: {module}" for module in modules(room)]) + "\n"


class PlainMaths(Extension):
    """Leaves x_t and [W][m] alone: they are indices and shapes, not emphasis and links."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Takes such text for itself, after code and before links and emphasis."""
        for name, pattern, priority in (
            ("shapes", r"((?:\[[^\]\[.`]*\] ?){2,})", 189.5),
            ("underscores", "(_)", 65),
        ):
            md.inlinePatterns.register(SimpleTextInlineProcessor(pattern), name, priority)


def on_config(config: Any) -> Any:
    """Adds the reference to the navigation."""
    config.markdown_extensions.append(PlainMaths())
    for package in SOURCES:
        pages = [{room: f"reference/{room}.md"} for room in rooms(package)]
        config.nav.append({f"Reference: {package}": pages})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages themselves."""
    for package in SOURCES:
        for room in rooms(package):
            files.append(File.generated(config, f"reference/{room}.md", content=page(room)))
    return files
