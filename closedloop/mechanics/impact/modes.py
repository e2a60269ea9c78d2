"""The names of an impact: the ratios of restitution, and what can happen, as bits."""

from __future__ import annotations

NEWTON, POISSON, STRONGE = 0, 1, 2

# What happened, as bits: `ImpactWork.happened` after a call of `closedloop.mechanics.impact.impact`. The tip slid;
# ended sticking; slip stopped and went on in another direction; slip turned; friction drove the tip into the surface
# for a while; there was a second compression; Newton's law would have created energy; held by friction, the tip cannot
# leave.
SLIP, STICK, REVERSAL, TURN, JAM, RECOMPRESSION, CUT, WEDGE = 1, 2, 4, 8, 16, 32, 64, 128

# A law of restitution by what its coefficient is the ratio of, see `closedloop.mechanics.impact.restitution`.
RATIOS = {"velocities": NEWTON, "impulses": POISSON, "energies": STRONGE}
MODE_NAMES = {
    SLIP: "slip",
    TURN: "turn",
    REVERSAL: "reversal",
    STICK: "stick",
    JAM: "jam",
    RECOMPRESSION: "recompression",
    CUT: "cut",
    WEDGE: "wedge",
}
