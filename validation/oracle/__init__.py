"""The paper's algorithm written by hand, to be read beside it and to judge every other engine.

Read in this order: `spatial` (conventions), `tree` and `urdf` (the robot), `kinematics` (Eqs. 4–5, 13–18, 25–32),
`dynamics` (Eq. 8), `closure` (Eqs. 1–3, 6–7, 9–12, 19–24), `slide` (Eq. 33 and the loop). `engine` puts them behind the
method names of an engine.

Independence is its worth: nothing here imports the simulator, nor any engine that it is compared with.
"""

from validation.oracle.engine import Law, Oracle, Slide, Terms, simulate_slide
from validation.oracle.tree import Joint, Link, Tree, UnsupportedModel, build_tree, read_urdf

__all__ = [
    "Joint", "Law", "Link", "Oracle", "Slide", "Terms", "Tree", "UnsupportedModel", "build_tree", "read_urdf",
    "simulate_slide",
]  # fmt: skip
