"""Random problems of contacts, the kernels that solve them, and what a solution must keep."""

import numpy as np

from closedloop.jit.kernel import entry_kernel
from closedloop.mechanics.contacts.impact import apply_impulses
from closedloop.mechanics.contacts.memory import CONE, contacts_at, make_contact_memory
from closedloop.mechanics.contacts.unknown_modes import solve_contacts


@entry_kernel
def solve_at(address):
    """Solve the problem in a memory of contacts."""
    links, c = contacts_at(address)
    return 1 if solve_contacts(links, c) else 0


@entry_kernel
def strike_at(address):
    """Let the contacts in a memory strike."""
    links, c = contacts_at(address)
    return apply_impulses(links, c, 1e-9)


def random_bodies(rng, planar):
    """X (3 k, n) of k contacts of one or two rigid bodies with each other and the world, and a velocity L q̇ (n,)."""
    k, bodies = int(rng.integers(2, 7)), int(rng.integers(1, 3))
    X = np.zeros((3 * k, 6 * bodies))
    for i in range(k):
        normal = rng.normal(size=3) * ([1, 0, 1] if planar else 1)
        normal /= np.linalg.norm(normal)
        side = np.cross([0, 1, 0], normal) if planar else np.cross(normal, rng.normal(size=3))
        side /= np.linalg.norm(side)
        frame = np.stack([normal, side, np.cross(normal, side)])
        sides = [(int(rng.integers(bodies)), 1.0)]
        if bodies == 2 and rng.random() < 0.5:
            sides = [(0, 1.0), (1, -1.0)]
        for b, sign in sides:
            arm = rng.normal(size=3) * ([1, 0, 1] if planar else 1)
            for a in range(3):
                row = np.concatenate([frame[a], 3.0 * np.cross(arm, frame[a])])  # a gyration radius of a third
                X[3 * i + a, 6 * b : 6 * b + 6] += sign * row * ([1, 0, 1, 0, 1, 0] if planar else 1)
    return X, rng.normal(size=6 * bodies)


def filled(rng, planar):
    """A memory of contacts that all touch, with this mobility and velocity."""
    X, v = random_bodies(rng, planar)
    k, n = len(X) // 3, X.shape[1]
    memory = make_contact_memory(n, k)
    c = memory.contacts
    c.X[:], c.u[:], c.problem.q[:] = X, X @ v, X @ v
    c.mu[:], c.problem.form[:], c.restitution[:] = (
        rng.choice([0.0, 0.2, 0.5, 1.0], size=k),
        CONE,
        rng.choice([0, 0.5, 1.0]),
    )
    return memory, v


def faults(c, k):
    """What complementarity and cone are off, relative to the largest force and velocity."""
    F, u = c.F.reshape(k, 3), (c.problem.q + c.X @ (c.X.T @ c.F)).reshape(k, 3)
    force, speed = np.max(np.abs(F)) + 1e-300, np.max(np.abs(c.problem.q)) + 1e-300
    slip = np.hypot(u[:, 1], u[:, 2])
    cone = max(np.max(np.hypot(F[:, 1], F[:, 2]) - c.mu * F[:, 0]), np.max(-F[:, 0])) / force
    open_ = np.max(-u[:, 0]) / speed
    work = np.max(np.abs(np.sum(F * u, axis=1) + c.mu * slip * F[:, 0])) / (force * speed)
    return max(cone, open_, work)
