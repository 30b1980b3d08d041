"""Where `grounded` starts: an interrupt while modules are imported ends it without a traceback."""

import gc
import signal


def main() -> None:
    """Imports the command line and runs it."""
    gc.set_threshold(100_000, 50, 100)  # a command ends soon: looking for garbage costs more
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from grounded_cli.main import main as run

    signal.signal(signal.SIGINT, handler)
    run()
