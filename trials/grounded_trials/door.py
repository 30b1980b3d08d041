"""The entry point of the package: a workspace with a method for every command.

    from grounded_trials import Workspace

    w = Workspace.create("turn", example="car-turn")
    w.learn(trials=5)
    w.diagnose()
    w.report(html=True)

Each method does what the command of the same name does, on the current files, and returns a frozen
result; its `to_json()` is the document that the command prints with --json.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import wraps
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, cast

from grounded.checks import refused
from grounded_trials.plain_file import path_of
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.frozen import Array
    from grounded_trials.report.reporting import report_in
    from grounded_trials.starting.drawing import draw as _draw
    from grounded_trials.workspace.adoption import adopt_effects
    from grounded_trials.workspace.adoption import undo_adoption as _undo_adoption
    from grounded_trials.workspace.candidates.exporting import export_in
    from grounded_trials.workspace.candidates.proposing import propose_in, status_in
    from grounded_trials.workspace.candidates.running import run_candidate
    from grounded_trials.workspace.diagnosing import diagnose_in, instruments_in
    from grounded_trials.workspace.discarding import discard_in, restore_in
    from grounded_trials.workspace.exciting import excite_in
    from grounded_trials.workspace.fitting import fit_in
    from grounded_trials.workspace.home.library import begin_with as _begin_with
    from grounded_trials.workspace.home.library import export_actuator as _export_actuator
    from grounded_trials.workspace.home.taking_home import export_model as _export_model
    from grounded_trials.workspace.inspecting import inspect_in
    from grounded_trials.workspace.intake.ingest import Ingested
    from grounded_trials.workspace.looping import learn_in, next_in
    from grounded_trials.workspace.verifying import verify_in


class _Method:
    """A method of `Workspace` that is a function of another module, imported when it is called.

    Args:
        path: the module in this package, and the function, whose first argument is the workspace.
        writes: whether it changes files of the user, to be read again.
    """

    def __init__(self, path: str, *, writes: bool = False) -> None:
        self.module, _, self.name = path.rpartition(".")
        self.writes = writes

    def __get__(self, workspace: Workspace | None, owner: type) -> Callable[..., Any]:
        function = getattr(import_module(f"grounded_trials.{self.module}"), self.name)
        if workspace is None:
            return cast("Callable[..., Any]", function)

        @wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            done = function(workspace.forget(), *args, **options)
            if self.writes:
                workspace.forget()
            return done

        return call


class Workspace(Folder):
    """A folder with a task, its trials and its candidates, with a method for every command.

    Every method raises a GroundedError for problems that the user can fix, such as a missing file.

    Args:
        folder: the folder of grounded.toml, which must exist and be valid.
    """

    def __init__(self, folder: str | Path = ".") -> None:
        super().__init__(folder)
        _ = self.config

    @classmethod
    def create(
        cls,
        folder: str | Path,
        *,
        example: str | None = None,
        log: str | Path | None = None,
        model: str | Path | None = None,
        dt: float | None = None,
    ) -> Self:
        """Create a workspace from an example, a log or a model; never overwrites a file.

        Args:
            folder: the workspace to create.
            example: car-turn, car-circle, car-figure8, flight-figure8 or pendulum.
            log: a log of your robot, in any format. `starting.begin.begin` also returns what was
                found in it.
            model: your model.py, or an MJCF or URDF file. With `log`, None writes a model skeleton.
                Without `log`, the target, weights and drive.py are placeholders to fill in.
            dt: control interval [s]; None: that of the log, 0.05 without a log.

        Raises:
            GroundedError: if there is no such example, the log can't be read, or the folder already
                holds a workspace.
        """
        if (example is None) == (log is None and model is None):
            raise refused("given.either", "example", "log or model", how="one")
        if log is None and model is not None:
            from grounded_trials.starting.blank import write_blank

            write_blank(Path(folder), model, dt)
        elif log is not None:
            from grounded_trials.starting.begin import begin

            begin(Path(folder), log, model=model, dt=dt)
        elif example is not None:
            from grounded_trials.starting.examples import write_example

            write_example(Path(folder), example)
        return cls(folder)

    # the functions that are its methods; each is imported when it is first called
    if TYPE_CHECKING:
        propose = propose_in
        run = run_candidate
        next = next_in
        draw = _draw
        excite = excite_in
        learn = learn_in
        status = status_in
        fit = fit_in
        diagnose = diagnose_in
        preflight = instruments_in
        adopt = adopt_effects
        undo_adoption = _undo_adoption
        report = report_in
        export = export_in
        export_model = _export_model
        export_actuator = _export_actuator
        begin_with = _begin_with
        verify = verify_in
        discard = discard_in
        restore = restore_in
        inspect = inspect_in
    else:
        propose = _Method("workspace.candidates.proposing.propose_in")
        run = _Method("workspace.candidates.running.run_candidate")
        next = _Method("workspace.looping.next_in")
        draw = _Method("starting.drawing.draw")
        excite = _Method("workspace.exciting.excite_in")
        learn = _Method("workspace.looping.learn_in")
        status = _Method("workspace.candidates.proposing.status_in")
        fit = _Method("workspace.fitting.fit_in", writes=True)
        diagnose = _Method("workspace.diagnosing.diagnose_in")
        preflight = _Method("workspace.diagnosing.instruments_in")
        adopt = _Method("workspace.adoption.adopt_effects", writes=True)
        undo_adoption = _Method("workspace.adoption.undo_adoption", writes=True)
        report = _Method("report.reporting.report_in")
        export = _Method("workspace.candidates.exporting.export_in")
        export_model = _Method("workspace.home.taking_home.export_model")
        export_actuator = _Method("workspace.home.library.export_actuator")
        begin_with = _Method("workspace.home.library.begin_with")
        verify = _Method("workspace.verifying.verify_in")
        discard = _Method("workspace.discarding.discard_in")
        restore = _Method("workspace.discarding.restore_in")
        inspect = _Method("workspace.inspecting.inspect_in")

    def __repr__(self) -> str:
        return f"Workspace({str(self.folder)!r})"

    def ingest(
        self,
        path: str | Path,
        *,
        candidate: str | None = None,
        data: bool = False,
        group: str = "",
        before: Mapping[str, float] = MappingProxyType({}),
    ) -> Ingested:
        """Check, resample and store a trial; a trial that is already stored is not added again.

        Args:
            path: a trial file of grounded's, a log of another format, or the folder of a bag. Of a
                LeRobot data set each episode is stored, and the last one is returned.
            candidate: the candidate that was run, or `best`; None: the log's, else the outstanding.
            data: the log ran no candidate and serves fitting and diagnosis only.
            group: the condition that it was run in ("wet"); a diagnosis fits its values without a
                group and predicts that.
            before: inputs' values until the log's first row, which it then need not hold.
        """
        from grounded_trials.logs.log_paths import logs_in
        from grounded_trials.workspace.intake.ingest import ingest_log

        about: dict[str, Any] = {"data": data, "group": group, "sent_before": before}
        for log in logs_in(path_of(path)):
            done = ingest_log(self.forget(), log, candidate, **about)
        return done

    def target(
        self,
        columns: Mapping[str, Array],
        terminal: Mapping[str, float] | None = None,
        only_at_end: Collection[str] = (),
    ) -> Path:
        """Write target.csv and set the horizon in grounded.toml; the old target is kept as .bak.

        Args:
            columns: the desired values of each state, (H + 1,), one per control step. The functions
                of `starting.shapes` return such columns. They are checked before a file is changed.
            terminal: weights for [reward] terminal, for states without one.
            only_at_end: columns that get no weight in [reward] state.
        """
        from grounded_trials.workspace.new_target import replace_target

        here = self.forget()
        path = replace_target(here.config, columns, here.base_model, terminal or {}, only_at_end)
        self.forget()
        return path
