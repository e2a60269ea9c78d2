"""A policy that is linear in a few parts of the observation, and the control law that it becomes.

    a = s/(1 + |s|),  s = Σ wₖ cₖ xₖ

with the parts x of the observation, scales c of their usual size and weights w; the action a from −1 to 1 is the
desired force. As a law it is evaluated once in a control period, and commands the task's own law in between.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from closedloop.base.arrays import Array
from closedloop.base.errors import ScenarioError
from closedloop.base.files import write_whole
from closedloop.control.law import LawInput
from closedloop.gym.core import Core

# The parts, the words for them in a law, and scales: a force error of 10 N, a sum of 1 N s.
FEATURES = {
    "force_error": ("x.f_des - x.f_measured", 0.1),
    "force_sum": ("z.force_sum", 1.0),
    "contact": ("x.pressed", 1.0),
}


@dataclass(frozen=True)
class LinearPolicy:
    """A policy with one number as its action, the desired force.

    names: names of the numbers of an observation, as an environment's `core.observation_names`
    weights: (4,), (N, 4), of the force's error, its sum, contact, and of 1; for N environments each its own
    """

    names: tuple[str, ...]
    weights: ArrayLike

    def act(self, observations: ArrayLike) -> Array:
        """Return the actions (N, 1) for observations (N, k)."""
        seen, weights = np.atleast_2d(np.asarray(observations, dtype=np.float64)), np.asarray(self.weights)
        total = np.zeros(len(seen)) + weights[..., len(FEATURES)]
        for k, (name, (_, scale)) in enumerate(FEATURES.items()):
            total = total + weights[..., k] * (scale * seen[:, self._place(name)])
        return (total / (1.0 + np.abs(total)))[:, None]

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise ScenarioError(
                f"policy: the observation has no {name!r}, which it needs; it has {', '.join(self.names)}"
            )
        return self.names.index(name)

    def write_law(self, path: str | Path, core: Core) -> Path:
        """Write the policy as a control law of its own, for ``closedloop run SCENARIO --law.kind FILE:Policy``.

        core: that of the environment: its action is the desired force alone, and its law is what the policy commands
        Raises `ScenarioError` if the environment has other actions, or the weights are those of many; `OutputError` if
        the file cannot be written.
        """
        weights = np.asarray(self.weights, dtype=np.float64)
        if core.actions.names != ("force",) or weights.shape != (len(FEATURES) + 1,):
            raise ScenarioError(
                f"policy: its actions are {', '.join(core.actions.names)}, its weights {weights.shape}: must be "
                f"'force' alone and ({len(FEATURES) + 1},)"
            )
        if not core.scenario.law.sample_period > 0.0:
            raise ScenarioError("law.sample_period: must be above 0: a policy keeps its memory between samples")
        law = type(core.scenario.law)
        if law.states != ("force_error",) or law.joint_states:
            raise ScenarioError(
                f"law.kind = {law.kind!r}: has states of its own; use a law without, such as 'impedance'"
            )
        text = law_text(law.__module__, law.__name__, weights.tolist(), core)
        return write_whole(Path(path), text.encode())


def law_text(module: str, base: str, weights: Sequence[float], core: Core) -> str:
    """Return the law as Python text."""
    fields = ", ".join("z.command" if name == "f_des" else f"x.{name}" for name in LawInput._fields)
    terms = "\n".join(
        f"            s += {weight!r} * ({scale!r} * ({word}))"
        for weight, (word, scale) in zip(weights, FEATURES.values(), strict=False)
    )
    low, high = float(core.actions.low[0]), float(core.actions.high[0])
    return f'''"""A learned policy as a control law: each {core.period:g} s it commands the force of {base}."""

from closedloop.control.law import force_error_rate
from closedloop.control.law import LawInput
from {module} import {base}
from closedloop.jit.kernel import kernel_of

PERIOD, LOW, HIGH = {core.period!r}, {low!r}, {high!r}
law_torque = kernel_of({base}, "torque")


class Policy({base}):
    """{base} under the force that the policy commands; `law.force` is what it is to keep."""

    states = ("force_error", "force_sum", "command")

    @staticmethod
    def torque(x, par, z, torque):
        k = round(x.t / PERIOD)
        if abs(x.t - k * PERIOD) < 1e-6 * PERIOD:
            if k > 0 and x.pressed != 0.0:
                z.force_sum += PERIOD * (x.f_des - x.f_measured)
            s = {weights[-1]!r}
{terms}
            share = 0.5 * (s / (1.0 + abs(s)) + 1.0)
            z.command = (1.0 - share) * LOW + share * HIGH
        law_torque(
            LawInput({fields}),
            par, z, torque,
        )

    @staticmethod
    def rates(x, par, z, f, torque, dz):
        dz.force_error = force_error_rate(x, par, z, f)
        dz.force_sum, dz.command = 0.0, 0.0
'''
