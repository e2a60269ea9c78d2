"""MuJoCo's own soft contact of a mass with a ball, found by its own collision detection, beside Kelvin and Voigt's law.

MuJoCo's constraint is a law of accelerations: with ``solref = (-S, -D)`` and an impedance d that does not depend on the
depth it gives a mass m the force

    f = m (S δ + D δ̇) − d m a₀

a₀ the acceleration along the normal without contact. S = k/m and D = damping/m make it a spring of k N/m, but for the
last term, which no setting removes: d is at least 1e-4. It is the bound of the comparison, and the reason for which
MuJoCo's contact is no second solver of ours: on an arm m is not the tip's mass at the state, but one at its zero pose.
"""

import math
from collections.abc import Iterator

import numpy as np

from closedloop.mechanics.surface.compliances.kelvin_voigt import KelvinVoigt
from closedloop.mechanics.surface.kinds.sphere import Sphere
from closedloop.mechanics.surface.motions.none import NoMotion
from closedloop.mechanics.surface.placed import PlacedSurface
from validation.engines import Missing
from validation.engines.interface import installed
from validation.engines.mujoco import MuJoCo
from validation.oracle.spatial import Array
from validation.report import Check, Section

MASS, RADIUS, PROBE = 2.0, 0.3, 0.02
IMPEDANCE = 1e-4
STIFFNESSES = tuple(10.0**power for power in range(2, 8))
# Of what is left when the impedance's share is taken away: its own rounding, and that of the depth.
ROUNDING = 1e-9


def ball(stiffness: float, damping: float) -> str:
    """Return a mass on three slides above a fixed ball as MuJoCo's XML."""
    solve = f'condim="1" solref="{-stiffness / MASS!r} {-damping / MASS!r}" solimp="{IMPEDANCE} {IMPEDANCE} 1"'
    return f"""<mujoco><worldbody><geom type="sphere" size="{RADIUS}" {solve}/><body pos="0 0 0">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{PROBE}" mass="{MASS}" {solve}/></body></worldbody></mujoco>"""


def force_by_mujoco(stiffness: float, damping: float, r: Array, v: Array) -> tuple[float, float]:
    """Return f and a₀ of the mass at r (3,), m, from the ball's centre, that moves with v (3,), m/s."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(ball(stiffness, damping))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = r, v
    mujoco.mj_forward(model, data)
    out = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, out)
    return float(out[0]), float(data.qacc_smooth @ data.contact[0].frame[:3])


def soft_contact_section(seed: int = 0, states: int = 5) -> Section:
    """Compare f of both at random places, depths and velocities, for stiffnesses of 1e2 to 1e7 N/m."""
    section = Section("a mass on a soft ball: MuJoCo's own contact beside Kelvin–Voigt of the same k, relative f")
    if not installed(MuJoCo):
        section.checks.append(Check("f", "mujoco", math.nan, math.nan, None, str(Missing("mujoco", MuJoCo.install))))
        return section
    section.checks += _rows(seed, states)
    return section


def _rows(seed: int, states: int) -> Iterator[Check]:
    surface = PlacedSurface.of(Sphere(radius=RADIUS + PROBE), NoMotion(), np.array([0.0, 0.0, RADIUS + PROBE]))
    for k in STIFFNESSES:
        rng, law = np.random.default_rng(seed), KelvinVoigt(stiffness=k, damping=0.1 * math.sqrt(k * MASS))
        worst, left = 0.0, 0.0
        for _ in range(states):
            n, v = rng.normal(size=3), rng.normal(scale=0.1, size=3)
            r = (RADIUS + PROBE - min(0.01, 50.0 / k)) * n / np.linalg.norm(n)
            v -= max(0.0, float(v @ n)) * n / float(n @ n)  # into the ball: f > 0
            now = surface.touching(r, v)
            ours = law.force(-now.gap, -float(now.frame[0] @ v), law)
            theirs, free = force_by_mujoco(k, law.damping, r, v)
            worst = max(worst, abs(theirs - ours) / ours)
            left = max(left, abs(theirs + IMPEDANCE * MASS * free - ours) / ours)
        note = f"−d m a₀ of its impedance d = {IMPEDANCE:g} taken away; with it they are {worst:.0e} apart"
        yield Check(f"k = {k:.0e} N/m", "mujoco", left, ROUNDING, left <= ROUNDING, note)
