"""Friction of the tip on a surface and in joints.

law          what every law of friction is
laws         those that ship, a file each
quantities   the types of their parameters
packing      their parameters by name, from a section
contact      a law at one contact, for use from Python
presliding   small motions before slip

    section = SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0)
    contact = surface_contact(section)
    draw(section, "lugre.png")
"""
