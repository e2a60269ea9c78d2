"""The values and constraints of many points at once: one batch of runs for all points and variations.

What has been run is kept in a file, a line a point, so that a tuning that was interrupted goes on: the search is the
same for the same input, and takes from the file what is there.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from closedloop.base.arrays import Array
from closedloop.base.errors import ClosedLoopError, OutputError, ScenarioError
from closedloop.mechanics.integrators import ADAPTIVE
from closedloop.record.report.measures import JOINT_MEASURES, MEASURES
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.batch.simulate_batch import simulate_batch
from closedloop.simulation.batch.table import one_number
from closedloop.simulation.engines.loops import COMPILED, PINOCCHIO
from closedloop.studies.analysis.linearise import linearise
from closedloop.studies.tune.given import Limit, Varied, with_numbers

AT = "@"
# Margins of the force loop at an instant, and how each is read.
MARGINS: dict[str, Callable[[Any], float]] = {
    "gain_margin": lambda margins: margins.decibels,
    "phase_margin": lambda margins: margins.phase,
    "delay_margin": lambda margins: margins.delay,
    "modulus_margin": lambda margins: margins.modulus,
}
# A margin without end, as that of a loop that no gain makes unstable, counts as this.
NO_END = 1e6


class Runs:
    """Evaluates points of a tuning; see `closedloop.studies.tune.search.Evaluate`.

    Parameters
    ----------
    some : sequence of Varied
        What varies.
    minimise : mapping of str to float
        Values of the summary and their weights: their weighted sum is minimised.
    over : mapping of str to sequence
        Variations, every value of a key with every value of the others.
    kept : Path, optional
        File of what has been run.
    report : callable
        Gets the number of runs done.
    """

    def __init__(
        self,
        scenario: Scenario,
        some: Sequence[Varied],
        minimise: Mapping[str, float],
        limits: Sequence[Limit],
        over: Mapping[str, Sequence[Any]],
        kept: Path | None = None,
        report: Callable[[int], None] = lambda done: None,
        workers: int | None = None,
    ) -> None:
        self.scenario, self.some, self.minimise, self.limits = scenario, list(some), dict(minimise), list(limits)
        self.variations = [dict(zip(over, point, strict=True)) for point in itertools.product(*over.values())]
        self.done, self._report, self._workers, self._kept = 0, report, workers, kept
        self.names = list(dict.fromkeys([*self.minimise, *(limit.name for limit in self.limits)]))
        for name in self.names:
            if name not in MEASURES and name not in JOINT_MEASURES and name.partition(AT)[0] not in MARGINS:
                raise ScenarioError(
                    f"tune: {name}: no value of a run's summary, such as rms_force_error, and no margin at an instant, "
                    "such as modulus_margin@3"
                )
            margin, _, instant = name.partition(AT)
            if margin in MARGINS and not _is_number(instant):
                raise ScenarioError(f"tune: {name}: say at which instant the margin is taken, such as {margin}@3")
        lost = set(over) & {each.key for each in self.some}
        if lost:
            raise ScenarioError(f"tune: {', '.join(sorted(lost))}: cannot vary and be listed as variations at once")
        self._engine = PINOCCHIO if scenario.time.integrator in ADAPTIVE else COMPILED
        self._known: dict[str, list[list[float | None]]] = {}
        if kept is not None:
            self._read(kept)

    def numbers(self, x: Array) -> list[float]:
        """Return the numbers at shares of their ranges."""
        return [each.at(float(share)) for each, share in zip(self.some, x, strict=True)]

    def changes(self, x: Array) -> dict[str, Any]:
        """Return the overrides of a point."""
        return with_numbers(self.scenario, self.some, self.numbers(x))

    def values(self, points: Array) -> Array:
        """Return all values, (P, V, names), NaN where there is no run."""
        keys = [json.dumps([number.hex() for number in self.numbers(x)]) for x in points]
        todo = {key: x for key, x in zip(keys, points, strict=True) if key not in self._known}
        if todo:
            found = self._run([self.changes(x) for x in todo.values()])
            lines = []
            for key, rows in zip(todo, found, strict=True):
                self._known[key] = [[float(v) if math.isfinite(v) else None for v in row] for row in rows]
                lines.append(json.dumps([key, self._known[key]]))
            if self._kept is not None:
                with self._kept.open("a", encoding="utf-8") as file:
                    file.write("\n".join(lines) + "\n")
        return np.array([[[math.nan if v is None else v for v in row] for row in self._known[key]] for key in keys])

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the values that are made least, (P, V), and the violations of the constraints, (P, V, K)."""
        found = self.values(points)
        at = {name: i for i, name in enumerate(self.names)}
        parts = [weight * found[..., at[name]] for name, weight in self.minimise.items()]
        violations = [limit.violation(found[..., at[limit.name]]) for limit in self.limits]
        shape = (*found.shape[:2], 0)
        return np.sum(parts, axis=0), np.stack(violations, axis=-1) if violations else np.zeros(shape)

    def as_it_is(self) -> Array:
        """Return the values of the scenario's own numbers, (V, names), be they in their ranges or not."""
        own = with_numbers(self.scenario, self.some, [each.present for each in self.some])
        return self._run([own])[0]

    def _run(self, changed: list[dict[str, Any]]) -> Array:
        """Run the scenario with each of these overrides under all variations, in one batch."""
        rows = [change | variation for change in changed for variation in self.variations]
        changes = {key: [row[key] for row in rows] for key in rows[0]}
        found = np.full((len(rows), len(self.names)), math.nan)
        plain = [i for i, name in enumerate(self.names) if AT not in name]
        if plain:
            table = simulate_batch(self.scenario, changes, engine=self._engine, workers=self._workers)
            ran = np.array([status == "done" for status in table.column("status").to_pylist()])
            for i in plain:
                column = [one_number(value) for value in table.column(self.names[i]).to_pylist()]
                found[:, i] = np.where(ran, column, math.nan)
        if len(plain) < len(self.names):
            variants = Variants(self.scenario, tuple(changes))
            for row, values in enumerate(rows):
                self._margins(variants, values, found[row])
        self.done += len(rows)
        self._report(self.done)
        return found.reshape(len(changed), len(self.variations), -1)

    def _margins(self, variants: Variants, values: Mapping[str, Any], row: Array) -> None:
        """Write the margins of a run; a loop that is unstable has negative ones."""
        loops: dict[str, Any] = {}
        for i, name in enumerate(self.names):
            margin, at, instant = name.partition(AT)
            if not at:
                continue
            try:
                if instant not in loops:
                    loops[instant] = linearise(variants.scenario(tuple(values.values())), float(instant))
                loop = loops[instant]
                found = MARGINS[margin](loop.margins())
                row[i] = min(found, NO_END) if loop.stable else -abs(min(found, NO_END))
            except ClosedLoopError:
                row[i] = math.nan

    def _read(self, kept: Path) -> None:
        """Take what has been run from the file, or begin one."""
        mark = self._fingerprint()
        try:
            if kept.exists():
                first, *lines = kept.read_text(encoding="utf-8").splitlines() or [""]
                if first != mark:
                    raise OutputError(f"{kept}: is of another tuning; name another folder, or remove the file")
                for line in lines:
                    try:
                        key, rows = json.loads(line)
                    except ValueError:  # cut off where it was interrupted
                        continue
                    self._known[key] = rows
            else:
                kept.write_text(mark + "\n", encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise OutputError(f"{kept}: cannot be used: {error}") from None

    def _fingerprint(self) -> str:
        ranges = [(each.name, each.low, each.high, each.log) for each in self.some]
        given = [self.scenario.to_toml(), ranges, self.names, self.variations]
        digest = hashlib.sha256(json.dumps(given, sort_keys=True, default=str).encode()).hexdigest()
        return json.dumps({"tuning": digest})


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
