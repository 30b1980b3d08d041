"""Entry point of `grounded`: an interrupt during the imports ends it without a traceback."""

# the built-in module: `signal` imports `enum` first, and may be interrupted there
from _signal import SIG_DFL, SIGINT, signal  # type: ignore[import-not-found]


def main() -> None:
    """Import the command line and run it."""
    handler = signal(SIGINT, SIG_DFL)
    import gc

    gc.set_threshold(100_000, 50, 100)  # commands are short: frequent collection costs more
    gc.disable()  # until the command is imported
    from grounded_cli.main import main as run

    signal(SIGINT, handler)
    run()
