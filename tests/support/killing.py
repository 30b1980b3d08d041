"""Run `grounded` commands and kill them at random moments, in a separate process for test_store."""

import os
import random
import signal
import sys
import time
from importlib import import_module


def child(arguments):
    os.dup2(2, 1)  # only the count goes to stdout
    sys.argv = ["grounded", *arguments]
    try:
        import_module("grounded_cli.main").main()
    except SystemExit as stop:
        os._exit(int(stop.code or 0))
    os._exit(99)


def main():
    seed, kills, longest, folder, *command = sys.argv[1:]
    for name in ("main", "learn", "propose", "ingest"):
        import_module(f"grounded_cli.{name}")
    for name in ("intake.ingest", "candidates.running", "candidates.proposing"):
        import_module(f"grounded_trials.workspace.{name}")
    import_module("grounded.search.improve")
    import_module("llvmlite.binding")
    rng, killed = random.Random(int(seed)), 0
    for k in range(int(kills) + 1):
        pid = os.fork()
        if pid == 0:
            child(["-C", folder, *command])
        if k < int(kills):
            time.sleep(rng.uniform(0, float(longest)))
            os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        killed += os.WIFSIGNALED(status)
    print(killed, os.waitstatus_to_exitcode(status))


main()
