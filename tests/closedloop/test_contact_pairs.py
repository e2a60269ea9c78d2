"""Features of contacts, alone and in pairs, drawn at random: every row of a short run recomputed by other code.

A foot of an arm drops on a surface (flat or curved, at rest or moving, rigid or soft, with any law of restitution) that
is [surface] or a [[contact]], and its elbow on another, with stops of the joints or without.
"""

import numpy as np
import pinocchio as pin
import pytest
from budget import seeds

import closedloop as cl
from closedloop.record.columns.touching import contact_torques

SURFACES = ({}, {"kind": "sphere", "radius": 0.4}, {"kind": "cylinder", "radius": 0.5, "axis": [0, 1, 0]})
MOTIONS = ({}, {"kind": "conveyor", "velocity": [0.1, 0, 0]})
SOFT = (
    {},
    {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 200.0},
    {"kind": "hunt_crossley", "stiffness": 3e5, "dissipation": 1.0},
)
LAWS = ("newton", "poisson", "stronge")
SCHEMES = ("rk4", "semi_implicit_euler")


def drawn(rng):
    """Return the changes to a dropped arm with two contacts drawn at random."""

    def one(of):
        return of[rng.integers(len(of))]

    surface, motion, soft = one(SURFACES), one(MOTIONS), one(SOFT)
    point, mu = [0.53, 0.0, float(rng.uniform(-0.02, 0.05))], float(one((0.0, 0.1, 0.4)))
    law, restitution = one(LAWS), float(one((0.0, 0.5)))
    elbow = {"link": "link2", "through": [0, 0, float(rng.uniform(0.19, 0.22))], "friction": float(one((0.0, 0.3)))}
    elbow |= {"compliance": SOFT[1]} if rng.random() < 0.3 else {}
    changes = {"time.duration": 0.3, "time.integrator": one(SCHEMES), "robot.stops": bool(rng.random() < 0.3)}
    if rng.random() < 0.5:
        parts = {"surface": surface, "motion": motion, "compliance": soft}
        foot = {name: part for name, part in parts.items() if part}
        foot |= {"link": "tip", "through": point, "friction": mu, "restitution": restitution, "restitution_law": law}
        return changes | {"surface": {"kind": "none"}, "contact": [elbow, foot]}
    placed = {"point": point} if surface else {"offset": point[2]}
    changes |= {"impact.law": law, "impact.restitution": restitution, "compliance": soft or {"kind": "none"}}
    changes |= {"friction": {"kind": "coulomb", "coefficient": mu}} if mu else {}
    changes |= {"surface_motion": motion} if motion else {}
    return changes | {"surface": {"kind": "plane", **surface, **placed, "contact": "unilateral"}, "contact": [elbow]}


def left_of_the_equation_of_motion(run):
    """Return the largest of H q̈ + C − Q − Σ Jᵀ F by Pinocchio over the rows, of the size of its terms."""
    model, worst = run.model.pinocchio_model(), 0.0
    data, robot = model.createData(), cl.Robot(run.model)
    others = contact_torques(run.scenario, model, run.time, run.q, run.link_forces, run.link_frictions)
    for k, (q, v) in enumerate(zip(run.q, run.v, strict=True)):
        inertia = np.triu(pin.crba(model, data, q))
        inertia += np.triu(inertia, 1).T
        bias, tip = pin.nle(model, data, q, v), robot.terms(q, v).jacobian.T @ run.tip_force[k]
        known = run.torque[k] + run.joint_friction[k] + run.stop_torque[k] + tip + others[k]
        left = inertia @ run.acceleration[k] + bias - known
        worst = max(worst, np.max(np.abs(left)) / (np.max(np.abs(bias)) + np.max(np.abs(known)) + 1.0))
    return worst


def examine(seed):
    """Run what is drawn with this seed, and check its rows."""
    changes = drawn(np.random.default_rng(seed))
    run = cl.simulate(cl.load_scenario("planar2_drop", changes), progress=False)
    assert run.stopped is None
    assert left_of_the_equation_of_motion(run) < 1e-12
    contacts = run.scenario.contact
    mu = np.array([contact.friction for contact in contacts])
    rigid = np.array([contact.compliance is None for contact in contacts])
    rub = np.hypot(run.link_frictions[:, ::2], run.link_frictions[:, 1::2])
    assert np.all(run.link_forces >= 0.0)
    assert np.all(rub <= mu * run.link_forces + 1e-9)
    assert not np.any(run.link_forces[run.link_modes == 0])
    assert np.all(run.link_gaps[:, rigid] > -1e-6)
    assert np.max(np.abs(run.link_forces * run.link_gaps)[:, rigid], initial=0.0) < 1e-5
    # Of the step alone the judgement may be bad: 1 ms is long for a foot that drops on a stiff spring.
    assert {problem["name"] for problem in run.summary()["verdict"]["problems"]} <= {"step", "resolution"}


@pytest.mark.parametrize("seed", seeds(4, 150))
def test_pairs_of_features(seed):
    """Some are quick, more are slow."""
    examine(seed)
