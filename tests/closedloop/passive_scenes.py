"""Free bodies over a floor or an incline, with nothing that drives them."""

import numpy as np

import closedloop as cl


def box(edges=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.05), tilt=0.0, **more):
    """Return the section of a box of 1 kg, turned about y by `tilt`, rad."""
    turned = [float(np.cos(0.5 * tilt)), 0.0, float(np.sin(0.5 * tilt)), 0.0]
    where = [float(x) for x in position]
    return {
        "name": "b",
        "shape": "box",
        "edges": list(edges),
        "mass": 1.0,
        "position": where,
        "quaternion": turned,
    } | more


def above(angle, height):
    """Return the place at a height over the plane through the origin that falls along x by `angle`, m."""
    return height * np.sin(angle), 0.0, height * np.cos(angle)


def thrown():
    """Return a box that is thrown, and turns."""
    more = {"velocity": [1.0, 0.3, 0.0], "spin": [3.0, -4.0, 2.0], "quaternion": [0.969, 0.148, 0.198, 0.0]}
    return box(position=(0.0, 0.0, 0.2)) | more


def run(
    bodies, friction, angle=0.0, duration=1.0, step=1e-3, integrator="time_stepping", restitution=0.0, compliance=None
):
    """Return the run of bodies on a plane that falls along x by `angle`, rad."""
    usual = {"at": "collision", "friction": friction, "restitution": restitution}
    usual |= {"compliance": compliance} if compliance else {}
    usual |= {"normal": [float(np.sin(angle)), 0.0, float(np.cos(angle))]}
    contact = [usual | {"link": body["name"]} for body in bodies]
    scenario = {
        "robot": {"model": "none"}, "body": bodies, "contact": contact,
        "surface": {"kind": "none", "contact": "unilateral"},
        "time": {"duration": duration, "step": step, "integrator": integrator},
    }  # fmt: skip
    return cl.simulate(cl.Scenario.model_validate(scenario), engine="compiled", progress=False)
