"""Forces in known modes: of one contact by its closed form, else of all together."""

from closedloop.jit.calls import row_of
from closedloop.jit.kernel import kernel
from closedloop.mechanics.closure.contact_force import pressed_force, stuck_force
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.contacts.given_modes import solve_modes
from closedloop.mechanics.contacts.memory import OFF, RAY, ContactLinks, Contacts
from closedloop.mechanics.contacts.unknown_modes import is_known
from closedloop.mechanics.limits import DEPENDENT


@kernel
def solve_closed(links: ContactLinks, c: Contacts) -> int:
    """Write F, `rigid` and `rounding` in the present modes: of one contact by its closed form, else of all."""
    alone = -1
    for i in range(links.k):
        if c.problem.form[i] != OFF:
            if alone >= 0 or c.friction.pulls[i] != 0.0:
                return int(solve_modes(links, c))
            alone = i
    if alone < 0 or is_known(links, c, alone) or not solve_one(c, links.k, alone):
        return int(solve_modes(links, c))
    return int(OK)


@kernel
def solve_one(c: Contacts, k: int, i: int) -> bool:
    """Do `solve_modes` for contact i, the only one closed, by the closed form of the tip, where there is one."""
    at, asked = 3 * i, 0.0
    S, a, b, F, rigid = c.S[i], c.a[at : at + 3], c.b[at : at + 3], c.F[at : at + 3], c.rigid[at : at + 3]
    for j in range(3 * k):
        c.F[j], c.rigid[j] = 0.0, 0.0
    if c.problem.form[i] == RAY:
        along, viscous = row_of(c.problem.along, i), c.viscous[at + 1 : at + 3]
        status, share = pressed_force(S, a, b[0], along, viscous, F)
        if status != OK:
            return False
        rigid[0] = F[0] - share
        rigid[1], rigid[2] = -along[0] * rigid[0] - viscous[0], -along[1] * rigid[0] - viscous[1]
    else:
        if stuck_force(S, a, b, F, rigid) != OK:
            return False
        for j in range(3):
            rigid[j] = F[j] - rigid[j]
    size, most = 0.0, 0.0
    for r in range(at, at + (1 if c.problem.form[i] == RAY else 3)):
        asked = max(asked, c.size[r] + abs(c.b[r]))
    for j in range(3):
        size, most = max(size, abs(rigid[j])), max(most, S[j, j])
    c.problem.rounding, c.problem.beyond = DEPENDENT * max(size, asked / most), 0.0
    return True
