"""The `grounded` command: turns errors into exit codes; `commands` has what it does.

    0 done      1 failed, with one clear message      2 usage      3 done with loss, saying what

A GroundedError is something the user can fix and is printed as one message. Any other exception is
a bug in grounded and keeps its traceback.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from io import StringIO, TextIOWrapper
from pathlib import Path
from typing import NoReturn

import click

from grounded.errors import GroundedError
from grounded_cli.commands import cli
from grounded_cli.console.terminal import ALARM, remark, say, style

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: threads only slow start-up


def main() -> NoReturn:
    """Run the command line and exit with its code."""
    atexit.register(gc.freeze)  # saves the 30 ms garbage collection at exit
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # show "?" for characters the encoding lacks
            stream.reconfigure(errors="replace")
    warnings.showwarning = _noted  # type: ignore[assignment]
    try:
        code, words = _run()
        if words:
            say(words)
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader has gone, as after `| head`
        code = 0
        _silence()
    except OSError as error:
        code = 1
        with suppress(OSError):
            sys.stderr.write(f"error: cannot write the output: {error.strerror}\n")
        _silence()
    sys.exit(code)


def _noted(message: object, category: object, filename: str, lineno: int, *_: object) -> None:
    """Print a warning of Python, such as NumPy's about the user's model, as a remark."""
    with suppress(OSError):
        remark("warning", f"{message} ({Path(filename).name}, line {lineno})")


INTERRUPTED = "interrupted; stored data is safe, run the same command again"


def _run() -> tuple[int, str]:
    """Run the command; return its exit code and a final message."""
    stdout = sys.stdout
    try:
        code = cli.main(standalone_mode=False, prog_name="grounded")
    except click.exceptions.Exit as stop:
        return stop.exit_code, ""
    except click.ClickException as error:
        text = StringIO()
        error.show(text)
        return error.exit_code, text.getvalue().rstrip()
    except (click.Abort, KeyboardInterrupt) as error:
        found = str(error.__cause__ or "") and f"{error.__cause__}\n"
        return 130, f"{found}{INTERRUPTED}"
    except SystemExit as error:
        if sys.stdout not in (stdout, sys.stderr):  # click found a closed pipe
            raise BrokenPipeError from None
        if "_GROUNDED_COMPLETE" in os.environ:  # click ends the program once it has completed words
            raise
        return 1, f"error: something that grounded called ended the program ({error.code})"
    except Exception as error:
        if any(isinstance(one, KeyboardInterrupt) for one in _leading_to(error)):
            return 130, INTERRUPTED
        if isinstance(error, OSError) and error.strerror:
            named = f"{error.filename}: " if error.filename else ""
            return 1, f"{style('error:', ALARM)} {named}{error.strerror}"
        if not isinstance(error, GroundedError):
            raise
        return 1, f"{style('error:', ALARM)} {error}"
    return code if isinstance(code, int) else 0, ""


def _leading_to(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and those before it: an import turns Ctrl-C into an error of its own."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _silence() -> None:
    """Discard output still buffered, or Python would report an error at exit."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # closed, or without a descriptor
            os.dup2(nowhere, stream.fileno())


if __name__ == "__main__":
    main()
