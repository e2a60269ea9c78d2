"""Types of the public names, and where each is: `closedloop/__init__.py` reads the latter from here."""

from closedloop import figures as figures
from closedloop.base.errors import ChatterError as ChatterError
from closedloop.base.errors import ClosedLoopError as ClosedLoopError
from closedloop.base.errors import ClusterError as ClusterError
from closedloop.base.errors import DivergenceError as DivergenceError
from closedloop.base.errors import InterruptedRunError as InterruptedRunError
from closedloop.base.errors import LawError as LawError
from closedloop.base.errors import ModelError as ModelError
from closedloop.base.errors import NoNormalError as NoNormalError
from closedloop.base.errors import OutputError as OutputError
from closedloop.base.errors import PainleveError as PainleveError
from closedloop.base.errors import RunFileError as RunFileError
from closedloop.base.errors import ScenarioError as ScenarioError
from closedloop.base.errors import SimulationError as SimulationError
from closedloop.base.errors import SingularClosureError as SingularClosureError
from closedloop.control.law import ControlLaw as ControlLaw
from closedloop.control.law import LawInput as LawInput
from closedloop.lab.start import lab as lab
from closedloop.mechanics.closure.solve import solve_closure as solve_closure
from closedloop.mechanics.robot.pinocchio import Robot as Robot
from closedloop.mechanics.robot.pinocchio import Terms as Terms
from closedloop.mechanics.surface.motion import SurfaceMotion as SurfaceMotion
from closedloop.mechanics.surface.placed import Plane as Plane
from closedloop.mechanics.surface.surface import Compliance as Compliance
from closedloop.mechanics.surface.surface import Surface as Surface
from closedloop.record.columns.record import Event as Event
from closedloop.record.run import Run as Run
from closedloop.record.run import load_run as load_run
from closedloop.scenario.load import load_scenario as load_scenario
from closedloop.scenario.load import shipped_scenarios as shipped_scenarios
from closedloop.scenario.scenario import Scenario as Scenario
from closedloop.serve.serve import serve as serve
from closedloop.simulation.batch.simulate_batch import simulate_batch as simulate_batch
from closedloop.simulation.engines.problem import Problem as Problem
from closedloop.simulation.engines.user_law import Law as Law
from closedloop.simulation.prepare import prepare as prepare
from closedloop.simulation.simulate import halve as halve
from closedloop.simulation.simulate import simulate as simulate
from closedloop.simulation.simulator import Simulator as Simulator
from closedloop.simulation.simulator import StepState as StepState
from closedloop.studies.analysis.assembly import linearise as linearise
from closedloop.studies.comparison.compare import compare as compare
from closedloop.studies.comparison.compare import compare_log as compare_log
from closedloop.studies.comparison.recording import Recording as Recording
from closedloop.studies.gradient.gradient import gradient as gradient
from closedloop.studies.gradient.gradient import gradients as gradients
from closedloop.studies.gradient.gradient import sensitivities as sensitivities
from closedloop.studies.identify.contact.identify_contact import identify_contact as identify_contact
from closedloop.studies.identify.excite import excite as excite
from closedloop.studies.identify.identify import identify as identify
from closedloop.studies.identify.motion import Log as Log
from closedloop.studies.sweep.maps import sweep_plot as sweep_plot
from closedloop.studies.tune.tune import tune as tune

linearize = linearise

__version__: str
