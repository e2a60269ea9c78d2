"""The posture of the studies: with the elbow up the workspace along y allows longer and faster paths."""

import math

ELBOW_UP = (math.pi / 2, 1.0, 0.0, 2.0)
"""Joint positions of the WAM, rad."""
