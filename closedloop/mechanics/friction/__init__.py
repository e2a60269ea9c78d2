"""Friction of the tip on a surface and in joints.

law        what every law of friction is, with the types of its parameters
laws       those that ship, a file each
bristle    what dahl and lugre share
contact    a law at one contact, for use from Python
turning    where the friction of a slow slip points

    section = SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0)
    contact = surface_contact(section)
"""
