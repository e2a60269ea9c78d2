"""Break-away in two dimensions: the cases of `test_break_away`, and what is to hold in every row.

Run as a program it prints what the adaptive integrator makes of the cases in `closed_forms`, as JSON.
"""

import json

import numpy as np

import closedloop as cl

LAWS = {
    "coulomb": {"coefficient": 0.3},
    "coulomb_viscous": {"coefficient": 0.3, "viscous": 2.0},
    "stribeck": {"kinetic": 0.3, "static": 0.4, "stribeck_speed": 0.005, "viscous": 1.0},
    "karnopp": {"kinetic": 0.3, "static": 0.4, "dead_band": 1e-4},
    "dahl": {"coefficient": 0.3, "stiffness": 1e3},
    "lugre": {"kinetic": 0.2, "static": 0.35, "stribeck_speed": 0.05, "stiffness": 1e3, "damping": 10.0},
    "seven_parameter": {
        "kinetic": 0.2,
        "static_excess": 0.15,
        "stribeck_speed": 0.05,
        "stiffness": 1e3,
        "memory_delay": 0.005,
        "rise_time": 0.5,
    },
}
# Bristles give back what they have stored: their force may be along the slip for a while, and no row says otherwise.
ELASTIC = ("dahl", "lugre")
INTEGRATORS = ("semi_implicit_euler", "explicit_euler", "rk4", "dop853")
STABILISERS = ("none", "baumgarte", "projection", "both")
ARMS = {"pointmass3": {"robot.model": "pointmass3", "start.q": [0, 0, 0], "start.v": [0, 0, 0]}, "wam4": {}}
PULLED = (("coulomb", 1e-12), ("coulomb", 1e-6), ("karnopp", 1e-12))  # with a closed form
PRESSED, NO_SLIP = 1, 1e-9  # mode; m/s
MASS, FORCE, ANGLE, PULL = 2.0, 10.0, 0.7, 100.0  # kg, N, rad, N/s


def scenario(law, integrator, stabiliser, arm="pointmass3", **time):
    """Return half a circle under a soft law, from rest: the tip sticks at first, and turns by some 160 degrees."""
    gains = {"time_constant": 0.002, "damping_ratio": 0.707} if stabiliser in ("baumgarte", "both") else {}
    return cl.load_scenario(
        "wam_stick_slip",
        {
            "law.stiffness": 2000.0,
            "law.damping": 40.0,
            "reference": {
                "kind": "circle",
                "direction": [1, 0.3, 0],
                "radius": 0.01,
                "turns": 0.5,
                "start": 0.0,
                "stop": 0.4,
            },
            "friction": {"kind": law} | LAWS[law],
            "stabiliser": {"kind": stabiliser} | gains,
            "time": {"duration": 0.4, "step": 1e-3, "integrator": integrator} | time,
        }
        | ARMS[arm],
    )


def driven(run, above=0.0):
    """Return the largest power of friction, W, on a tip that slides faster than `above`, m/s.

    It is not above rounding where friction opposes the slip.
    """
    power = np.sum(run.friction_force * run.velocity, axis=1)
    slides = (run.mode == PRESSED) & (np.linalg.norm(run.velocity, axis=1) > above)
    return float(np.max(power[slides], initial=-np.inf))


def check(run, law):
    """Check that the run broke away, slid in two dimensions, and that friction drove the tip in no row."""
    assert run.time[-1] == run.scenario.time.duration
    slip = run.velocity[:, :2]
    fast = np.linalg.norm(slip, axis=1) > 1e-3
    assert np.ptp(np.unwrap(np.arctan2(slip[fast, 1], slip[fast, 0]))) > 2.5
    if law not in ELASTIC:
        assert sum(event.kind == "slip" for event in run.events) <= 3
        assert run.events[0].kind == "slip"
        assert "reversal" not in {event.kind for event in run.events}
        # What Euler's first step leaves of the closure's rate is a slip without a direction of its own.
        assert driven(run, above=NO_SLIP) <= 1e-14
        assert driven(run) <= NO_SLIP * np.max(np.linalg.norm(run.friction_force, axis=1))


def pulled(friction, tolerance):
    """Return a block that is pulled askew by PULL t, and slides off."""
    base = {
        "robot.model": "pointmass3",
        "start": {"q": [0, 0, 0], "v": [0, 0, 0]},
        "reference": {"kind": "hold"},
        "law": {"kind": "paper", "kp": 0.0, "kd": 0.0, "force": FORCE},
        "friction": friction,
        "stabiliser": {"kind": "projection"},
        "time": {"duration": 0.08, "step": 0.002, "integrator": "dop853", "tolerance": tolerance},
    }

    def pull(t, q, v, terms):
        along = np.cos(ANGLE) * terms.jacobian[0] + np.sin(ANGLE) * terms.jacobian[1]
        return terms.bias - FORCE * terms.jacobian[2] + PULL * t * along

    return cl.simulate(cl.load_scenario("wam_slide", base), law=pull)


def closed_form(friction):
    """Return the instant of break-away, s, and the distance from the start at any instants, m.

    Pulled along a line with p t, held by μ_s f, slowed by μ_k f: m ẍ = p t − μ_k f from t₀ = μ_s f/p on.
    """
    static, kinetic = (friction.get(name, friction.get("coefficient")) * FORCE for name in ("static", "kinetic"))
    off = static / PULL

    def distance(t):
        since = np.maximum(t - off, 0.0)
        return ((PULL * off - kinetic) * since**2 / 2 + PULL * since**3 / 6) / MASS

    return off, distance


def closed_forms():
    """Return, for laws and tolerances, how far the adaptive integrator is from what is known."""
    found = {}
    for law, tolerance in PULLED:
        friction = {"kind": law} | LAWS[law]
        run = pulled(friction, tolerance)
        off, distance = closed_form(friction)
        x = run.position[:, :2] - run.position[0, :2]
        found[f"{law} {tolerance:g}"] = {
            "kinds": [event.kind for event in run.events],
            "late": abs(run.event_time[0] - off),
            "across": float(np.max(np.abs(x @ [-np.sin(ANGLE), np.cos(ANGLE)]))),
            "along": float(np.max(np.abs(x @ [np.cos(ANGLE), np.sin(ANGLE)] - distance(run.time)))),
            "driven": driven(run),
            "rows": len(run),
        }
    run = cl.simulate(scenario("stribeck", "dop853", "none", duration=0.06, step=2e-3, tolerance=1e-9))
    found["turning"] = {"kinds": [event.kind for event in run.events], "driven": driven(run), "rows": len(run)}
    return found


if __name__ == "__main__":
    print(json.dumps(closed_forms()))
