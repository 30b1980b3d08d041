"""The disk: MCAP logs, mapping, resampling, the store, the workspace, recordings.

Own files are written by `mcap_log` and kept by `store`; foreign logs come in through `signals`
(which values, from which messages) and `resample` (onto the control grid). A file is data, never
code: nothing read here is executed.
"""
