"""The paper's simulation in one file gives what the simulator gives, row by row."""

import ast
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
from closedloop import paper


@pytest.mark.parametrize("engine", ["compiled", "pinocchio"])
@pytest.mark.parametrize("name", ["wam_slide", "wam_slide_unstabilised"])
def test_every_row_equals_the_engines(name, engine):
    """8001 rows, with the stabiliser and without it: f to 1e-8 N, q to 1e-12 rad, e to 1e-13 m.

    Measured: 7.4e-10 N, 7.8e-13 rad and 2.1e-15 m. The path's knots differ by 1e-13 rad, since only the simulator
    corrects them by Newton's method; the PD part makes 1e-10 N of that.
    """
    run = cl.simulate(cl.load_scenario(name), engine=engine)
    t, q, f, e = paper.slide(stabilised=name == "wam_slide")
    assert t.shape == f.shape == e.shape == (8001,)
    assert np.array_equal(t, run.time)
    assert np.abs(f - run.contact_force).max() < 1e-8
    assert np.abs(q - run.q).max() < 1e-12
    assert np.abs(e - run.closure_error).max() < 1e-13


def test_numbers_are_those_of_the_scenario():
    """The constants of the file are those of wam_slide and, but for posture, path and gains, the paper's."""
    s = cl.load_scenario("wam_slide")
    assert np.array_equal(paper.Q0, s.start.q)
    assert np.array_equal(paper.KP, s.law.kp)
    assert np.array_equal(paper.KD, s.law.kd)
    assert (s.reference.start, s.reference.stop, s.law.force) == (paper.START, paper.STOP, paper.FORCE)


def test_it_is_short_and_stands_alone():
    """At most 100 lines; at the top numpy, Pinocchio and what loads the robot, and names of the standard library."""
    text = Path(paper.__file__).read_text(encoding="utf-8")
    imports = [node for node in ast.parse(text).body if isinstance(node, (ast.Import, ast.ImportFrom))]
    names = {getattr(node, "module", None) or node.names[0].name for node in imports}
    assert len(text.splitlines()) <= 100
    assert names == {"pathlib", "typing", "numpy", "numpy.typing", "pinocchio", "robot_models"}


@pytest.mark.slow
def test_figures(tmp_path, capsys):
    """The module draws one picture with Figs. 4 to 7, and prints a line for each."""
    paper.draw(tmp_path / "made" / "figures.png")
    said = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in said] == ["Fig. 4", "Fig. 5", "Fig. 6", "Fig. 7"]
    assert said[1].endswith("at the end 10.0")
    assert (tmp_path / "made" / "figures.png").read_bytes().startswith(b"\x89PNG")
