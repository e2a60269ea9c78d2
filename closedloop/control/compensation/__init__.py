"""Compensation, beside any law: of friction from a model, by an observer or by adaptation; of an unknown normal.

model      feedforward of a friction model along the desired motion
observer   disturbance observer: the estimated disturbance of the joints is compensated
adaptive   adaptation of the surface's Coulomb and viscous coefficients by the tracking error
normal     the surface's normal, estimated from the measured force and the tip's velocity
"""
