"""What the code of a user may do at the worst, as texts of Python for an attack and a test."""

from __future__ import annotations

DEEDS = {
    "prints": 'print("printed")',
    "writes to stdout": 'import os; os.write(1, b"written\\n")',
    "starts a process": 'import subprocess; subprocess.run(["echo", "started"], check=True)',
    "prints at exit": 'import atexit; atexit.register(print, "at exit")',
    "prints past sys.stdout": 'import sys; sys.__stdout__.write("past\\n")',
    "changes the folder": 'import os; os.chdir("/")',
    "warns": 'import warnings; warnings.warn("a warning of the model")',
    "exits": "raise SystemExit(0)",
    "exits with a text": 'raise SystemExit("done")',
    "raises no exception": 'raise BaseException("no exception")',
    "stops a generator": "raise GeneratorExit",
    "raises without a text": "raise KeyError",
    "raises what can't be shown": """
class Mute(BaseException):
    def __str__(self):
        raise Mute
    __repr__ = __str__
raise Mute""",
}
HARMLESS = 7  # the first ones let a command succeed


def _at_import(text: str, deed: str) -> str:
    return f"{text}\n{deed}\n"


def _at_call(text: str, deed: str) -> str:
    inside = "\n".join(f"    {line}" for line in deed.strip("\n").split("\n"))
    return f"""{text}
import dataclasses
_before = model.derivative
def _derivative(s, a, p):
{inside}
    return _before(s, a, p)
model = dataclasses.replace(model, derivative=_derivative)
"""


def _opaque(text: str, deed: str) -> str:
    """Return a model that can't be traced: it is called with numbers, many times."""
    return _at_call(text, f"{deed}\nfloat(s.v)")


PLACES = {"import": _at_import, "call": _at_call, "black box": _opaque}
