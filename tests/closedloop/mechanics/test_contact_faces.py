"""A face that presses with its area: a tilted disc and a rectangle on a plane, against closed forms."""

import math

import numpy as np
import pytest

import closedloop as cl
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.tables import disc, points_of_face, rectangle

STIFFNESS, RADIUS, MASS = 2e4, 0.03, 0.5
TEXT = """
[robot]
model = "none"
[surface]
kind = "none"
[[body]]
name = "pad"
shape = "cylinder"
radius = 0.03
length = 0.02
mass = 0.5
[[contact]]
name = "face"
link = "pad"
at = {{ {face}, centre = [0, 0, -0.01] }}
compliance = {{ kind = "kelvin_voigt", stiffness = 2e4, damping = 40.0 }}
friction = {friction}
[time]
duration = 0.0005
step = 1e-4
integrator = "rk4"
"""


def placed(depth, tilt, face="disc = 0.03, rings = 5", friction=0.0):
    """Return a pad whose face is tilted about y, its middle so deep in the floor, m."""
    height = 0.01 * math.cos(tilt) - depth
    body = {"body.pad.position": [0.01 * math.sin(tilt), 0.0, height],
            "body.pad.quaternion": [math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]}  # fmt: skip
    return parse_scenario(TEXT.format(face=face, friction=friction), where="face", overrides=body)


def disc_on_plane(depth, tilt):
    """Return force, moment about the middle, N and N m, of a disc on an elastic foundation; partial contact included.

    The depth at x along the face is depth + x sin(tilt), where that is positive: a segment of the disc from x = −c on.
    With R sin a = c, ∫dA = R²(a + sin a cos a + π/2), ∫x dA = (2/3) R³cos³a, ∫x²dA = R⁴/4 (a + π/2 + sin 4a/4 ...).
    """
    s = math.sin(tilt)
    c = RADIUS if s == 0.0 else min(depth / s, RADIUS)
    a = math.asin(c / RADIUS)
    area = RADIUS**2 * (a + math.sin(a) * math.cos(a) + math.pi / 2)
    first = 2.0 / 3.0 * RADIUS**3 * math.cos(a) ** 3
    second = RADIUS**4 / 4.0 * (a + math.pi / 2 - math.sin(4 * a) / 4.0)
    pressure = STIFFNESS / (math.pi * RADIUS**2)
    return pressure * (depth * area + s * first), pressure * (depth * first + s * second)


def test_points_have_the_moments_of_their_area():
    """Number, mean and second moments, of discs and rectangles; a face is at right angles to its normal."""
    for rings in (1, 2, 4):
        points = disc(RADIUS, rings)
        assert len(points) == 1 + 3 * rings * (rings + 1)
        np.testing.assert_allclose(points.T @ points / len(points), RADIUS**2 / 4.0 * np.eye(2), atol=1e-15)
        assert np.linalg.norm(points, axis=1).max() < RADIUS
    points = rectangle(0.04, 0.02, (5, 2))
    np.testing.assert_allclose(points.T @ points / 10, np.diag([0.04**2, 0.02**2]) / 12.0, atol=1e-15)
    turned = np.array(points_of_face({"disc": 0.01, "normal": [1, 1, 0], "centre": [0, 0, 1]}, "a"))
    np.testing.assert_allclose(turned @ [1, 1, 0], 0.0, atol=1e-15)
    np.testing.assert_allclose(turned.mean(axis=0), [0, 0, 1], atol=1e-15)


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
@pytest.mark.parametrize(
    ("depth", "tilt", "error"),
    [(1e-3, 0.0, 1e-9), (1e-3, 0.02, 1e-9), (1e-3, 0.06, 3e-3), (3e-4, 0.05, 5e-3), (-2e-4, 0.05, 0.01)],
)
def test_a_tilted_disc_presses_as_its_foundation_does(depth, tilt, error, engine):
    """Force, moment and centre of pressure in the first row; pressed whole they are exact, else to the edge's cells."""
    run = cl.simulate(placed(depth, tilt), engine=engine)
    found = run.contact_wrench("face")[0]
    force, moment = disc_on_plane(depth, tilt)
    # The plane's normal is z: depths are along it, and the moment about y is that of the forces at their places.
    assert found[2] == pytest.approx(force, rel=error)
    assert -found[4] == pytest.approx(moment * math.cos(tilt), rel=error, abs=1e-12)
    assert found[6] == pytest.approx(moment * math.cos(tilt) / force, rel=error, abs=1e-9)
    assert found[2] == pytest.approx(run.link_forces[0].sum(), rel=1e-12)


def test_engines_and_batches_agree_and_a_pad_comes_to_rest_on_its_weight():
    """A tilted pad settles: forces and velocities are those of both engines and a batch; the last is the weight."""
    scenario = placed(2e-4, 0.02, face="rectangle = [0.04, 0.02], points = [4, 3]")
    scenario = scenario.replace({"time.duration": 0.2, "time.step": 5e-4})
    runs = [cl.simulate(scenario, engine=engine) for engine in ("pinocchio", "compiled")]
    np.testing.assert_allclose(runs[0].link_forces, runs[1].link_forces, rtol=0, atol=1e-7)
    assert runs[0].contact_wrench("face")[-1, 2] == pytest.approx(MASS * 9.81, rel=0.02)
    masses = [0.4, 0.5]
    table = cl.simulate_batch(scenario, {"body.pad.mass": masses}, engine="compiled", keep=["v"], workers=1)
    assert table["status"].to_pylist() == ["done", "done"]
    kept = np.array(table["v"].to_pylist()[1]).reshape(runs[1].v.shape)
    np.testing.assert_allclose(kept, runs[1].v, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("face", "said"),
    [
        ("disk = 0.03", "must be { disc = radius, rings = 3 } or"),
        ("disc = -1.0", "lengths above 0 in metres, at least 1 ring or 2 points"),
        ("rectangle = [0.1, 0.1], points = [1, 3]", "lengths above 0 in metres, at least 1 ring or 2 points"),
        ("disc = 0.03, rings = 30", "has 2791 points; at most 400"),
    ],
)
def test_a_face_that_is_none_is_one_line(face, said):
    """What it must be, with the name of the contact."""
    with pytest.raises(cl.ScenarioError) as raised:
        placed(0.0, 0.0, face=face)
    assert said in str(raised.value)
    assert "contact 'face': at" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_rigid_face_and_an_unknown_name_are_refused():
    """A face needs a pad; and a wrench is asked for by the name of a contact."""
    with pytest.raises(cl.ScenarioError, match="a face presses with the pressure of a soft pad"):
        parse_scenario(TEXT.format(face="disc = 0.03", friction=0.0).replace("compliance", "#"), where="face")
    run = cl.simulate(placed(1e-3, 0.0).replace({"time.duration": 1e-4}))
    with pytest.raises(cl.ScenarioError, match="there is no such contact: face"):
        run.contact_wrench("fase")
    assert run.contact_wrench("face 1").shape == (2, 9)
