"""Our own files, trials and candidates as MCAP, and the store that keeps them.

Read `store.py` first (content-addressed, never rewritten), then `trial_file.py` and
`candidate_file.py`; `own_files.py` is what they share. `documents.py` is what is kept as JSON.

A trial has channels `/state` and `/input`, a message a sample, with one double a name; step k is
stamped k dt after the start. A candidate has `/policy` (lists feedforward[m], gain[m * nz] row by
row, reference[nz], a message a control step), `/predicted_state` and `/predicted_input`. Both have
the metadata record `grounded`, a table of strings:

    format            "grounded trial 1" or "grounded candidate 1"
    dt                control interval [s]
    states, inputs    JSON objects, name -> unit, in array order
    candidate         (trial) the candidate that was run, "" for none
    start_inputs      (trial) JSON list, the inputs held before t = 0, or null
    start_ns          (trial) the stamp of t = 0 [ns]; a trial without its beginning is refused
    steps             (candidate) H; one without its end is refused
    policy            (candidate) JSON object: low, high (null: no limit), past, depths, angles, z
    sha256            (candidate) of the rest of this table and all numbers; absent in files of 0.1

and whatever the writer adds. A trial carries the candidate's file as attachment `policy`.
Numbers in text are Python's repr: they come back exactly. Every file is complete and has all its
checksums, or it is refused.
"""
