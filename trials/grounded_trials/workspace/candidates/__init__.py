"""The policies to run: planned from the stored trials, checked, and handed over to the robot.

Read `proposing.py` first (propose and status); `search_state.py` derives where the search stands,
also without some trials. `handover.py` checks each candidate before it
leaves, for `exporting.py` (other programs) and `running.py` (the robot, or a simulated one).
`first_plan.py` and `at_rest.py` tell before the first run what the configuration lacks.
"""
