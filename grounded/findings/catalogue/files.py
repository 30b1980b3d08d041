"""Findings on files, on what a user gives, and on how a workspace and its target begin."""

from __future__ import annotations

from grounded.findings.catalogue.entry import Entry, note, refuse, warn

_STAMPS = "one in seconds named 't', or 't_ms', 't_us', 't_ns' in their units"

# files: why one can't be read or written, and what in it is not as it should be
FILE: dict[str, Entry] = {
    # contents of a log
    "decode": refuse(
        "its {what} can't be read[[ at '{at}']][[: {why}]]",
        "[[{what:CDR=`ros2 bag convert` with compression_mode none writes plain CDR,header "
        'stamp=set clock = "log" (or "publish") for it}]]',
    ),
    "path": refuse(
        "expected {expected}[[ at {at}]][[, found {found}]][[ in message path '{path}']][[: there "
        "are {known}]]",
    ),
    "signal": refuse(
        "[[{file}: ]]'{about}' ({path}) can't be read[[ from {topic}]][[ ({type})]][[ at {at:.3f} "
        "s]][[: {why}]][[: none of {messages:message} has it]][[: {what:one=a single sample can't "
        "be interpolated,zero=all its stamps are 0,nothing=no value is a finite number}]][[ of "
        "{values}]]",
        '[[{what:one=set resample = "hold",zero=use another clock}]]',
    ),
    "damaged": refuse(
        "{about}: {part} [[{what:cut=is cut off: the file ends inside it,checksum=does not match "
        "its checksum,time=is from after the year 2262}]][[!what? is damaged]][[: {why}]][[ (at "
        "byte {byte})]]",
        "`recover` saves what can be saved",
    ),
    "no_message": refuse("{about} holds no message[[: the file ends at byte {byte}]]"),
    "no_log": refuse(
        "{about} is no log[[ but a {head}]][[: it begins with {begins}]][[, it is a "
        "workspace{own:1=}]]",
        "[[!tables? give the file that the robot's program wrote: MCAP, ROS 2 .db3, ROS 1 .bag, "
        ".csv, .npz, .parquet, .mat, PX4 .ulg or ArduPilot .bin]][[give {tables} as one .npz if "
        "they are one run: see docs/log-reference.md, two tables with two clocks]]",
    ),
    # tables
    "no_times": refuse(
        "{about} [[begins with '{line}', not with column names]][[!line? has no column of "
        "times]][[ among {names}]]",
        "[[line? name the columns: `--columns t,x,v`, or `columns` in [log]; ]]"
        f"add or name {_STAMPS}; or give the rate of "
        "its rows [Hz], `--rate 100`, or `rate = 100` in [log]",
    ),
    "times": refuse(
        "{about}[[, line {line}]]: '{name}' has no times[[ in {lost:row}]][[: '{text}']]",
        f"expected {_STAMPS}, 2026-11-21 10:05:00.250, 21.11.2026 10:05:00.250 or 10:05:00.250",
    ),
    "row": refuse(
        "{about}[[, line {line},]] has {has} cells, but {names:column} {names:is/are} named",
        "export it with a point as decimal sign, or with semicolons or tabs between the columns",
    ),
    "rows": refuse(
        "{about} has {rows} rows below its header[[, expected {needs} or more]]",
        "[[target? draw the manoeuvre, or write a row per control step with t and the "
        "states]][[add rows, or set [task] horizon = {horizon}]]",
    ),
    "grid": refuse(
        "{about} has [[sample {sample} at {at:.4f} s instead of {expected:.4f} s]][[a sample "
        "every {every:.4g} s]], dt is {dt:.6g} s",
        "[[set [task] dt = {each:.6g}, the time in s from one command to the next, or resample "
        "the rows]][[robot? samples are missing or late: run it again]][[append each at {unit} "
        "times its stamp: it is in another unit]]",
    ),
    # files and folders
    "missing": refuse(
        "{about} does not exist[[, nor does its folder {folder}]][[: did you mean '{near}'?]]"
    ),
    "no_workspace": refuse(
        "there is no {about}, which a workspace has",
        "name its folder, such as -C DIR (in Python Workspace(DIR))[[: {near}]]",
    ),
    "unreadable": refuse(
        "{about} can't be read[[ as a {kind}]]: {why}",
        "[[{kind:ROS 2 bag=`sqlite3 FILE .recover` saves what can be saved,ROS 1 bag=`rosbag "
        "reindex` repairs it if it was not closed,MATLAB class=save plain numbers there: `run.t = "
        "q.Time; run.q = q.Data; save('run.mat', 'run')`}]][[{mend:diagnosis=diagnose "
        "again,delete=delete it: what it kept can then not be undone,candidate=delete it: a trial "
        "that ran it holds a copy,module=install its package here, or give file = "
        "'model.py',trials=install grounded_trials, or export with --format npz}]][[it reads "
        "{outside} outside its folder: copy them too, then give --model]]",
    ),
    "unwritable": refuse(
        "{about} can't be written[[: {why}]][[: the folder {folder} does not exist]]",
        "[[{mend:space=free disk space,permission=get write permission,lock=move the workspace to "
        "a local disk, since this file system has no locks,recover=`recover` restores what the "
        "file already holds}]]",
    ),
    "exists": refuse("{about} exists already", "name another, or remove it first"),
    "changed": refuse(
        "{about} was changed or damaged: {what:checksum=its checksum does not match,none=it has "
        "no checksum,hash=its contents do not match the hash in its name,manifest=it is not as "
        "the manifest has it,candidate=it was rewritten since it was proposed,policy=it is not "
        "the policy that ran,name=it holds another candidate,gone=what it was made from is "
        "gone}[[: {lost}]]",
        "{what:checksum=make it again,none=make it again,hash=restore it from a backup, or ingest "
        "the original log again,manifest=restore it,candidate=delete it; a new one is "
        "made,policy=delete it; the trial holds the one that ran,name=rename it,gone=bring that "
        "back from a copy, or ingest the original logs again}",
    ),
    "no_mapping": refuse(
        "{about} is no trial of grounded, and grounded.toml has no [log] table to map it",
        "`inspect` prints one",
    ),
    "untrusted": refuse(
        "{about} {by:owner=belongs to another user,all=is writable by everybody,group=is writable "
        "by its group}[[ ({id})]]; nothing in {folder} is executed",
        "if it is yours: chown -R $USER and chmod -R go-w, or name the folder in {trust}",
    ),
    # times of a log's signals
    "gap": refuse(
        "'{about}' ({path}) is not known[[ at {at} s]][[, only from {first} s to {last} s]][[ "
        "from {start} s to {end} s after the start]][[ in each control step of {dt:.3g} s: it "
        "comes every {every:.3g} s]]",
        "end the span before that, or set max_age_s[[dt? ; if its times are milliseconds, name "
        "the column t_ms]]",
    ),
    "clocks": refuse(
        "{about:the clock/the clocks} of {about} [[jumps back by {by:.3f} s after sample "
        "{sample}]][[differ by about {apart:.3f} s (simulation time, or an unset clock?)]]",
        'use one clock, such as clock = "log"[[by? , or cut the log there]][[, or align them: '
        "{lines}]]",
    ),
    "steps": refuse(
        "the trial would have {steps} steps of {dt:g} s, from {start:.3f} s to {stop:.3f} s[[; "
        "samples come every {every:.3g} s: are the times in another unit than their column says?]]",
        "see [log.span][[every? and the unit of the times]]",
    ),
    # what is odd in a log
    "vanished": warn(
        "[[{about} {about:has/have} no sample after {until:.2f} s of the log: the trial ends "
        "there]][[{about} is not a finite number at {ends}: the trial ends there]][[all states "
        "are known from {late:.3f} s on: the trial starts there]]",
    ),
    "odd_values": warn(
        "{about}:[[ only {messages:message}]][[ only its first {first:number} are listed]][[ "
        "{lost:value} not finite]][[ {bridged:value} bridged]][[ {stamps:stamp} out of order, "
        "repeated or 0]][[ held from a single sample{single:1=}]][[, the largest gap is {gap}]]",
    ),
    # what is lost
    "cut": warn(
        "[[{about} ]][[!about? the file ]]is cut off at [[line {line}]][[byte {byte}]][[ "
        "({text})]]: what came after that is lost[[, only its index{index:1=}]]",
    ),
    "lost": warn(
        "[[!wrong? not saved:]][[wrong? the checksum does not match, so some number may be "
        "wrong:]][[ {bytes} bytes]][[ {part}]][[ {messages:message}]][[ {more} more losses of "
        "these kinds]][[ second {span} of the log]][[, at byte {byte}]][[: {why}]]",
    ),
}

# what a user gives: values, names, shapes, and things that do not fit together
GIVEN: dict[str, Entry] = {
    "value": refuse(
        "{about} must be[[ {must:given=given,real=one real number,named=read by name,level=those "
        "of a level flight,inside=inside the workspace,even=equally long,groups=two groups of "
        "different trials,plant=a dict input -> seconds and a whole number,words=a program with "
        "the words for both files,number=a number,units=names with a unit each,free=another name: "
        "grounded writes this one,outside=outside the folder of the cases,unique=one file: give "
        "more digits of its hash,finite=finite,positive=a positive number,whole=a whole "
        "number,numbers=an array of numbers,names=a list of names,above=above 0,str=a "
        "text,float=a number,int=a whole number,list=a list in brackets,natural=0 or "
        "more,nonzero=other than 0,pair=[low; high],time=a time of a log's clock,path=a message "
        "path,crossing=a time or a path with one of above and below,one=either a file or a "
        "module,alone=without a model,effects=tables with a name,deviations=standard deviations "
        "of states,divisor=a whole part of the control step,way=away from the start,span=at some "
        "time in the log,actuator=a file of one actuator,weights=finite and not "
        "negative,place=one state along an axis, two in a plane (horizontal first) or "
        "three,bool=True or False,dict=a dict by name,ascending=in ascending order,name=a valid "
        "Python name,trial=the gr.Trial of the run,call=a function of a candidate that returns "
        "the Trial of its run,bounded=inside its bounds:}]][[ of the form {form}]][[ a {type}]][[ "
        "of shape {shape}]][[ from {low}]][[ to {high}]][[ below {below}]][[: {known}]][[, such "
        "as {like}]][[, not {given}]][[: did you mean '{near}'?]]",
        "[[{do:omit=omit the column if the state is free,turned=transpose it,column=make it a "
        "column, inputs[:, None],last=leave out the last row, since the last state has no "
        "input,rows=give one row for each control step and one for the end,free=infinite for no "
        "limit,widen=correct it, or widen the bounds of its "
        "Param,read=`grounded_trials.store.trial_file.read_trial` reads a file,load=read a file "
        "with `load(path)`,hold=hold a value inside ([task] start; in Python past), or widen the "
        "limits}]]",
    ),
    "name": refuse(
        "[[{of} has]][[!of? there is]] no {kind} '{about}'[[: did you mean '{near}'?]][[: there "
        "are {known}]]",
    ),
    "twice": refuse("'{name}' stands twice in {about}[[, as {kinds}]]", "change one"),
    "either": refuse(
        "{about}: expected {how:one=exactly one of them,both=both or none,first=the second only "
        "with the first}",
    ),
    "fit": refuse("{about} has the {what} {theirs}, expected {own}[[ in this order{order:1=}]]"),
    "large": refuse(
        "{about} has {states} states and {inputs} inputs, more than the {most} for which a "
        "{what:plan=plan,fit=fit,diagnosis=diagnosis} is made",
    ),
    "short": refuse(
        "a {what:bias=bias,fit=fit,noise=noise estimate,estimate=state estimate,"
        "diagnosis=diagnosis} needs a trial of {needs} finite steps or more[[, got {has}]]",
    ),
    "unweighed": refuse(
        "[reward] weighs {about}, but the target has no value for it[[ at step {step}]]",
        "add the column to the target ([[`{to}`]][[!to? for a line: `--to {about}=0`]]; if only "
        "`terminal` weighs it, only the last value counts), or drop the weight",
    ),
    "no_input": refuse(
        "{about} has no {what}",
        "[[{what:state=,input=for a free motion, add the force that nobody applied, and to the "
        "log a column of zeros}]]",
    ),
    "constant": refuse(
        "{about} has no uncertain parameter[[ '{name}']] to fit",
        "give bounds, Param(value, unit, low, high), or a prior, Param(value, unit, std=s)",
    ),
}

# how a workspace begins: what a log's numbers are, and why
START: dict[str, Entry] = {
    # why a number of the log is a state or input
    "unit": note(
        "{about:its/their} unit is {unit}[[ in the log, {model} in the model]][[size? , by size]]"
    ),
    "joint": note(
        "[[{index} of ]]{about} is its joint[[ '{joint}']][[index? , in order from the base: "
        "check it]]",
    ),
    "follows": note(
        "it [[no? does not follow]][[!no? follows]] the [[speed? speed]][[!speed? derivative]] of "
        "{of}[[opposite?  with the OPPOSITE SIGN]][[, correlation {correlation:.3f}]][[, "
        "{slope:.3g} times as large]]",
    ),
    "still": note(
        "{about} never {about:changes/change} in this log",
        "[[empty? there are no messages: record the commands]]",
    ),
    "left": note(
        "no name matches; {numbers} {numbers:is/are} left[[only? , by unit]]",
    ),
    "given": note("as you specified"),
    "unused": note("{about} {about:is/are} not used of the log: [log] can name {about:it/them}"),
    "angles": note(
        "{about} is a heading, of which a whole turn counts as an error",
        "declare angles = {declared} in model.py",
    ),
    "interval": note(
        "the log's commands change every {every:.3g} s; dt is {dt:.3g} s",
        "[task] dt (--dt) sets another",
    ),
    # what the file of a model says
    "unmoved": note(
        "{about} {about:is/are} no {about:state/states}, as no input moves {about:it/them}",
        "delete `without` in model.py to have {about:it/them}",
    ),
    "outside": note(
        "{about} {about:starts/start} in the middle of {about:its range/their ranges}, which "
        "{about:does/do} not include 0",
        "set [task] start",
    ),
    "no_start": refuse(
        "{about} can't begin a workspace: {why:own=grounded wrote it,text=it holds no "
        "numbers,still=nothing changes in it}[[ ({names})]]",
        "give a log in which the robot moves, with its states and commands as numbers",
    ),
    # the drawing of a target
    "no_position": refuse(
        "model '{about}' has no role 'position' of two states, which a {shape} needs",
        "add {roles} to model.py; line and step with --to STATE=VALUE need no role",
    ),
    "sideways": refuse(
        "the role 'speed' of model '{about}' is {speed}, which moves it across its heading",
        'write "speed": "{ahead}" in model.py',
    ),
    "follows_path": refuse(
        "--to {about}={asked} can't be chosen: {why:path=the shape sets it,ends=the path ends "
        "with another,rest=the line ends at rest}",
        "omit it[[rate?, or ask for 0 (--to {about}=0)]][[; --hold 1 lets the path end at rest "
        "and stay there{hold:1=}]]",
    ),
}

# a manoeuvre that was drawn
TARGET: dict[str, Entry] = {
    "start": note(
        "[task] start is where {about} rests: {start}",
        "if runs begin elsewhere, change it and draw the target again",
    ),
}
