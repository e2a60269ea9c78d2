"""Compensation of friction, beside any law: from a model, by a disturbance observer, or by adaptation.

model      feedforward of a friction model along the desired motion
observer   disturbance observer: the estimated disturbance of the joints is compensated
adaptive   adaptation of the surface's Coulomb and viscous coefficients by the tracking error
"""
