"""`at = "collision"`: what of each collision shape touches, and what is said where it cannot be."""

import numpy as np
import pytest
import trimesh

import closedloop as cl
import robot_models
from closedloop.base.errors import ScenarioError
from closedloop.figures.scene.solids import robot_shapes
from closedloop.scenario.arm import hulls_taken, parts_of, with_collision_shapes
from robot_models.collision import CollisionShape, collision_shapes

GEOMS = """<mujoco><worldbody><body name="body"><freejoint/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
<geom type="box" size="0.1 0.2 0.3" pos="1 0 0" euler="0 0 90"/><geom type="sphere" size="0.4" pos="0 1 0"/>
<geom type="capsule" size="0.05" fromto="0 0 0 0 0 0.5"/><geom type="cylinder" size="0.1 0.2" pos="0 0 1"/>
<geom type="ellipsoid" size="0.1 0.2 0.3"/><geom type="box" size="1 1 1" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""
URDF = """<robot name="mesh"><link name="base"/><link name="body"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="{file}" scale="2 2 2"/></geometry></collision></link>
<joint name="free" type="floating"><parent link="base"/><child link="body"/></joint></robot>"""


def scenario(tmp_path, text, name="body.xml", **contact):
    """Return a scenario of a body from this text, and its model."""
    (tmp_path / name).write_text(text)
    keys = {"link": "body", "at": "collision", "through": [0, 0, -5.0]} | contact
    lines = "".join(f"{key} = {value!r}\n".replace("'", '"') for key, value in keys.items())
    (tmp_path / "scenario.toml").write_text(
        f'[robot]\nmodel = "{name}"\n[[contact]]\nname = "part"\nfriction = 0.3\n{lines}'
    )
    return cl.load_scenario(tmp_path / "scenario.toml"), robot_models.load(str(tmp_path / name))


def test_each_shape_becomes_what_of_it_can_touch(tmp_path):
    """Corners, a ball, two balls, edges and feet, an ellipsoid; nothing of what has no contact."""
    asked, model = scenario(tmp_path, GEOMS)
    found = with_collision_shapes(asked, model).contact
    assert [section.name for section in found] == [f"part {k}" for k in range(1, 21)]
    assert all(section.friction == 0.3 for section in found)
    corners = np.array([section.at for section in found[:8]])
    np.testing.assert_allclose(np.abs(corners - [1, 0, 0]), np.tile([0.2, 0.1, 0.3], (8, 1)), atol=1e-15)
    assert len(np.unique(corners.round(9), axis=0)) == 8
    assert (found[8].at, found[8].radius) == ((0.0, 1.0, 0.0), 0.4)
    assert sorted(section.at[2] for section in found[9:11]) == [0.0, 0.5]
    assert [section.radius for section in found[9:11]] == [0.05, 0.05]
    assert [len(section.half_axes) for section in found[11:13]] == [2, 2]
    assert sorted(section.at[2] for section in found[11:13]) == [0.8, 1.2]
    feet = np.array([section.at for section in found[13:19]])
    np.testing.assert_allclose(np.hypot(feet[:, 0], feet[:, 1]), 0.1)
    np.testing.assert_allclose(np.array(found[19].half_axes), np.diag([0.1, 0.2, 0.3]), atol=1e-15)
    run = cl.prepare(asked)  # and it is what is prepared
    assert len(run.scenario.contact) == 20
    again = cl.load_scenario
    (tmp_path / "again.toml").write_text(run.scenario.to_toml())
    assert again(tmp_path / "again.toml").contact == found


@pytest.mark.parametrize("kind", ["box", "sphere", "capsule", "cylinder", "ellipsoid"])
def test_the_lowest_part_is_as_low_as_the_shape(kind):
    """Against points of the surface of each shape, drawn at random: none is below the parts, and one comes near."""
    rng = np.random.default_rng(0)
    size = np.array([0.1, 0.2, 0.3])
    x = rng.normal(size=(200_000, 3))
    x /= np.linalg.norm(x, axis=1)[:, None]
    h = rng.choice([-0.2, 0.2], size=len(x))[:, None] * [[0, 0, 1]]
    points = {
        "box": rng.choice([-1, 1], size=x.shape) * size, "sphere": 0.1 * x, "capsule": 0.1 * x + h,
        "cylinder": 0.1 * x / np.hypot(x[:, 0], x[:, 1])[:, None] * [1, 1, 0] + h, "ellipsoid": size * x,
    }[kind]  # fmt: skip
    parts = parts_of(CollisionShape(kind, size, np.eye(4), np.zeros((0, 3))), "")
    for n in rng.normal(size=(5, 3)):
        n = n / np.linalg.norm(n)
        halves = [np.array(part.get("half_axes") or np.zeros((1, 3))) for part in parts]
        low = [
            n @ part["at"] - np.linalg.norm(H @ n) - part.get("radius", 0)
            for part, H in zip(parts, halves, strict=True)
        ]
        assert min(low) == pytest.approx(np.min(points @ n), abs=1e-3)
        assert min(low) <= np.min(points @ n) + 1e-12


def test_a_mesh_touches_with_the_corners_of_its_hull_and_a_hollow_one_is_told(tmp_path):
    """A tetrahedron with a dent: four corners touch, and how deep the dent is is said."""
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.1, 0.1, 0.1]]
    faces = [[1, 2, 3], [1, 3, 2], [1, 2, 4], [1, 4, 3], [2, 5, 4], [5, 3, 4], [2, 3, 5]]
    text = "".join(f"v {' '.join(map(str, v))}\n" for v in corners)
    (tmp_path / "dent.obj").write_text(text + "".join(f"f {' '.join(map(str, f))}\n" for f in faces))
    asked, model = scenario(tmp_path, URDF.format(file="dent.obj"), "body.urdf")
    found = {section.at for section in with_collision_shapes(asked, model).contact}
    assert found == {(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0)}
    (line,) = hulls_taken(asked, model)
    assert line == "contact 'part': the mesh 'dent.obj' is not convex: its convex hull touches"


def test_a_mesh_of_an_mjcf_touches_as_its_convex_hull(tmp_path):
    """A box as a mesh, off its link's origin and turned: its eight corners; a ball has as many as may touch."""
    box, ball = trimesh.creation.box((0.2, 0.4, 0.6)), trimesh.creation.icosphere(3, 0.1)
    box.export(tmp_path / "box.stl")
    ball.export(tmp_path / "ball.stl")
    text = """<mujoco><asset><mesh name="box" file="box.stl" scale="2 1 1"/><mesh name="ball" file="ball.stl"/>
    <mesh name="drawn" file="gone.stl"/></asset><worldbody><body name="body"><freejoint/>
    <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><geom type="mesh" mesh="box" pos="1 0 0" euler="0 0 90"/>
    <geom type="mesh" mesh="drawn" contype="0" conaffinity="0"/>{}</body></worldbody></mujoco>"""
    asked, model = scenario(tmp_path, text.format(""))
    found = np.array([section.at for section in with_collision_shapes(asked, model).contact])
    np.testing.assert_allclose(np.sort(np.unique(found.round(6), axis=0), axis=0)[0], [0.8, -0.2, -0.3])
    assert len(found) == 8
    np.testing.assert_allclose(np.abs(found - [1.0, 0.0, 0.0]), np.tile([0.2, 0.2, 0.3], (8, 1)), atol=1e-7)
    assert not hulls_taken(asked, model)
    (drawn,) = robot_shapes(model, "body")
    np.testing.assert_allclose(np.abs(drawn.vertices - [1.0, 0.0, 0.0]), np.tile([0.2, 0.2, 0.3], (8, 1)), atol=1e-6)
    assert drawn.faces.shape == (12, 3)
    asked, model = scenario(tmp_path, text.format('<geom type="mesh" mesh="ball"/>'))
    assert len(with_collision_shapes(asked, model).contact) == 8 + 64
    assert "convex hulls of meshes have 64 corners at most, chosen by MuJoCo: ball" in model.warnings
    (tmp_path / "ball.stl").unlink()
    (without,) = [line for line in robot_models.load(str(tmp_path / "body.xml")).warnings if "meshes" in line]
    assert without.startswith("meshes of the file are not read as shapes: ")
    assert "ball.stl" in without


def test_a_flat_part_with_a_notch_is_told_too(tmp_path):
    """An L, all of whose corners are on its two faces; one of its parts is convex."""
    boxes = [trimesh.creation.box(bounds=[[0, 0, 0], top]) for top in ([2, 1, 0.5], [1, 2, 0.5])]
    boxes[0].export(tmp_path / "plate.obj")
    trimesh.util.concatenate(boxes).export(tmp_path / "L.obj")
    told = {
        name: hulls_taken(*scenario(tmp_path, URDF.format(file=f"{name}.obj"), "body.urdf")) for name in ("L", "plate")
    }
    assert (len(told["L"]), told["plate"]) == (1, [])


CUBE = trimesh.creation.box((1, 1, 1))
NAN = np.where(np.arange(24).reshape(8, 3) == 4, np.nan, CUBE.vertices)
DEGENERATE = {
    "no byte": (None, "has no triangles"),
    "no triangle": (CUBE.vertices[:0], "has no triangles"),
    "a plate without thickness": (CUBE.vertices * [1, 1, 0], "is flat: give the mesh of a solid, or at as a list"),
    "a rod without thickness": (CUBE.vertices * [1, 0, 0], "is flat"),
    "one point": (CUBE.vertices * 0, "is 0 m large"),
    "a corner that is NaN": (NAN, "has a vertex, or a scale, that is no finite number"),
    "every corner NaN": (CUBE.vertices * np.nan, "no finite number"),
    "1e30 m": (CUBE.vertices * 1e30, "is 2e+30 m large and reaches 1e+30 m: it must be"),
    "1e-30 m": (CUBE.vertices * 1e-30, "is 2e-30 m large"),
    "1e12 m away": (CUBE.vertices + 1e12, "reaches 2e+12 m"),
}


@pytest.mark.parametrize(("vertices", "said"), DEGENERATE.values(), ids=DEGENERATE)
@pytest.mark.parametrize("form", ["obj", "stl"])
def test_a_degenerate_mesh_is_refused_in_a_line(tmp_path, form, vertices, said):
    """It can touch nothing, or a reader would leave out what is no number; beside a contact it is left alone."""
    mesh = b"" if vertices is None else text_of_mesh(form, vertices).encode()
    (tmp_path / f"part.{form}").write_bytes(mesh)
    text = URDF.format(file=f"part.{form}")
    with pytest.raises(cl.ClosedLoopError) as caught:
        cl.prepare(scenario(tmp_path, text, "body.urdf")[0])
    assert f"mesh 'part.{form}'" in str(caught.value)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    scenario(tmp_path, text, "body.urdf", at=[0, 0, 0])
    beside = cl.simulate(cl.load_scenario(tmp_path / "scenario.toml", {"time.duration": 0.002}))
    assert beside.summary()["clearance"] is None


def text_of_mesh(form, vertices):
    """Return a cube's triangles between other corners, as text."""
    faces = CUBE.faces if len(vertices) else ()
    if form == "obj":
        lines = ["v {} {} {}".format(*each) for each in vertices]
        return "\n".join(lines + ["f {} {} {}".format(*(face + 1)) for face in faces]) + "\n"
    facets = ("".join("vertex {} {} {}\n".format(*vertices[i]) for i in face) for face in faces)
    return (
        "solid x\n"
        + "".join(f"facet normal 0 0 1\nouter loop\n{each}endloop\nendfacet\n" for each in facets)
        + "endsolid\n"
    )


@pytest.mark.parametrize(
    ("file", "scale", "said"),
    [
        ("circle.stl", "1 1 1", "'circle.stl', is not there"),
        ("x" * 300 + ".stl", "1 1 1", ".stl', is not there"),
        ("folder.stl", "1 1 1", "'folder.stl', is not there"),
        ("cube.stl", "1 1", "the scale of its collision mesh 'cube.stl' has 2 numbers: it must have three"),
        ("cube.stl", "nan 1 1", "no finite number"),
        ("cube.stl", "1 0 1", "is flat"),
    ],
)
def test_a_mesh_that_no_file_or_scale_gives_is_refused_in_a_line(tmp_path, file, scale, said):
    """Links that lead in a circle, names that no file has."""
    (tmp_path / "circle.stl").symlink_to("circle.stl")
    (tmp_path / "folder.stl").mkdir()
    CUBE.export(tmp_path / "cube.stl")
    with pytest.raises(cl.ClosedLoopError) as caught:
        cl.prepare(scenario(tmp_path, URDF.format(file=file).replace("2 2 2", scale), "body.urdf")[0])
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


WRONG = [
    ({"at": "colision"}, "contact[0].at = 'colision': must be a point, a list of points, or \"collision\""),
    ({"radius": 0.1}, 'at = "collision" takes the shapes of the link: radius must be left out'),
    ({"at": [0, 0, 0], "half_axes": [[1, 0, 0]]}, "half_axes must be two or three vectors in different directions"),
    ({"at": [0, 0, 0], "half_axes": [[1, 0, 0], [2, 0, 0]]}, "half_axes must be two or three vectors"),
    ({"through": [0, 0, 0.5]}, "inside the surface: start it outside, or move the surface with through"),
    ({"at": [0, 0, 0], "radius": 0.2, "through": [0, 0, -0.1]}, "the shape starts 0.1 m inside the surface: start it"),
    ({"link": "boddy"}, "contact 'part': link: body has no frame 'boddy': did you mean 'body'?"),
]  # fmt: skip


@pytest.mark.parametrize(("contact", "said"), WRONG)
def test_what_is_wrong_is_said_in_a_line(tmp_path, contact, said):
    """Which key, and what would be right."""
    with pytest.raises(ScenarioError) as caught:
        cl.prepare(scenario(tmp_path, GEOMS, **contact)[0])
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_link_without_shapes_and_a_shape_on_a_curved_surface_are_refused(tmp_path):
    """A body that has none; an ellipsoid on a sphere."""
    bare = "\n".join(line for line in GEOMS.split("\n") if "<geom" not in line)
    with pytest.raises(ScenarioError, match="'body' of body has no collision shape: give at as a point or a list"):
        cl.prepare(scenario(tmp_path, bare)[0])
    curved = {"surface": {"kind": "sphere", "radius": 1.0}}
    asked, _ = scenario(tmp_path, GEOMS, at=[0, 0, 0], half_axes=[[1, 0, 0], [0, 1, 0]])
    data = asked.model_dump(exclude_none=True)
    data["contact"] = [data["contact"][0] | curved]
    with pytest.raises(ScenarioError, match="half_axes: must be left out with a surface that is curved or moves"):
        cl.prepare(type(asked).model_validate(data))


def test_shapes_of_a_link_are_in_its_frame():
    """A capsule given by its ends is where these are."""
    model = robot_models.load("gripper")
    assert collision_shapes(model, "block") == []
    (box,) = collision_shapes(model, "block", visual=True)
    np.testing.assert_array_equal(box.size, [0.03, 0.03, 0.03])
