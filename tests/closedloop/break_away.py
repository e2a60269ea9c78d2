"""Break-away in two dimensions: the cases of `test_break_away`, and what is to hold in every row."""

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
PRESSED, NO_SLIP = 1, 1e-9  # mode; m/s


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
