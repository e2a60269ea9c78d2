"""One contact of a link strikes alone: impulses and q̇ after it against the law of impact by itself.

The mobility is made here, of Pinocchio's H and the Jacobians of the two links that touch. The contact is closed at t =
0 and comes together, so the first event is at t = 0, and the row there is recorded after it. Faults planted in what is
compared are told from it: the μ, ε or law of another contact, a mobility without the link that carries the surface.
"""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest

import closedloop as cl
from closedloop.mechanics.impact import Impact, two_phase_impact
from closedloop.mechanics.surface.placed import contact_frame
from robot_models import load

ARMS = {name: cl.Robot(load(name)) for name in ("wam4", "panda")}
SCENARIO = {"wam4": "wam_bounce", "panda": "panda_touchdown"}
# The link that has the point, and the frame that carries the surface.
PAIRS = (("wam4", "link4", "world"), ("panda", "panda_link6", "world"), ("panda", "panda_hand", "panda_link3"))
FAR = {"surface.gap": 50.0, "surface.contact": "unilateral", "reference": {"kind": "hold"}, "time.duration": 0.001}


@dataclasses.dataclass
class Strike:
    """A contact that strikes: its section and the state, and what is compared with the run of it."""

    arm: str
    contact: dict
    q: np.ndarray
    v: np.ndarray
    H: np.ndarray
    rows: np.ndarray  # of the contact, (3, n), along its normal and tangents
    without: np.ndarray  # the same if the link that carries the surface stood still
    tangents: np.ndarray

    def expected(self, rows=None, **other) -> Impact:
        """Return the impact by its law, or with another ε, law or μ than the contact has."""
        rows = self.rows if rows is None else rows
        S = rows @ np.linalg.solve(self.H, rows.T)
        given = {key: self.contact[key] for key in ("restitution", "restitution_law", "friction")} | other
        return two_phase_impact(0.5 * (S + S.T), self.rows @ self.v, *given.values())

    def run(self, contacts) -> cl.Run:
        """Return the run of one step that begins with it; `contacts` are its own, and others that stay open."""
        start = {"start.q": self.q.tolist(), "start.v": self.v.tolist(), "contact": contacts}
        scenario = cl.load_scenario(
            SCENARIO[self.arm], FAR | {"impact.restitution": 0.9, "impact.law": "newton"} | start
        )
        return cl.simulate(scenario, model=ARMS[self.arm].model, law=lambda x: 0.0 * x.q)

    def off(self, run, hit) -> float:
        """Return by how much the first event and q̇ after it differ from an impact, as a share of its impulse."""
        event = run.events[0]
        after = self.v + np.linalg.solve(self.H, self.rows.T @ hit.impulse)
        size, fastest = np.linalg.norm(hit.impulse), 1.0 + np.max(np.abs(after))
        return max(
            abs(event.compression - hit.compression[0]) / size,
            abs(event.decompression - hit.decompression[0]) / size,
            np.max(np.abs(event.tangential - self.tangents.T @ hit.impulse[1:])) / size,
            abs(event.energy_lost - hit.energy_lost) / (1.0 + self.v @ self.H @ self.v),
            abs(event.rate_after - hit.after[0]),
            abs(event.slip_after - np.hypot(*hit.after[1:])),
            np.max(np.abs(run.v[0] - after)) / fastest,
        )


def draw(pair, seed, law, restitution, friction):
    """Return a strike of these links at a random state, of a random point on a random plane."""
    arm, link, against = pair
    robot, rng = ARMS[arm], np.random.default_rng(seed)
    model = robot.model.pinocchio_model()
    data = model.createData()
    q = rng.uniform(robot.model.position_lower, robot.model.position_upper)
    v, at, normal = rng.normal(size=robot.n), 0.2 * rng.normal(size=3), rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    pin.forwardKinematics(model, data, q)
    pin.updateFramePlacements(model, data)
    place = data.oMf[model.getFrameId(link)].act(at)

    def point_jacobian(frame):
        """Return that of the point of a frame that lies at `place`, (3, n)."""
        number = model.getFrameId(frame)
        J = pin.computeFrameJacobian(model, data, q, number, pin.LOCAL_WORLD_ALIGNED)
        return J[:3] - pin.skew(place - data.oMf[number].translation) @ J[3:]

    carries = pin.SE3.Identity() if against == "world" else data.oMf[model.getFrameId(against)]
    frame = contact_frame(normal) @ carries.rotation.T
    without = frame @ point_jacobian(link)
    rows = without if against == "world" else without - frame @ point_jacobian(against)
    contact = {
        "link": link, "at": at.tolist(), "against": against, "normal": normal.tolist(),
        "through": carries.actInv(place).tolist(), "restitution": restitution, "restitution_law": law,
        "friction": friction,
    }  # fmt: skip
    v = -np.sign(rows[0] @ v) * v
    return Strike(arm, contact, q, v, np.array(robot.terms(q, v).mass_matrix), rows, without, frame[1:])


@pytest.mark.parametrize("law", ["newton", "poisson", "stronge"])
@pytest.mark.parametrize("pair", PAIRS, ids=" on ".join)
def test_a_strike_is_the_one_of_its_law(pair, law):
    """At random states, and each planted fault is off by a thousand times as much as the strike of the run."""
    for seed in range(4):
        restitution, friction = [0.0, 0.3, 0.6, 1.0][seed], [0.1, 0.4, 0.7, 0.2][seed]
        strike = draw(pair, seed, law, restitution, friction)
        away = strike.contact | {"name": "away", "friction": 0.9, "restitution": 0.8, "restitution_law": "impact"}
        away["through"] = (np.array(away["through"]) - np.array(away["normal"])).tolist()
        run = strike.run([away, strike.contact])
        assert (run.events[0].time, run.events[0].contact) == (0.0, 2)
        assert run.events[0].kind == ("impact" if restitution else "touchdown")
        assert strike.off(run, strike.expected()) < 1e-11
        planted = [strike.expected(friction=0.9), strike.expected(restitution=0.8)]
        planted += [strike.expected(strike.without)] if pair[2] != "world" else []
        for hit in planted:
            assert strike.off(run, hit) > 1e-8, seed
