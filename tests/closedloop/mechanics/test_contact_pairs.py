"""Features of contacts, alone and in pairs, drawn at random: every row of a short run recomputed by other code.

A foot of an arm drops on a surface (flat or curved, with an edge or without, at rest or moving, rigid or soft, with any
law of friction and of restitution) that is [surface] or a [[contact]], and its elbow on another, with stops of the
joints, dry friction in them, and any stabiliser, or without.
"""

import numpy as np
import pinocchio as pin
import pytest
from budget import budget, seeds

import closedloop as cl
from closedloop.mechanics.contacts.friction import coulomb_of, has_other_law
from closedloop.record.columns.touching import contact_torques

SURFACES = ({}, {"kind": "sphere", "radius": 0.4}, {"kind": "cylinder", "radius": 0.5, "axis": [0, 1, 0]})
MOTIONS = ({}, {"kind": "conveyor", "velocity": [0.1, 0, 0]})
SOFT = (
    {},
    {"kind": "kelvin_voigt", "stiffness": 2e4, "damping": 200.0},
    {"kind": "hunt_crossley", "stiffness": 3e5, "dissipation": 1.0},
)
LAWS = ("newton", "poisson", "stronge")
FRICTIONS = (
    {"kind": "coulomb", "coefficient": 0.4},
    {"kind": "coulomb_viscous", "coefficient": 0.2, "viscous": 1.0},
    {"kind": "stribeck", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-2},
    {"kind": "karnopp", "kinetic": 0.2, "static": 0.3, "dead_band": 1e-3},
    {"kind": "dahl", "coefficient": 0.3, "stiffness": 2e3},
    {"kind": "lugre", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 1e-2, "stiffness": 2e3, "damping": 5.0},
    {"kind": "seven_parameter", "kinetic": 0.2, "static_excess": 0.1, "stribeck_speed": 1e-2, "stiffness": 2e3,
     "memory_delay": 3e-3, "rise_time": 0.1},
)  # fmt: skip
EDGES = ({}, {"edge_radius": 0.05}, {"extent": [0.02, 1.0]})
JOINTS = ({"kind": "coulomb", "kinetic": 0.5}, {"kind": "coulomb_viscous", "kinetic": 0.3, "viscous": 0.1})
STABILISERS = ({"kind": "projection"}, {"kind": "none"})
SCHEMES = ("rk4", "semi_implicit_euler")


def drawn(rng):
    """Return the changes to a dropped arm with two contacts drawn at random."""

    def one(of):
        return of[rng.integers(len(of))]

    def sometimes(of, share=0.5):
        return one(of) if rng.random() < share else None

    surface, motion, soft = one(SURFACES) or {"kind": "plane", **one(EDGES)}, one(MOTIONS), one(SOFT)
    point, mu = [0.53, 0.0, float(rng.uniform(-0.02, 0.05))], float(one((0.0, 0.1, 0.4)))
    law, restitution = one(LAWS), float(one((0.0, 0.5)))
    elbow = {"link": "link2", "through": [0, 0, float(rng.uniform(0.19, 0.22))]}
    other = sometimes(FRICTIONS, 0.3)
    elbow |= {"friction_law": other} if other else {"friction": float(one((0.0, 0.3)))}
    elbow |= {"compliance": SOFT[1]} if rng.random() < 0.3 else {}
    changes = {"time.duration": 0.3, "time.integrator": one(SCHEMES), "robot.stops": bool(rng.random() < 0.3)}
    for key, of in (("joint_friction", JOINTS), ("stabiliser", STABILISERS)):
        if (section := sometimes(of)) is not None:
            changes[key] = section
    rub = sometimes(FRICTIONS)
    if rng.random() < 0.5:
        parts = {"surface": surface if len(surface) > 1 else {}, "motion": motion, "compliance": soft}
        foot = {name: part for name, part in parts.items() if part}
        foot |= {"link": "tip", "through": point, "restitution": restitution, "restitution_law": law}
        foot |= {"friction_law": rub} if rub else {"friction": mu}
        return changes | {"surface": {"kind": "none"}, "contact": [elbow, foot]}
    curved = surface["kind"] != "plane"
    placed = {"point": point} if curved else {"offset": point[2]}
    changes |= {"impact.law": law, "impact.restitution": restitution, "compliance": soft or {"kind": "none"}}
    changes |= {"friction": rub or {"kind": "coulomb", "coefficient": mu}} if rub or mu else {}
    changes |= {"surface_motion": motion} if motion else {}
    if soft:  # a tip starts above a soft surface, not beyond its edge
        surface = {key: value for key, value in surface.items() if key not in ("extent", "edge_radius")}
    return changes | {"surface": {**surface, **placed, "contact": "unilateral"}, "contact": [elbow]}


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


def off_surface(run, which):
    """Return how far these contacts are off their surface while they touch it, or inside it, m: the most of each."""
    gaps = run.link_gaps[:, which]
    return np.max(np.where(run.link_modes[:, which] == 0, -gaps, np.abs(gaps)), axis=0, initial=0.0)


def drifts(changes, off, which):
    """Whether it is what a scheme of first order leaves of a closure that nothing stabilises: half at half the step."""
    if changes["time.integrator"] != "semi_implicit_euler" or changes.get("stabiliser") != {"kind": "none"}:
        return False
    return np.all(off < 1e-4) and np.all(off_surface(at_half_the_step(changes), which) <= 0.6 * off + 1e-11)


def at_half_the_step(changes):
    """Return the same run with steps of half the length."""
    return cl.simulate(cl.load_scenario("planar2_drop", changes | {"time.step": 5e-4}), progress=False)


def problems(run):
    """Return the names of what the numerical verdict finds wrong."""
    return {problem["name"] for problem in run.summary()["verdict"]["problems"]}


def examine(seed):
    """Run what is drawn with this seed, and check its rows."""
    changes = drawn(np.random.default_rng(seed))
    run = cl.simulate(cl.load_scenario("planar2_drop", changes), progress=False)
    assert run.stopped is None
    assert left_of_the_equation_of_motion(run) < 1e-12
    contacts = run.scenario.contact
    mu = np.array([np.inf if has_other_law(contact) else coulomb_of(contact) for contact in contacts])
    ends = np.array([contact.surface is not None and np.isfinite(contact.surface.bounds()[0]) for contact in contacts])
    rigid = np.array([contact.compliance is None for contact in contacts])
    rub = np.hypot(run.link_frictions[:, ::2], run.link_frictions[:, 1::2])
    assert np.all(run.link_forces >= 0.0)
    plain = np.isfinite(mu)
    assert np.all(rub[:, plain] <= mu[plain] * run.link_forces[:, plain] + 1e-9)
    assert not np.any(run.link_forces[run.link_modes == 0])
    kept = np.max(np.abs(run.link_forces * run.link_gaps)[:, rigid], initial=0.0) < 1e-5
    kept = kept and np.all(run.link_gaps[:, rigid & ~ends] > -1e-6)
    assert kept or drifts(changes, off_surface(run, rigid & ~ends), rigid & ~ends)
    most = changes.get("joint_friction", {}).get("kinetic", 0.0)
    dry = run.joint_friction + changes.get("joint_friction", {}).get("viscous", 0.0) * run.v
    assert np.all(np.abs(dry) <= most * (1 + 1e-12))
    # 1 ms is long for a foot that drops on a stiff spring, and for a bristle: what it leaves is gone at half the step.
    if left := problems(run) - {"step", "resolution"}:
        assert not left & problems(at_half_the_step(changes))


@pytest.mark.parametrize("seed", seeds(4, budget(60, 150)))
def test_pairs_of_features(seed):
    """Some are quick, more are slow."""
    examine(seed)
