"""Every command with its options and its help; what a command does is in a module of its own.

A command's module is imported when it is called: `--help`, the TAB key and a misuse import none.
`command` (in `console/options.py`) finds there the function of the same name as the one here.
"""

from __future__ import annotations

from typing import Any

import click
from click import Choice, FloatRange, IntRange, argument, option

from grounded import __version__
from grounded.errors import GroundedError
from grounded.refusals import unknown
from grounded_cli.console.options import command, flag, in_workspace, parallel, table_layout
from grounded_cli.console.terminal import given, next_line
from grounded_trials.wording import placed


class Commands(click.Group):
    """A group that lists its commands in the order of use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the command names, in the order of use."""
        return list(self.commands)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Suggest the nearest name for an unknown command."""
        if args[0] not in self.commands and not args[0].startswith("-"):
            ctx.fail(str(unknown("command", args[0], self.commands)))
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; append the command to type next to the message of a GroundedError."""
        try:
            return super().invoke(ctx)
        except GroundedError as error:
            then = "" if error.then is None else f"\n{next_line(error.then)}"
            raise GroundedError(f"{placed(str(error), given())}{then}") from None


@click.command(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="grounded")
def cli() -> None:
    """Teach a real system a manoeuvre in a few trials, from a crude model.

    Start with `grounded demo car-figure8` in an empty folder, or make a workspace of your own with
    `grounded init DIR --example car-turn`.
    """


in_workspace(cli)
details = flag("--details", help="Tell all notes, with codes.")
anyway = flag("--anyway", help="Even if [limits], [safety], task or model changed.")
only_trials = option("--trials", metavar="T1,T2,...", help="Only these trials (default: all).")
which_candidate = option("--candidate", metavar="ID", help="Which candidate was run.")
without = option("--without", multiple=True, metavar="F1,F2,...", help="Families to exclude.")
folder = argument("folder", metavar="DIR")
above = FloatRange(min=0, min_open=True)


# a workspace, its manoeuvre, its first drive


@command(cli, "init", workspace=False)
@argument("folder", metavar="DIR", required=False)
@option("--from", "log", metavar="LOG", help="A log of your robot, of any format.")
@option("--model", metavar="FILE", help="Your model.py, MJCF or URDF, beside --from or --blank.")
@flag("--blank", help="No log yet: a workspace of --model, to fill in.")
@option("--kind", help="car, rover, differential, boat, drone, arm, pendulum or generic.")
@option("--inputs", metavar="A,B,...", help="Columns that are inputs (kind generic).")
@table_layout
@option("--dt", type=above, metavar="S", help="Control interval (the log's; 0.05 with --blank).")
@option("--actuators", multiple=True, metavar="FILE[:U,...]", help="By `export --library`.")
@flag("--yes", help="Ask nothing: use the best guesses, marked as such.")
@option("--example", metavar="NAME", help="Which example (see --list).")
@flag("--list", help="List the examples.")
def init() -> None:
    """Make a workspace from a log or an example.

    DIR gets grounded.toml, model.py, target.csv, trials/ and candidates/. --from LOG finds the
    model's states and inputs in a log and says why it chose them; without --model it also writes a
    model skeleton for the kind of robot in the log. --blank --model FILE needs no log and writes
    drive.py, the robot's program. --example NAME copies an example, whose real.py simulates the
    robot.
    """


@command(cli, "target")
@argument("shape", metavar="SHAPE|FILE")
@option("--size", type=float, help="Length of a line, radius, half a figure-8's width [m] (2).")
@option("--speed", type=float, help="Maximum speed [m/s] (1).")
@option("--accel", type=float, help="Maximum acceleration along the path [m/s^2] (1).")
@option("--lateral", type=float, help="Maximum lateral acceleration [m/s^2] (4).")
@option("--laps", type=float, help="Laps of a circle or figure-8 (1).")
@option("--hold", type=float, help="Time at rest at a path's end [s] (0).")
@option("--to", multiple=True, metavar="X=VALUE", help="Where it ends, or what a path keeps.")
@option("--seconds", type=float, help="Duration of a step (5), or of a line.")
@flag("--rest", help="Let the states that a line leaves free rest at its end, by weights.")
@details
def target() -> None:
    """Draw the manoeuvre: line, circle, figure-8 or step.

    FILE is a log, read through [log], a stored trial (t0001), or a CSV with columns `t` and states.
    Paths begin at rest at the position in [task] start, along x. A line with --to, or of a robot
    with one axis, goes from [task] start to rest, in the states' own units.

    The previous target is kept as target.csv.bak, and grounded.toml as grounded.toml.bak. [task]
    start is set where a stored trial begins at rest, if it is empty; [task] horizon and the weights
    that you have not chosen are updated. The search starts again.
    """


@command(cli, "excite", "target")
@option("--seconds", type=float, help="Its duration (5 to 40, until no parameter is weak).")
def excite() -> None:
    """Write the drive to record first, before there is a target.

    It makes the model's uncertain parameters identifiable: multisines or staircases on all inputs,
    from [task] start, inside [limits] and, by the model, inside [safety]. The table says how well
    its log will tell each parameter if the model is right but for these.
    """


# the loop


@command(cli, "propose")
@details
def propose() -> None:
    """Say what to run next and write its candidate file.

    The outstanding candidate is shown again while its trial is missing. Nothing is proposed once
    the search has ended.
    """


@command(cli, "run", "learn")
@argument("candidate", required=False)
@anyway
def run() -> None:
    """Run the candidate on the system of grounded.toml.

    It writes a trial file for `grounded ingest`. CANDIDATE defaults to the outstanding one. Any may
    be run again, also `best`; its utilities are averaged. It is refused if its file was rewritten,
    or if [limits], [safety], the task or the model changed so that it must not be run any more.
    """


@command(cli, "ingest")
@argument("files", nargs=-1, required=True, metavar="FILE...")
@which_candidate
@flag("--data", help="The log ran no candidate: for fit and diagnose only.")
@option("--group", default="", metavar="NAME", help="A condition that no signal shows: wet.")
@option("--before", multiple=True, metavar="U=0", help="An input before the log.")
@details
def ingest() -> None:
    """Check, resample and store the log of a run.

    It may have any format that `inspect` reads. Ingesting a file again succeeds and names the trial
    it is stored as. Trials written by grounded are stored unchanged; other logs are mapped by the
    [log] table (`grounded inspect LOG` prints one).
    """


@command(cli, "next")
@argument("log", metavar="LOG")
@which_candidate
@details
def following() -> None:
    """Ingest a log, propose, and export for the robot, in one go.

    Does the same as `ingest LOG`, `propose` and `export ID --runner`, or `export` in the format in
    which the last candidate was exported; the file is written into the workspace's folder.
    """


@command(cli, "discard", "adopt")
@argument("trials", nargs=-1, required=True, metavar="TRIAL...")
@option("--why", default="", metavar="TEXT", help="The reason; `status` shows it.")
def discard() -> None:
    """Set a trial aside; nothing is deleted.

    Search, fit, diagnosis and report leave it out, and the search goes on as if it had not been
    run. `grounded restore` undoes it.
    """


@command(cli, "restore", "adopt")
@argument("trials", nargs=-1, required=True, metavar="TRIAL...")
def restore() -> None:
    """Use a discarded trial again."""


@command(cli, "learn")
@option("--trials", type=IntRange(min=1), metavar="N", help="At most N trials now.")
def learn() -> None:
    """Propose, run and ingest until the search ends.

    It can be interrupted and resumed.
    """


# what it came to


@command(cli, "status")
@details
def status() -> None:
    """Show where the search stands.

    It follows from the stored trials; nothing is written.
    """


@command(cli, "report")
@flag("--html", help="Write reports/report.html, one page with everything.")
@flag("--png", help="Write the page's figures as pictures, reports/*.png.")
@flag("--rrd", help="Write reports/recording.rrd for the Rerun viewer.")
def report() -> None:
    """Summarise all trials: text, page, pictures, recording.

    A damaged or missing trial is left out and named (exit code 3).
    """


@command(cli, "view", "report", json=False)
def view() -> None:
    """Open the recording in Rerun.

    The file reports/recording.rrd is written first. If this machine has no screen, copy the file to
    one that has (with the extra `view`) and open it there: rerun recording.rrd
    """


@command(cli, "fit")
@only_trials
@option("--params", metavar="A,B,...", help="Fit only these; the others keep their values.")
@flag("--latency", help="Fit one transport delay of all inputs too.")
@flag("--apply", help="Write the values to grounded.toml.")
@parallel("all processors")
def fit() -> None:
    """Estimate the model's parameters from all trials.

    They are the most likely ones, noise included. Sensor faults (a delay, filtered speeds, degrees)
    are corrected first, as in `diagnose`. Trials are predicted with values from the others; values
    that predict worse are never written.
    """


@command(cli, "diagnose")
@only_trials
@option("--max-effects", type=IntRange(1, 12), metavar="K", help="Claim at most K (3, or more).")
@without
@option("--compare", nargs=2, metavar="A B", help="Two groups, T1,T2 T3,T4: what changed.")
@parallel("all processors")
@flag("--details", help="Also all findings, errors, rival effects and places.")
def diagnose() -> None:
    """Find where the model is wrong, and which effect explains it.

    The verdict, kept in reports/diagnosis.json, is one effect, several, none (the rest is noise, or
    cannot be told from it) or unknown (a gap that no known effect explains). If two effects tie, a
    probe is written: a candidate whose trial would tell them apart.
    """


@command(cli, "adopt")
@argument("effects", nargs=-1, metavar="EFFECT...")
@flag("--effect-only", help="Leave the model's own parameters alone.")
@flag("--undo", help="Undo the last adoption.")
def adopt() -> None:
    """Add diagnosed effects to the model.

    They are written to [model] in grounded.toml, and the parameters calibrated with them to [model]
    params. Effects that were claimed together are adopted together; one that was not claimed can be
    adopted alone, without parameters. The search goes on from the best policy with the better
    model. --undo restores what [model] had before the last adoption.
    """


# logs and files


@command(cli, "inspect")
@argument("log", metavar="LOG")
@table_layout
def inspect() -> None:
    """Show what is in a log and guess its [log] table.

    The table is guessed for the states and inputs of the workspace; `unsure` marks lines to check.
    There is none for files written by grounded, for damaged files, and outside a workspace.
    """


@command(cli, "recover", "inspect", workspace=False)
@argument("log", metavar="LOG")
@option("-o", "--output", metavar="FILE", help="Default: LOG with -recovered in its name.")
def recover() -> None:
    """Recover what is readable in a damaged log.

    It exits with 3 if something was lost. The damaged MCAP file is not changed.
    """


@command(cli, "export")
@argument("candidate", metavar="ID", required=False)
@option("--format", "form", type=Choice(("csv", "npz", "json")), help="Default: by FILE's ending.")
@option("-o", "--output", metavar="FILE", help="Default: ID.FORMAT in the current folder.")
@flag("--runner", help="Write npz, and grounded_runner.py, which runs it with numpy alone.")
@flag("--model", help="Write the model with the values found: MJCF, URDF or model.py.")
@option("--library", metavar="FILE.yaml", help="Write one actuator; ID is its input.")
@anyway
def export() -> None:
    """Write a candidate for the robot: csv, npz or json.

    `best` names the best candidate so far; a trial (t0007) can be written as csv or npz. A
    candidate that must not be run any more (see `grounded run`) is refused.

    --model writes the model as it is now, fitted values and adopted effects, in the form that it
    came in. --library writes one actuator, for `grounded init --actuators`.
    """


@command(cli, "verify", "status")
def verify() -> None:
    """Check every stored file against its hash."""


# to try it, to check it


@command(cli, "demo", workspace=False)
@argument("name", metavar="[NAME]", default="car-figure8")
@option("--dir", "folder", metavar="DIR", help="Default: demo-NAME in the current folder.")
def demo() -> None:
    """Run a whole example in a new folder: learn, diagnose, report.

    `grounded init --list` lists the examples.
    """


@command(cli, "experiment", workspace=False)
@argument("name", type=Choice(("flight", "car", "footnote9", "theorem1")), required=False)
@option("--seeds", metavar="N|A-B|A,B,...", help="How many seeds, or which ones.")
@parallel("1")
def experiment() -> None:
    """Reproduce the paper's studies.

    The same seeds give the same results on any machine. Without NAME the studies are listed.
    """


@cli.group("challenge")
def challenge() -> None:
    """Make, diagnose and score blind cases for the diagnosis.

    Run `grounded challenge run DIR` on a machine without the labels.
    """


labels = option("--labels", metavar="DIR", help="Where the labels are (default: DIR-labels).")


@command(challenge, "make", "challenge", workspace=False)
@folder
@option("--kind", type=Choice(("single", "double", "none", "withheld")), required=True)
@option("--cases", type=IntRange(1), required=True, metavar="N", help="How many.")
@option("--seed", type=IntRange(0), required=True, metavar="S", help="Of all draws.")
@option("--systems", default="own", metavar="G1,G2", help="Of own, kinked, mujoco.")
@labels
@option("--param-error", type=FloatRange(0.0, 0.5), metavar="E", help="Of parameters, relative.")
def make_cases() -> None:
    """Write N workspaces with trials into DIR, and their labels, sealed by hash, elsewhere.

    The kind is how many effects they have; `withheld` is an effect that no family has.
    """


@command(challenge, "run", "challenge", workspace=False)
@folder
@without
@flag("--again", help="Also repeat the diagnoses that exist.")
@parallel("1")
def run_cases() -> None:
    """Diagnose the cases of DIR that have no diagnosis yet; an interrupted run resumes."""


@command(challenge, "score", "challenge", workspace=False)
@folder
@labels
@parallel("1")
def score() -> None:
    """Open the labels, score the diagnoses of DIR, and an oracle that knows the effects."""


@command(cli, "explain", workspace=False)
@argument("name", metavar="[CODE|EFFECT]", required=False, default="")
def explain() -> None:
    """Say what the code of a finding, or an effect, means."""
