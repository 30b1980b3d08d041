"""The search on foreign systems: MuJoCo, JSBSim and CommonRoad in the robot's place.

robots       runs a policy in a simulator and returns a Trial
mechanisms   cart-pole, two-link arm, files that others ship (MuJoCo)
pushing      a block pushed over a floor (MuJoCo)
aircraft     a Cessna 172 (JSBSim)
cars         a single-track drift car and a multi-body car (CommonRoad)
setups       one name for each system and what is withheld from its crude model
optimum      the best utility known, from the simulator itself; cached in optima.json
study        trials to 90, 97, 99 % of the gap
"""
