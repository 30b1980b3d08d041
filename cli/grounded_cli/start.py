"""Where `grounded` starts: an interrupt while modules are imported ends it without a traceback."""

import gc

# of the interpreter itself: `signal` imports `enum` first, and may be interrupted there
from _signal import SIG_DFL, SIGINT, signal  # type: ignore[import-not-found]


def main() -> None:
    """Imports the command line and runs it."""
    gc.set_threshold(100_000, 50, 100)  # a command ends soon: looking for garbage costs more
    handler = signal(SIGINT, SIG_DFL)
    from grounded_cli.main import main as run

    signal(SIGINT, handler)
    run()
