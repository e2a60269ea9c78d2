"""Models of bodies that turn freely, and random states of theirs, for tests."""

from pathlib import Path

import numpy as np

import closedloop as cl
from robot_models import RobotModel
from robot_models.coordinates import normalised

#: A floating body with an arm on a ball joint, a hand on a hinge and a leg on a slider; a free ball beside it, and a
#: stick that hangs on a ball joint.
TREE = """<mujoco><worldbody>
<body name="cube" pos="0 0 1" quat="1 0.2 0 0"><freejoint/>
 <inertial mass="0.37" pos="0.01 0.02 0.03" fullinertia="8e-4 9e-4 1e-3 1e-5 2e-5 3e-5"/>
 <body name="arm" pos="0.05 0 0" euler="0 30 0"><joint name="b" type="ball" pos="0 0 0.02"/>
  <inertial mass="0.1" pos="0.1 0.02 0.01" diaginertia="1e-4 3e-4 3e-4"/>
  <body name="hand" pos="0.2 0 0"><joint name="h" axis="0 1 1" range="-90 90"/>
   <inertial mass="0.05" pos="0.05 0.01 0.02" diaginertia="1e-4 2e-4 2e-4"/>
   <site name="tip" pos="0.1 0.02 0.03"/></body></body>
 <body name="leg" pos="-0.05 0 0"><joint name="s" type="slide" axis="1 0 1" armature="0.2"/>
  <inertial mass="0.1" pos="0.1 0.02 0" diaginertia="1e-4 3e-4 3e-4"/></body>
</body>
<body name="ball" pos="1 0 1"><freejoint name="bf"/><geom type="sphere" size="0.05"/></body>
<body name="stick" pos="2 0 1" euler="10 20 30"><joint name="sb" type="ball" armature="0.001"/>
 <inertial mass="0.1" pos="0.1 0.02 0.05" diaginertia="1e-4 3e-4 3e-4"/></body>
</worldbody></mujoco>"""

#: One free body of given principal moments, kg m², turning about its centre of mass.
BODY = """<mujoco><option gravity="{gravity}"/><worldbody><body name="body"><freejoint/>
<inertial mass="{mass}" pos="0 0 0" diaginertia="{moments}"/><geom type="box" size="0.05 0.05 0.05"/>
</body></worldbody></mujoco>"""


def written(folder: Path, text: str, name: str = "bodies") -> str:
    """Return the path of a file with this text."""
    path = folder / f"{name}.xml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def random_positions(model: RobotModel, rng: np.random.Generator) -> np.ndarray:
    """Return positions (nq,) with unit quaternions."""
    return normalised(rng.normal(size=len(model.coordinate_names)), model.joint_types, "q")


def energy(run):
    """Return the mechanical energy in each row, J."""
    return run.kinetic_energy + run.potential_energy


def scenario_of(folder: Path, model: str, q=None, v=None, tip: str | None = None, contacts=(), **changes):
    """Return a scenario of bodies that fall, its surface out of reach, with contacts of links."""
    text = ["[robot]", f'model = "{model}"', *([f'tip = "{tip}"'] if tip else []), "[surface]", "gap = 1000.0"]
    text += ['contact = "unilateral"', "[law]", "kp = 0", "kd = 0", "force = 0", "[stabiliser]", "time_constant = 0.01"]
    text += ["[time]", "duration = 0.5", "step = 0.001", 'integrator = "rk4"', "[start]"]
    text += [f"{key} = {list(map(float, x))}" for key, x in (("q", q), ("v", v)) if x is not None]
    for contact in contacts:
        text += ["[[contact]]", *(f"{key} = {value!r}".replace("'", '"') for key, value in contact.items())]
    path = folder / "scenario.toml"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return cl.load_scenario(str(path), {key.replace("__", "."): value for key, value in changes.items()})


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotations (N, 3, 3) of unit quaternions w, x, y, z (N, 4)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
