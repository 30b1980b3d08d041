"""Every command and code block of README.md and docs/*.md runs.

    ```console    lines that start with `$ ` are run in bash; the lines that follow are the output,
                  compared loosely: numbers may differ, `...` stands for anything
    ```python     run in the same folder as the console blocks of the page, in one namespace a page
    ```toml       parsed; a block named by `<!-- file: NAME -->` is written to the workspace
    ```text, ```  not run: pictures, equations, output

An HTML comment just above a block says what is special about it:

    <!-- not run: WHY -->         it is not; WHY must be a reason
    <!-- file: NAME -->           it is written to NAME in the page's folder
    <!-- in: FOLDER -->           it starts in this folder of the page's
    <!-- workspace: EXAMPLE -->   from here on the page works in a fresh workspace of an example
    <!-- trial: NAME -->          a trial with states x, y, psi is written to NAME before
    <!-- needs: shared -->        skipped where ../shared (or an importable module) is missing
    <!-- figures: 0.1 -->         numbers may differ by this part only, and line breaks
    <!-- exit: 1 -->              the last command must end with this code
    <!-- slow -->                 only with GROUNDED_DOCS=all (above ten seconds)
    <!-- demo-command -->         the README's set-up commands: checked, and run by .ci/run
    <!-- test-command -->

Every block starts in the page's folder; a `cd` holds to the end of its block.
"""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from contextlib import chdir
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from cli import Done, grounded
from grounded.trial import Trial
from grounded_trials.store.trial_file import write_trial
from shared_data import DATA
from workspaces import make

ROOT = Path(__file__).resolve().parents[2]
PAGES = [p for p in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if p.is_file()]
NOTES = [p for p in (ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md") if p.is_file()]
FENCE = re.compile(r"^( *)```+ *(\S*).*?\n(.*?)^\1```+ *$", re.M | re.S)
MARK = re.compile(
    r"<!--\s*(not run|file|in|trial|workspace|needs|figures|exit|slow|demo-command|test-command)"
    r"\s*:?\s*(.*?)\s*-->",
    re.S,
)
NUMBER = re.compile(r"[-+]?\d[\d,]*(\.\d+)?(e[-+]?\d+)?")
RUN = ("console", "python", "bash", "sh", "shell", "toml", "json")
SHOWN = ("", "text", "mermaid", "cpp", "c++", "c", "cmake", "csv", "diff", "yaml", "xml", "html")
ALL = os.environ.get("GROUNDED_DOCS") == "all"
LONG = ("README.md", "commands.md", "python.md")  # pages that take more than four seconds


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    line: int
    marks: dict[str, str] = field(default_factory=dict)


def blocks_of(text: str) -> list[Block]:
    """The fenced blocks of a page with the comments that stand directly above each."""
    found, end = [], 0
    for match in FENCE.finditer(text):
        above = re.split(r"\n\s*\n(?!\s*<!--)", text[end : match.start()].rstrip("\n"))[-1]
        comments = re.search(r"(?:<!--(?:(?!-->).)*-->\s*)+$", above, re.S)
        marks = dict(MARK.findall(comments.group(0))) if comments else {}
        indent = len(match[1])
        body = "".join(line[indent:] for line in match[3].splitlines(keepends=True))
        found.append(Block(match[2].lower(), body, text[: match.start()].count("\n") + 1, marks))
        end = match.end()
    return found


def sessions(text: str) -> list[tuple[str, list[str]]]:
    """Commands of a console block, each with the output lines shown below it."""
    found: list[tuple[str, list[str]]] = []
    lines = iter(text.splitlines())
    for line in lines:
        if line.startswith("$ "):
            command = line[2:]
            while command.endswith("\\"):
                command = command[:-1] + next(lines).removeprefix("> ")
            found.append((command, []))
        elif found:
            found[-1][1].append(line)
    return found


def told_otherwise(shown: str, out: str, part: float) -> str:
    """What the page shows otherwise than the output, whose numbers may differ by a part of them."""
    words = [" ".join(NUMBER.sub("\0", text).split()) for text in (shown, out)]
    if (at := words[1].find(words[0])) < 0:
        pairs = enumerate(zip(*words, strict=False))
        first = next((i for i, (a, b) in pairs if a != b), len(words[1]))
        return " instead of ".join(text[first : first + 100].replace("\0", "N") for text in words)
    here, there = ([float(m[0].replace(",", "")) for m in NUMBER.finditer(t)] for t in (shown, out))
    there = there[words[1][:at].count("\0") :]
    unlike = [(a, b) for a, b in zip(here, there, strict=False) if abs(a - b) > part * abs(b)]
    return ", ".join(f"{a} instead of {b}" for a, b in unlike)


def loosely(line: str) -> str:
    """A line with what may differ from run to run left out: numbers, blanks, bars, paths."""
    line = re.sub(r"\x1b\[[0-9;]*m", "", line)
    line = re.sub(r"[▁▂▃▄▅▆▇█x]{2,}", "BAR", line)
    line = re.sub(r"[0-9a-f]{12,}", "HASH", line)
    line = NUMBER.sub("N", line)
    return re.sub(r"\s+", " ", line).strip()


def missing_lines(shown: list[str], out: str) -> list[str]:
    """Shown lines that the output does not hold, in order; `...` skips any number."""
    real = [loosely(line) for line in out.splitlines()]
    at, missing = 0, []
    for line in shown:
        wanted = loosely(line)
        if not wanted or wanted in ("...", "…"):
            continue
        pattern = re.compile(re.escape(wanted).replace(r"\.\.\.", ".*"))
        hit = next((i for i in range(at, len(real)) if pattern.fullmatch(real[i])), None)
        if hit is None:
            missing.append(line)
        else:
            at = hit + 1
    return missing


class Page:
    """Runs the blocks of one page, one after another, in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.names, self.count = folder, {"__name__": "__main__"}, 0
        binary = Path(sys.executable).parent
        self.env = os.environ | {
            "PATH": f"{binary}{os.pathsep}{os.environ['PATH']}",
            "NO_COLOR": "1",
            "COLUMNS": "80",
        }
        if DATA is not None:
            self.env["GROUNDED_SHARED"] = str(DATA.parent)

    def take(self, block: Block) -> None:
        if "workspace" in block.marks:
            self.count += 1
            folder = self.folder / f"w{self.count}"
            self.folder = make(folder, block.marks["workspace"]).folder
        if "trial" in block.marks:
            _write_trial(self.folder / block.marks["trial"])
        if "file" in block.marks:
            path = self.folder / block.marks["file"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
        if block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "json":
            json.loads(block.text)
        elif block.language == "python":
            self.python(block)
        elif block.language in ("console", "bash", "sh", "shell"):
            self.console(block)

    def python(self, block: Block) -> None:
        if "file" in block.marks:
            ast.parse(block.text)
            return
        script = self.folder / f".block_{block.line}.py"
        before = Path.cwd()
        try:
            os.chdir(self.folder)
            exec(compile("\n" * block.line + block.text, str(script), "exec"), self.names)
        finally:
            os.chdir(before)

    def done(self, command: str, folder: Path) -> Done:
        """A command's result: in this process if it is `grounded` and plain words, else in bash."""
        program, *words = command.split()
        if program == "grounded" and re.fullmatch(r"[\w ./:,=+-]*", " ".join(words)):
            with chdir(folder), patch.dict(os.environ, self.env):
                return grounded(*words)
        ran = subprocess.run(
            ["bash", "-c", command],
            cwd=folder,
            env=self.env,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        return Done(ran.returncode, ran.stdout, ran.stderr)

    def console(self, block: Block) -> None:
        steps = sessions(block.text)
        if block.language != "console" and not steps:
            steps = [(line, []) for line in block.text.splitlines() if line.strip()]
        assert steps, f"line {block.line}: a console block needs lines that start with '$ '"
        folder = self.folder / block.marks.get("in", "")
        for k, (command, shown) in enumerate(steps):
            if command.startswith("cd "):
                folder = (folder / command[3:].split("&&")[0].strip()).resolve()
                if "&&" not in command:
                    continue
                command = command.split("&&", 1)[1].strip()
            done = self.done(command, folder)
            last = k == len(steps) - 1
            wanted = int(block.marks.get("exit", "0")) if last else 0
            said = f"line {block.line}: $ {command}\n{done.out}{done.err}"
            assert done.code == wanted, said
            if part := float(block.marks.get("figures", "0")):
                otherwise = told_otherwise("\n".join(shown), done.out, part)
                assert not otherwise, f"{said}\nthe page shows {otherwise}"
                continue
            lost = missing_lines(shown, done.out + done.err)
            lost = missing_lines(shown, done.err + done.out) if lost else lost
            assert not lost, f"{said}\nshown in the page, not in the output: {lost}"


def _there(name: str) -> bool:
    if name == "shared":
        return DATA is not None
    return not name or importlib.util.find_spec(name) is not None


def _write_trial(path: Path) -> None:
    states, inputs = np.zeros((21, 3)), np.zeros((20, 2))
    trial = Trial(states, inputs, 0.05, ("x", "y", "psi"), ("speed", "turn"))
    write_trial(path, trial, {"kind": "trial"})


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=pytest.mark.slow) if p.name in LONG else p for p in PAGES],
    ids=[str(p.relative_to(ROOT)) for p in PAGES],
)
def test_every_block_of_the_page_runs(page, tmp_path):
    runner, skipped = Page(tmp_path), []
    for block in blocks_of(page.read_text()):
        where = f"{page.name} line {block.line}"
        assert block.language in RUN + SHOWN, f"{where}: unknown language '{block.language}'"
        if "not run" in block.marks:
            assert len(block.marks["not run"]) >= 5, f"{where}: say why it is not run"
            continue
        if block.language in SHOWN:
            if "file" in block.marks:
                (runner.folder / block.marks["file"]).write_text(block.text)
            continue
        if not _there(block.marks.get("needs", "")):
            skipped.append(f"{where}: {block.marks['needs']} is missing")
            continue
        if {"demo-command", "test-command"} & set(block.marks):
            continue
        if "slow" in block.marks and not ALL:
            skipped.append(f"{where}: slow (GROUNDED_DOCS=all)")
            continue
        runner.take(block)
    if skipped:
        print("\n".join(skipped))


def test_the_two_set_up_commands_are_complete():
    """One line each, from nothing but Python: a venv, an install that exists, what is promised."""
    marked = {}
    for block in blocks_of((ROOT / "README.md").read_text()):
        for name in {"demo-command", "test-command"} & set(block.marks):
            marked[name] = block.text.strip()
    if not marked:
        pytest.skip("README.md marks no set-up commands yet")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for text in marked.values():
        assert "\n" not in text and text.startswith(
            "python3 -m venv .venv && .venv/bin/pip install"
        )
        for extra in re.findall(r"\[(\w+)\]", text):
            assert extra in project["optional-dependencies"]
    assert marked["demo-command"].endswith(".venv/bin/grounded demo car-figure8")
    assert "pytest" in marked["test-command"] and len(marked) == 2


def test_links_between_pages_lead_somewhere():
    for page in [*PAGES, *NOTES]:
        text = FENCE.sub("", page.read_text())
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", text):
            assert (page.parent / target).exists(), f"{page.name}: {target} is not there"


@pytest.mark.skipif(not (ROOT / "grounded").is_dir(), reason="only a checkout has the code's files")
@pytest.mark.parametrize("page", [*PAGES, *NOTES], ids=lambda p: p.name)
def test_files_and_modules_that_a_page_names_are_there(page):
    text = page.read_text()
    ours = r"\b(?:grounded|trials/grounded_trials|cli|tests|benchmarks)/[\w./-]*[\w/]"
    for path in re.findall(ours, text):
        assert path.endswith("NAME.py") or (ROOT / path).exists(), f"{path} is not there"
    folders = ("grounded", "trials", "cli", "tests", "benchmarks")
    files = {path.name for folder in folders for path in (ROOT / folder).rglob("*.py")}
    files |= {"model.py", "real.py", "drive.py", "rig.py", "grounded_runner.py"}  # a user's own
    for name in re.findall(r"`(\w+\.py)`", text):
        assert name in files, f"{name} is not there"
    for name in set(re.findall(r"\bgrounded(?:_trials|_cli)?(?:\.[a-z]\w*)+", text)):
        assert name == "grounded.toml" or pkgutil.resolve_name(name) is not None


@pytest.mark.skipif(not (ROOT / "grounded").is_dir(), reason="only a checkout has the code's files")
def test_every_room_says_where_to_begin_and_names_files_that_are_there():
    for package in ("grounded", "trials/grounded_trials", "cli/grounded_cli"):
        for room in (ROOT / package).rglob("__init__.py"):
            text = ast.get_docstring(ast.parse(room.read_text())) or ""
            assert re.search(r"\b[Rr]ead|START HERE", text), f"{room}: where does one begin?"
            for name in re.findall(r"`(\w+\.py)`", text):
                assert (room.parent / name).exists(), f"{room}: {name} is not there"


def test_every_command_is_documented():
    from grounded_cli.commands import cli

    text = "\n".join(page.read_text() for page in PAGES)
    missing = [name for name in cli.commands if f"grounded {name}" not in text]
    if not (ROOT / "README.md").read_text().count("```") > 4:
        pytest.skip("README.md is not written yet")
    assert not missing, f"no page shows {missing}"
