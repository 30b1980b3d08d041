"""Findings on files: why one can't be read or written, and what in it is not as it should be."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

_STAMPS = "one in seconds named 't', or 't_ms', 't_us', 't_ns' in their units"
ENTRIES: dict[str, Entry] = {
    # definitions and messages
    "schema": Entry(
        "refuse",
        "its definition {what:damaged=is damaged at,lacks=does not define,refused=can't be read "
        "at,unexpected=is none at,nested=is nested too deep at,long=has too many items:} '{at}'",
    ),
    "schema_language": Entry(
        "refuse",
        "the schema's language '{language}' can't be read",
        "expected ros1msg, ros2msg, ros2idl, omgidl or protobuf",
    ),
    "message_ends": Entry("refuse", "it ends inside a {inside}"),
    "message_number": Entry("refuse", "a number is not encoded as its schema says"),
    "message_variant": Entry(
        "refuse",
        "its variant of CDR[[, {variant},]] can't be read",
        "`ros2 bag convert` with compression_mode none writes plain CDR",
    ),
    "after_wstring": Entry(
        "refuse", "it comes after a wstring, whose encoding is not standardised"
    ),
    "type_large": Entry("refuse", "its type is larger than {limit} bytes"),
    "json": Entry("refuse", "it is not JSON: {why}"),
    "stamp": Entry("refuse", "its stamp, {stamp}, is out of range"),
    # message paths
    "path": Entry("refuse", "message path '{path}'[[, character {at}]]: expected {expected}"),
    "path_field": Entry(
        "refuse",
        "{type} has no field '{name}'[[: did you mean '{near}'?]][[: there are {known}]][[; "
        "{read} {read:is/are} read already]]",
    ),
    "path_list": Entry("refuse", "'{name}' follows a list: select an item first, as in [0] or [:]"),
    "path_step": Entry("refuse", "{step} needs {needs}, found a {type}"),
    "path_ends": Entry(
        "refuse", "it ends at a {type}, not at a number[[: add one of its fields, {fields}]]"
    ),
    # MCAP
    "record": Entry(
        "refuse",
        "its {what:short=content is too short,checksum=checksum does not match its content,"
        "text=text is not UTF-8,packed=content is compressed,size=size is another than stated,"
        "compression=compression can't be read}[[: {why}]]",
    ),
    "defined_again": Entry("refuse", "{what} is '{first}' and defined again as '{second}'"),
    "mcap": Entry(
        "refuse",
        "{about}: {where} {what:cut=is cut off: the file ends inside it,record=is damaged,"
        "checksum=has a checksum that does not match its content,time=is from after the year "
        "2262}[[: {why}]] (at byte {byte})",
        "`recover` saves what can be saved",
    ),
    "mcap_lost": Entry(
        "refuse",
        "{about} holds no message: {what:cut=the file ends inside,empty=it is empty in,other=it "
        "is no MCAP file by} {where}",
        "did the recorder, or the program that it recorded, stop at once? Record again",
    ),
    "no_bag": Entry("refuse", "{about} is an SQLite file without the tables of a ROS 2 bag"),
    "no_channel": Entry(
        "refuse", "{about}: a message belongs to channel {channel}, which is not defined"
    ),
    # tables
    "column_twice": Entry(
        "refuse", "{about}: two columns have the name '{name}' ({both})", "rename or delete one"
    ),
    "exported": Entry(
        "refuse",
        "{about} is an exported candidate, {candidate}: the policy to run, not a log of its run",
        "give the log that the robot's program wrote",
    ),
    "no_times": Entry(
        "refuse",
        "{about} has no column of times[[ among {names}]]",
        f"add or name {_STAMPS}[[; '{{rises}}' increases in every row]]; or give the rate of "
        "its rows [Hz], `--rate 100`, or `rate = 100` in [log]",
    ),
    "times": Entry(
        "refuse",
        "{about}: '{name}'[[ is not a number in {lost:row}]][[ goes up to {top:g}, out of range "
        "in {unit}]]",
        f"delete such rows, or name the times: {_STAMPS}",
    ),
    "no_time": Entry(
        "refuse",
        "{about}, line {line}: '{name}' is '{text}', which is not a time",
        "expected a number, 2026-11-21 10:05:00.250, 21.11.2026 10:05:00.250 or 10:05:00.250, the "
        "date perhaps in a column 'Date'",
    ),
    "no_rows": Entry("refuse", "{about} has no rows below line {line} with the column names"),
    "no_names": Entry(
        "refuse",
        "{about} begins with '{line}'",
        "expected a line with column names above the rows, such as 't,x,v'; or name them, "
        "`--columns t,x,v`, or `columns` in [log]",
    ),
    "columns": Entry(
        "refuse", "{about} has {has} columns ('{row}'), but {names} {names:is/are} named for it"
    ),
    "row": Entry(
        "refuse",
        "{about}, line {line} has {has} cells, but line {head} names {names} columns",
        "[[export it with a point as decimal sign, or with semicolons or tabs between the "
        "columns{comma:1=}]]",
    ),
    "names_moved": Entry(
        "refuse",
        "{about}, line {line}: '{name}' is empty in every row, while column {column} has numbers "
        "but no name",
        "correct that line: its names seem to be one column too far to the right",
    ),
    "last_column": Entry(
        "warn",
        "{about}: '{name}', its last column, is empty in every row",
        "if line {line} has one name too many, delete it there",
    ),
    "cut": Entry(
        "warn", "{about} is cut off at line {line}[[ ({text})]]: what came after that is lost"
    ),
    # files and folders
    "missing": Entry(
        "refuse",
        "{about} does not exist[[, nor does its folder {folder}]][[: did you mean '{near}'?]][[: "
        "the newest of the {logs} logs in its folder {newest:is/are} {newest}]]",
    ),
    "unreadable": Entry(
        "refuse",
        "{about} can't be read[[ as a {kind}]]: {why}",
        "[[{kind:ROS 2 bag=`sqlite3 FILE .recover` saves what can be saved,ROS 1 bag=`rosbag "
        "reindex` repairs it if it was not closed}]][[{mend:diagnosis=diagnose again,"
        "delete=delete it: what it kept can then not be undone,candidate=delete it: a trial that "
        "ran it holds a copy,module=install its package here, or give file = 'model.py'}]]",
    ),
    "unwritable": Entry(
        "refuse",
        "{about} can't be written[[: {why}]][[: the folder {folder} does not exist]]",
        "[[{mend:space=free disk space,permission=get write permission,lock=move the workspace to "
        "a local disk, since this file system has no locks,recover=`recover` restores what the "
        "file already holds}]]",
    ),
    "special": Entry(
        "refuse",
        "{about} is a {what:link=link, and links are not followed,pipe=pipe,device=device}[[: it "
        "leads to {to}]]",
        "give a file with its contents",
    ),
    "large": Entry("refuse", "{about} is larger than {limit} bytes, the limit for such a file"),
    "changed": Entry(
        "refuse",
        "{about} was changed or damaged: {what:checksum=its checksum does not match,none=it has "
        "no checksum,hash=its contents do not match the hash in its name,manifest=it is not as "
        "the manifest has it,candidate=it was rewritten since it was proposed,policy=it is not "
        "the policy that ran,name=it holds another candidate,gone=what it was made from is "
        "gone}[[: {lost}]]",
        "{what:checksum=make it again,none=make it again,hash=restore it from a backup, or ingest "
        "the original log again,manifest=restore it,candidate=delete it; a new one is made,"
        "policy=delete it; the trial holds the one that ran,name=rename it, or delete it if the "
        "file of that candidate exists,gone=bring that back from a copy, or ingest the original "
        "logs again}",
    ),
    "not_own": Entry(
        "refuse", "{about} is not a {kind} file of grounded[[: its format is '{has}']]"
    ),
    "rows": Entry(
        "refuse",
        "{about} has {rows} rows below its header, expected {needs} or more",
        "[[!horizon? draw the manoeuvre, or write a row per control step with t and the "
        "states]][[add rows, or set [task] horizon = {horizon}]]",
    ),
    "no_mapping": Entry(
        "refuse",
        "{about} is no trial of grounded, and grounded.toml has no [log] table to map it",
        "`inspect` prints one",
    ),
    "grid": Entry(
        "refuse",
        "{about} has [[sample {sample} at {at:.4f} s instead of {expected:.4f} s]][[a sample "
        "every {every:.4g} s]], dt is {dt:.6g} s",
        "[[set [task] dt = {each:.6g}, the time in s from one command to the next]][[resample? , "
        "or resample the rows]][[robot? samples are missing or late: run it again]][[append each "
        "at {unit} times its stamp: it is in another unit]]",
    ),
    "exists": Entry("refuse", "{about} exists already", "name another, or remove it first"),
    "folder": Entry("refuse", "{about} is a folder", "name a file in it"),
    "no_folder": Entry("refuse", "{about} is a file", "-C takes the folder with grounded.toml"),
    "no_workspace": Entry(
        "refuse",
        "{about} does not exist: this is not a workspace",
        "name its folder, such as -C DIR (in Python Workspace(DIR))[[: {near}]]",
    ),
    "empty": Entry(
        "refuse",
        "{about} is empty (0 bytes): the recorder wrote nothing, or the copy is unfinished",
        "copy it again, or record again",
    ),
    "no_log": Entry(
        "refuse",
        "{about} is not a log: it begins with {head}",
        "expected MCAP, ROS 2 .db3, ROS 1 .bag, .csv, .npz, .parquet, .mat, PX4 .ulg or ArduPilot "
        ".bin",
    ),
    "no_log_inside": Entry(
        "refuse",
        "{about} holds no *.mcap or *.db3 file[[; it is a workspace{own:1=}]]",
        "give the log itself[[, {tables} as one .npz if they are one run: see "
        "docs/log-reference.md, two tables with two clocks]]",
    ),
    "objects": Entry(
        "refuse",
        "{file}: {about} {about:is/are} of the class {kinds}, which MATLAB alone can read",
        "save plain numbers there: `run.t = q.Time; run.q = q.Data; save('run.mat', 'run')`",
    ),
    "no_episode": Entry("refuse", "{about} is no episode: the data set has {count}"),
    "listed": Entry(
        "refuse", "{about} lists {name}, which is not in the folder", "give its files one by one"
    ),
    # tables of TOML
    "key": Entry(
        "refuse",
        "{about}: {key}: [['{value}' ]]is not known here[[: did you mean '{near}'?]][[: there are "
        "{known}]]",
    ),
    "value": Entry(
        "refuse",
        "{about}: {key} must be {must:str=a text,bool=true or false,float=a number,int=a whole "
        "number,list=a list in brackets,dict=a table,finite=a finite number,positive=positive,"
        "natural=0 or more,nonzero=other than 0,pair=[low; high],time=a time of a log's clock,"
        "path=a message path,crossing=a time or a path with one of above and below,one=either a "
        "file or a module,alone=without a model,effects=tables with a name,deviations=standard "
        "deviations of states}[[, found {given}]]",
    ),
    # signals of [log]
    "unmapped": Entry(
        "refuse", "[log] maps no {kinds}: a trial needs states and inputs", "add their paths"
    ),
    "no_input": Entry("refuse", "{about} is no input of [log]: {hint}"),
    "mapped_twice": Entry(
        "refuse",
        "[log] maps the input {input} and the state {state} to the same number, {path}",
        "set the path of the input to what was sent to the robot",
    ),
    "no_topic": Entry(
        "refuse",
        "{about} {about:is/are} read from {topic}, but the log has no topic '{topic}'[[: did you "
        "mean '{near}'?]][[: there are {known}]]",
        "if it was renamed, edit the path in [log] of grounded.toml",
    ),
    "misfit": Entry(
        "refuse", "{file}: '{about}' is read from '{path}', but in {topic} ({type}) {why}"
    ),
    "message": Entry(
        "refuse",
        "{about}: a message of {topic} ({type}) logged at {at:.3f} s does not fit its definition: "
        "{why}",
    ),
    "encoding": Entry(
        "refuse",
        "the messages are encoded as '{encoding}'[[ without a schema{bare:1=}]]",
        "expected cdr, ros1, protobuf or json",
    ),
    "no_stamp": Entry(
        "refuse", "messages have no header stamp", 'set clock = "log" (or "publish") for it'
    ),
    "several_values": Entry(
        "refuse",
        "the message logged at {at:.3f} s has several values for it",
        "name one item, or add a filter such as (name==1) in braces",
    ),
    "no_samples": Entry(
        "refuse",
        "'{about}' is read from '{path}', but {topic} has {messages:message}, none with it",
    ),
    "unusable": Entry(
        "refuse",
        "'{about}' ({path}) can't be used: {what:one=one sample can't be interpolated: set "
        'resample = "hold",zero=all its stamps are 0: use another clock,nothing=no value is a '
        "finite number}[[ of {values}]]",
    ),
    "sparse": Entry(
        "refuse",
        "'{about}' ({path}) comes every {every:.3g} s, a control step is {dt:.3g} s",
        "if its times are milliseconds, name the column t_ms; if it is so slow, set max_age_s",
    ),
    "outside": Entry(
        "refuse",
        "'{about}' ({path}) is not known at {at:.3f} s: its samples range from {first:.3f} s to "
        "{last:.3f} s",
    ),
    "gap": Entry(
        "refuse",
        "'{about}' ({path}) has a gap of {gap:.3f} s from {start:.3f} s to {end:.3f} s after the "
        "start, more than {limit:.3f} s",
        "end the span before it, or set max_age_s to interpolate over it",
    ),
    "clock_jumps": Entry(
        "refuse",
        "'{about}' ({path}): its {clock} clock jumps back by {by:.3f} s after sample {sample}",
        'cut the log there[[, or use clock = "log"{other:1=}]]',
    ),
    "clocks": Entry(
        "refuse",
        "{early} and {late} are on clocks that differ by about {apart:.3f} s (simulation time, or "
        "an unset clock?)",
        'log all on one clock, such as clock = "log"[[, or align them: {lines}]]',
    ),
    "never": Entry(
        "refuse",
        "[log.span] {about}: {path} is never {wanted} in this log; it is {low:g} to {high:g}",
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
        "delete that row or message from the log",
    ),
    "vanished": Entry(
        "warn",
        "{about} {about:has/have} no sample after {until:.2f} s of the log, in which other states "
        "go on until {whole:.2f} s: the trial ends there",
    ),
    "late_start": Entry("warn", "the trial starts {late:.3f} s late, when all states are known"),
    "odd_values": Entry(
        "warn",
        "{about}:[[ {lost} of {samples} values are not finite numbers]][[ {bridged:value} bridged,"
        " the largest gap is {gap}]][[ {stamps:stamp} out of order, repeated or 0]][[ held from a "
        "single sample{single:1=}]]",
    ),
    "clocks_apart": Entry("warn", "the clocks of {about} differ by {apart:.3f} s"),
    "topic": Entry("warn", "{about} ({type}) can't be read: {why}"),
    "gaps": Entry("warn", "{about} has {messages:message}[[, with a gap of {gap:.3f} s]]"),
    "first_numbers": Entry(
        "note", "{about} is listed with its first {numbers} numbers", "[log] can use any other"
    ),
    "not_finite": Entry("warn", "{about} has values that are not numbers"),
    "opposite": Entry(
        "warn",
        "{about} show the same motion with OPPOSITE SIGN, correlation {correlation:.3f}",
    ),
    # what a recovery loses
    "nothing_saved": Entry(
        "refuse", "{about}: nothing can be saved[[: {why}]]", "expected an MCAP log with messages"
    ),
    "cut_at": Entry(
        "warn",
        "the file is cut off at byte {byte}: what came after that is lost[[, only its "
        "index{index:1=}]]",
    ),
    "lost": Entry(
        "warn",
        "not saved:[[ {bytes} bytes]][[ {part}]][[ {messages:message} of unknown topics or "
        "times]][[ {more} more losses of these kinds]][[ second {span} of the log]][[, at byte "
        "{byte}]][[: {why}]]",
    ),
    "unverified": Entry(
        "warn",
        "the checksum of the file does not match: some number in [[{messages:message}]] may be "
        "wrong, and it can't be located",
    ),
    "untrusted": Entry(
        "refuse",
        "{about} {by:owner=belongs to another user,all=is writable by everybody,group=is writable "
        "by its group}[[ ({id})]], so another user may have changed its code; nothing in {folder} "
        "is executed",
        "if it is yours: chown -R $USER and chmod -R go-w, or name the folder in {trust}",
    ),
}
