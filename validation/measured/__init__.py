"""The simulator's models against measurements of real robots, which come with it: ``python -m validation.measured``.

Each robot is a file with a function `judge`; `ROBOTS` of `validation.measured.__main__` lists them. Where the data come
from, under which licence, and what was done to them: `data/README.md`.
"""
