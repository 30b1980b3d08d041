"""Instruments, judged from their own signals before any physics: late, scaled, stuck, in degrees.

Read `preflight` first: it looks at trials and a model's kinematics, states each `Finding`, and
gives the trials with what can be corrected corrected. `single` judges one signal at a time,
`kinematics` a position against its velocity and a heading against the way that was travelled,
`mismatch` a position against all that its rate is made of (`rows`), `lag` measures how late one
signal is behind another.
"""
