"""Which engines there are, and which of them can answer for a given robot here and now."""

from collections.abc import Sequence

from validation.engines.drake import Drake
from validation.engines.exudyn import Exudyn
from validation.engines.hand_written import HandWritten
from validation.engines.interface import CannotBuild, Engine, Missing, Refused, Robot, installed, refuse_balls
from validation.engines.loop import ClosedLoop, Compiled
from validation.engines.mujoco import MuJoCo
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.engines.robotics_toolbox import RoboticsToolbox
from validation.engines.symbolic import Symbolic

ENGINES: tuple[type[Engine], ...] = (
    HandWritten,
    ClosedLoop,
    Compiled,
    PinocchioCpp,
    MuJoCo,
    Drake,
    Exudyn,
    RoboticsToolbox,
    Symbolic,
)
"""Every engine that this project knows; a new one is a file beside these and a line here."""


def available(robot: Robot, tip: str, engines: Sequence[type[Engine]] = ENGINES) -> list[Engine | Missing | Refused]:
    """Build every engine for a robot; what is not installed or cannot represent it stands there as such.

    Nothing is caught but an engine's own refusal: a package that is installed and does not import is an error.
    """
    return [_make(engine, robot, tip) for engine in engines]


def _make(engine: type[Engine], robot: Robot, tip: str) -> Engine | Missing | Refused:
    if not installed(engine):
        return Missing(engine.name, engine.install)
    try:
        if not engine.turns_freely:
            refuse_balls(robot, engine.name)
        return engine(robot, tip)
    except CannotBuild as error:
        return Refused(engine.name, str(error))
