"""A run whose scenario has classes of one's own is judged, drawn and exported where none of them is named."""

import sys
from pathlib import Path

import pytest

import closedloop as cl
from closedloop.base import families
from closedloop.command.saved import export, plot, show

# Of each family: module and class that ship, and keys beside `kind`.
SHIPPED = {
    "law": ("control.laws.hybrid", "HybridLaw", {"kp": 900.0, "kd": 60.0}),
    "compensation": ("control.compensation.observer", "ObserverCompensation", {}),
    "reference": (
        "control.reference.paths.line",
        "Line",
        {"direction": [1, 0, 0], "speed": 0.01, "start": 0.0, "stop": 1.0},
    ),
    "friction": ("mechanics.friction.laws.coulomb", "SurfaceCoulomb", {"coefficient": 0.2}),
    "joint_friction": ("mechanics.friction.laws.coulomb", "JointCoulomb", {"kinetic": 0.1}),
    "surface": ("mechanics.surface.kinds.sphere", "Sphere", {"radius": 0.3}),
    "surface_motion": ("mechanics.surface.motions.breathing", "Breathing", {"amplitude": 1e-4, "frequency": 1.0}),
    "compliance": ("mechanics.surface.compliances.kelvin_voigt", "KelvinVoigt", {"stiffness": 1e4, "damping": 100.0}),
}


@pytest.mark.parametrize("section", SHIPPED)
def test_a_run_with_a_class_of_ones_own_is_read_where_the_class_is_not_named(
    section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The summary, the report, the figures and the files are those of the run itself."""
    module, name, keys = SHIPPED[section]
    home = f"absent_{section}"
    (tmp_path / f"{home}.py").write_text(f"from closedloop.{module} import {name}\n\n\nclass Mine({name}):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    changes = {section: {"kind": f"{home}:Mine", **keys}, "time.duration": 0.02}
    run = cl.simulate(cl.load_scenario("wam_slide", changes), progress=False)
    path = run.save(tmp_path / "run.nc")
    monkeypatch.delitem(families.users, f"{home}:Mine")
    monkeypatch.delitem(sys.modules, home)
    read = cl.load_run(path)
    assert isinstance(getattr(read.scenario, section), families.Absent)
    assert read.summary() == run.summary()
    file = str(path)
    commands = [show([file]), plot([file]), *(export([file, "--to", to]) for to in ("csv", "mat", "html"))]
    assert commands == [0] * len(commands), capsys.readouterr().err
