"""The rows of the resistances to rolling and pivoting, see `closedloop.mechanics.contacts.resistance`."""

from closedloop.jit.calls import integers_at
from closedloop.jit.kernel import kernel
from closedloop.mechanics.contacts.memory import ContactLinks, Contacts
from closedloop.mechanics.contacts.modes import near
from closedloop.mechanics.contacts.rolling import Shapes, turn_against, turn_on_surface
from closedloop.mechanics.loops.memory import LoopLinks, LoopRows
from closedloop.mechanics.surface.contact import ask_at


@kernel
def write_resistances(joints: LoopLinks, rows: LoopRows, shapes: Shapes, links: ContactLinks, c: Contacts) -> None:
    """Write the rows of the resistances to rolling and pivoting of all contacts that are closed, or about to be."""
    for s in range(links.points + links.stops, links.joints):
        for r in range(3 * s, 3 * s + 3):
            c.u[r], c.drift[r], c.carried[r], c.turning[r] = 0.0, 0.0, 0.0, 0.0
            for j in range(links.n):
                c.G[r, j] = 0.0
    for i in range(1, links.points):
        rolling, pivoting = int(c.friction.resistance.rolling[i]), int(c.friction.resistance.pivoting[i])
        if (rolling < 0 and pivoting < 0) or not near(c, i):
            continue
        turn_against(joints, rows, 3 * i - 3, shapes)
        where = integers_at(links.surfaces, 2 * links.k) if links.surfaces != 0 else integers_at(links.address, 1)
        if links.surfaces != 0 and where[2 * i] != 0:
            turn_on_surface(shapes, ask_at(where[2 * i + 1])[1])
        else:
            for a in range(3):
                shapes.carried[a], shapes.turning[a] = 0.0, 0.0
        if rolling >= 0:
            _write_turn(shapes, c, rolling, 1, 1)
            _write_turn(shapes, c, rolling, 2, 2)
        if pivoting >= 0:
            _write_turn(shapes, c, pivoting, 1, 0)


@kernel
def _write_turn(shapes: Shapes, c: Contacts, s: int, tangent: int, axis: int) -> None:
    """Write row `tangent` of resistance s: the turning about n, t1 or t2, `axis`, times its arm."""
    r, arm = 3 * s + tangent, c.friction.resistance.arm[s]
    c.u[r] = arm * (shapes.spin[axis] - shapes.carried[axis])
    c.carried[r], c.turning[r] = arm * shapes.carried[axis], arm * shapes.turning[axis]
    c.drift[r] = arm * (shapes.spin_rate[axis] + shapes.turning[axis])
    for j in range(c.G.shape[1]):
        c.G[r, j] = arm * shapes.turns[axis, j]
