"""The pictures of a film: which bodies are drawn, where, and what is drawn over them."""

import numpy as np
import pytest

import closedloop as cl
from closedloop.figures.scene.scene import ARROWS, scene_of
from closedloop.figures.scene.solids import Ghost
from closedloop.lab.animate import Picture, nearest_triangles
from closedloop.lab.curves import main_panel


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


def test_a_robot_of_meshes_is_drawn_as_its_meshes():
    """All triangles of an arm of many are drawn, in the colours of its shapes, where its links are."""
    run = cl.simulate(cl.load_scenario("panda_slide", {"time.duration": 0.002}))
    picture = picture_of(run)
    assert len(picture._solid._faces) == sum(len(shape.faces) for shape in picture.scene.shapes) > 10_000
    seen = picture._solid.seen(picture._space, *picture.scene.joint_places(0))
    solid = seen[seen[..., 3] == 255].astype(int)
    assert len(solid) > 5000
    assert np.median(solid[:, 0]) > 180  # white links
    assert np.count_nonzero(solid[:, :3].max(axis=1) < 100) > 100  # black covers


def test_the_nearest_triangle_is_seen_wherever_two_overlap():
    """Two that pass through each other: each is seen where it is nearer, in whatever order they are drawn."""
    across = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0]])
    near_left, near_right = (np.column_stack([across, depth]) for depth in ([0.0, 40.0, 0.0], [20.0, 20.0, 20.0]))
    pictures = []
    for order in ([0, 1], [1, 0]):
        seen = nearest_triangles(np.array([near_left, near_right])[order], (40, 40))
        pictures.append(np.append(order, -1)[seen])
    assert np.array_equal(*pictures)
    i, j = np.mgrid[:40, :40] + 0.5
    covered = i + j <= 40.0
    assert np.array_equal(pictures[0] >= 0, covered)
    assert np.array_equal(pictures[0] == 0, covered & (j < 20.0))


def test_a_picture_without_curves_is_space_alone():
    """It has the colours of its arrows, and nothing is cut off at its edges."""
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.1}))
    scene = scene_of(run)
    pixels = Picture(scene, None).pixels(len(run) - 1)[..., :3]
    for kind in ("contact force", "commanded force"):
        assert np.any(np.all(np.abs(pixels - 255.0 * np.array(ARROWS[kind])) < 2.0, axis=-1))
    edges = (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])
    assert all(np.all(edge == 255) for edge in edges)
