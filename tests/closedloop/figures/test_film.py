"""The pictures of a film: which bodies are drawn, where, and what is drawn over them."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.scene.scene import ARROWS, scene_of
from closedloop.figures.scene.solids import Ghost
from closedloop.lab import film_picture
from closedloop.lab.curves import main_panel
from closedloop.lab.film_picture import Picture


def picture_of(run, ghosts=()):
    """Return the picture of a run."""
    return Picture(scene_of(run, ghosts), main_panel(run))


@pytest.fixture(scope="module")
def thrown():
    """Return a cube that flies, without an arm."""
    return cl.simulate(cl.load_scenario("cube_toss", {"time.duration": 0.2, "start.v": [0, 0, 0, 0, 0, 0]}))


def test_a_film_draws_free_bodies(thrown):
    """The cube is drawn, and falls: without its shape the picture would have only the line that it leaves."""
    picture = picture_of(thrown)
    places = []
    for row in (0, len(thrown) - 1):
        pixels = picture.pixels(row)
        blue = np.argwhere(pixels[:, :480, 2].astype(int) - pixels[:, :480, 0] > 60)
        assert len(blue) > 400
        places.append(blue.mean(axis=0))
    assert places[1][0] > places[0][0] + 20


def test_a_ghost_is_drawn_where_it_is(thrown):
    """One metre per half second along x, half way between its rows; its colour is in the picture."""
    shape = scene_of(thrown).shapes[0]
    turned = np.array([[1.0, 0.0, 0.0, 0.0], [np.cos(0.5), 0.0, 0.0, np.sin(0.5)]])
    ghost = Ghost("measured", (shape,), np.array([0.0, 0.2]), turned, np.array([[0, 0, 0.3], [0.4, 0, 0.3]]))
    axes, origin = ghost.place(0.1)
    np.testing.assert_allclose(origin, [0.2, 0.0, 0.3])
    np.testing.assert_allclose(axes[:2, 0], [np.cos(0.5), np.sin(0.5)])
    assert np.array_equal(ghost.place(-1.0)[1], [0, 0, 0.3])
    assert np.array_equal(ghost.place(9.0)[1], [0.4, 0, 0.3])
    with_it, without = (picture_of(thrown, ghosts) for ghosts in ((ghost,), ()))
    pictures = [picture.pixels(100)[80:, :480].astype(int) for picture in (with_it, without)]  # below the legend
    assert [np.count_nonzero(each[..., 0] - each[..., 2] > 40) > 400 for each in pictures] == [True, False]


def test_an_arm_of_many_triangles_is_a_line_and_the_body_is_not(monkeypatch):
    """The line goes to the tip, and not to the contacts of the body, whose joints start at the world's origin."""
    run = cl.simulate(cl.load_scenario("push_block", {"time.duration": 0.002}))
    scene = scene_of(run)
    assert scene.body_frames == {5, 6, 7, 8}
    line = film_picture.rods(scene, 0)
    assert np.nanmin(np.linalg.norm(line - run.position[0], axis=1)) < 1e-9
    block = run.q[0, 4:7]
    assert np.nanmin(np.linalg.norm(line - block, axis=1)) > 0.05
    monkeypatch.setattr(film_picture, "MOST_TRIANGLES", 100)
    picture = picture_of(run)
    assert len(picture._solid._faces) == 12
    assert picture.pixels(1).shape == (500, 1000, 4)


def test_faces_are_drawn_from_outside_and_from_far_to_near():
    """Of a cube three sides are seen, or fewer; the one nearest to the eye is drawn last."""
    run = cl.simulate(cl.load_scenario("cube_toss", {"time.duration": 0.002}))
    picture = picture_of(run)
    seen = picture._solid.seen(picture._space, *picture.scene.joint_places(0))
    assert 2 <= len(seen.corners) <= 6


def test_a_picture_without_curves_is_space_alone():
    """It has the colours of its arrows, and nothing is cut off at its edges."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.1}))
    scene = scene_of(run)
    pixels = Picture(scene, None).pixels(len(run) - 1)[..., :3]
    for kind in ("contact force", "commanded force"):
        assert np.any(np.all(np.abs(pixels - 255.0 * np.array(ARROWS[kind])) < 2.0, axis=-1))
    edges = (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])
    assert all(np.all(edge == 255) for edge in edges)
