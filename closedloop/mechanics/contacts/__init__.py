"""Point contacts of the links of a tree, many at once: their rows, the forces in them, impacts, and their modes.

memory         what they are, and what they are at the state asked about last
mobility       what forces do to their rows
given_modes    forces where it is known which contacts are free, slide or stick; `closed` of one contact alone
joint_space    the solver of all problems of cones, with as many unknowns as joints
unknown_modes  forces or impulses in Coulomb's cones that solve all contacts together
modes, impact  what happens in an event
turning        friction of contacts that slip slowly, with the forces, and when the first of these slips ends
time_step      one step at the level of impulses, where no modes agree, and the tangential impact
stepping       time stepping: each step at that level
surfaces       those that are curved or move
"""
