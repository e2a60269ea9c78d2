"""Drake: the eight corners of a cube as balls on a half-space, Hunt and Crossley's contact.

A box touches a half-space at one point only, so that it could not rest.
"""

import logging
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from closedloop.base.arrays import Array
from validation.measured.cubes.engine import CUBE, STEPS, CubeEngine, Parameter, corners, gravity, moment
from validation.measured.cubes.tosses import MASS, RATE, Toss


class DrakeCube(CubeEngine):
    """Fitted: friction, stiffness and dissipation of each corner."""

    name: ClassVar = "drake"
    what: ClassVar = "Drake, point contact of eight corners, discrete, lagged"
    parameters: ClassVar = (
        Parameter("friction", "1", 0.18, 0.02, 1.0),
        Parameter("stiffness", "N/m", 4e4, 5e2, 1e6),
        Parameter("dissipation", "s/m", 0.9, 0.01, 20.0),
        *CUBE,
    )

    def simulate(self, values: Sequence[float], starts: Sequence[Array], tosses: Sequence[Toss]) -> list[Array]:
        """Return position and quaternion (rows, 7) of each toss."""
        from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
        from pydrake.math import RigidTransform
        from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
        from pydrake.multibody.tree import SpatialInertia, UnitInertia
        from pydrake.systems.analysis import Simulator
        from pydrake.systems.framework import DiagramBuilder

        mu, stiffness, dissipation, inertia, radius, side = map(float, values)
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, 1.0 / (RATE * STEPS))
        unit = moment(inertia, side) / MASS
        centre: Any = np.zeros(3)  # its signatures name the dtype in the place of the shape
        body = plant.AddRigidBody("cube", SpatialInertia(MASS, centre, UnitInertia(unit, unit, unit)))
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity(side)])
        friction = CoulombFriction(mu, mu)
        ground = ProximityProperties()
        AddContactMaterial(1e-6, 1e12, friction, ground)  # all that gives way is the corner
        log = logging.getLogger("drake")
        usual = log.level
        log.setLevel(logging.ERROR)  # it warns that deformable bodies, of which there are none, do not see a half-space
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground)
        log.setLevel(usual)
        corner = ProximityProperties()
        AddContactMaterial(dissipation, stiffness, friction, corner)
        at: Any
        for number, at in enumerate(corners(side, radius)):
            plant.RegisterCollisionGeometry(body, RigidTransform(at), Sphere(radius), f"corner{number}", corner)
        plant.Finalize()
        simulator = Simulator(builder.Build())
        context = simulator.get_mutable_context()
        inside = plant.GetMyMutableContextFromRoot(context)
        paths = []
        for start, toss in zip(starts, tosses, strict=True):
            context.SetTime(0.0)
            turned = np.empty(3)
            turned[:] = _rotation(start[:4]) @ start[7:10]
            plant.SetPositions(inside, np.concatenate([start[:4], start[4:7]]))
            plant.SetVelocities(inside, np.concatenate([turned, start[10:13]]))
            simulator.Initialize()
            path = np.empty((len(toss.states), 7))
            path[0] = np.concatenate([start[4:7], start[:4]])
            for i in range(1, len(path)):
                simulator.AdvanceTo(i / RATE)
                q = plant.GetPositions(inside)
                path[i] = np.concatenate([q[4:7], q[:4] / np.linalg.norm(q[:4])])  # which drifts from length one
            paths.append(path)
        return paths


def _rotation(quaternion: Array) -> Array:
    """Return the rotation matrix of a unit quaternion w x y z."""
    from pydrake.common.eigen_geometry import Quaternion

    return np.asarray(Quaternion(quaternion / np.linalg.norm(quaternion)).rotation())
