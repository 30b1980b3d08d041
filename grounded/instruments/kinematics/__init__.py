"""Kinematic relations between sensors, which hold whatever the physics, derived from the model.

Read `relations` first: which state is the rate of which, and how headings turn speeds into courses.

velocities     a velocity against its position: dead, computed from it, biased
swapped        two exchanged columns, by positions and velocities
rows           rates made of several sensors, like x' = u cos psi - v sin psi
way            the distance travelled against speeds and heading, by one complex factor
late_position  positions that lag behind velocities and heading
"""
