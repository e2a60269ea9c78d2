"""Control of an arm that presses on a surface and moves along it.

law            what every control law and every compensation of friction is
law_input      what a law knows at one instant
laws           those that ship, a file each
compensation   those of friction that ship, a file each
tip_space      what laws for the tip have in common
sensor         the force sensor
stability      how much force feedback a sampled sensor allows
"""
