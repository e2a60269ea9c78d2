"""The impact of the tip on a rigid plane at one point: compression and decompression, with Coulomb friction.

The impact takes no time: positions stay, and the tip velocity u changes with the impulse P of the surface on the robot,
u⁺ = u + S P, S = A H⁻¹Aᵀ, everything in the contact frame (n, t1, t2). What replaces time is the normal impulse P_n,
which only grows. Against it (Routh 1905; Keller, J. Appl. Mech. 53, 1986):

- While the tip slides, friction is μ times the normal impulse, against the slip. In three dimensions the direction of
  slip turns meanwhile.
- Where slip stops, the tip sticks if friction can hold it, else it leaves in the one direction that Coulomb's law
  allows.
- Compression is all of P while u_n < 0, decompression all of it while u_n > 0.

The impact ends when decompression has given back the share that the law of restitution asks for:

==========  ===============================================================================================
NEWTON      u_n⁺ = −ε u_n⁻: kinematic
POISSON     P_n of decompression = ε P_n of compression: kinetic
STRONGE     work of P_n in decompression = −ε² its work in compression: energetic (Proc. R. Soc. A 431, 1990)
==========  ===============================================================================================

Without friction, and wherever slip neither turns nor stops, the three are one. With friction they differ.

Energy. Along the path the power per impulse, h = dE/dP_n = u_n − μ|u_t|, grows, and its growth
h' = (1, −μ s)·S (1, −μ s) never increases: while slip turns by dφ it falls by 2 μ |u_t| (dφ/dP_n)² dP_n, and where
slip stops it drops to the least value in the friction disk. As h <= 0 when decompression begins for the last time, a
decompression no longer than compression cannot give back more than compression took: under POISSON the energy never
grows, in three dimensions as in two. Under STRONGE both the normal impulse and friction take energy, each by itself.
NEWTON prescribes a velocity instead, and can create energy where slip reverses or sticks (Kane & Levinson 1985;
Stronge 1990). This module then cuts decompression off at the instant when the energy is back at its value before the
impact, and says so (CUT): u_n⁺ is then smaller than −ε u_n⁻, but positive. No other input is touched.

Friction may drive the tip into the surface, S_nn − μ S_nt·s < 0 (the jam that Painlevé's paradox becomes in an impact):
u_n then first becomes more negative, until slip turns or stops. That is well defined here, for it happens over a
finite impulse. In three dimensions slip can also turn so far in decompression that the tip comes back and a second
compression follows; the two phases then sum up all that happens while u_n < 0 and while u_n > 0.

A tip that can only move along one line (rank of S one) and that friction can hold does not rebound (WEDGE): no impulse
moves it. NEWTON and STRONGE then end the impact at rest; POISSON adds its impulse, which changes nothing.

The laws are a family, `closedloop.mechanics.impact.single`, with a file for each in `laws`. They differ in the
ratio alone, so the numbers of the three ratios are all that the kernel knows of them; a law of one's own takes one of
the ratios and may let ε depend on the speed of approach.

`impact` is the kernel; `two_phase_impact` checks its input and returns an `Impact`.
"""

from closedloop.mechanics.impact.begin import CUT, MODE_NAMES, RATIOS, ImpactWork
from closedloop.mechanics.impact.single import Impact, energy_lost, impact, two_phase_impact

__all__ = ["CUT", "MODE_NAMES", "RATIOS", "Impact", "ImpactWork", "energy_lost", "impact", "two_phase_impact"]
