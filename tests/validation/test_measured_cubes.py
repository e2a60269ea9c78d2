"""Tosses of a cube: what is read, flights, errors, the engines on some tosses, and the command."""

import json
import threading

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from closedloop.base.errors import ModelError
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.scene.solids import OPACITY
from closedloop.lab.drawn import robot_message
from validation.measured.__main__ import main
from validation.measured.cubes import figures
from validation.measured.cubes.__main__ import main as command
from validation.measured.cubes.comparing import (
    BUDGET,
    TOSSES,
    Tried,
    against,
    corner_impacts,
    engines,
    fit,
    fits,
    fitted_start,
    flight,
    geometry,
    held_out,
    impacts_before,
    interval,
    training,
)
from validation.measured.cubes.engine import (
    FALL,
    RATE,
    SIDE,
    CubeEngine,
    Parameter,
    Toss,
    errors,
    first_row,
    mean_errors,
    read,
)
from validation.measured.judged import DATA


@pytest.fixture(scope="module")
def tosses():
    """All tosses that come with the package."""
    return read()


def written(path, tosses):
    """Write tosses as a file of a user."""
    states = np.concatenate([toss.states for toss in tosses])
    rows = np.array([len(toss.states) for toss in tosses])
    np.savez(path, state=states, rows=rows, toss=np.array([toss.number for toss in tosses]))
    return path


def flying(rows=30, seed=0):
    """Return a toss that has not come down: a parabola, and a constant angular velocity."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / RATE
    first, spin = Rotation.random(rng=rng), rng.normal(size=3) * 4.0
    turned = Rotation.from_rotvec(np.outer(t, spin)) * first
    velocity = rng.normal(size=3)
    place = np.array([0.0, 0.0, 3.0]) + np.outer(t, velocity) - np.outer(t * t, [0, 0, 0.5 * FALL])
    backwards = velocity - np.outer(t - 0.5 / RATE, [0, 0, FALL])  # of a row and the one before it
    states = np.hstack([turned.as_quat(scalar_first=True), place, turned.inv().apply(spin), backwards])
    return Toss(0, states), velocity


def test_the_tosses_are_those_of_a_cube_that_comes_to_rest(tosses):
    """400 of them; each ends on a face, half a side above the board, and 40 are for fitting."""
    assert len(tosses) == 400
    ends = np.array([toss.states[-1] for toss in tosses])
    assert np.abs(ends[:, 6] / (SIDE / 2.0) - 0.978).max() < 0.05
    upright = np.abs(Rotation.from_quat(ends[:, :4], scalar_first=True).as_matrix()[:, 2, :]).max(axis=1)
    assert upright.min() > 0.99
    assert len(training(tosses)) == TOSSES
    assert len(held_out(tosses, tosses)) == 400 - TOSSES
    assert sum(path.stat().st_size for path in DATA.iterdir()) < 6e6


def test_a_velocity_of_the_log_is_half_a_row_old(tosses):
    """Without it the vertical velocities of first rows are too high, by what gravity takes in half a row."""
    starts = [(fitted_start(toss)[12], toss.states[0, 12], first_row(toss)[12]) for toss in tosses]
    slope, raw, corrected = np.array(starts).T
    error = (slope - raw).std() / np.sqrt(len(tosses))
    assert abs((slope - raw).mean()) > 20.0 * error
    assert abs((slope - corrected).mean()) < 4.0 * error


def test_a_flight_is_fitted_exactly():
    """The start of a toss without noise; with noise it is nearer than the first row's."""
    toss, velocity = flying()
    assert flight(toss) == 30
    start = fitted_start(toss)
    np.testing.assert_allclose(start[10:], velocity, atol=1e-9)
    np.testing.assert_allclose(start[:10], toss.states[0, :10], atol=1e-9)
    np.testing.assert_allclose(first_row(toss), start, atol=1e-9)
    rng = np.random.default_rng(1)
    noisy = Toss(
        0, toss.states + rng.normal(size=toss.states.shape) * ([1e-3] * 4 + [2e-4] * 3 + [0.2] * 3 + [0.03] * 3)
    )
    better = np.abs(fitted_start(noisy)[7:] - start[7:]).max()
    assert better < 0.5 * np.abs(first_row(noisy)[7:] - start[7:]).max()


def test_a_centre_of_mass_beside_the_middle_is_found():
    """Of simulated flights, exact; without it, zero. On a board that leans by 2 mrad the slope is found too."""
    for offset in ([0.002, -0.001, 0.0005], [0.0, 0.0, 0.0]):
        flights = []
        for seed in range(6):
            toss, _ = flying(seed=seed)
            axes = Rotation.from_quat(toss.states[:, :4], scalar_first=True)
            toss.states[:, 4:7] -= axes.apply(offset)
            flights.append(toss)
        found = geometry(flights)
        np.testing.assert_allclose(found.centre, offset, atol=1e-9)
        np.testing.assert_allclose(found.gravity, [0.0, 0.0, -FALL], atol=1e-6)
    resting = []
    for x, y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.2)):
        toss, _ = flying()
        toss.states[-8:, 4:7] = [x, y, 0.05 + 0.002 * x]
        resting.append(toss)
    np.testing.assert_allclose(geometry(resting).slope, [0.002, 0.0], atol=1e-9)


def test_errors_are_lengths_and_angles(tosses):
    """A path that is moved by a tenth of a side and turned by ten degrees, with the other sign of the quaternion."""
    toss = tosses[0]
    exact = np.hstack([toss.states[:, 4:7], toss.states[:, :4]])
    turned = Rotation.from_quat(exact[:, 3:], scalar_first=True) * Rotation.from_euler("x", 10, degrees=True)
    moved = np.hstack([exact[:, :3] + [0.0, 0.1 * SIDE, 0.0], -turned.as_quat(scalar_first=True)])
    position, rotation = errors(toss, moved)
    np.testing.assert_allclose(position, 10.0)
    np.testing.assert_allclose(rotation, 10.0, atol=1e-5)
    means = mean_errors([toss, toss], [moved, moved[:-1]])
    np.testing.assert_allclose(means[0], 10.0, atol=1e-5)
    assert np.isnan(means[1]).all()
    counted = impacts_before(toss)
    assert counted[0] == 0
    assert counted[flight(toss)] == 1
    assert (np.diff(counted) >= 0).all()
    assert counted[-1] > 1


class Shifted(CubeEngine):
    """An engine whose errors are known: it moves the measured path, by its parameter from 2 cm."""

    name, what = "shifted", "moves what was measured"
    parameters = (Parameter("by", "m", 0.01, 0.001, 1.0), Parameter("side", "m", 0.1, 0.09, 0.11))

    def simulate(self, values, starts, tosses):
        """Return the measured paths, moved."""
        by = [values[0] - 0.02, values[1] - 0.1, 0.0]
        return [np.hstack([toss.states[:, 4:7] + by, toss.states[:, :4]]) for toss in tosses]


def test_a_fit_finds_what_is_best(tosses):
    """Of an engine that is right at 2 cm, within the budget."""
    found = fit(Shifted(), tosses[:3])
    assert found.simulations <= BUDGET
    np.testing.assert_allclose(found.values, [0.02, 0.1], rtol=0.05)


def test_the_fitted_values_are_inside_their_bounds():
    """Of all engines, found within the budget by `python -m validation.measured.cubes --fit`."""
    for engine in engines():
        if engine.name not in fits():
            continue
        known = fits()[engine.name]
        assert known["simulations"] <= BUDGET
        for p in engine.parameters:
            assert p.low < known["values"][p.name] < p.high, p.name


def test_engines_fly_alike(tosses):
    """Before the first impact all engines fall and turn alike, but for their integrators."""
    some = [Toss(toss.number, toss.states[: flight(toss) - 1]) for toss in tosses[:4]]
    starts = [first_row(toss) for toss in some]
    paths = [engine.simulate([p.start for p in engine.parameters], starts, some) for engine in engines()]
    for other in paths[1:]:
        for ours, theirs in zip(paths[0], other, strict=True):
            assert ours.shape == theirs.shape
            np.testing.assert_allclose(ours[:, :3], theirs[:, :3], atol=2e-4)
            assert np.abs(np.abs(np.einsum("ij,ij->i", ours[:, 3:], theirs[:, 3:])) - 1.0).max() < 1e-4


def test_an_interval_covers_the_mean():
    """95 % of bootstrap intervals hold the mean that samples are drawn from."""
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        low, high = interval(rng.normal(10.0, 3.0, size=80))
        inside += low <= 10.0 <= high
    assert 0.90 <= inside / 200 <= 0.985


def test_tosses_of_a_user_are_judged(tosses, tmp_path, capsys):
    """All are completed, near the measured ones; tosses that were fitted to are left out."""
    some = tosses[:12]
    path = written(tmp_path / "some.npz", some)
    status = main(["cubes", "--data", str(path), "--json", str(tmp_path / "out.json")])
    told = capsys.readouterr().out
    found = json.loads((tmp_path / "out.json").read_text())
    ours = found["closedloop"]
    assert ours["completed"] == ours["tosses"] == len(held_out(some, tosses)) == 10
    assert 3.0 < ours["position_percent"] < 25.0
    assert 1.0 < ours["rotation_degrees"] < 60.0
    low, high = ours["position_percent_interval"]
    assert low < ours["position_percent"] < high
    assert "10/10" in told
    assert "published" in told
    assert status == (1 if found["differs"] else 0)
    first = ours["over_impacts"]
    assert first[0][1] < first[-1][1]  # errors grow with impacts
    assert [row[0] for row in first] == sorted(row[0] for row in first)


def test_errors_against_another_engine_are_paired():
    """An engine whose errors are twice as large is 50 % above, with no doubt about it."""
    means = np.random.default_rng(0).uniform(5.0, 15.0, (10, 2))
    ours, theirs = (Tried(Shifted(), [], k * means, k * means, 0.1) for k in (1.0, 2.0))
    found = against(ours, theirs)["position"]
    assert found["below"] == pytest.approx(0.5)
    np.testing.assert_allclose(found["interval"], 0.5)


def test_a_file_that_has_no_tosses_is_refused(tosses, tmp_path):
    """Missing columns, wrong sums of rows, quaternions that are none, units, and tosses that were fitted to."""
    states = tosses[1].states
    cases = [
        ({"state": states}, "no column 'rows'"),
        ({"state": states[:, :5], "rows": [len(states)], "toss": [0]}, "must be"),
        ({"state": states, "rows": [3], "toss": [0]}, "their sum must be"),
        ({"state": 2.0 * states, "rows": [len(states)], "toss": [0]}, "unit quaternion"),
        ({"state": states * ([1.0] * 10 + [1e3] * 3), "rows": [len(states)], "toss": [0]}, "velocity"),
    ]
    for columns, expected in cases:
        np.savez(tmp_path / "wrong.npz", **{name: np.asarray(x) for name, x in columns.items()})
        with pytest.raises(ModelError, match=expected):
            read(tmp_path / "wrong.npz")
    from validation.measured.cubes import judge

    with pytest.raises(ModelError, match="every toss is one that the engines were fitted to"):
        judge(written(tmp_path / "known.npz", training(tosses)[:2]))


def test_single_corners_bounce_and_slide_as_the_engines_are_fitted(tosses):
    """Their restitution and friction need no engine."""
    impacts = corner_impacts(tosses)
    assert len(impacts) > 100
    e = np.array([-x.after / x.before for x in impacts])
    ratio = np.array([x.ratio for x in impacts])
    values = fits()["closedloop"]["values"]
    assert abs(e.mean() - values["restitution"]) < 0.05
    assert abs(ratio.mean() - values["friction"]) < 0.05
    assert all(x.before < 0.0 < x.after for x in impacts)


def test_a_film_shows_a_toss_beside_the_measured_one(tosses, tmp_path, monkeypatch, capsys):
    """A page is written for each frame; the ghost is where the log has the cube. A number that is none is one line."""
    monkeypatch.setattr(figures, "SPEED", 4.0)
    assert command(["--film", str(tosses[3].number), str(tmp_path / "toss.gif")]) == 0
    assert (tmp_path / "toss.gif").read_bytes()[:3] == b"GIF"
    ghost = figures.measured(tosses[3])
    np.testing.assert_array_equal(ghost.place(5 / RATE)[1], tosses[3].states[5, 4:7])
    for words in (["--film", "4000", "a.gif"], ["--film", "x", "a.gif"], ["--film", "3", "a.avi"]):
        assert command(words) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_lab_shows_a_toss_beside_the_measured_one(tosses, capsys):
    """Whatever friction is set; another scenario has no measured cube. A number that is none is one line."""
    lab, shown = figures.opened(tosses[3]), threading.Event()
    try:
        lab.after_show.append(lambda answer: shown.set())
        lab.changed("contact.0.friction", 0.05)
        assert shown.wait(60.0)
        assert lab.run.scenario.contact[0].friction == 0.05
        assert [ghost.name for ghost in lab.ghosts] == ["measured"]
        lab.open("planar2_drop")
        assert lab.ghosts == ()
    finally:
        lab.close()
    assert command(["--lab", "4000"]) == command(["--lab", "x"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_the_page_of_the_lab_has_the_ghosts_of_a_run(tosses):
    """The shape of each has a place of its own, which is where the log has the cube at that instant."""
    scene = scene_of(figures.simulated(tosses[3]), [figures.as_fitted(tosses[3])])
    ghost = [shape for shape in robot_message(scene)["shapes"] if shape["kind"] == "measured"]
    assert [shape["opacity"] for shape in ghost] == [OPACITY]
