"""Proof that an engine's constraint acts, before any of its numbers counts.

Engines accept constraints that they then ignore: Drake on a continuous plant, MuJoCo with the row disabled,
Exudyn where its start-up gave up. A probe asks two questions whose answers are known beforehand.
"""

from dataclasses import dataclass

import numpy as np

from validation.engines.interface import Engine
from validation.oracle.spatial import Array

PUSH = 50.0
"""The force with which the arm is pressed against the surface [N]."""

TOLERANCE = 1e-8
"""Relative error at which the probe's answers count as right. A constraint that is off is wrong by 1, one that is
soft by its softness (1e-4 at MuJoCo's hardest); rounding times a mass matrix of condition 1e6 stays below."""


@dataclass(frozen=True)
class ProbeResult:
    """What the probe found; relative errors, infinite where the engine gave no number.

    force : of f, where PUSH is right
    closure : of A q̈ = b, against |b| and what the free arm would do
    motion : of H q̈ + C = Q + Aᵀ f, against its largest part
    escape : how far from b the *free* arm's A q̈ is, on the scale of `closure`: what a constraint that is off shows
    """

    engine: str
    force: float
    closure: float
    motion: float
    escape: float

    @property
    def passed(self) -> bool:
        """Tell whether the constraint acts, and whether the probe could have seen it if it did not."""
        right = max(self.force, self.closure, self.motion) <= TOLERANCE
        return bool(right and self.escape > 1e3 * TOLERANCE)

    def __str__(self) -> str:
        verdict = "acts" if self.passed else "DOES NOT ACT"
        return (
            f"{self.engine}: the constraint {verdict} (errors: f {self.force:.1e}, closure {self.closure:.1e}, "
            f"motion {self.motion:.1e}; the free arm would miss the closure by {self.escape:.1e})"
        )


def probe(engine: Engine, *, seed: int = 0) -> ProbeResult:
    """Press the arm against a surface, at rest and then in motion, and look whether the surface answers.

    First Q = C − Aᵀ·PUSH and b = 0: the answer is q̈ = 0 and f = PUSH, whatever the robot. Then the same push
    on top of a random torque, in motion and with b ≠ 0: the answer must satisfy both rows of Eq. 24. The normal
    is the direction in which the tip moves most easily, so the pose cannot be singular for it.

    engine: one that covers `constrained`
    """
    rng = np.random.default_rng(seed)
    q, v, torque, b = rng.uniform(-1, 1, engine.n), rng.normal(size=engine.n), rng.normal(size=engine.n), rng.normal()
    J = engine.jacobian(q)
    normal: Array = np.linalg.svd(J)[0][:, 0]
    A = normal @ J
    still = np.zeros(engine.n)
    _, f = engine.constrained(q, still, engine.gravity_term(q) - A * PUSH, normal, 0.0)
    force = _number(abs(f - PUSH) / PUSH)

    Q = torque + engine.bias(q, v) - A * PUSH
    a, f = engine.constrained(q, v, Q, normal, float(b))
    free = engine.free_acceleration(q, v, Q)
    size = abs(float(b)) + float(np.abs(A) @ np.abs(free))
    H = engine.mass_matrix(q)
    parts = [H @ a, engine.bias(q, v) - Q, -A * f]
    motion = np.abs(sum(parts)).max() / max(np.abs(part).max() for part in parts)
    return ProbeResult(
        engine=engine.name,
        force=force,
        closure=_number(abs(float(A @ a) - float(b)) / size),
        motion=_number(float(motion)),
        escape=_number(abs(float(A @ free) - float(b)) / size),
    )


def _number(x: float) -> float:
    """Return x, or infinity for what is no number, so that a missing answer cannot pass."""
    return float(x) if np.isfinite(x) else float("inf")
