"""The mobility of contacts whose rows a test has written, and the size of what their accelerations are made of."""

import numpy as np

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.mobility import own_mobilities


def write_own_mobilities(c):
    """Write S and `size` of the rows X, the load and the drift that are there."""
    interpreted(own_mobilities)(c, c.near.shape[0])
    c.size[:] = np.abs(c.drift) + np.abs(c.X) @ np.abs(c.load)


def mobility(c):
    """W = X Xᵀ."""
    return c.X @ c.X.T
