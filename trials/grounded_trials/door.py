"""The front door: a workspace with a method for every command.

    from grounded_trials import Workspace

    w = Workspace.create("turn", example="car-turn")
    w.learn(trials=5)
    w.diagnose()
    w.report(html=True)

Each method does what the command of its name does, on the files as they are now, and returns a
frozen result whose `to_json()` is the document that the command prints with --json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Self

from grounded.errors import GroundedError
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.diagnosis.report import Diagnosis
    from grounded.effects import Library
    from grounded.engine import Engine
    from grounded.frozen import Array
    from grounded.instruments.finding import Finding
    from grounded.search.candidate import Candidate
    from grounded_trials.report.reporting import Report
    from grounded_trials.workspace.adopting import Adopted, Undone
    from grounded_trials.workspace.exporting import Exported
    from grounded_trials.workspace.fitting import Fitted
    from grounded_trials.workspace.identity import SetAside
    from grounded_trials.workspace.inspecting import Inspected
    from grounded_trials.workspace.intake.ingested import Ingested
    from grounded_trials.workspace.looping import NextRun
    from grounded_trials.workspace.proposing import Proposed, Status
    from grounded_trials.workspace.running import Ran
    from grounded_trials.workspace.verifying import Verified


class Workspace(Folder):
    """A folder with a task, its trials and its candidates, and what can be done in it.

    Every method raises a GroundedError for what is the user's to mend: a file that is missing or
    damaged, a name that is not known, a system that fails.

    Args:
        folder: where grounded.toml lies.

    Raises:
        GroundedError: if there is none, or it is wrong.
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
        """Makes a workspace from an example, a log or a model; nothing is ever overwritten.

        Args:
            folder: where it is made.
            example: car-turn, car-circle, car-figure8, flight-figure8 or pendulum.
            log: of your robot, any format; `starting.begin.begin` says what it found.
            model: your model.py, or an MJCF or URDF file, beside `log`, where None writes a
                skeleton; or alone: target, weights and drive.py are to be filled in then.
            dt: control interval [s]; None: the log's, 0.05 for a model alone.

        Raises:
            GroundedError: if there is no such example, the log can't be read, or the folder holds
                a workspace already.
        """
        if (example is None) == (log is None and model is None):
            raise GroundedError("give an example, a log or a model to make a workspace from")
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

    def propose(self) -> Proposed:
        """Says what to run next and writes its candidate file.

        The outstanding candidate is named again while its trial is missing.
        """
        from grounded_trials.workspace.proposing import propose_in

        return propose_in(self._afresh())

    def run(
        self,
        candidate: str | None = None,
        *,
        anyway: bool = False,
        warn: Callable[[str], None] | None = None,
    ) -> Ran:
        """Runs a candidate on [system] and writes a trial file to be ingested.

        It is refused if it is not the file that was proposed, or is void by now: [limits],
        [safety], the task or the model were changed.

        Args:
            candidate: c0003, or `best`; None: the outstanding one.
            anyway: run it though it is void.
            warn: told what is overridden, before the robot moves.
        """
        from grounded_trials.workspace.running import run_candidate

        return run_candidate(self._afresh(), candidate, anyway=anyway, warn=warn)

    def ingest(
        self, path: str | Path, *, candidate: str | None = None, data: bool = False
    ) -> Ingested:
        """Checks, resamples and stores a trial; one that is known already is stored once.

        Args:
            path: a trial of grounded's, another MCAP log, or the folder of a bag.
            candidate: which candidate was run, or `best`; None: as the trial says, else the
                outstanding one.
            data: the log ran no candidate: for fitting and diagnosis only.
        """
        from grounded_trials.workspace.intake.ingest import ingest_log

        return ingest_log(self._afresh(), Path(path), candidate, data=data, ahead=True)

    def next(
        self, log: str | Path, *, candidate: str | None = None, runner: bool = True
    ) -> NextRun:
        """The loop at the track in one call: takes a log in, proposes, exports for the robot.

        Args:
            log: what came back.
            candidate: which one was run; None: the outstanding one.
            runner: write the program that runs the candidate beside it, see `export`.
        """
        from grounded_trials.workspace.looping import next_in

        return next_in(self._afresh(), Path(log), candidate, runner=runner)

    def target(self, columns: Mapping[str, Array]) -> Path:
        """Writes target.csv and its length to grounded.toml; the old one is kept as target.csv.bak.

        Args:
            columns: what each state is to do, (H + 1,) each, a row a control step; see `starting`.
        """
        from grounded_trials.workspace.task_file import replace_target

        here = self._afresh()
        path = replace_target(here.config, columns, here.base_model)
        self.forget()
        return path

    def learn(
        self,
        trials: int | None = None,
        *,
        progress: Callable[[str], None] | None = None,
        each: Callable[[Candidate, Ingested], None] | None = None,
    ) -> Status:
        """Proposes, runs and ingests until the search ends.

        Args:
            trials: at most so many now; None: until the search ends.
            progress: told what is being done.
            each: given every candidate with its trial, once that is stored.
        """
        from grounded_trials.workspace.looping import learn_in

        return learn_in(self._afresh(), trials, progress, each)

    def status(self) -> Status:
        """Where the search stands; nothing is written."""
        from grounded_trials.workspace.proposing import standing_in, status_of

        return status_of(self._afresh(), standing_in(self, ahead=True))

    def fit(
        self,
        params: Sequence[str] | None = None,
        *,
        latency: bool = False,
        apply: bool = False,
        engine: Engine | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> Fitted:
        """Estimates the model's parameters from all trials, their instruments corrected first.

        Args:
            params: only these; None: all of them.
            latency: fit one transport delay of all inputs too.
            apply: write the values to grounded.toml.
            engine: workers for the trials' likelihoods; the same comes out on any number.
            progress: told of the stage, the share done and the time left.

        Raises:
            GroundedError: if they should be written and predict held-out time worse.
        """
        from grounded_trials.workspace.fitting import fit_in

        asked = partial(fit_in, self._afresh(), params, latency=latency, apply=apply)
        done = asked(engine=engine, progress=progress)
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
        """Explains the gap between model and trials; keeps reports/diagnosis.json.

        Args:
            trials: short names, t0007; none: all that can be used.
            max_effects: blame at most so many at once; None: 3, and more where those leave a gap.
            without: families not to blame.
            compare: a second group of trials; what changed from the first is `changed`.
            probe: write the most instructive candidate also where nothing ties.
            engine: workers that fit hypotheses; the same comes out on any number.
            library: the effects that may be blamed; None: those that are installed.
            progress: told of each stage.
        """
        from grounded_trials.workspace.adopted import installed_effects
        from grounded_trials.workspace.diagnosing import diagnose_in

        return diagnose_in(
            self._afresh(),
            trials=trials,
            max_effects=max_effects,
            without=without,
            library=library or installed_effects(),
            compare=compare,
            probe=probe,
            engine=engine,
            progress=progress,
        )

    def preflight(self, trials: Sequence[str] = ()) -> tuple[Finding, ...]:
        """Judges the instruments of some trials, or all, from their own signals: late, scaled."""
        from grounded_trials.workspace.diagnosing import instruments_in

        return instruments_in(self._afresh(), trials)

    def adopt(self, *effects: str, parameters: bool = True) -> Adopted:
        """Adds effects of the last diagnosis to the model of grounded.toml.

        Args:
            effects: `family:target`; those that were claimed together, or one alone.
            parameters: take over the model's own parameters that were calibrated beside them.
        """
        from grounded_trials.workspace.adopting import adopt_effects

        done = adopt_effects(self._afresh(), effects, parameters=parameters)
        self.forget()
        return done

    def undo_adoption(self) -> Undone:
        """Gives the model of grounded.toml what it had before the last `adopt`: effects, params."""
        from grounded_trials.workspace.adopting import undo_adoption

        done = undo_adoption(self._afresh())
        self.forget()
        return done

    def report(self, *, html: bool = False, png: bool = False, rrd: bool = False) -> Report:
        """Utilities, trajectories, bias and gap of all stored trials.

        A damaged or missing file is left out, and named in `findings.lost`.

        Args:
            html: write reports/report.html, and layouts for Foxglove and PlotJuggler beside it.
            png: write its figures, reports/*.png.
            rrd: write reports/recording.rrd for the Rerun viewer, and the layouts.

        Raises:
            GroundedError: if an extra is missing that one of them needs; nothing is written then.
        """
        from grounded_trials.report.reporting import report_in

        return report_in(self._afresh(), html=html, png=png, rrd=rrd)

    def watch(
        self, *, every: float = 1.0, trouble: Callable[[GroundedError], None] = lambda error: None
    ) -> Iterator[Report]:
        """Keeps reports/report.html current while trials come in; open in a browser, it reloads.

        Args:
            every: how often the files are looked at [s].
            trouble: told what keeps the page from being written for now.

        Yields:
            A report each time that the page was written; it ends when it is no longer asked.

        Raises:
            GroundedError: if the extra `report` is missing.
        """
        from grounded.errors import needs
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
        """Writes a candidate for other languages; refused as in `run`, an earlier task's is not.

        A trial, or the run that a candidate predicts (form "bag"), is written to be looked at.

        Args:
            candidate: c0003, `best`, or a trial, t0007.
            path: the file; None: named after the candidate, in the current folder.
            form: csv, json or npz, of a run bag, csv or npz; None: as the file is named.
            runner: npz, and beside it the program that runs it on a robot with numpy alone.
            anyway: write it though it is void.
        """
        from grounded_trials.workspace.exporting import export_candidate

        file, here = Path(path) if path else None, self._afresh()
        if form == "bag" or candidate.startswith("t"):
            from grounded_trials.report.ros_bag import export_run

            return export_run(here, candidate, form, file)
        return export_candidate(here, candidate, form, file, runner=runner, anyway=anyway)

    def verify(self) -> Verified:
        """Checks everything that is kept: what was changed, damaged, deleted or put in its place.

        Trials and notes against their hashes, and whether all are there that were stored;
        candidates against their checksums, what was handed out under their names and what they
        predict; the last diagnosis and the optimum against their checksums.
        """
        from grounded_trials.workspace.verifying import verify_in

        return verify_in(self._afresh())

    def discard(self, *trials: str, why: str = "") -> SetAside:
        """Sets trials aside: search, fit, diagnosis and report leave them out; nothing is deleted.

        Args:
            trials: short names, t0004.
            why: kept with it, for who asks later.
        """
        from grounded_trials.workspace.identity import set_aside

        return set_aside(self._afresh(), "discard", trials, why)

    def restore(self, *trials: str) -> SetAside:
        """Takes back what `discard` did."""
        from grounded_trials.workspace.identity import set_aside

        return set_aside(self._afresh(), "restore", trials, "")

    def inspect(self, log: str | Path) -> Inspected:
        """Shows what a log holds, and guesses a [log] table for this workspace's model."""
        from grounded_trials.workspace.inspecting import inspect_in

        return inspect_in(self._afresh(), log)

    def _afresh(self) -> Self:
        """The folder as it is now: what was read for an earlier call may have been changed."""
        self.forget()
        return self
