"""The `grounded` command: imports each command when it is called, turns errors into exit codes.

    0 done      1 failed, with one clear message      2 usage      3 done with loss, saying what

A GroundedError is something the user can fix and is printed as one message. Any other exception is
a bug in grounded and keeps its traceback.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from io import StringIO, TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn, TextIO

import click
from click.shell_completion import CompletionItem

from grounded import __version__
from grounded.errors import GroundedError
from grounded.refusals import unknown
from grounded_cli.console.terminal import ALARM, remark, say, style
from grounded_cli.console.workspace_option import given, in_workspace, next_line
from grounded_trials.wording import placed

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: threads only slow start-up

# name -> (module, one line); in the order in which they are used
COMMANDS = {
    "init": ("init", "Make a workspace from a log or an example."),
    "target": ("target", "Draw the manoeuvre: line, circle, figure-8, step, swing-up, a run."),
    "excite": ("excite", "Write the drive to record first, before there is a target."),
    "propose": ("propose", "Say what to run next and write its candidate file."),
    "run": ("learn", "Run the candidate on the system of grounded.toml."),
    "ingest": ("ingest", "Check, resample and store the log of a run."),
    "next": ("ingest", "Ingest a log, propose, and export for the robot, in one go."),
    "discard": ("discard", "Set a trial aside; nothing is deleted."),
    "restore": ("discard", "Use a discarded trial again."),
    "learn": ("learn", "Propose, run and ingest until the search ends."),
    "status": ("status", "Show where the search stands."),
    "report": ("report", "Summarise all trials: text, page, pictures, recording."),
    "view": ("report", "Open the recording in Rerun."),
    "fit": ("fit", "Estimate the model's parameters from all trials."),
    "diagnose": ("diagnose", "Find where the model is wrong, and which effect explains it."),
    "adopt": ("adopt", "Add a diagnosed effect to the model."),
    "inspect": ("inspect", "Show what is in a log and guess its [log] table."),
    "recover": ("recover", "Recover what is readable in a damaged log."),
    "export": ("export", "Write a candidate for the robot: csv, npz or json."),
    "verify": ("status", "Check every stored file against its hash."),
    "demo": ("demo", "Run a whole example in a new folder: learn, diagnose, report."),
    "experiment": ("experiment", "Reproduce the paper's studies."),
    "challenge": ("challenge", "Make, diagnose and score blind cases for the diagnosis."),
    "explain": ("explain", "Say what the code of a finding, or an effect, means."),
    "completion": ("console.completion", "Print the shell's completion script."),
}


class LazyGroup(click.Group):
    """A group that imports a command's module when it is called, so that start-up stays fast."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the command names, in the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Import and return the command with this name."""
        if name not in COMMANDS:
            return None
        module = importlib.import_module(f"grounded_cli.{COMMANDS[name][0]}")
        if not gc.isenabled():  # see `main`
            gc.freeze()
            gc.enable()
        commands = (one for one in vars(module).values() if isinstance(one, click.Command))
        return next(one for one in commands if one.name == name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Suggest the nearest name for an unknown command."""
        name = args[0]
        if name in COMMANDS or name.startswith("-"):
            return super().resolve_command(ctx, args)
        ctx.fail(str(unknown("command", name, COMMANDS)))

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; append the command to type next to the message of a GroundedError."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            if not isinstance(error, GroundedError):
                raise
            then = "" if error.then is None else f"\n{next_line(error.then)}"
            raise GroundedError(f"{placed(str(error), given())}{then}") from None

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete command names without importing any command."""
        named = [(name, text) for name, (_, text) in COMMANDS.items()]
        found = [CompletionItem(n, help=text) for n, text in named if n.startswith(incomplete)]
        return [*found, *click.Command.shell_complete(self, ctx, incomplete)]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing any."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="grounded")
def cli() -> None:
    """Teach a real system a manoeuvre in a few trials, from a crude model.

    Start with `grounded demo car-figure8` in an empty folder, or make a workspace of your own with
    `grounded init DIR --example car-turn`.
    """


in_workspace(cli)


def main() -> NoReturn:
    """Run the command line and exit with its code."""
    gc.disable()  # until the command is imported: 80 collections on the way would find nothing
    gc.set_threshold(30_000)  # not 700, for what it goes on to import
    atexit.register(gc.freeze)  # saves the 30 ms garbage collection at exit
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # show "?" for characters the encoding lacks
            stream.reconfigure(errors="replace")
    warnings.showwarning = _noted
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


def _noted(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
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
