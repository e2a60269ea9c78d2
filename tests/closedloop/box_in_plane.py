"""A block in the plane and its corners: what tests of contacts need."""

import numpy as np

import closedloop as cl
import robot_models
from validation.loops.cases import joint, point

G = 9.81
WIDTH, HEIGHT, MASS = 0.2, 0.1, 2.0


def body(name, mass, inertia):
    """A link whose centre of mass is its origin."""
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def block(inertia=0.02):
    """A body that may go anywhere in the plane x-z: q = (x, z, turn), turn positive from x towards z."""
    text = '<robot name="block"><link name="base"/>' + body("sx", 1e-9, 1e-12) + body("sz", 1e-9, 1e-12)
    text += body("block", MASS, inertia) + joint("X", "base", "sx", axis="1 0 0", kind="prismatic")
    text += joint("Z", "sx", "sz", axis="0 0 1", kind="prismatic") + joint("T", "sz", "block") + point("tip", "block")
    return robot_models.from_text(
        text + "</robot>", "urdf", name="block", armature=np.zeros(3), tip="tip", home=[0, 0, 0], locked={}
    )


def corners(friction, normal=(0, 0, 1), restitution=0.0, width=WIDTH, height=HEIGHT):
    """Contacts of the two lower corners of the block, below and above on an incline that rises along x."""
    return [
        {"name": name, "link": "block", "at": [s * width / 2, 0, -height / 2], "normal": list(normal),
         "friction": friction, "restitution": restitution}
        for name, s in (("below", -1), ("above", 1))
    ]  # fmt: skip


def moved(q, v, contacts, duration=0.02, step=1e-3, engine="pinocchio", model=None, **changes):
    """The run of the block from a state: nothing acts on it but its weight and its contacts."""
    soft = {} if "stabiliser.kind" in changes else {"stabiliser.time_constant": 0.01}
    scenario = cl.load_scenario(
        "planar2_drop",
        {"surface.gap": 50.0, "time.duration": duration, "time.step": step, "time.integrator": "rk4", "law.kp": 0,
         "law.kd": 0, "law.force": 0, "start.q": [float(x) for x in q], "start.v": [float(x) for x in v],
         "contact": contacts, **soft, **changes},
    )  # fmt: skip
    return cl.simulate(scenario, model=model or block(), law=lambda x: 0.0 * x.q, engine=engine)


def total_energy(run):
    """Energy less what was supplied, J: a constant."""
    return run.kinetic_energy + run.potential_energy - run.energy_supplied
