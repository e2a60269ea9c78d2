"""Bodies and robots in contact, beside MuJoCo's bare ``mj_step``.

All take steps of a millisecond with the same bodies, friction and start; ours records all columns. MuJoCo's contacts
give way and have no restitution: what falls or is tossed ends elsewhere in each, at rest on the floor as ours does.

Free bodies, a tossed cube, and towers of two to ten boxes at rest: in MuJoCo they are boxes, in ours their corners.
Ours steps once with located events, and once by time stepping, which is a scheme like MuJoCo's.

A box on four feet that slides and turns on a floor, or stands on it: a body on three prismatic and three revolute
joints, the feet are points of it; in MuJoCo they are spheres of a millimetre. Sliding, MuJoCo's box hops on them, and
most of its steps have one contact or none.

Many contacts, by time stepping: stacks, dominoes, a can, a bin of boxes.

Robots that are put down, by time stepping: a car that coasts on four cylinders; the quadruped that ships, with a ball
beside it; and Unitree's G1 of example-robot-data, on the four balls of each foot, from 20 mm. The legged ones have
springs and dampers in their joints. Both engines read one MJCF file.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import example_robot_data
import numba
import numpy as np

import closedloop as cl
import robot_models
from closedloop.scenario.load import SHIPPED, load_scenario, parse_scenario
from closedloop.simulation.engines.problem import Problem
from robot_models import RobotModel
from validation.oracle.spatial import Array
from validation.speed.contestants import CONES, Contestant, lap_of, with_errors

CUBE, TOWERS = "cube_toss", ("tower_2", "tower_5", "tower_10")
BOXES = ("box_slides", "box_stands")
SLIDES, STANDS = BOXES
STACKS = ("stack_3", "dominoes", "can", "bin_4", "bin_8", "bin_20")
ROBOTS = ("car", "quadruped", "humanoid")
SCENES = (*BOXES, CUBE, *TOWERS, *STACKS, *ROBOTS)
G1 = "g1_description/urdf/g1_29dof_rev_1_0.urdf"
STEP, SECOND, FRICTION = 1e-3, 1000, 0.5
TIME = {"duration": SECOND * STEP, "step": STEP}
# How far from where it stood a tower of soft contacts may be, m, and from where they ended in ours, a body that falls,
# and a box that slides and a robot, of each kind of cone: friction of a pyramid is not against the slip.
STANDS_WITHIN, ANYWHERE, SLIDES_WITHIN, ROBOTS_WITHIN = 0.01, 10.0, (0.02, 0.5), 0.02


@dataclass(frozen=True)
class Scene:
    """A scene as both engines have it.

    problem: ours
    xml: MuJoCo's model as text, by its cones of friction
    v: MuJoCo's velocities at the start
    q: what differs from the model's own position there: where, and the values
    contacts: how many MuJoCo must end with, where that is known
    entries: how many of q are compared, from the first on; all if None
    wanted: where MuJoCo must end; None: where ours does
    apart: how far from there it may be, of each of `CONES`
    rests: q at the end, where nothing should have moved
    """

    problem: Problem
    xml: Callable[[str], str]
    v: Array
    q: tuple[slice, Any] = (slice(0), ())
    contacts: int | None = None
    entries: int | None = None
    wanted: Array | None = None
    apart: tuple[float, float] = (ANYWHERE, ANYWHERE)
    rests: Array | None = None


def ours(name: str, scene: Scene, called: str, what: str, law: Any = None) -> Contestant:
    """Return our compiled engine, whose scheme is that of the scene."""
    lap, problem = lap_of(scene.problem, law, entries=scene.entries), scene.problem
    rests = None if scene.rests is None else problem.q
    return Contestant(called, name, problem.robot.n, problem.steps, lap, lap()[1], 1e-9, what, rests)


def bare(name: str, scene: Scene, ends: Array, cone: str) -> Contestant:
    """Return ``mj_step`` alone, all steps in one call, with elliptic or pyramidal cones of friction."""
    import mujoco

    made = mujoco.MjModel.from_xml_string(scene.xml(cone))
    data: Any = mujoco.MjData(made)
    (where, q), steps, contacts = scene.q, scene.problem.steps, scene.contacts

    def lap() -> tuple[float | None, Array | None]:
        mujoco.mj_resetData(made, data)
        data.qpos[where], data.qvel[:] = q, scene.v
        mujoco.mj_step(made, data, steps)
        if contacts is not None and data.ncon != contacts:
            raise RuntimeError(f"MuJoCo ended with {data.ncon} contacts, where {contacts} are wanted")
        return None, data.qpos[: scene.entries].copy()

    called, wanted = (
        "mj_step" if cone == CONES[0] else f"mj_step_{cone}",
        ends if scene.wanted is None else scene.wanted,
    )
    apart, what = scene.apart[CONES.index(cone)], f"MuJoCo: bare mj_step, {cone} cones"
    return Contestant(called, name, scene.problem.robot.n, steps, lap, wanted, apart, what, scene.rests)


def racing(name: str, with_mujoco: bool) -> list[Contestant]:
    """Return everyone who moves one of `SCENES`; nobody moves the humanoid, which MuJoCo reads, without it."""
    if name == "humanoid" and not with_mujoco:
        return []
    law = no_torque if name in BOXES else None
    if name == CUBE or name in TOWERS:
        scene = cube() if name == CUBE else tower(int(name.removeprefix("tower_")))
        stepped = scene.problem.scenario.replace({"time.integrator": "time_stepping"})
        other = Scene(cl.prepare(stepped, scene.problem.robot.model), scene.xml, scene.v, rests=scene.rests)
        own = [ours(name, scene, "compiled", "compiled engine"), ours(name, other, "time_stepping", "time stepping")]
    else:
        scene = box_on_feet(name) if name in BOXES else robot(name) if name in ROBOTS else stack(name)
        own = [ours(name, scene, "compiled", "compiled engine" if name in BOXES else "time stepping", law)]
    ends = np.asarray(own[0].wanted)
    everyone = [*own, *(bare(name, scene, ends, cone) for cone in CONES if with_mujoco)]
    return with_errors(everyone, scene.problem, law) if name in BOXES else everyone


def rubs(friction: float = FRICTION) -> str:
    """Return what MJCF says of a surface that rubs."""
    return f'condim="3" friction="{friction} 0 0"'


def world_xml(bodies: str, cone: str, floors: str) -> str:
    """Return a model of MuJoCo: a floor and bodies, and which cones of friction they have."""
    return f'<mujoco><option timestep="{STEP}" cone="{cone}"/><worldbody>{floors}{bodies}</worldbody></mujoco>'


def floor(friction: float = FRICTION) -> str:
    """Return a floor as MJCF."""
    return f'<geom type="plane" size="0 0 1" {rubs(friction)}/>'


def loaded(xml: str) -> RobotModel:
    """Return the robot of an MJCF."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "model.xml"
        file.write_text(xml)
        return robot_models.load(file)


def cube() -> Scene:
    """Return a tossed cube."""
    changes = {"time.integrator": "semi_implicit_euler"} | {f"time.{key}": value for key, value in TIME.items()}
    scenario = load_scenario(CUBE, changes)
    assert scenario.contact is not None  # a cube whose corners touch
    mu = scenario.contact[0].friction
    xml = '<body><freejoint/><inertial pos="0 0 0" mass="0.37" diaginertia="8.1e-4 8.1e-4 8.1e-4"/>'
    xml += f'<geom type="box" size="0.0524 0.0524 0.0524" {rubs(mu)}/></body>'
    q, v = np.array(scenario.start.q), np.array(scenario.start.v)
    q[3:] /= np.linalg.norm(q[3:])
    return Scene(
        cl.prepare(scenario), lambda cone: world_xml(xml, cone, floor(mu)), v, (slice(None), q), contacts=4, wanted=q
    )


def tower(n: int) -> Scene:
    """Return a tower of n boxes of 1 kg at rest, for a second: each stands on the one below by four corners."""
    half = 0.05
    geom = f'<freejoint/><geom type="box" size="{half} {half} {half}" mass="1" {rubs()}/>'
    boxes = "".join(f'<body name="box{i + 1}" pos="0 0 {half * (1 + 2 * i)}">{geom}</body>' for i in range(n))
    corners = [[x * half, y * half, -half] for x in (-1, 1) for y in (-1, 1)]
    text = ["[robot]", 'model = "planar2"', "[stabiliser]", "time_constant = 0.01", "[time]"]
    text += [f"duration = {SECOND * STEP}", f"step = {STEP}", 'integrator = "semi_implicit_euler"']
    for i in range(n):
        text += ["[[contact]]", f'link = "box{i + 1}"', f"at = {corners}", f"friction = {FRICTION}"]
        text += [f'against = "{f"box{i}" if i else "world"}"', f"through = {[0.0, 0.0, half if i else 0.0]}"]
    model = loaded(f'<mujoco model="tower"><worldbody>{boxes}</worldbody></mujoco>')
    q = np.array([x for i in range(n) for x in (0.0, 0.0, half * (1 + 2 * i), 1.0, 0.0, 0.0, 0.0)])
    return Scene(
        cl.prepare(parse_scenario("\n".join(text)), model), lambda cone: world_xml(boxes, cone, floor()),
        np.zeros(6 * n), contacts=4 * n, wanted=q, apart=(STANDS_WITHIN, STANDS_WITHIN), rests=q,
    )  # fmt: skip


@numba.njit
def no_torque(x: Any, Q: Array) -> None:
    """Leave the joints to gravity and contact."""
    for j in range(Q.shape[0]):
        Q[j] = 0.0


def box_on_feet(name: str) -> Scene:
    """Return a box of 1 kg on six joints and four feet, one of `BOXES`, for a second."""
    half, radius, friction = (0.1, 0.075, 0.05), 1e-3, 0.2
    feet = [(x * half[0], y * half[1], -half[2]) for x in (1, -1) for y in (1, -1)]
    start = [3.0, 0.0, 0.0, 0.0, 0.0, 0.5] if name == SLIDES else [0.0] * 6
    x, y, z = inertia = [(sum(a * a for a in half) - a * a) / 3.0 for a in half]
    heavy = f'<inertial><mass value="1"/><inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>'
    limit, axes = '<limit lower="-1000" upper="1000" velocity="1e4" effort="1e6"/>', ("1 0 0", "0 1 0", "0 0 1")
    parts, parent = ['<link name="base"/>'], "base"
    for i, (kind, axis) in enumerate((kind, axis) for kind in ("prismatic", "continuous") for axis in axes):
        child = "box" if i == 5 else f"c{i}"
        parts.append(f'<link name="{child}">{heavy if i == 5 else ""}</link>')
        parts.append(
            f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
            f"{limit if i < 3 else ''}</joint>"
        )
        parent = child
    model = robot_models.from_text(
        f'<robot name="box">{"".join(parts)}</robot>', "urdf", name="box", armature=np.zeros(6), tip="box",
        home=np.zeros(6), locked={},
    )  # fmt: skip
    text = [
        "[robot]", 'model = "planar2"', 'tip = "box"', "[surface]", "gap = 100.0", 'contact = "unilateral"', "[law]",
        "kp = 0", "kd = 0", "force = 0", "[stabiliser]", "time_constant = 0.01", "[time]",
        f"duration = {SECOND * STEP}", f"step = {STEP}", 'integrator = "semi_implicit_euler"', "[start]",
        f"q = {[0.0, 0.0, half[2], 0.0, 0.0, 0.0]}", f"v = {start}",
    ]  # fmt: skip
    for at in feet:
        text += ["[[contact]]", 'link = "box"', f"at = {list(at)}", f"friction = {friction}"]
    joints = "".join(f'<joint type="{kind}" axis="{axis}"/>' for kind in ("slide", "hinge") for axis in axes)
    spheres = "".join(
        f'<geom type="sphere" size="{radius}" pos="{x} {y} {z + radius}" {rubs(friction)}/>' for x, y, z in feet
    )
    body = f'<inertial pos="0 0 0" mass="1" diaginertia="{" ".join(map(str, inertia))}"/>{spheres}'
    return Scene(
        cl.prepare(parse_scenario("\n".join(text)), model),
        lambda cone: world_xml(f"<body>{joints}{body}</body>", cone, floor(friction)), np.array(start),
        (slice(2, 3), half[2]), contacts=4 if name == STANDS else None, apart=SLIDES_WITHIN,
    )  # fmt: skip


WALL = 0.15


def bodies_of(name: str) -> tuple[list[dict[str, Any]], list[tuple[int, int]]]:
    """Return the sections [[body]] of one of `STACKS`, and which of them may touch each other."""
    if name == "stack_3":
        boxes = [_box(i, (0.1, 0.1, 0.1), [0.0, 0.0, 0.05 + 0.1 * i + 0.002 * (i + 1)]) for i in range(3)]
        return boxes, [(0, 1), (1, 2)]
    if name == "dominoes":
        boxes = [_box(i, (0.024, 0.1, 0.2), [0.06 * i, 0.0, 0.1], mass=0.2) for i in range(5)]
        boxes[0]["spin"] = [0.0, 5.0, 0.0]
        return boxes, [(i, i + 1) for i in range(4)]
    if name == "can":
        can = {"name": "body0", "shape": "cylinder", "radius": 0.033, "length": 0.12, "mass": 0.35}
        turned = [float(np.cos(0.15)), float(np.sin(0.15)), 0.0, 0.0]
        return [can | {"position": [0.0, 0.0, 0.12], "quaternion": turned, "velocity": [0.2, 0.0, 0.0]}], []
    count, rng, boxes = int(name.removeprefix("bin_")), np.random.default_rng(0), []
    for i in range(count):
        turn = rng.normal(size=4)
        place = [*rng.uniform(-0.06, 0.06, size=2).tolist(), 0.12 + 0.13 * i]
        boxes.append(_box(i, (0.06, 0.08, 0.1), place) | {"quaternion": (turn / np.linalg.norm(turn)).tolist()})
    return boxes, [(j, i) for i in range(count) for j in range(i)]


def _box(i: int, edges: tuple[float, ...], position: list[float], mass: float = 1.0) -> dict[str, Any]:
    return {"name": f"body{i}", "shape": "box", "edges": list(edges), "mass": mass, "position": position}


def planes_of(name: str) -> list[tuple[list[float], list[float]]]:
    """Return normal and a point of the floor, and of the walls of a bin."""
    sides = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)) if name.startswith("bin") else ()
    return [([0.0, 0.0, 1.0], [0.0] * 3), *(([x, y, 0.0], [-WALL * x, -WALL * y, 0.0]) for x, y in sides)]


def scenario_of(name: str, integrator: str = "time_stepping") -> cl.Scenario:
    """Return the scenario of one of `STACKS`: bodies on a floor, or inside the walls of a bin."""
    (bodies, pairs), usual = bodies_of(name), {"at": "collision", "friction": FRICTION}
    contact = [usual | {"link": b["name"], "normal": n, "through": p} for b in bodies for n, p in planes_of(name)]
    for i, j in pairs:
        contact.append(usual | {"link": bodies[j]["name"], "against": bodies[i]["name"], "onto": "collision"})
    return cl.Scenario.model_validate({
        "robot": {"model": "none"}, "body": bodies, "contact": contact,
        "surface": {"kind": "none", "contact": "unilateral"},
        "time": {"duration": 1.5, "step": STEP, "integrator": integrator},
    })  # fmt: skip


def stack(name: str) -> Scene:
    """Return one of `STACKS`."""

    def words(numbers: Any) -> str:
        return " ".join(f"{x:.17g}" for x in numbers)

    def xml(b: dict[str, Any]) -> str:
        size = [0.5 * x for x in b["edges"]] if b["shape"] == "box" else [b["radius"], 0.5 * b["length"]]
        geom = f'<geom type="{b["shape"]}" size="{words(size)}" mass="{b["mass"]}" {rubs()}/>'
        place = f'pos="{words(b["position"])}" quat="{words(b.get("quaternion", (1, 0, 0, 0)))}"'
        return f"<body {place}><freejoint/>{geom}</body>"

    floors = "".join(
        f'<geom type="plane" size="0 0 1" pos="{words(p)}" zaxis="{words(n)}" {rubs()}/>' for n, p in planes_of(name)
    )
    bodies, _ = bodies_of(name)
    v = np.concatenate([[*b.get("velocity", (0, 0, 0)), *b.get("spin", (0, 0, 0))] for b in bodies])
    q = np.concatenate([[*b["position"], *b.get("quaternion", (1, 0, 0, 0))] for b in bodies])
    return Scene(
        cl.prepare(scenario_of(name)), lambda cone: world_xml("".join(map(xml, bodies)), cone, floors), v, wanted=q
    )


def humanoid(touches: str) -> tuple[str, list[dict[str, Any]]]:
    """Return the MJCF of Unitree's G1 with springs in its joints, feet 20 mm above the floor, and its contacts.

    MuJoCo makes the MJCF of the URDF.
    """
    import mujoco

    folder = Path(example_robot_data.getModelPath(G1)) / G1
    text = re.sub("<visual>.*?</visual>", "", folder.read_text(), flags=re.DOTALL)
    text = re.sub("<collision>(?:(?!</collision>).)*<mesh.*?</collision>", "", text, flags=re.DOTALL)  # feet are balls
    text = re.sub("<robot.*?>", r'\g<0><mujoco><compiler fusestatic="false"/></mujoco>', text, count=1)
    spec = mujoco.MjSpec.from_string(text)
    pelvis = spec.worldbody.first_body()
    pelvis.add_freejoint()
    for joint in spec.joints[1:]:
        joint.stiffness, joint.damping, joint.armature = [500.0, 0.0, 0.0], [10.0, 0.0, 0.0], 0.01
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    pelvis.pos = [0.0, 0.0, 0.02 - float(np.min(data.geom_xpos[:, 2] - model.geom_size[:, 0]))]
    contacts = [
        {"link": model.body(model.geom_bodyid[i]).name, "at": model.geom_pos[i].tolist()}
        | {"radius": float(model.geom_size[i, 0])}
        for i in range(model.ngeom)
    ]
    return spec.to_xml().replace("<geom ", f"<geom {touches} ").replace(
        "<worldbody>", "<default/><worldbody>"
    ), contacts


def robot(name: str) -> Scene:
    """Return one of `ROBOTS`, put down: only wheels, feet and the ball touch."""
    friction, bent, turned, v = (
        0.6,
        (0.0, -0.7091, 1.6),
        [0.0] * 4,
        np.zeros(10),
    )  # abduction, hip and knee of a leg, rad
    touches = f'contype="1" {rubs(friction)}'
    wheels = {"rear_left": (-0.25, 0.2), "rear_right": (-0.25, -0.2), "left": (0.25, 0.2), "right": (0.25, -0.2)}
    contacts: list[dict[str, Any]] = [{"link": wheel, "at": "collision"} for wheel in wheels]
    if name == "quadruped":
        turned, v = [*bent * 4], np.zeros(24)
        foot = {"at": [0.0, 0.0, -0.175], "radius": 0.0175}
        contacts = [{"link": f"{leg}_shank"} | foot for leg in ("front_left", "front_right", "hind_left", "hind_right")]
        contacts.append({"link": "ball", "at": [0.0, 0.0, 0.0], "radius": 0.05})
        xml = (SHIPPED / "bodies" / "quadruped.xml").read_text()
        for joint, angle in zip(("60 60", "180 180", "160 160"), bent, strict=True):
            spring = f'stiffness="60" damping="2" springref="{np.degrees(angle):.17g}"'
            xml = xml.replace(f'range="-{joint}"', f'range="-{joint}" {spring}')
        xml = xml.replace("<default>", '<default><geom contype="0" conaffinity="0"/>', 1)
        xml = xml.replace('type="sphere"', f'type="sphere" {touches}')
    elif name == "humanoid":
        turned, v = [0.0] * 29, np.zeros(35)
        xml, contacts = humanoid(touches)
    else:
        v[0], v[6:] = 2.0, 20.0
        turning = "".join(
            f'<body name="{wheel}" pos="{x} {y} 0"><joint name="{wheel}" type="hinge" axis="0 1 0"/>'
            f'<geom type="cylinder" euler="90 0 0" size="0.1 0.025" mass="0.5" {touches} conaffinity="0"/></body>'
            for wheel, (x, y) in wheels.items()
        )
        body = '<freejoint name="car"/><inertial pos="0 0 0.05" mass="10" diaginertia="0.2 0.4 0.5"/>'
        xml = f'<worldbody><body name="car" pos="0 0 0.12">{body}{turning}</body></worldbody>'
        xml = f'<mujoco model="car"><default/>{xml}</mujoco>'
    scenario = cl.Scenario.model_validate({
        "robot": {"model": "planar2", "friction": name != "car"},  # another model takes its place
        "contact": [each | {"friction": friction} for each in contacts],
        "surface": {"kind": "none"}, "start": {"q": turned, "v": v.tolist()},
        "time": TIME | {"integrator": "time_stepping"},
    })  # fmt: skip
    floors = f'<worldbody><geom type="plane" size="0 0 1" {touches} conaffinity="1"/>'

    def mujocos(cone: str) -> str:
        option = f'<option timestep="{STEP}" cone="{cone}"/>'
        with_floor = xml.replace("<worldbody>", floors).replace("<default>", f"{option}<default>", 1)
        return with_floor.replace("<default/>", option)

    where = slice(7, 7 + len(turned))
    apart = (ROBOTS_WITHIN, ROBOTS_WITHIN)
    return Scene(cl.prepare(scenario, loaded(xml)), mujocos, v, (where, turned), entries=3, apart=apart)
