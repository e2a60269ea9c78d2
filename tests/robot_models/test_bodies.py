"""Free bodies beside a robot: the same mechanism in both formats, and the robot's own unchanged."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import robot_models
from robot_models.bodies import FreeBody, with_bodies
from robot_models.coordinates import in_pinocchios_order

ARM = """<mujoco model="arm"><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" range="-2 2" armature="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="2"/></body>
</worldbody></mujoco>"""

TURN = (np.cos(0.3), 0.0, np.sin(0.3), 0.0)
BODIES = (
    FreeBody("block", "box", (0.1, 0.12, 0.06), 1.0, (0.3, 0.2, 0.03)),
    FreeBody("Ball", "ball", (0.05,), 0.5, (1.0, 0.0, 0.05)),
    FreeBody("can", "cylinder", (0.03, 0.1), 0.4, (0.0, 1.0, 0.05), TURN),
    FreeBody("heavy", "box", (0.1, 0.1, 0.1), 2.0, inertia=(0.02, 0.03, 0.04, 0.001, -0.002, 0.003)),
)


def arms(folder: Path) -> list[robot_models.RobotModel]:
    """Return an arm from a URDF, and one from an MJCF."""
    path = folder / "arm.xml"
    path.write_text(ARM)
    return [robot_models.load("wam4"), robot_models.load(path)]


def mass_matrix(model: robot_models.RobotModel) -> np.ndarray:
    """Return H at the home posture."""
    built = model.pinocchio_model()
    H = pin.crba(built, built.createData(), in_pinocchios_order(model.home, model.joint_types))
    return np.triu(H) + np.triu(H, 1).T


def test_bodies_have_their_mass_and_the_robot_keeps_its_own(tmp_path: Path) -> None:
    """H is block diagonal: that of the arm, and of each body m and the tensor of its shape, whatever the format."""
    for arm in arms(tmp_path):
        model = with_bodies(arm, BODIES)
        assert model.n == arm.n + 6 * len(BODIES)
        assert model.tip == arm.tip
        H, names = mass_matrix(model), list(model.joint_names)
        own = [names.index(name) for name in arm.joint_names]
        np.testing.assert_allclose(H[np.ix_(own, own)], mass_matrix(arm), rtol=0, atol=1e-15)
        left = np.ones_like(H, dtype=bool)
        left[np.ix_(own, own)] = False
        for body in BODIES:
            at = names.index(f"{body.name}_x")
            np.testing.assert_allclose(H[at : at + 3, at : at + 3], body.mass * np.eye(3), atol=1e-15)
            np.testing.assert_allclose(H[at + 3 : at + 6, at + 3 : at + 6], body.tensor(), atol=1e-15)
            left[at : at + 6, at : at + 6] = False
        assert np.max(np.abs(H[left])) < 1e-15


def test_bodies_are_where_they_are_said_to_be(tmp_path: Path) -> None:
    """The home posture has the place and the unit quaternion of each, by the names of its coordinates."""
    for arm in arms(tmp_path):
        model = with_bodies(arm, BODIES)
        home = dict(zip(model.coordinate_names, model.home.tolist(), strict=True))
        assert [home[name] for name in arm.coordinate_names] == arm.home.tolist()
        for body in BODIES:
            assert [home[f"{body.name}_{axis}"] for axis in "xyz"] == list(body.position)
            np.testing.assert_allclose([home[f"{body.name}_q{part}"] for part in "wxyz"], body.quaternion, rtol=1e-15)
        assert list(model.free) == [name not in arm.joint_names for name in model.joint_names]


def test_uniform_density() -> None:
    """The tensors are those of points spread evenly through the shapes."""
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (400_000, 3))
    for shape, size in (("box", (0.1, 0.12, 0.06)), ("ball", (0.05,)), ("cylinder", (0.03, 0.1))):
        spans = {"box": size, "ball": (0.1, 0.1, 0.1), "cylinder": (0.06, 0.06, 0.1)}[shape]
        inside = {
            "box": np.ones(len(points), dtype=bool),
            "ball": np.sum(points**2, axis=1) < 0.25,
            "cylinder": np.sum(points[:, :2] ** 2, axis=1) < 0.25,
        }[shape]
        x = points[inside] * spans
        tensor = np.sum(x**2, axis=1).mean() * np.eye(3) - x.T @ x / len(x)
        np.testing.assert_allclose(FreeBody("b", shape, size, 1.0).tensor(), tensor, atol=1e-2 * tensor.max())


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (FreeBody("link1", "ball", (0.1,), 1.0), "body 'link1': wam4 has a link or a joint of that name"),
        (FreeBody("J1", "ball", (0.1,), 1.0), "body 'J1': wam4 has a link or a joint of that name"),
        (FreeBody("world", "ball", (0.1,), 1.0), "body 'world': wam4 has a link"),
        (FreeBody("b", "ball", (0.1,), 1.0, inertia=(1, 1, 3, 0, 0, 0)), "'b'"),
    ],
)
def test_bodies_that_cannot_be(body: FreeBody, words: str) -> None:
    """One line says what is wrong with which body."""
    with pytest.raises(robot_models.ModelError, match=words):
        with_bodies(robot_models.load("wam4"), [body])


def test_two_of_one_name() -> None:
    """Names are each body's own."""
    ball = FreeBody("ball", "ball", (0.1,), 1.0)
    with pytest.raises(robot_models.ModelError, match="body 'ball': wam4 has a link or a joint of that name"):
        with_bodies(robot_models.load("wam4"), [ball, ball])
