"""Small robot descriptions for the tests, right or wrong in one place at a time."""

import robot_models

INERTIAL = (
    '<inertial><origin xyz="0.1 0.02 0.3"/><mass value="2"/>'
    '<inertia ixx="0.10" iyy="0.12" izz="0.05" ixy="0.01" ixz="0.002" iyz="0.003"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="1" effort="5" velocity="2"/>'


def load(tmp_path, text):
    """Return the robot of an MJCF text."""
    path = tmp_path / "robot.xml"
    path.write_text(text)
    return robot_models.load(path)


def link(name: str, content: str = INERTIAL) -> str:
    """Return a URDF link."""
    return f'<link name="{name}">{content}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    *,
    kind: str = "revolute",
    axis: str = "0 1 0",
    origin: str = "0 0 0.5",
    limit: str = LIMIT,
    extra: str = "",
) -> str:
    """Return a URDF joint."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/>{limit}{extra}</joint>'
    )


def urdf(*parts: str) -> str:
    """Return a URDF of these parts."""
    return '<robot name="sample">' + "\n".join(parts) + "</robot>"


#: Base, two moving links, a massless tip.
ARM = (
    link("base", ""),
    link("upper"),
    link("fore"),
    link("tip", ""),
    joint("shoulder", "base", "upper"),
    joint("elbow", "upper", "fore", axis="0 0 1"),
    joint("end", "fore", "tip", kind="fixed", limit=""),
)


def arm(*, without: str = "", plus: str = "", **replacements: str) -> str:
    """Return the sample arm with the named parts replaced, one left out or one added."""
    names = ("base", "upper", "fore", "tip", "shoulder", "elbow", "end")
    parts = [replacements.get(n, part) for n, part in zip(names, ARM, strict=True) if n != without]
    return urdf(*parts, plus)


MJCF_INERTIAL = '<inertial pos="0.1 0.02 0.3" mass="2" diaginertia="0.1 0.12 0.15" euler="10 20 30"/>'


def mjcf(
    *,
    head: str = "",
    base: str = '<body name="base" pos="0.3 0 1" euler="15 0 0">',
    joint: str = '<joint name="shoulder" axis="0 1 0" range="-90 90" armature="0.3" damping="2"/>',
    inertial: str = MJCF_INERTIAL,
    inner: str = "",
    tail: str = "",
    world: str = "",
) -> str:
    """Return an MJCF arm of two joints on a tilted base, with a body welded to its end."""
    return (
        f'<mujoco model="sample">{head}<worldbody>{world}{base}'
        f'<body name="upper" pos="0.1 0 0.5" euler="0 0 20">{joint}{inertial}{inner}'
        f'<body name="fore" pos="0 0.3 0.5" quat="0.9 0.1 0.2 0.3">'
        f'<joint name="elbow" axis="1 1 0"/>{MJCF_INERTIAL}'
        f'<body name="hand" pos="0 0 0.2">{MJCF_INERTIAL}<site name="touch" pos="0 0.1 0.2"/></body>'
        f"</body></body></body></worldbody>{tail}</mujoco>"
    )
