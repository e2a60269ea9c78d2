"""Compensation of friction, beside any law: from a model, by a disturbance observer, or by adaptation.

model      friction as it is believed to be, fed forward along the wanted motion
observer   whatever accelerates the joints beyond torque and contact force, estimated and taken out
adaptive   the surface's Coulomb and viscous coefficients, found from the tracking error
"""
