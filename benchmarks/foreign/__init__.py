"""The search on systems that nobody here wrote: MuJoCo, JSBSim, CommonRoad as the robot.

robots       a policy runs in a simulator and comes back as a Trial
mechanisms   cart-pole, two-link arm, seven-joint arm, pushed block (MuJoCo)
aircraft     a Cessna 172 (JSBSim)
cars         a single-track drift car and a multi-body car (CommonRoad)
setups       one name for each system and what is withheld from its crude model
optimum      what was possible, from the simulator itself; cached in optima.json
study        trials to 90, 97, 99 % of the gap, beside refit-and-replan and ILC
"""
