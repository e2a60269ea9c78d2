"""The mobility of contacts whose rows a test has written, and the size of what their accelerations are made of."""

import numpy as np

from closedloop.jit.interpreted import interpreted
from closedloop.mechanics.contacts.mobility import own_mobilities, write_mobility


def write_whole_mobility(c):
    """Write W and `size` of the rows X, the load and the drift that are there."""
    k = c.near.shape[0]
    interpreted(own_mobilities)(c, k)
    interpreted(write_mobility)(c, k)
    c.size[:] = np.abs(c.drift) + np.abs(c.X) @ np.abs(c.load)
