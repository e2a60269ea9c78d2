"""A scenario as a robot of LeRobot: a package `lerobot_robot_closedloop` with this file as its `__init__.py`.

Then `--robot.type=closedloop --robot.scenario=panda_slide` names it. An action is the wanted positions of the joints.
"""

from dataclasses import dataclass

import numpy as np
from lerobot.robots import Robot, RobotConfig

import closedloop as cl


@RobotConfig.register_subclass("closedloop")
@dataclass
class ClosedLoopConfig(RobotConfig):
    """The scenario, how long an action lasts, s, and the frequency of the springs at the joints, 1/s."""

    scenario: str = "panda_slide"
    period: float = 1.0 / 30.0
    frequency: float = 20.0


class ClosedLoop(Robot):
    """An arm whose joints follow actions, and the force of the surface on its tip, N."""

    config_class = ClosedLoopConfig
    name = "closedloop"

    def __init__(self, config):
        super().__init__(config)
        self.config, self._connected = config, False
        self._simulator = cl.Simulator(cl.load_scenario(config.scenario, {"time.duration": 600.0}))
        problem = self._simulator.problem
        self._robot, self._steps = problem.robot, max(1, round(config.period / problem.h))
        self._names = [f"{name}.pos" for name in problem.robot.model.joint_names]

    @property
    def action_features(self):
        """What an action has."""
        return dict.fromkeys(self._names, float)

    @property
    def observation_features(self):
        """What an observation has."""
        return self.action_features | {"contact_force": float}

    @property
    def is_connected(self):
        """Whether `connect` was called."""
        return self._connected

    @property
    def is_calibrated(self):
        """Joints of a simulation need no calibration."""
        return True

    def connect(self, calibrate=True):
        """Begin a run."""
        self._simulator.reset()
        self._connected = True

    def calibrate(self):
        """Do nothing."""

    def configure(self):
        """Do nothing."""

    def get_observation(self):
        """Return the positions of the joints, rad (m), and the contact force, N."""
        state = self._simulator.state
        return dict(zip(self._names, state.q.tolist(), strict=True)) | {"contact_force": state.f}

    def send_action(self, action):
        """Pull the joints to wanted positions for a period."""
        wanted, w = np.array([action[name] for name in self._names]), self.config.frequency
        for _ in range(self._steps):
            state = self._simulator.state
            terms = self._robot.terms(state.q, state.v)
            springs = w * w * (wanted - state.q) - 2.0 * w * state.v
            self._simulator.step(terms.mass_matrix @ springs + terms.bias)
        return action

    def disconnect(self):
        """Save the run."""
        self._connected = False
        self._simulator.run().save("run.nc")
