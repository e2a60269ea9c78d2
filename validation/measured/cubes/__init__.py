"""Real tosses of a cube, simulated from their first row by this package and by other engines, all fitted alike.

python -m validation.measured cubes             # judge, with the fitted values that come with the package
python -m validation.measured.cubes --fit       # fit every engine again, and write the values
python -m validation.measured.cubes --figures DIR
python -m validation.measured.cubes --film 20 toss.gif   # a toss, simulated and measured
"""

from validation.measured.cubes.comparing import judge

__all__ = ["judge"]
