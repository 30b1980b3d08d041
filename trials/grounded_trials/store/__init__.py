"""Files of grounded's own: trials and candidates as MCAP, and the store that keeps them.

Read `store.py` first (content-addressed, never rewritten), then `trial_file.py` and
`candidate_file.py`, which share `own_files.py`. `documents.py` handles files in JSON.

A trial has the channels `/state` and `/input`, with one message per sample and one double per name;
step k is stamped k dt after the start. A candidate has `/policy` (one message per control step with
the lists feedforward[m], gain[m * nz] row by row, reference[nz]), `/predicted_state` and
`/predicted_input`. Both have the metadata record `grounded`, a table of strings:

    format            "grounded trial 1" or "grounded candidate 1"
    dt                control interval [s]
    states, inputs    JSON objects, name -> unit, in array order
    candidate         (trial) the candidate that was run, "" for none
    start_inputs      (trial) JSON list, the inputs held before t = 0, or null
    start_states      (trial) JSON object, states at t = 0 as the samples before show them, if any
    start_ns          (trial) time stamp of t = 0 [ns]; detects a trial without its beginning
    steps             (candidate) H; detects a candidate without its end
    policy            (candidate) JSON object: low, high (null: no limit), past, depths, angles, z
    sha256            (candidate) of the rest of this table and all numbers; absent in files of 0.1

and the writer's own entries. A trial carries the candidate's file as the attachment `policy`.
Numbers in text are written as Python's repr and are read back exactly. A file that is incomplete or
lacks a checksum is refused.
"""
