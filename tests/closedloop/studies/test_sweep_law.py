"""A sweep with a law of one's own: the same as its runs one by one, recorded, and resumed with the same text only."""

import json

import numba
import numpy as np
import pyarrow.parquet
import pytest

import closedloop as cl
from closedloop.base.errors import ScenarioError
from closedloop.command.sweep import main
from closedloop.simulation.engines.law_source import law_digest
from closedloop.studies.sweep.store import METADATA, law_of

LAWS = """
import numba

print("imported")

@numba.njit
def compiled(t, q, v, terms):
    return terms.bias - 15.0 * terms.jacobian[2]

def plain(x):
    return x.C - x.A[0] * x.f_des

class Counting:
    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        self.calls += 1
        return x.C - x.A[0] * self.calls

counting = Counting()
"""
SHORT = ("planar2_slide", "--time.duration", "0.01", "--over", "law.force=5,10")


@pytest.fixture
def laws(tmp_path, monkeypatch):
    """Write a module of laws into the current folder, and return its file."""
    monkeypatch.chdir(tmp_path)
    law_of.cache_clear()
    (tmp_path / "laws_of_a_sweep.py").write_text(LAWS)
    return tmp_path / "laws_of_a_sweep.py"


def swept(law, *words):
    """Run a sweep with a law of the module, and return its status."""
    return main([*SHORT, "--law", f"laws_of_a_sweep:{law}", "--out", "s.parquet", *words])


@pytest.mark.usefixtures("laws")
@pytest.mark.parametrize("law", ["plain", "counting"])
def test_each_run_is_that_of_simulate(law, capsys):
    """Each begins with the law as it was; and the table says which law it was, with the digest of its text."""
    assert swept(law, "--engine", "pinocchio", "--keep", "torque") == 0
    assert "imported" not in capsys.readouterr().out
    import laws_of_a_sweep

    table = pyarrow.parquet.read_table("s.parquet")
    identity = json.loads(table.schema.metadata[METADATA.encode()])["identity"]
    assert identity["law"] == f"laws_of_a_sweep:{law}"
    assert identity["law_digest"] == law_digest(getattr(laws_of_a_sweep, law))
    for force, least in zip((5.0, 10.0), table["min_contact_force"].to_pylist(), strict=True):
        own = laws_of_a_sweep.Counting() if law == "counting" else laws_of_a_sweep.plain
        run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.01, "law.force": force}), law=own)
        assert least == run.contact_force.min()


@pytest.mark.usefixtures("laws")
def test_what_numba_has_not_compiled_is_refused_by_the_compiled_engine(capsys):
    """In one line that says what would do; a law that there is not, too."""
    for law in ("plain", "nowhere"):
        assert swept(law) == 2
        assert len(capsys.readouterr().err.replace("imported\n", "").splitlines()) == 1


def test_a_sweep_goes_on_with_the_same_law_only(laws, capsys):
    """Another text, another law, or none is another sweep."""
    assert swept("plain", "--engine", "pinocchio") == 0
    assert swept("plain", "--engine", "pinocchio") == 0
    assert "all were there before" in capsys.readouterr().out
    assert swept("counting", "--engine", "pinocchio") == 2
    assert "the law differs" in capsys.readouterr().err
    assert main([*SHORT, "--engine", "pinocchio", "--out", "s.parquet"]) == 2
    assert "the law differs" in capsys.readouterr().err
    import laws_of_a_sweep

    digest = law_digest(laws_of_a_sweep.plain)
    laws.write_text(LAWS.replace("x.A[0] * x.f_des", "x.A[0] * 3.0"))
    with pytest.MonkeyPatch.context() as patched:
        patched.delitem(__import__("sys").modules, "laws_of_a_sweep")
        law_of.cache_clear()
        assert swept("plain", "--engine", "pinocchio") == 2
        assert "the text of the law differs" in capsys.readouterr().err
        with pytest.raises(ScenarioError, match="its text here is not the one that the sweep was begun with"):
            law_of("laws_of_a_sweep:plain", digest)


def test_a_batch_takes_a_compiled_law_in_threads():
    """Without lanes, which have no law of a user's; as `simulate` runs it."""

    @numba.njit
    def press(t, q, v, terms):
        return terms.bias - 15.0 * terms.jacobian[2]

    base, forces = cl.load_scenario("planar2_slide", {"time.duration": 0.01}), [5.0] * 9
    table = cl.simulate_batch(base, {"law.force": forces}, law=press, keep=["f"], workers=2)
    run = cl.simulate(base, law=press, engine="compiled")
    for kept in table["contact_force"].to_pylist():
        assert np.array_equal(kept, run.contact_force)
