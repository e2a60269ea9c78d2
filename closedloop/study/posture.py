"""The posture of the studies: with the elbow up there is room along y for longer and faster paths than wam_slide's."""

import math

ELBOW_UP = (math.pi / 2, 1.0, 0.0, 2.0)
"""Joint positions of the WAM, rad."""
