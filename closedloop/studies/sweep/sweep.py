"""A sweep: what it varies, and its division into parts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from closedloop.base.errors import ScenarioError
from closedloop.record.columns.recorded import ALL_COLUMNS
from closedloop.scenario.overrides import Variants
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.user_module import import_law
from closedloop.simulation.batch.table import kept_columns
from closedloop.simulation.engines.law_source import law_digest
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.simulate import check_engine
from closedloop.studies.identity import identity_of, members
from closedloop.studies.sweep.design import GRID, LATIN, Design
from closedloop.studies.sweep.part import Job
from robot_models.cached import cached_property

# Runs in a part: enough that writing it costs little, few enough that a kill loses little and all cores have work to
# the end. It depends on the sweep only, so that the parts are the same whoever makes them.
MOST_IN_PART, PARTS = 256, 128


# Numbers of whole columns in a part, 32 MB.
MOST_KEPT = 4_000_000


@dataclass(frozen=True)
class Sweep:
    """A sweep: everything that its table depends on."""

    scenario: Scenario  # what the runs have in common
    design: Design  # the keys that change, and their values
    # full names of the columns to keep whole, see `closedloop.simulation.batch.table.kept_columns`
    keep: tuple[str, ...] = ()
    engine: str = COMPILED  # see `closedloop.simulate`
    # law, law_digest: see `closedloop.studies.sweep.part.Job`
    law: str = ""
    law_digest: str = ""

    @classmethod
    def of(
        cls, scenario: Scenario, design: Design, keep: Iterable[str] = (), engine: str = COMPILED, law: str = ""
    ) -> Sweep:
        """Return a sweep that can begin; `law` is MODULE:FUNCTION, imported here, or "" for the scenario's own.

        Raises
        ------
        ScenarioError, ModelError
            If a key is unknown, the engine does not cover the scenario, there is no such column to keep, or the robot
            is at fault.
        """
        own = import_law(law) if law else None
        sweep = cls(scenario, design, kept_columns(keep), engine, law, law_digest(own) if law else "")
        check_engine(Variants(scenario, design.keys).look(design), engine, own)
        for name in sweep.keep:
            if "joint" in ALL_COLUMNS[name].dims and any(key.startswith("robot.") for key in design.keys):
                raise ScenarioError(
                    f"keep: {name} has a number a joint, and the robot changes from run to run; keep other columns"
                )
        return sweep

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What the table depends on, as JSON has it."""
        design = self.design
        identity = identity_of(self.scenario, self._changes, self.engine)
        if design.kind == LATIN:
            identity["versions"]["scipy"] = version("scipy")
        return identity | {
            "design": design.kind,
            "axes": {axis.key: axis.spec for axis in design.axes},
            "runs": design.runs,
            "seed": design.seed if design.kind != GRID else None,
            "keep": list(self.keep),
            **({"law": self.law, "law_digest": self.law_digest} if self.law else {}),
        }

    @property
    def job(self) -> Job:
        """What a worker needs to run any part."""
        kinds = tuple(axis.kind for axis in self.design.axes)
        return Job(
            self.scenario.to_toml(), self.design.keys, kinds, self.engine, self.keep, self.design.runs, self._members,
            self.law, self.law_digest,
        )  # fmt: skip

    @cached_property
    def part_size(self) -> int:
        """Runs in a part."""
        size = min(MOST_IN_PART, math.ceil(self.design.runs / PARTS))
        if self.keep:
            rows = self.scenario.time.duration / self.scenario.time.step + 1.0
            size = min(size, max(1, int(MOST_KEPT / (rows * 3 * len(self.keep)))))
        return size

    @property
    def parts(self) -> int:
        """How many parts there are."""
        return math.ceil(self.design.runs / self.part_size)

    def runs_of(self, part: int) -> range:
        """Return the numbers of a part's runs."""
        first = part * self.part_size
        return range(first, min(first + self.part_size, self.design.runs))

    @cached_property
    def _changes(self) -> dict[str, Any]:
        """The values of the keys that change."""
        return {axis.key: axis.values for axis in self.design.axes}

    @cached_property
    def _members(self) -> tuple[tuple[str, str], ...]:
        return members(self.scenario, self._changes)
