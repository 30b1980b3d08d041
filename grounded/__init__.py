"""Learn a manoeuvre on a real system in a few trials from a crude model; diagnose model errors.

    import grounded as gr

    search = gr.Search(gr.Task(model=gr.Model(...), ...))
    while (candidate := search.ask()) is not None:
        search.tell(run(candidate))                # run returns a gr.Trial of the real system
    found = gr.diagnose(search.task, search.trials)

The algorithm is that of Abbeel, Quigley & Ng, "Using Inaccurate Models in Reinforcement Learning",
ICML 2006; start reading in `grounded.search.improve`. The modules of this package define the data
types:

model, task, utility    the crude model, the manoeuvre, its quadratic reward
trial, rollout, plant   a real run, a simulated run, a simulated real system
policy, onboard         what a robot runs, and the single file that runs it with numpy alone
result, errors, frozen  base classes of results, errors and read-only arrays; `figures` draws them
engine                  where independent pieces of work run: in this process, threads, a cluster

The subpackages, in the order of the paper's loop:

search       chooses what to run next from stored trials
solve        optimal control in the model, and the bias that makes the model replay a trial
compile      differentiates and compiles a model written in NumPy
diagnosis    finds what the model lacks; `effects` lists candidates; `challenge` makes blind tests
accounts     judges how a log came about, and corrects what its sensors and commands show
estimate     estimates states and noise from measurements; `fit` estimates parameters from trials
models       models that come with grounded; `adapters` wraps models of other software
experiments  the paper's studies

The names in `__all__` are imported on first use.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from grounded.diagnosis.diagnose import diagnose
    from grounded.diagnosis.parts import Diagnosis
    from grounded.engine import Engine
    from grounded.errors import GroundedError, NextCommand
    from grounded.fit import fit
    from grounded.model import Model, Param
    from grounded.policy import Policy
    from grounded.search.ask_tell import Search, TrialRefused, learn
    from grounded.search.improve import propose
    from grounded.search.step_size import SearchOptions
    from grounded.task import Task
    from grounded.trial import Trial
    from grounded.utility import Reward

__version__ = "0.2.0"

__all__ = [
    "Diagnosis", "Engine", "GroundedError", "Model", "NextCommand", "Param", "Policy", "Reward",
    "Search", "SearchOptions", "Task", "Trial", "TrialRefused", "__version__", "diagnose", "fit",
    "learn", "propose",
]  # fmt: skip

_HOMES = {
    "grounded.diagnosis.diagnose": ("diagnose",),
    "grounded.diagnosis.parts": ("Diagnosis",),
    "grounded.engine": ("Engine",),
    "grounded.errors": ("GroundedError", "NextCommand"),
    "grounded.fit": ("fit",),
    "grounded.model": ("Model", "Param"),
    "grounded.policy": ("Policy",),
    "grounded.search.ask_tell": ("Search", "TrialRefused", "learn"),
    "grounded.search.improve": ("propose",),
    "grounded.search.step_size": ("SearchOptions",),
    "grounded.task": ("Task",),
    "grounded.trial": ("Trial",),
    "grounded.utility": ("Reward",),
}

if not TYPE_CHECKING:  # else type checkers would accept any misspelt attribute

    def __getattr__(name: str) -> Any:
        from importlib import import_module

        for home, names in _HOMES.items():
            if name in names:
                globals()[name] = value = getattr(import_module(home), name)
                return value
        raise AttributeError(f"module 'grounded' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Door(ModuleType):
    """Module type that keeps `grounded.fit` the function after the subpackage is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name == "fit" and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Door
