"""The same robot file read by somebody else: yourdfpy with the hand-written oracle, and MuJoCo."""

import numpy as np
import pinocchio as pin
import yourdfpy

import robot_models

#: Relative to the largest entry of H, and of the bias: rounding of two algorithms on well-scaled arms.
EQUAL = 1e-8


def same_robot(robot, reference):
    """Return what differs from the robot of another file, bit by bit."""
    other = robot_models.load(reference)
    for field in ("joint_names", "joint_types", "frames", "tip", "format", "notes"):
        if getattr(robot, field) != getattr(other, field):
            return f"{field}: {getattr(robot, field)} instead of {getattr(other, field)}"
    for field in ("armature", "position_lower", "position_upper", "velocity_limit", "effort_limit", "home", "gravity"):
        if not np.array_equal(getattr(robot, field), getattr(other, field)):
            return f"{field}: {getattr(robot, field)} instead of {getattr(other, field)}"
    one, two = robot.pinocchio_model(), other.pinocchio_model()
    numbers = [
        np.concatenate(
            [
                *(place.homogeneous.ravel() for place in model.jointPlacements),
                *(body.matrix().ravel() for body in model.inertias),
                *(frame.placement.homogeneous.ravel() for frame in model.frames),
            ]
        )
        for model in (one, two)
    ]
    same = np.array_equal(*numbers)
    return "" if same else "Pinocchio's models differ"


def urdf(robot, path):
    """Return what differs from yourdfpy's reading, and from the oracle's dynamics."""
    from validation.oracle.dynamics import bias, mass_matrix
    from validation.oracle.engine import Oracle
    from validation.oracle.tree import build_tree, parse_urdf

    text = path.read_bytes().decode("utf-8-sig")
    links, joints = parse_urdf(text)
    names, gravity = robot.joint_names, np.array([0.0, 0.0, -9.81])
    tree = build_tree(
        links, joints, joint_names=names, armature=np.zeros(robot.n), gravity=gravity, locked=robot.locked
    )
    theirs = Oracle(tree, robot.tip)
    for q, v in _states(robot):
        pose = theirs.pose(q)
        wrong = _dynamics(robot, q, v, mass_matrix(tree, pose), bias(tree, pose, v))
        if wrong:
            return wrong
    limits = {
        joint.name: joint
        for joint in yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot.joints
    }
    for k, name in enumerate(names):
        limit, bounded = limits[name].limit, limits[name].type != "continuous"
        wanted = (
            [limit.lower if bounded else -np.inf, limit.upper if bounded else np.inf] if limit else [-np.inf, np.inf]
        )
        wanted += [limit.velocity or np.inf, limit.effort or np.inf] if limit else [np.inf, np.inf]
        held = [getattr(robot, f)[k] for f in ("position_lower", "position_upper", "velocity_limit", "effort_limit")]
        wanted = [x if abs(x) < 1e300 else np.copysign(np.inf, x) for x in wanted]  # none, as the loader counts it
        if not np.array_equal(held, np.array(wanted, dtype=float)):
            return f"limits of {name}: {held} instead of {wanted}"
    return ""


def mjcf(robot, path):
    """Return what differs from MuJoCo's model, or why MuJoCo refuses the file."""
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        return f"MuJoCo refuses it: {' '.join(str(error).split())}"
    data = mujoco.MjData(model)
    order = [model.joint(name).qposadr[0] for name in robot.joint_names]
    if model.nv != robot.n:
        return f"{robot.n} joints instead of {model.nv}"
    for q, v in _states(robot):
        data.qpos[order], data.qvel[order] = q, v
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        for k in range(model.nv):
            mujoco.mj_mulM(model, data, full[k], np.eye(model.nv)[k])
        wrong = _dynamics(robot, q, v, full[np.ix_(order, order)], data.qfrc_bias[order])
        if wrong:
            return wrong
    limited = np.array([model.joint(name).limited[0] for name in robot.joint_names], dtype=bool)
    ranges = np.array([model.joint(name).range for name in robot.joint_names])
    wanted = np.where(limited[:, None], ranges, [-np.inf, np.inf])
    held = np.column_stack([robot.position_lower, robot.position_upper])
    return "" if np.allclose(held, wanted, rtol=1e-12, atol=1e-12) else f"limits: {held} instead of {wanted}"


def _states(robot):
    rng = np.random.default_rng(0)
    return [(rng.uniform(-1, 1, robot.n), rng.uniform(-1, 1, robot.n)) for _ in range(2)]


def _dynamics(robot, q, v, mass, bias):
    """Compare H and the bias of the robot with another's."""
    model = robot.pinocchio_model()
    upper = np.triu(pin.crba(model, model.createData(), q))
    held = upper + np.triu(upper, 1).T
    own = pin.nonLinearEffects(model, model.createData(), q, v)
    for what, one, two in (("H", held, mass), ("bias", own, bias)):
        if not np.isfinite(one).all():
            return f"{what} is not finite"
        if not np.abs(one - two).max() <= EQUAL * max(np.abs(two).max(), np.abs(mass).max()):
            return f"{what}: {one.tolist()} instead of {np.asarray(two).tolist()}"
    return ""
