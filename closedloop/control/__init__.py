"""Control of an arm that presses on a surface and moves along it.

law            base classes of control laws and of friction compensations, and their input
laws           the control laws that ship, a file each
compensation   the friction compensations that ship, a file each
tip_space      functions shared by laws in operational space
drives         torque limits, gears, elastic joints
sensor         the force sensor, and encoders
stability      how much force feedback a sampled sensor allows
"""
