"""Control of an arm that presses on a surface and moves along it.

law            base classes of control laws and of friction compensations
law_input      the input of a law
laws           the control laws that ship, a file each
compensation   the friction compensations that ship, a file each
tip_space      functions shared by laws in operational space
sensor         the force sensor
stability      how much force feedback a sampled sensor allows
"""
