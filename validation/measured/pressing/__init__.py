"""A UR10e in its maker's force mode that comes down on a surface: measured, and simulated with machine and law alike.

python -m validation.measured pressing --data FILE.npz                       # fit, and predict the other tests
python -m validation.measured pressing --data FILE.npz --fitted FIT.json     # write the fit, or use it if it is there
python -m validation.measured.pressing --data FILE.npz --fitted FIT.json --figures DIR      # force of each test
python -m validation.measured.pressing --data FILE.npz --fitted FIT.json --scenarios DIR    # and its scenario
python -m validation.measured.pressing --data FILE.npz --fitted FIT.json --map MAP.png      # how it swings at rest

The data are not part of the package: the measurements of the JKU Linz, GPL-3, from
JKU-Linz-Institute-of-Robotics/ur10e_force_control_comparison, as a file with the arrays that `touchdowns.read` names.
"""

from validation.measured.pressing.judging import judge

__all__ = ["judge"]
