"""What several tests of the simulator need: runs made once, random states, the command line in this process."""

import dataclasses
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.run import main


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a call of the command line left behind."""

    status: int
    out: str
    err: str

    def refusal(self, status: int = 2) -> str:
        """Return the one line on standard error, having checked that it is one, and the exit status."""
        lines = self.err.splitlines()
        assert self.status == status, self.err
        assert len(lines) == 1, self.err
        assert lines[0].startswith("closedloop: ")
        assert "Traceback" not in self.out + self.err
        return lines[0].removeprefix("closedloop: ")


@dataclasses.dataclass(frozen=True)
class State:
    """A random state, torque and unit normal."""

    q: np.ndarray
    v: np.ndarray
    torque: np.ndarray
    normal: np.ndarray


@pytest.fixture(scope="session", autouse=True)
def compiled():
    """Compile the step before anything is captured or timed."""
    cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.002}))


@pytest.fixture(scope="session")
def shipped_run() -> Callable[[str], cl.Run]:
    """Return a function that simulates a shipped scenario, once a session."""
    return lru_cache(maxsize=None)(lambda name: cl.simulate(cl.load_scenario(name)))


@pytest.fixture(scope="session")
def robot() -> Callable[..., cl.Robot]:
    """Return a function that loads a robot with its tip, once a session."""
    return lru_cache(maxsize=None)(lambda name, tip=None: cl.Robot(robot_models.load(name), tip))


@pytest.fixture(scope="session")
def random_states() -> Callable[..., list[State]]:
    """Return a function of (robot, count, seed) that draws states with q inside the joint limits."""

    def draw(robot: cl.Robot, count: int, seed: int) -> list[State]:
        rng = np.random.default_rng(seed)
        low = np.maximum(robot.model.position_lower, robot.model.home - 1.5)
        high = np.minimum(robot.model.position_upper, robot.model.home + 1.5)
        states = []
        for _ in range(count):
            normal = rng.normal(size=3)
            states.append(
                State(
                    rng.uniform(low, high),
                    rng.normal(size=robot.n),
                    10.0 * rng.normal(size=robot.n),
                    normal / np.linalg.norm(normal),
                )
            )
        return states

    return draw


@pytest.fixture
def command_line(capsys, monkeypatch, tmp_path) -> Callable[..., Outcome]:
    """Return a function that runs the command line here, in an empty folder of its own.

    That it compiles is left out of what it says: the first test to ask for a form of the step hears it.
    """
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        try:
            status = main([str(a) for a in arguments])
        except SystemExit as leaving:  # argparse leaves this way after --help
            status = int(leaving.code or 0)
        captured = capsys.readouterr()
        said = "".join(line for line in captured.err.splitlines(True) if not line.startswith("compiling the step"))
        return Outcome(status, captured.out, said)

    return call


@pytest.fixture
def short() -> tuple[str, ...]:
    """Return the options of a run of ten steps that writes no figures."""
    return ("--time.duration", "0.01", "--no-figures", "--json")
