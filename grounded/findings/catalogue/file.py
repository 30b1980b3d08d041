"""Findings on files: why one can't be read or written, and what in it is not as it should be."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

_STAMPS = "one in seconds named 't', or 't_ms', 't_us', 't_ns' in their units"
ENTRIES: dict[str, Entry] = {
    # contents of a log
    "decode": Entry(
        "refuse",
        "its {what} can't be read[[ at '{at}']][[: {why}]]",
        "[[{what:CDR=`ros2 bag convert` with compression_mode none writes plain CDR,"
        'header stamp=set clock = "log" (or "publish") for it}]]',
    ),
    "path": Entry(
        "refuse",
        "expected {expected}[[ at {at}]][[, found {found}]][[ in message path '{path}']]"
        "[[: there are {known}]]",
    ),
    "signal": Entry(
        "refuse",
        "[[{file}: ]]'{about}' ({path}) can't be read[[ from {topic}]][[ ({type})]]"
        "[[ at {at:.3f} s]][[: {why}]][[: none of {messages:message} has it]]"
        "[[: {what:one=a single sample can't be interpolated,zero=all its stamps are 0,"
        "nothing=no value is a finite number}]][[ of {values}]]",
        '[[{what:one=set resample = "hold",zero=use another clock}]]',
    ),
    "damaged": Entry(
        "refuse",
        "{about}: {part} [[{what:cut=is cut off: the file ends inside it,checksum=does not match "
        "its checksum,time=is from after the year 2262}]][[!what? is damaged]][[: {why}]]"
        "[[ (at byte {byte})]]",
        "`recover` saves what can be saved",
    ),
    "no_message": Entry("refuse", "{about} holds no message[[: the file ends at byte {byte}]]"),
    "no_log": Entry(
        "refuse",
        "{about} is no log[[ but a {head}]][[: it begins with {begins}]]"
        "[[, it is a workspace{own:1=}]]",
        "[[!tables? give the file that the robot's program wrote: MCAP, ROS 2 .db3, ROS 1 .bag, "
        ".csv, .npz, .parquet, .mat, PX4 .ulg or ArduPilot .bin]][[give {tables} as one .npz if "
        "they are one run: see docs/log-reference.md, two tables with two clocks]]",
    ),
    # tables
    "no_times": Entry(
        "refuse",
        "{about} [[begins with '{line}', not with column names]][[!line? has no column of times]]"
        "[[ among {names}]]",
        "[[line? name the columns: `--columns t,x,v`, or `columns` in [log]; ]]"
        f"add or name {_STAMPS}[[; '{{rises}}' increases in every row]]; or give the rate of "
        "its rows [Hz], `--rate 100`, or `rate = 100` in [log]",
    ),
    "times": Entry(
        "refuse",
        "{about}[[, line {line}]]: '{name}' has no times[[ in {lost:row}]][[: '{text}']]",
        f"expected {_STAMPS}, 2026-11-21 10:05:00.250, 21.11.2026 10:05:00.250 or 10:05:00.250",
    ),
    "row": Entry(
        "refuse",
        "{about}[[, line {line},]] has {has} cells, but {names:column} {names:is/are} named",
        "[[export it with a point as decimal sign, or with semicolons or tabs between the "
        "columns{comma:1=}]]",
    ),
    "rows": Entry(
        "refuse",
        "{about} has {rows} rows below its header[[, expected {needs} or more]]",
        "[[target? draw the manoeuvre, or write a row per control step with t and the "
        "states]][[add rows, or set [task] horizon = {horizon}]]",
    ),
    "grid": Entry(
        "refuse",
        "{about} has [[sample {sample} at {at:.4f} s instead of {expected:.4f} s]][[a sample "
        "every {every:.4g} s]], dt is {dt:.6g} s",
        "[[set [task] dt = {each:.6g}, the time in s from one command to the next, or resample the "
        "rows]][[robot? samples are missing or late: run it again]][[append each "
        "at {unit} times its stamp: it is in another unit]]",
    ),
    # files and folders
    "missing": Entry(
        "refuse",
        "{about} does not exist[[, nor does its folder {folder}]][[: did you mean '{near}'?]]",
    ),
    "no_workspace": Entry(
        "refuse",
        "there is no {about}, which a workspace has",
        "name its folder, such as -C DIR (in Python Workspace(DIR))[[: {near}]]",
    ),
    "unreadable": Entry(
        "refuse",
        "{about} can't be read[[ as a {kind}]]: {why}",
        "[[{kind:ROS 2 bag=`sqlite3 FILE .recover` saves what can be saved,ROS 1 bag=`rosbag "
        "reindex` repairs it if it was not closed,MATLAB class=save plain numbers there: `run.t = "
        "q.Time; run.q = q.Data; save('run.mat', 'run')`}]][[{mend:diagnosis=diagnose again,"
        "delete=delete it: what it kept can then not be undone,candidate=delete it: a trial that "
        "ran it holds a copy,module=install its package here, or give file = "
        "'model.py',trials=install grounded_trials, "
        "or export with --format npz}]]"
        "[[it reads {outside} outside its folder: copy them too, then give --model]]",
    ),
    "unwritable": Entry(
        "refuse",
        "{about} can't be written[[: {why}]][[: the folder {folder} does not exist]]",
        "[[{mend:space=free disk space,permission=get write permission,lock=move the workspace to "
        "a local disk, since this file system has no locks,recover=`recover` restores what the "
        "file already holds}]]",
    ),
    "exists": Entry("refuse", "{about} exists already", "name another, or remove it first"),
    "changed": Entry(
        "refuse",
        "{about} was changed or damaged: {what:checksum=its checksum does not match,none=it has "
        "no checksum,hash=its contents do not match the hash in its name,manifest=it is not as "
        "the manifest has it,candidate=it was rewritten since it was proposed,policy=it is not "
        "the policy that ran,name=it holds another candidate,gone=what it was made from is "
        "gone}[[: {lost}]]",
        "{what:checksum=make it again,none=make it again,hash=restore it from a backup, or ingest "
        "the original log again,manifest=restore it,candidate=delete it; a new one is made,"
        "policy=delete it; the trial holds the one that ran,name=rename it,gone=bring that back "
        "from a copy, or ingest the original logs again}",
    ),
    "no_mapping": Entry(
        "refuse",
        "{about} is no trial of grounded, and grounded.toml has no [log] table to map it",
        "`inspect` prints one",
    ),
    "untrusted": Entry(
        "refuse",
        "{about} {by:owner=belongs to another user,all=is writable by everybody,group=is writable "
        "by its group}[[ ({id})]]; nothing in {folder} is executed",
        "if it is yours: chown -R $USER and chmod -R go-w, or name the folder in {trust}",
    ),
    # times of a log's signals
    "gap": Entry(
        "refuse",
        "'{about}' ({path}) is not known[[ at {at} s]][[, only from {first} s to {last} "
        "s]][[ from {start} s to {end} s after the start, more than "
        "{limit:.3f} s]][[ in each control step of {dt:.3g} s: it comes every {every:.3g} s]]",
        "end the span before that, or set max_age_s[[dt? ; if its times are milliseconds, name "
        "the column t_ms]]",
    ),
    "clocks": Entry(
        "refuse",
        "{about:the clock/the clocks} of {about} [[jumps back by {by:.3f} s after sample "
        "{sample}]][[differ by about {apart:.3f} s (simulation time, or an unset clock?)]]",
        'use one clock, such as clock = "log"[[by? , or cut the log there]][[, or align them: '
        "{lines}]]",
    ),
    "steps": Entry(
        "refuse",
        "the trial would have {steps} steps of {dt:g} s, from {start:.3f} s to {stop:.3f} s[[; "
        "samples come every {every:.3g} s: are the times in another unit than their column says?]]",
        "see [log.span]",
    ),
    # what is odd in a log
    "staircase": Entry(
        "warn",
        "{about} {about:changes/change} at {changes:g} Hz, but rows come at {rows:g} Hz: samples "
        "are held and {late:g} s late on average",
        "leave cells empty in rows that repeat a value",
    ),
    "outlier": Entry(
        "warn",
        "'{about}' is {value:.4g} at {at:.3f} s, far outside all its other samples, {low:.4g} to "
        "{high:.4g}",
    ),
    "vanished": Entry(
        "warn",
        "[[{about} {about:has/have} no sample after {until:.2f} s of the log, in which other "
        "states go on until {whole:.2f} s: the trial ends there]][[{about} is not a finite number "
        "at {ends}: the trial ends there]][[all states are known from {late:.3f} s on: the trial "
        "starts there]]",
    ),
    "odd_values": Entry(
        "warn",
        "{about}:[[ only {messages:message}]][[ only its first {first:number} are listed]]"
        "[[ {lost:value} not finite]][[ {bridged:value} bridged]]"
        "[[ {stamps:stamp} out of order, repeated or 0]][[ held from a single sample{single:1=}]]"
        "[[, the largest gap is {gap}]]",
    ),
    "opposite": Entry(
        "warn",
        "{about} show the same motion with OPPOSITE SIGN, correlation {correlation:.3f}",
    ),
    # what is lost
    "cut": Entry(
        "warn",
        "[[{about} ]][[!about? the file ]]is cut off at [[line {line}]][[byte {byte}]][[ "
        "({text})]]: what came after that is lost[[, only its index{index:1=}]]",
    ),
    "lost": Entry(
        "warn",
        "[[!wrong? not saved:]][[wrong? the checksum does not match, so some number may be wrong:]]"
        "[[ {bytes} bytes]][[ {part}]][[ {messages:message}]]"
        "[[ {more} more losses of these kinds]][[ second {span} of the log]][[, at byte "
        "{byte}]][[: {why}]]",
    ),
}
