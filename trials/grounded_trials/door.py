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

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

from grounded.checks import refused
from grounded.errors import GroundedError, needs
from grounded_trials.plain_file import path_of
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.accounts.finding import Finding as Fault
    from grounded.diagnosis.parts import Diagnosis
    from grounded.effects import Library
    from grounded.engine import Engine
    from grounded.findings import Finding
    from grounded.frozen import Array
    from grounded.search.candidate import Candidate
    from grounded_trials.report.reporting import Report
    from grounded_trials.starting.drawing import Drawn, Manoeuvre
    from grounded_trials.workspace.adoption import Adopted, Undone
    from grounded_trials.workspace.candidates.exporting import Exported
    from grounded_trials.workspace.candidates.proposing import Proposed, Status
    from grounded_trials.workspace.candidates.running import Ran
    from grounded_trials.workspace.discarding import SetAside
    from grounded_trials.workspace.exciting import Excited
    from grounded_trials.workspace.fitting import Fitted
    from grounded_trials.workspace.home.library import Shelved
    from grounded_trials.workspace.home.rivals import Compared
    from grounded_trials.workspace.home.taking_home import TakenHome
    from grounded_trials.workspace.inspecting import Inspected
    from grounded_trials.workspace.intake.ingest import Ingested
    from grounded_trials.workspace.looping import NextRun
    from grounded_trials.workspace.verifying import Verified


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

    def __repr__(self) -> str:
        return f"Workspace({str(self.folder)!r})"

    def propose(self, tick: Callable[[str], None] | None = None) -> Proposed:
        """Propose the next candidate to run and write its file.

        While a candidate's trial is outstanding, the same candidate is returned.

        Args:
            tick: called with a line of progress during a long first plan.
        """
        from grounded_trials.workspace.candidates.proposing import propose_in

        return propose_in(self.forget(), tick)

    def run(
        self,
        candidate: str | None = None,
        *,
        anyway: bool = False,
        warn: Callable[[Finding], None] | None = None,
    ) -> Ran:
        """Run a candidate on [system] and write a trial file, to be ingested.

        The candidate is refused if its file was altered since it was proposed, or if it is void
        because [limits], [safety], the task or the model have changed.

        Args:
            candidate: c0003, or `best`; None: the outstanding one.
            anyway: run it although it is void.
            warn: called with the finding of each check that is overridden, before the robot moves.
        """
        from grounded_trials.workspace.candidates.running import run_candidate

        return run_candidate(self.forget(), candidate, anyway=anyway, warn=warn)

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
        from grounded_trials.logs.log_files import logs_in
        from grounded_trials.workspace.intake.ingest import ingest_log

        about: dict[str, Any] = {"data": data, "group": group, "sent_before": before}
        each = logs_in(path_of(path))
        done = [ingest_log(self.forget(), log, candidate, ahead=True, **about) for log in each]
        return done[-1]

    def next(
        self, log: str | Path, *, candidate: str | None = None, runner: bool = True
    ) -> NextRun:
        """Ingest a log, propose the next candidate and export it for the robot, in one call.

        Args:
            log: the log of the run.
            candidate: the candidate that was run; None: the outstanding one.
            runner: also write the program that runs the exported candidate, see `export`.
        """
        from grounded_trials.workspace.looping import next_in

        return next_in(self.forget(), path_of(log), candidate, runner=runner)

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

    def draw(self, asked: Manoeuvre) -> Drawn:
        """Write a line, circle, figure-8, step, swing-up or recorded run as the target.

        Args:
            asked: the manoeuvre.

        Raises:
            GroundedError: if it can't be drawn for this model; the files are then as before.
        """
        from grounded_trials.starting.drawing import draw

        return draw(self.forget(), asked)

    def excite(self, seconds: float | None = None) -> Excited:
        """Write the drive to record first, which makes uncertain parameters identifiable.

        Args:
            seconds: its duration; None: as long as it takes, up to 40 s.

        Raises:
            GroundedError: if no parameter is uncertain, [limits] or [safety] are missing, or no
                drive stays inside [safety].
        """
        from grounded_trials.workspace.exciting import excite_in

        return excite_in(self.forget(), seconds)

    def learn(
        self,
        trials: int | None = None,
        *,
        progress: Callable[[str], None] | None = None,
        each: Callable[[Candidate, Ingested], None] | None = None,
    ) -> Status:
        """Propose, run and ingest until the search ends.

        Args:
            trials: maximum number of trials in this call; None: until the search ends.
            progress: called with a description of each step.
            each: called with every candidate and its trial, once that is stored.
        """
        from grounded_trials.workspace.looping import learn_in

        return learn_in(self.forget(), trials, progress, each)

    def status(self) -> Status:
        """Return the state of the search; writes nothing."""
        from grounded_trials.workspace.candidates.proposing import status_in

        return status_in(self.forget())

    def fit(
        self,
        params: Sequence[str] | None = None,
        *,
        trials: Sequence[str] = (),
        latency: bool = False,
        apply: bool = False,
        engine: Engine | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> Fitted:
        """Estimate the model's parameters from trials, after correcting sensor errors.

        Args:
            params: names of the parameters to fit; None: all.
            trials: short names such as t0007; empty: all usable trials.
            latency: also fit one transport delay, common to all inputs.
            apply: write the values to grounded.toml.
            engine: workers for the trials' likelihoods; their number does not change the result.
            progress: called with the stage and the time taken.

        Raises:
            GroundedError: with `apply`, if the fitted values predict held-out data worse.
        """
        from grounded_trials.workspace.fitting import fit_in

        asked = partial(fit_in, self.forget(), params, trials=trials, latency=latency)
        done = asked(apply=apply, engine=engine, progress=progress)
        self.forget()
        return done

    def diagnose(
        self,
        trials: Sequence[str] = (),
        *,
        max_effects: int | None = None,
        without: Sequence[str] = (),
        library: Library | None = None,
        compare: Sequence[str] = (),
        probe: bool = False,
        engine: Engine | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> Diagnosis:
        """Explain the gap between model and trials; writes reports/diagnosis.json.

        Args:
            trials: short names such as t0007; empty: all usable trials.
            max_effects: largest number of effects in one hypothesis; None: 3, and more if those
                leave a gap.
            without: effect families to exclude.
            compare: a second group of trials; the result's `changed` lists what differs from the
                first group.
            probe: write the most informative probe even if no two explanations tie.
            engine: workers that fit hypotheses; their number does not change the result.
            library: the effects to consider; None: the installed ones.
            progress: called with each stage.
        """
        from grounded_trials.workspace.adopted import installed_effects
        from grounded_trials.workspace.diagnosing import diagnose_in

        return diagnose_in(
            self.forget(),
            trials=trials,
            max_effects=max_effects,
            without=without,
            library=library or installed_effects(),
            compare=compare,
            probe=probe,
            engine=engine,
            progress=progress,
        )

    def compare(
        self,
        first: str | Path,
        second: str | Path,
        trials: Sequence[str] = (),
        *,
        progress: Callable[[str], None] | None = None,
    ) -> Compared:
        """Compare two models on the stored trials: which predicts better, where, and which numbers.

        Args:
            first: a folder (a workspace; "." for this one), a model.py, an MJCF or URDF file, or a
                YAML file with values of this model.
            second: likewise.
            trials: short names such as t0007; empty: all usable trials.
            progress: called with each stage.
        """
        from grounded_trials.workspace.home.rivals import compare_models

        return compare_models(self.forget(), str(first), str(second), trials, progress)

    def preflight(self, trials: Sequence[str] = ()) -> tuple[Fault, ...]:
        """Check the sensors of some or all trials for delays and scale errors, from their data."""
        from grounded_trials.workspace.diagnosing import instruments_in

        return instruments_in(self.forget(), trials)

    def adopt(self, *effects: str, parameters: bool = True) -> Adopted:
        """Add effects of the last diagnosis to the model in grounded.toml.

        Args:
            effects: `family:target` names of effects that were claimed together, or of one effect.
            parameters: also take over the model parameters that were calibrated together with them.
        """
        from grounded_trials.workspace.adoption import adopt_effects

        done = adopt_effects(self.forget(), effects, parameters=parameters)
        self.forget()
        return done

    def undo_adoption(self) -> Undone:
        """Undo the last `adopt`: restore the effects and params of grounded.toml."""
        from grounded_trials.workspace.adoption import undo_adoption

        done = undo_adoption(self.forget())
        self.forget()
        return done

    def report(self, *, html: bool = False, png: bool = False, rrd: bool = False) -> Report:
        """Report utilities, trajectories, model bias and gap of all stored trials.

        A damaged or missing file is left out and listed in `findings.lost`.

        Args:
            html: write reports/report.html, and layouts for Foxglove and PlotJuggler.
            png: write the figures of the page as reports/*.png.
            rrd: write reports/recording.rrd for the Rerun viewer, and the layouts.

        Raises:
            GroundedError: if an extra that one of them needs is missing; nothing is written then.
        """
        from grounded_trials.report.reporting import report_in

        return report_in(self.forget(), html=html, png=png, rrd=rrd)

    def watch(
        self, *, every: float = 1.0, trouble: Callable[[GroundedError], None] = lambda error: None
    ) -> Iterator[Report]:
        """Rewrite reports/report.html whenever its files change; an open page reloads itself.

        Args:
            every: polling interval [s].
            trouble: called with each error that keeps the page from being written.

        Yields:
            A report each time the page has been written. The iterator never ends by itself.

        Raises:
            GroundedError: if the extra `report` is missing.
        """
        from grounded_trials.report.reporting import watched

        needs("jinja2", "report")
        return watched(self, every, trouble)

    def export(
        self,
        candidate: str = "best",
        path: str | Path | None = None,
        *,
        form: str | None = None,
        runner: bool = False,
        anyway: bool = False,
    ) -> Exported:
        """Export a candidate for other languages, or a trial or predicted run for viewing.

        Candidates are refused as in `run`, except that one of an earlier task is allowed. A trial,
        or a candidate with form "bag", is exported as a recorded or predicted run.

        Args:
            candidate: c0003, `best`, or a trial, t0007.
            path: the file; None: named after the candidate, in the current folder.
            form: csv, json or npz; for a run bag, csv or npz; None: by the file's suffix.
            runner: write npz, and beside it the program that runs it on a robot with only numpy.
            anyway: write it although it is void.
        """
        from grounded_trials.workspace.candidates.exporting import export_candidate

        file, here, candidate = Path(path) if path else None, self.forget(), candidate.lower()
        if form == "bag" or candidate.startswith("t"):
            from grounded_trials.report.ros_bag import export_run

            return export_run(here, candidate, form, file, runner=runner)
        return export_candidate(here, candidate, form, file, runner=runner, anyway=anyway)

    def export_model(self, path: str | Path | None = None) -> TakenHome:
        """Write the model as it is now, in the form that it came in, for other programs.

        An MJCF or URDF file, or a model.py, with the values of fitted parameters and of adopted
        effects; what the form can't hold is among the findings, with its equation.

        Args:
            path: the file; None: named after the model's, in the current folder.
        """
        from grounded_trials.workspace.home.taking_home import export_model

        return export_model(self.forget(), Path(path) if path else None)

    def export_actuator(self, path: str | Path, actuator: str | None = None) -> Shelved:
        """Write what is known of one actuator as a YAML file that another workspace begins from.

        Args:
            path: the file.
            actuator: the input; None: the only one.
        """
        from grounded_trials.workspace.home.library import export_actuator

        return export_actuator(self.forget(), Path(path), actuator)

    def begin_with(self, *actuators: str) -> tuple[Mapping[str, Any], ...]:
        """Begin with actuators that were exported: their values as effects, their +- as priors.

        Args:
            actuators: files; FILE:INPUT,INPUT for these inputs, else for all with its unit.

        Returns:
            [model] effects.
        """
        from grounded_trials.workspace.home.library import begin_with

        return begin_with(self.forget(), actuators)

    def verify(self) -> Verified:
        """Check all stored files for changes, damage, deletion and replacement.

        Trials and notes are checked against their hashes and for completeness; candidates against
        their checksums, what was handed out, and their predictions; the rest by checksums.
        """
        from grounded_trials.workspace.verifying import verify_in

        return verify_in(self.forget())

    def discard(self, *trials: str, why: str = "") -> SetAside:
        """Exclude trials from search, fit, diagnosis and report; nothing is deleted.

        Args:
            trials: short names such as t0004.
            why: the reason, stored with the note.
        """
        from grounded_trials.workspace.discarding import discard_in

        return discard_in(self.forget(), trials, why)

    def restore(self, *trials: str) -> SetAside:
        """Undo `discard` for some trials."""
        from grounded_trials.workspace.discarding import set_aside

        return set_aside(self.forget(), "restore", trials, "")

    def inspect(self, log: str | Path) -> Inspected:
        """List the signals of a log, and guess a [log] table for this workspace's model."""
        from grounded_trials.workspace.inspecting import inspect_in

        return inspect_in(self.forget(), path_of(log))
