"""Eight runs at a time in SIMD lanes: runs of a batch with the paper's law and the tip on a smooth surface.

Such a run has no events, impacts or friction, so its steps have no branches. Eight of them take each step together in
float64x8 (`closedloop.jit.simd8`), by the same kernels as a single run, with the same result to the last bit. This
loop, `closedloop.simulation.engines.lane_loop`, only calls them. The summary of a run is accumulated row by
row (`closedloop.record.report.measured`); the rows are kept only on request.

If one of the eight needs an event (liftoff), comes near a singular pose or diverges, the loop returns a status, and
each of the eight is run by itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from closedloop.base.arrays import Array
from closedloop.control.reference.desired import Reference
from closedloop.jit.background import make_ready
from closedloop.jit.calls import address_of
from closedloop.jit.kernel import jit_disabled, plain
from closedloop.jit.simd8 import WIDE, aligned
from closedloop.loop.step.memory import Work
from closedloop.loop.step.record_row import Row
from closedloop.mechanics.closure.conditioning import BATCH
from closedloop.mechanics.closure.contact_force import PRESSED
from closedloop.mechanics.closure.solve import OK
from closedloop.mechanics.integrators import INTEGRATORS
from closedloop.mechanics.robot.pinocchio import Robot
from closedloop.mechanics.robot.tree import Tree, work_size
from closedloop.record.report.measured import Tally, Values
from closedloop.record.report.row_sample import joint_limits
from closedloop.scenario.scenario import Scenario
from closedloop.simulation.engines.lane_loop import SIGNALS, LaneAddresses, Sizes, Worst, run_in_lanes
from closedloop.simulation.engines.loops import COMPILED
from closedloop.simulation.engines.needs import needs_general_form
from closedloop.simulation.engines.problem import Problem

# Eight runs in lanes take as long as two by themselves; fewer than this many are run one by one.
FEWEST = 3


def can_use_lanes(scenario: Scenario) -> bool:
    """Whether a scenario may run without branches: the paper's law, on a smooth surface from the start."""
    return (
        not needs_general_form(scenario)
        and scenario.surface.kind == "plane"
        and scenario.tool.radius == 0.0
        and scenario.surface_motion.kind == "none"
        and np.isinf(scenario.surface.bounds()[0])
        and scenario.compliance.kind == "none"
        and not scenario.surface.gap > 0.0
        and scenario.stabiliser.kind in ("baumgarte", "none")
        and scenario.time.integrator in INTEGRATORS
        and not jit_disabled()
    )


class Kind(NamedTuple):
    """What the runs of one set of lanes have in common."""

    contact: str
    integrator: str
    robot: Robot
    steps: int
    h: float
    nodes: int
    hold: int


def kind_of(problem: Problem) -> Kind | None:
    """Return what a run must have in common with the others in its lanes; None for one that cannot use lanes."""
    scenario = problem.scenario
    if not can_use_lanes(scenario) or problem.general or problem.robot.model.loops or problem.mode != PRESSED:
        return None
    return Kind(
        scenario.surface.contact, scenario.time.integrator, problem.robot, problem.steps, problem.h, problem.nodes,
        problem.hold,
    )  # fmt: skip


class LaneRuns:
    """Memory for eight runs of one kind; see `kind_of`.

    Parameters
    ----------
    like : Problem
        One of the runs, for the sizes.
    keep : bool
        Whether all rows are kept.

    Attributes
    ----------
    kind : Kind
        The kind of all eight.
    n : int
        Joints.
    end : float
        Instant of the last row, s.
    """

    def __init__(self, like: Problem, kind: Kind, keep: bool) -> None:
        n, stages = like.robot.n, like.integrator.stages
        self.kind, self.n, self.end = kind, n, like.h * like.steps
        loop = like.loop()
        self._state, self._tableau = loop.state, like.integrator.tableau()
        self._h = like.h
        self._work = Work(aligned(Work.count(n, 0, stages, 1, 0)), n, 0, stages, 1, 0)
        self._constants = aligned(loop.constants.memory.size)
        self._forces, self._largest = aligned(like.table.shape[0]), aligned(1)
        self._rows = aligned(like.steps + 1 if keep else BATCH, Row.count(n))
        (instants, columns), (kept, width) = like.table.shape, self._rows.shape[:2]
        self._sizes = Sizes(like.nodes, instants, columns, kept, width)
        self._values, self._signals = aligned(Values.count(n)), aligned(like.steps + 1, SIGNALS)
        self._worst = aligned(Worst.count())
        self._limits = joint_limits(like.robot.model)
        self._parts = {
            "work": self._work.memory, "terms": aligned(n * n + n + plain(work_size)(n)), "constants": self._constants,
            "forces": self._forces, "largest": self._largest, "rows": self._rows, "tallies": aligned(Tally.count(n)),
            "values": self._values, "signals": self._signals, "worst": self._worst,
        }  # fmt: skip
        self._addresses = LaneAddresses(np.zeros(LaneAddresses.count(), dtype=np.int64))
        for name, part in self._parts.items():
            setattr(self._addresses, name, address_of(part))
        self._tables: list[Array] = []
        self._misses, self._has_misses = np.empty((WIDE, like.steps + 1)), False

    @property
    def bytes(self) -> int:
        """Return the size of the memory, bytes."""
        return sum(part.nbytes for part in self._parts.values())

    def put(self, lane: int, problem: Problem) -> None:
        """Load a problem into a lane; afterwards the table's forces and noise may be overwritten."""
        n = self.n
        if lane == 0:
            self._tables.clear()
        self._constants[:, lane] = problem.constants().memory
        self._work.q[:, lane], self._work.v[:, lane] = problem.q, problem.v
        self._work.tip.frame[..., lane] = problem.frame
        force = problem.table[:, Reference.place("force", n)]
        self._forces[:, lane] = force
        self._largest[0, lane] = np.abs(force[:: problem.nodes]).max()
        self._tables.append(problem.table)

    def run(self, tree: Tree, count: int) -> bool:
        """Run the first `count` lanes; False if one of them could not be finished here."""
        for part in (self._constants, self._forces, self._largest, self._work.q, self._work.v, self._work.tip.frame):
            part[..., count:] = part[..., :1]  # unused lanes repeat the first
        addresses = [address_of(table) for table in self._tables[:count]]
        tables = np.array(addresses + addresses[:1] * (WIDE - count))
        self._state.batched, self._has_misses = 0, False
        make_ready(run_in_lanes)
        status = run_in_lanes(
            tree, self._addresses.memory, self._state.memory, self._h, self._tableau, tables, self._sizes, self._limits
        )
        return status == OK

    def values(self, lane: int) -> Array:
        """Return the values of a run's summary, see `closedloop.record.report.measured`."""
        return self._values[:, lane].copy()

    def worst(self, lane: int) -> Worst:
        """Return what a first look at the control goes by."""
        return Worst(self._worst[:, lane])

    def miss(self, lane: int) -> Array:
        """Return f − f_des, (N,)."""
        if not self._has_misses:  # of all lanes at once: they are in the same cache lines
            np.copyto(self._misses, self._signals[:, 0].T)
            self._has_misses = True
        return self._misses[lane]

    def signals(self, lane: int) -> tuple[Array, Array, Array, Array]:
        """Return f_des, (N,), f, (N,), the tip less its path along the surface, (N, 3), and the path, (N, 3)."""
        n, nodes = self.n, self._sizes.nodes
        wanted, own = self._forces[::nodes, lane].copy(), self._signals[:, :, lane].T.copy()
        along = own[1:].T @ self._work.tip.frame[1:, :, lane]
        return wanted, wanted + own[0], along, self._tables[lane][::nodes, Reference.place("position", n)]

    def normal(self, lane: int) -> Array:
        """Return the normal (3,) of the plane."""
        return self._work.tip.frame[0, :, lane].copy()

    def rows(self, lane: int) -> Array:
        """Return the rows of a run, if they were kept; the next run overwrites them."""
        return self._rows[:, :, lane]


def uses_lanes(scenario: Scenario, engine: str, runs: int) -> bool:
    """Whether a scenario is run in lanes, with others of its kind, in a batch of so many runs."""
    return engine == COMPILED and runs >= FEWEST and can_use_lanes(scenario)
