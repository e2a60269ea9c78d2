"""Exudyn with the loops of a mechanism."""

from importlib import import_module
from typing import Any

import numpy as np

from robot_models.loop_joint import WORLD, LoopJoint
from validation.engines.exudyn import Exudyn, add_marker, add_tree, quiet_settings
from validation.loops.cases import Case, mechanism_called, oracle_of
from validation.loops.peers import LoopPeer, refuse_other
from validation.oracle.loop_joint import COUPLES, FORCES, joint_axes
from validation.oracle.spatial import Array
from validation.oracle.tree import GROUND
from validation.tolerances import Tolerance

# A row is independent of those before it if more than this share of it is outside their span.
INDEPENDENT = 1e-6


class ExudynLoops(LoopPeer):
    """A `JointGeneric` between two links, and a `ConnectorDistance` for a rod.

    Its multipliers are exact, but rows that depend on others make its system singular: such axes are left unlocked
    here, forces kept before couples. What it knows of the drift is a difference quotient.
    """

    name, package, install = Exudyn.name, Exudyn.package, Exudyn.install
    bound = Tolerance("Exudyn's drift", 1e-5, "a difference quotient, good to 1e-7 or so of the rows' own drift")
    kinds = ("point", "hinge", "slider", "cylinder", "planar", "weld", "distance")

    def __init__(self, mechanism: str) -> None:
        self.robot, self.oracle = mechanism_called(mechanism), oracle_of(mechanism)
        for joint in self.robot.loops:
            refuse_other(joint, self.kinds, "JointGeneric")

    def __call__(self, case: Case) -> Array:
        """Return q̈ (n,) of a case."""
        exudyn: Any = import_module("exudyn")
        tree = self.oracle.oracle.tree
        container = exudyn.SystemContainer()
        system: Any = container.AddSystem()
        body, _ = add_tree(system, tree, str(self.robot.tip), case.q, case.v)
        system.SetObjectParameter(body, "jointForceVector", case.torque)
        ground = system.AddObject(import_module("exudyn.itemInterface").ObjectGround())
        for joint, locked in zip(self.robot.loops, self._independent(case), strict=True):
            self._add(system, body, ground, joint, locked)
        system.Assemble()
        solver: Any = exudyn.MainSolverImplicitSecondOrder()
        loud = exudyn.config.suppressWarnings
        exudyn.config.suppressWarnings = True  # what it would warn of is checked
        started = bool(solver.InitializeSolver(system, quiet_settings()))
        exudyn.config.suppressWarnings = loud
        acceleration = np.array(system.systemData.GetODE2Coordinates_tt())
        if not started or not np.any(np.abs(acceleration) > 0.0):
            raise np.linalg.LinAlgError("Exudyn finds no initial accelerations")
        return acceleration

    def _independent(self, case: Case) -> list[list[bool]]:
        """Return which rows of each loop joint are locked: those that depend on the ones before them are not."""
        taken: list[Array] = []
        chosen = []
        for rows in self.oracle.all_rows(case.q, case.v):
            locked = []
            for row in rows.A:
                left, size = row.copy(), float(np.linalg.norm(row))
                for _ in range(2):
                    for direction in taken:
                        left = left - direction * (direction @ left)
                locked.append(bool(np.linalg.norm(left) > INDEPENDENT * max(size, INDEPENDENT)))
                if locked[-1]:
                    taken.append(left / np.linalg.norm(left))
            chosen.append(locked)
        return chosen

    def _add(self, system: Any, body: Any, ground: Any, joint: LoopJoint, locked: list[bool]) -> None:
        items = import_module("exudyn.itemInterface")
        markers, tree = [], self.oracle.oracle.tree
        for k in (1, 0):  # its axes are those of the first
            frame, pose = joint.frames[k], np.eye(4)
            pose[:3, :3], pose[:3, 3] = joint_axes(joint, k), joint.points[k]
            if frame != WORLD and tree.frame(frame).body != GROUND:
                markers.append(add_marker(system, body, tree, frame, pose))
                continue
            if frame != WORLD:
                place = np.eye(4)
                place[:3, :3], place[:3, 3] = tree.frame(frame).rotation, tree.frame(frame).translation
                pose = place @ pose
            markers.append(system.AddMarker(items.MarkerBodyRigid(bodyNumber=ground, localHT=pose)))
        if joint.type == "distance":
            system.AddObject(items.ObjectConnectorDistance(markerNumbers=markers, distance=joint.length))
            return
        names = [*FORCES[joint.type], *(x.upper() for x in COUPLES[joint.type])]
        held = {name for name, yes in zip(names, locked, strict=True) if yes}
        axes = [int(x in held) for x in "xyzXYZ"]
        system.AddObject(items.ObjectJointGeneric(markerNumbers=markers, constrainedAxes=axes))
