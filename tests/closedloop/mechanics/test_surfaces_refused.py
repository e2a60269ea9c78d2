"""Surfaces that are refused or end a run, and surfaces of one's own."""

from typing import Annotated

import numpy as np
import pytest
from pydantic import Field
from test_surfaces import no_torque, point_mass

import closedloop as cl
from closedloop.base.sections import Number
from closedloop.mechanics.surface.motion import SurfaceMotion
from closedloop.mechanics.surface.surface import CURVATURE, Surface


class Cliff(Surface):
    """A level plane whose φ is constant beyond x = 10 mm."""

    @staticmethod
    def level(p, par, gradient, hessian):
        """Return z, or nothing."""
        gradient[2] = 1.0 if p[0] < 0.01 else 0.0
        return p[2] if p[0] < 0.01 else 0.0


class Forgetful(SurfaceMotion):
    """A rise whose velocity is not written."""

    @staticmethod
    def move(t, par, m):
        """Write the shift alone."""
        m.shift[2] = 0.01 * t * t
        m.shift_acceleration[2] = 0.02


IMPLICIT = {"kind": "implicit"}


REFUSED = {
    "heights": (
        {"surface.kind": "height_field", "surface.heights": [[0.0] * 4] * 3},
        "must be at least 4 lists of at least 4 numbers, all of one length",
    ),
    "cylinder's axis": ({"surface.kind": "cylinder", "surface.axis": [0, 1, 1]}, "right angles to surface.normal"),
    "no radius": ({"surface.kind": "sphere", "surface.radius": 0.0}, "surface.radius = 0.0: must be greater than 0"),
    "path too long": (
        {"surface.kind": "sphere", "surface.radius": 0.05},
        "from where the surface cannot be reached along its normal",
    ),
    "tip inside": (
        {"surface.kind": "sphere", "surface.point": [0.0, 0.3, 0.9], "surface.contact": "unilateral"},
        "surface.point",
    ),
    "belt without velocity": ({"surface_motion.kind": "conveyor", "surface_motion.velocity": [1, 2]}, "three numbers"),
    "belt without velocity, at rest": (
        {"surface_motion.kind": "conveyor", "surface_motion.velocity": [0, 0, 0]},
        "surface_motion.velocity = [0, 0, 0]: must not be zero",
    ),
    "motion that forgets its velocity": ({"surface_motion.kind": Forgetful}, "must be the derivatives of `angle`"),
    "no gradient on the way": ({"surface.kind": Cliff, "reference.direction": [1, 0, 0]}, "the surface has no normal"),
    "gradient that vanishes at one point of the way": (
        {"surface": IMPLICIT | {"expression": "z*(x**2 + (y - 0.02)**2)"}},
        "at t = 2.5 s the path comes to [0.0, 0.8071, 0.3388] m, where the surface has no normal, as the gradient of "
        "its φ vanishes there",
    ),
    "tip of a cone on the way": (
        {"surface": IMPLICIT | {"expression": "x**2 + y**2 - z**2", "at": [0.0, -0.03, -0.03]}},
        "at t = 3.5 s the path comes to [0.0, 0.8171, 0.3688] m",
    ),
    "ridge on the way": (
        {"surface": IMPLICIT | {"expression": "z + sqrt((y - 0.0312)**2)", "at": [0, 0, -0.0312]}},
        "as the gradient of its φ jumps there",
    ),
    "turntable at rest": (
        {"surface_motion.kind": "turntable", "surface_motion.speed": 0.0},
        "surface_motion.speed = 0.0: must not be zero",
    ),
    "breath of no depth": (
        {"surface_motion.kind": "breathing", "surface_motion.amplitude": 0.0},
        "surface_motion.amplitude = 0.0: must not be zero",
    ),
    "belt that does not say how fast": ({"surface_motion.kind": "conveyor"}, "'surface_motion.velocity' is missing"),
    "turntable that does not say how fast": ({"surface_motion.kind": "turntable"}, "'surface_motion.speed' is missing"),
    "tool without mass": ({"tool.centre": [0.0, 0.0, 0.1]}, "tool.mass = 0: a tool with a centre of mass"),
    "gap of a placed one": (
        {"surface.kind": "sphere", "surface.point": [0.0, 0.3, 0.9], "surface.gap": 0.1},
        'acts with point = "start" only',
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_is_refused_in_one_line(case):
    """Each with the key and what would be right."""
    changes, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(cl.load_scenario("wam_slide", changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_surface_without_a_normal_ends_the_run():
    """A tip that comes to where the gradient vanishes ends the run with a line that says so; its rows are kept."""
    scenario = point_mass(surface__kind=Cliff, start__v=[0.1, 0.0, 0.0], time__duration=0.3)
    with pytest.raises(cl.NoNormalError, match=r"stopped at t = 0.1.* the surface has no normal at \[0.01") as caught:
        cl.simulate(scenario, law=no_torque)
    assert 99 <= len(caught.value.run) <= 101
    # A step of 0.1 mm leads over the one point at which the gradient vanishes, 12.34 mm away.
    factor = {"kind": "implicit", "expression": "z*((x - 0.01234)**2 + y**2)"}
    with pytest.raises(cl.NoNormalError, match=r"stopped at t = 0\.12.* has no normal at .* within a step"):
        cl.simulate(point_mass(surface=factor, start__v=[0.1, 0.0, 0.0], time__duration=0.2), law=no_torque)
    bowl = {"surface__kind": "sphere", "surface__radius": 0.01, "surface__inside": True, "surface__gap": 0.01}
    with pytest.raises(cl.ScenarioError, match="has no normal at"):
        cl.simulate(point_mass(surface__contact="unilateral", **bowl))


def test_a_surface_of_ones_own():
    """Given by a class of one's own it is what the shipped one is, in both engines, and in a batch."""
    mine = cl.load_scenario("wam_slide", {"surface.kind": Paraboloid, "surface.bend": 2.5, "time.duration": 0.8})
    run, other = cl.simulate(mine), cl.simulate(mine, engine="compiled")
    assert np.allclose(run.contact_force, other.contact_force, rtol=0, atol=1e-8)
    r = run.position - run.position[0]
    assert np.allclose(r[:, 2], -1.25 * np.sum(r[:, :2] ** 2, axis=1), rtol=0, atol=1e-9)
    table = cl.simulate_batch(mine, {"surface.bend": [2.5, 1.0, 0.0]}, workers=1).to_pydict()
    assert table["max_kkt_residual"][0] < 1e-14
    assert table["peak_contact_force"][0] == pytest.approx(np.max(run.contact_force), abs=1e-8)
    plane = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.8}))
    assert table["peak_contact_force"][2] == pytest.approx(np.max(plane.contact_force), abs=1e-8)


class Paraboloid(Surface):
    """A hill, z = −bend (x² + y²)/2."""

    bend: Annotated[Number, CURVATURE] = Field(1.0, description="curvature at the top, 1/m")

    @staticmethod
    def level(p, par, gradient, hessian):
        """Return z + bend (x² + y²)/2."""
        gradient[0], gradient[1], gradient[2] = par.bend * p[0], par.bend * p[1], 1.0
        hessian[0, 0] = hessian[1, 1] = par.bend
        return p[2] + 0.5 * par.bend * (p[0] * p[0] + p[1] * p[1])
