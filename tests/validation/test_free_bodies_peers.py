"""The harness holds bodies that turn freely: engines agree, identities hold on the manifold, and faults are seen."""

import numpy as np
import pytest

import robot_models
from validation.engines.compiled import Compiled
from validation.engines.drake import Drake
from validation.engines.interface import Refused
from validation.engines.loop import ClosedLoop
from validation.engines.mujoco import MuJoCo
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.engines.registry import available
from validation.identities import IDENTITIES, draw_sample

BODIES = """<mujoco><worldbody>
<body name="trunk" pos="0 0 1"><freejoint/>
 <inertial mass="3" pos="0.05 0.02 0.03" fullinertia="0.4 0.5 0.6 0.02 0.03 0.04"/>
 <body name="arm" pos="0.2 0 0" euler="0 30 0"><joint name="shoulder" type="ball" pos="0 0 0.05"/>
  <inertial mass="2" pos="0.3 0.1 0.05" diaginertia="0.1 0.3 0.3"/>
  <body name="hand" pos="0.5 0 0"><joint name="elbow" axis="0 1 1"/>
   <inertial mass="1" pos="0.2 0.05 0.1" diaginertia="0.1 0.2 0.2"/><site name="tip" pos="0.4 0.1 0.1"/></body></body>
</body>
<body name="stick" pos="2 0 1"><joint name="hanger" type="ball" armature="0.1"/>
 <inertial mass="1" pos="0.3 0.1 0.2" diaginertia="0.2 0.3 0.3"/></body>
</worldbody></mujoco>"""

TERMS = ("mass_matrix", "bias", "gravity_term", "position", "jacobian", "drift")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A floating trunk with an arm, and a stick that hangs on a ball joint."""
    path = tmp_path_factory.mktemp("bodies") / "bodies.xml"
    path.write_text(BODIES, encoding="utf-8")
    return robot_models.load(str(path))


def state(model, seed):
    """Return q, as the loop has it, and q̇."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, model.n), 0.5 * rng.normal(size=model.n)


def test_engines_that_share_nothing_have_the_same_terms(model):
    """Pinocchio's and MuJoCo's own algorithms, and the simulator's two sources."""
    engines = [engine(model, "tip") for engine in (PinocchioCpp, MuJoCo, ClosedLoop)]
    for seed in range(5):
        q, v = state(model, seed)
        for method in TERMS:
            found = [getattr(e, method)(*((q, v) if method in ("bias", "drift") else (q,))) for e in engines]
            for other in found[1:]:
                assert np.abs(other - found[0]).max() < 1e-12 * max(1.0, np.abs(found[0]).max())


def checks(engine, model, seed):
    """Return the identities that do not hold."""
    q, v = state(model, seed)
    sample = draw_sample(q, v, np.random.default_rng(seed))
    able = {name: check for name, (check, needs) in IDENTITIES.items() if all(n in engine.covers for n in needs)}
    found = {name: check(engine, sample) for name, check in able.items()}
    return {name for name, residual in found.items() if not residual.value <= residual.tolerance}


@pytest.mark.parametrize("engine", [PinocchioCpp, MuJoCo, ClosedLoop])
def test_identities_hold_on_the_manifold(model, engine):
    """Derivatives along a rotation, and Euler's and Poincaré's equations."""
    for seed in range(3):
        assert checks(engine(model, "tip"), model, seed) == set()


def test_a_missing_gyroscopic_term_is_seen(model):
    """ω × (H q̇) left out of the stick's rows of C."""

    class Wrong(ClosedLoop):
        def bias(self, q, v):
            C, at = super().bias(q, v).copy(), model.balls[-1]
            momentum = self.mass_matrix(q) @ v
            C[at : at + 3] -= np.cross(v[at : at + 3], momentum[at : at + 3])
            return C

    assert {"bias_follows_from_mass_matrix"} <= checks(Wrong(model, "tip"), model, 0)


def test_a_position_on_the_wrong_side_is_seen(model):
    """The rotation vector read as one in the parent's axes."""

    class Wrong(PinocchioCpp):
        def jacobian(self, q):
            J, at = super().jacobian(q).copy(), model.balls[0]
            J[:, at : at + 3] = J[:, [at + 1, at + 2, at]]
            return J

    assert "jacobian_is_derivative" in checks(Wrong(model, "tip"), model, 0)


def test_engines_without_such_joints_say_so(model):
    """One line for each, no traceback."""
    found = available(model, "tip", [Drake, Compiled, MuJoCo])
    assert isinstance(found[0], Refused)
    assert "'trunk' turns freely" in str(found[0])
    assert [type(each) for each in found[1:]] == [Compiled, MuJoCo]
