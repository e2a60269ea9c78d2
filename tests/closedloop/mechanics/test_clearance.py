"""The least distance of a run: closed forms of boxes and balls that slide, and what is said where they pass through."""

import pytest

import closedloop as cl
from closedloop.record.clearance import clearance, passing_note

TWO = """<mujoco><option gravity="0 0 0"/><worldbody><body name="box"><joint name="x" type="slide" axis="1 0 0"/>
<geom type="box" size="0.1 0.1 0.1" mass="1"/><site name="tip"/></body>
<body name="ball" pos="0 0 1"><joint name="z" type="slide" axis="0 0 1"/><geom size="0.2" mass="1"/></body>
</worldbody></mujoco>"""


def passed(tmp_path, v, contacts="", duration=0.1):
    """Return the run of a box that moves along x and a ball that moves along z, and the least distance in it."""
    (tmp_path / "two.xml").write_text(TWO)
    text = f'[robot]\nmodel = "two.xml"\ntip = "tip"\n[start]\nv = {v}\n[time]\nduration = {duration}\nstep = 0.001\n'
    (tmp_path / "run.toml").write_text(text + contacts)
    run = cl.simulate(cl.load_scenario(tmp_path / "run.toml"), progress=False)
    return run, clearance(run)


def test_distance_of_a_box_and_a_ball(tmp_path):
    """1 − 0.1 − 0.2 m less the way of the ball, at the end, and no line: nothing passes through."""
    run, found = passed(tmp_path, [0.0, -3.0])
    assert found.distance == pytest.approx(0.7 - 0.3, abs=1e-9)
    assert found.time == pytest.approx(0.1)
    assert set(found.between) == {"box", "ball"}
    assert run.summary()["clearance"] == {**found._asdict(), "between": list(found.between)}
    assert passing_note(found._asdict()) == ""


def test_what_passes_through_is_said(tmp_path):
    """The ball is deepest in the box where its centre is in the box's, 0.1 + 0.2 m, half way."""
    run, found = passed(tmp_path, [0.0, -20.0])
    assert found.distance == pytest.approx(-0.3, abs=1e-6)
    assert found.time == pytest.approx(0.05)
    assert passing_note(run.summary()["clearance"]).startswith(
        "box passes through ball, up to 300 mm deep at t = 0.05 s"
    )


def test_the_deepest_row_is_found_between_those_that_are_looked_at(tmp_path):
    """The ball is in the middle of the box at 0.049 s: of 101 rows 25 are looked at, and then those on both sides."""
    for row in (47, 49):
        _, found = passed(tmp_path, [0.0, -1000.0 / row])
        assert found.time == pytest.approx(1e-3 * row)
        assert found.distance == pytest.approx(-0.3, abs=1e-6)


def test_long_shapes_far_apart_are_nearer_than_small_ones_side_by_side(tmp_path):
    """Two rods whose middles are 3.2 m apart end 0.2 m from each other; two balls are 0.9 m apart."""
    shapes = {"rod1": (0.0, "1.5 0.01 0.01"), "rod2": (3.2, "1.5 0.01 0.01")}
    text = "".join(
        f'<body name="{name}" pos="{x} 0 0"><joint type="slide"/><geom type="box" size="{size}" mass="1"/></body>'
        for name, (x, size) in shapes.items()
    )
    text += "".join(
        f'<body name="b{k}" pos="{k} 0 9"><joint type="slide"/><geom size="0.05" mass="1"/></body>' for k in range(2)
    )
    (tmp_path / "rods.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    (tmp_path / "run.toml").write_text('[robot]\nmodel = "rods.xml"\ntip = "b0"\n[time]\nduration = 0.01\n')
    found = clearance(cl.simulate(cl.load_scenario(tmp_path / "run.toml"), progress=False))
    assert found.between == ("rod1", "rod2")
    assert found.distance == pytest.approx(0.2, abs=1e-6)


def test_a_plane_that_another_link_touches(tmp_path):
    """The ball falls through the floor that the box touches; the box, which has the contact, is not compared."""
    floor = '[[contact]]\nname = "floor"\nlink = "box"\nat = [0, 0, -0.1]\nthrough = [0, 0, -0.1]\n'
    _, found = passed(tmp_path, [1.0, -14.0], floor)
    assert tuple(found.between) == ("ball", "the plane of 'floor'")
    assert found.distance == pytest.approx(1.0 - 1.4 - 0.2 + 0.1, abs=1e-12)


PEN = """<mujoco><option gravity="0 0 0"/><worldbody><body name="arm"><joint name="x" type="slide" axis="1 0 0"/>
<geom type="box" size="0.1 0.1 0.1" mass="1" pos="0 0 0.3"/><body name="pen"><joint name="z" type="slide" axis="0 0 1"/>
<geom size="0.02" mass="1"/><site name="tip"/></body></body>
<body name="tool" pos="0 0 HEIGHT"><joint name="down" type="slide" axis="0 0 1"/><geom size="0.05" mass="1"/></body>
</worldbody></mujoco>"""


def above_a_surface(tmp_path, height, radius=0.0):
    """Return the least distance of a run in which a ball falls with 2 m/s from a height, m, above the tip's centre."""
    (tmp_path / "pen.xml").write_text(PEN.replace("HEIGHT", str(height)))
    text = (
        '[robot]\nmodel = "pen.xml"\ntip = "tip"\n[surface]\nkind = "plane"\n[law]\nkind = "paper"\nkp = 0.0\n'
        "kd = 0.0\nforce = 1.0\n[start]\nv = [0.0, 0.0, -2.0]\n[time]\nduration = 0.1\nstep = 0.001\n"
    )
    (tmp_path / "run.toml").write_text(text)
    run = cl.simulate(cl.load_scenario(tmp_path / "run.toml", {"tool.radius": radius}), progress=False)
    return clearance(run)


@pytest.mark.parametrize("radius", [0.0, 0.02])
def test_a_link_that_comes_through_the_plane_of_the_surface_is_named(tmp_path, radius):
    """From 0.1 m above the tip to 0.1 m below, its ball 0.05 m deeper; a round tip is its radius above the plane."""
    found = above_a_surface(tmp_path, 0.1, radius)
    assert found.between == ("tool", "the surface")
    assert found.distance == pytest.approx(-0.15 + radius, abs=1e-9)


def test_a_link_that_begins_below_the_plane_of_the_surface_is_beside_it(tmp_path):
    """The plane has no edge in the file: wam4 reaches its surface from below, and nothing passes through anything."""
    assert "the surface" not in above_a_surface(tmp_path, -0.01).between
    for name in ("wam_slide", "wam_bounce", "panda_slide", "planar2_slide"):
        short = cl.simulate(cl.load_scenario(name, {"time.duration": 0.2}), progress=False)
        assert passing_note(short.summary()["clearance"]) == ""


def test_no_more_pairs_are_compared_than_the_most(tmp_path, monkeypatch):
    """Of five balls side by side ten pairs are apart: with at most two pairs the others are not looked at."""
    from closedloop.record import clearance as module

    balls = "".join(
        f'<body name="b{k}" pos="{k} 0 0"><joint type="slide"/><geom size="0.1" mass="1"/></body>' for k in range(5)
    )
    (tmp_path / "five.xml").write_text(f"<mujoco><worldbody>{balls}</worldbody></mujoco>")
    (tmp_path / "run.toml").write_text('[robot]\nmodel = "five.xml"\ntip = "b0"\n[time]\nduration = 0.01\n')
    run = cl.simulate(cl.load_scenario(tmp_path / "run.toml"), progress=False)
    compared, distance = set(), module._distance

    def noted(a, b, pose):
        compared.add((a.link, b.link))
        return distance(a, b, pose)

    monkeypatch.setattr(module, "_distance", noted)
    monkeypatch.setattr(module, "MOST_PAIRS", 2)
    assert clearance(run).distance == pytest.approx(0.8)
    assert compared == {("b0", "b1"), ("b0", "b2")}
