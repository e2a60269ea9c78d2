"""Point contacts of the links of a tree, many at once: their rows, the forces in them, impacts, and their modes.

memory             what they are, and what they are at the state asked about last
linear             a square system of any rank
complementarity    forces or impulses in Coulomb's cones that solve all contacts together
continuation       the same along a path, where the quick method does not find them
closed             forces in known modes: of one contact, or of all
turning            friction of contacts that slip slowly, with the forces
slips_end          when the first of these slips ends within a step
given_modes        forces where it is known which contacts are free, slide or stick
shortest           of equations that depend on each other which do not, and the shortest forces that obey them
time_step          one step at the level of impulses, where no modes agree
tangential_impact  one impulse that stops a slip, where pressing harder pulls the contact in
least_norm         of forces that are not unique those of least norm inside the cones
surfaces           those that are curved or move
"""
