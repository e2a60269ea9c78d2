"""Scenarios whose force loops are known in closed form."""

import closedloop as cl

MASS, STIFFNESS, DAMPING = 2.0, 1e4, 50.0


def mass_on_a_spring(gain=20.0, **changes):
    """Return the scenario of a point mass that presses on a spring and a damper under f_c = f_des + K ∫(f_des − f)."""
    return cl.load_scenario("wam_slide", {
        "robot.model": "pointmass3", "robot.tip": "tip", "start.q": [0.0, 0.0, 0.0], "start.v": [0.0, 0.0, 0.0],
        "reference": {"kind": "hold"}, "stabiliser": {"kind": "none"}, "time.integrator": "dop853",
        "law": {"kind": "paper", "kp": [100, 100, 0], "kd": [20, 20, 0], "force": 10.0, "force_integral": gain},
        "time.duration": 0.1, "time.step": 0.0005, "compliance.kind": "kelvin_voigt",
        "compliance.stiffness": STIFFNESS, "compliance.damping": DAMPING,
    } | {key.replace("__", "."): value for key, value in changes.items()})  # fmt: skip
