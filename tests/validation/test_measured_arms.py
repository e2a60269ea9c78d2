"""Logs of real robots: friction as published, torques where they were not fitted, data that fit into the wheel."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from closedloop.base.errors import ModelError
from closedloop.studies.identify.identify import Estimate
from validation.measured import kr300, tx40, ur10
from validation.measured.__main__ import main
from validation.measured.judged import DATA, possible


def test_friction_of_a_tx40_is_the_published_one(tmp_path, capsys):
    """Each of the twelve coefficients within 10 %, or in three times its interval; eleven certain to 35 %."""
    assert main(["tx40", "--json", str(tmp_path / "out.json")]) == 0
    assert "every value that has a bound is within it" in capsys.readouterr().out
    found = json.loads((tmp_path / "out.json").read_text())
    halves = []
    for kind in ("viscous", "dry"):
        value, published = np.array(found[kind]["value"]), np.array(tx40.PUBLISHED[kind])
        low, high = np.array(found[kind]["interval"]).T
        half = (high - low) / 2.0
        assert ((np.abs(value - published) < 3.0 * half) | (np.abs(value / published - 1.0) < 0.1)).all()
        assert (np.abs(value / published - 1.0) < 0.1).sum() >= 5
        halves.extend(half / value)
    assert np.sort(halves)[10] < 0.35
    # The drives of axes 1 and 2 turn with their links: no log tells them apart, and no number is made up.
    assert found["drive_inertia"]["value"][:2] == [None, None]
    np.testing.assert_allclose(found["drive_inertia"]["value"][2:], tx40.PUBLISHED["drive_inertia"][2:], rtol=0.2)


def test_a_wrist_without_its_coupling_is_found_out():
    """Without the terms of the shared motor the torques of both joints are predicted worse: the log knows of them."""
    log = tx40.log()
    coupled = tx40.found()
    from closedloop.studies.identify.identify import identify

    plain = identify(log, DATA / "tx40.urdf", cutoff=tx40.CUTOFF)
    assert (plain.held_out[4:] > 1.5 * coupled.held_out[4:]).all()
    assert np.allclose(plain.held_out[:3], coupled.held_out[:3], rtol=0.1)


@cache
def judged_of(robot):
    """Judge a robot once for all tests."""
    return robot.judge()


@pytest.mark.parametrize("robot", [ur10, kr300])
def test_torques_that_were_not_fitted_are_predicted(robot):
    """Every joint within 10 % relative RMS."""
    judged = judged_of(robot)
    assert judged.faults == []
    assert max(judged.numbers["torque"]["held_out_error"]) < 0.1
    json.dumps(judged.numbers, allow_nan=False)


def test_no_negative_drive_inertia_is_given():
    """Where the UR10's log gives one, beyond its interval, there is a reason in its place."""
    judged = judged_of(ur10)
    values = judged.numbers["drive_inertia"]["value"]
    assert all(x is None or x > -0.5 for x in values)
    assert values[3:5] == [None, None]
    assert sum("cannot be" in note for note in judged.notes) >= 2


def test_forward_a_simulated_robot_stays_near_its_log():
    """A tenth of a second at least by the torques alone; with a weak spring beside them within 50 mrad, all joints."""
    judged = judged_of(kr300)
    told = judged.numbers["forward"]
    assert min(told["seconds"]) > 0.1
    assert max(told["held_error_rad"]) < 0.05
    assert max(told["feedback_over_torque"]) < 0.3


def test_both_encoders_of_a_kr300_tell_the_stiffness_of_two_axes():
    """Axes 2 and 3 within 15 %, axis 1 not, and one delay between the encoders of all three."""
    found = judged_of(kr300).numbers["stiffness"]
    assert found["value"][0] is None
    for value, (low, high) in list(zip(found["value"], found["interval"], strict=True))[1:]:
        assert 1e6 < low < value < high < 1e8
        assert (high - low) / 2.0 < 0.25 * value
    np.testing.assert_allclose(found["encoder_delay_s"], 3.0e-3, rtol=0.05)
    assert min(found["explained"]) > 0.99


def test_every_file_has_its_licence_and_its_source():
    """Each data file is named in the README beside it, with a licence that is there; together they leave room."""
    text = (DATA / "README.md").read_text(encoding="utf-8")
    files = [file for file in DATA.iterdir() if file.suffix in (".npz", ".urdf")]
    assert files
    for file in files:
        assert f"`{file.name}`" in text
        assert (DATA / f"LICENSE.{file.stem.removesuffix('_A').removesuffix('_B')}").exists() or (
            DATA / f"LICENSE.{file.stem.removesuffix('_log')}_log"
        ).exists()
    assert sum(file.stat().st_size for file in files) < 6e6


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["panda"], "no robot 'panda'"),
        (["tx40", "ur10", "--data", "x"], "name the one robot"),
        (["tx40", "--data", "no_such.npz"], "No such file"),
        (["tx40", "--data", str(DATA / "README.md")], "is no .npz file"),
        (["tx40", "--data", str(DATA / "ur10_log.npz")], "has no column 'motor_position'"),
        (["tx40", "--json", "no_folder/x.json"], "--json no_folder"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(words, says, capsys):
    """Exit status 2, a line on standard error."""
    assert main(words) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_a_file_in_the_same_format_may_take_the_place_of_the_log(tmp_path):
    """With positions in degrees the log is refused, as a user's would be."""
    with np.load(DATA / "tx40_log.npz") as shipped:
        turned = {name: shipped[name] for name in shipped}
    turned["motor_position"] = np.rad2deg(turned["motor_position"])
    np.savez(tmp_path / "mine.npz", **turned)
    with pytest.raises(ModelError, match=r"mine.npz: joint joint_1 reaches .*: angles look like degrees"):
        tx40.judge(Path(tmp_path / "mine.npz"))


@pytest.mark.parametrize(
    ("name", "low", "high", "given"),
    [("dry_J1", -2, -1, False), ("dry_J1", -2, 1, True), ("dry_J1", 1, 2, True), ("offset_J1", -2, -1, True)],
)
def test_what_is_surely_negative_and_cannot_be_is_not_given(name, low, high, given):
    """Friction below zero with its whole interval; an offset may be."""
    e = Estimate(name, 0.5 * (low + high), low, high, "N m", name, "")
    assert (possible(e) == e) == given
    assert ("which cannot be" in possible(e).why) != given
