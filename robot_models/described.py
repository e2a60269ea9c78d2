"""A robot by its name or its file: its canonical text, what is known beside it, and what of it does not act.

The inspection reads a URDF through yourdfpy, whose import alone costs half a second. The descriptions in `PASSED`
were inspected when they were added, a test inspects them again, and a file that differs in one byte is a
stranger. Files of users are not listed and are inspected at every start.
"""

import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from robot_models import example_robots, urdf
from robot_models.errors import ModelError, some
from robot_models.sidecar import Sidecar, read_sidecar
from robot_models.urdf import Beside, read_beside
from robot_models.xml_text import parse, read_text

_HERE = Path(__file__).parent

_NAMES = (
    "wam4", "wam7", "planar2", "pointmass3", "four_bar", "five_bar", "delta", "stewart", "two_arms", "gripper",
    "peg_gantry", "fr3",
)  # fmt: skip


def shipped_names() -> tuple[str, ...]:
    """Return the names of the robots that come with the package."""
    return _NAMES


def path_of(name: str) -> Path:
    """Return where the URDF of a shipped robot lies."""
    return _HERE / name / f"{name}.urdf"


if TYPE_CHECKING:
    from os import PathLike

Format = Literal["urdf", "mjcf"]

_ROOTS: dict[str, Format] = {"robot": "urdf", "mujoco": "mjcf"}
_SUFFIXES = (".urdf", ".xml", ".mjcf", ".xacro")


@dataclass(frozen=True)
class Description:
    """A canonical text and what is known beside it; `lock` in the sidecar is the default."""

    name: str
    text: str
    format: Format
    where: str
    sidecar: Sidecar
    #: What of the file is left out, or is not as it should be, a line each.
    warnings: list[str] = field(default_factory=list)


def find(name: "str | PathLike[str]", mocap: Collection[str] = ()) -> Description:
    """Return the description of a robot that comes with a package, or of a file; of `mocap` see `mjcf.read`.

    Raises `ModelError` if there is no such robot, or its text is at fault.
    """
    if name in shipped_names():
        return _from_file(str(name), path_of(str(name)), "robot_models")
    if names_a_file(name):
        path = Path(name)
        return _from_file(path.stem, path, "", mocap)
    assert isinstance(name, str)
    if name not in example_robots.example_names():
        known = (*shipped_names(), *example_robots.example_names())
        near = get_close_matches(name.lower(), known, n=3)
        hint = (
            f"did you mean {' or '.join(map(repr, near))}?"
            if near
            else "`closedloop robots` lists them, such as wam4, panda and ur5"
        )
        if not example_robots.installed():
            hint = f"robots of other makers, as panda and ur5, need {example_robots.NEEDS}"
        raise ModelError(f"no robot is named {name!r}: {hint} (or give the path of a .urdf or MJCF .xml)")
    example = example_robots.find(name)
    own = _of_urdf(urdf.read(example.text, name), name, name)
    sidecar = replace(example.sidecar, closed_loop=own.sidecar.closed_loop, drives=own.sidecar.drives)
    if example.rotors is not None:
        rotors = example_robots.rotor_inertia(example.rotors, list(urdf.joint_types(own.text)))
        sidecar = replace(sidecar, drive_inertia=rotors)
    return replace(own, sidecar=sidecar)


def names_a_file(name: "str | PathLike[str]") -> bool:
    """Whether this is the path of a file, not the name of a robot that comes with a package."""
    path = Path(name)
    return not isinstance(name, str) or path.suffix.lower() in _SUFFIXES or len(path.parts) > 1


def _from_file(name: str, path: Path, owner: str, mocap: Collection[str] = ()) -> Description:
    where = path.name if owner else str(path)
    text = read_text(path)
    root = parse(text, where).tag
    if root not in _ROOTS:
        raise ModelError(f"{where} is neither URDF nor MJCF: its root is <{root}>, not <robot> or <mujoco>")
    format = _ROOTS[root]
    if path.suffix.lower() == ".xacro":
        text = urdf.expanded(path, where)
    beside = read_beside(path.with_suffix(".yaml"), text) if format == "urdf" else Beside(text)
    found = canonical(beside.text, format, name, where, path, mocap)
    own, sidecar = found.sidecar, read_sidecar(path.with_suffix(".toml"), joint_names(found.text, format))
    sidecar = replace(
        sidecar,
        source=sidecar.source or ("" if owner else where),
        home=dict(own.home) | dict(sidecar.home),
        drives=sidecar.drives or beside.drives or own.drives,
        closed_loop=(*own.closed_loop, *beside.loops, *sidecar.closed_loop),
    )
    return replace(found, sidecar=sidecar, warnings=[*found.warnings, *beside.warnings])


def canonical(
    text: str, format: Format, name: str, where: str, path: Path | None, mocap: Collection[str] = ()
) -> Description:
    """Return the description of a text alone, that of the file `path` if there is one.

    Raises `ModelError` if the text is at fault.
    """
    if format == "urdf":
        return _of_urdf(urdf.read(text, where), name, where)
    from robot_models import mjcf  # here: it imports MuJoCo

    said = mjcf.read(text, where, path, mocap)
    sidecar = Sidecar(home=said.home, drives=said.drives, closed_loop=said.loops)
    return Description(name, said.text, format, where, sidecar, said.warnings)


def _of_urdf(text: str, name: str, where: str) -> Description:
    """Return the description of a plain URDF: a joint that mimics another is bound to it and has no drive."""
    loops, warnings = urdf.mimics(text, where)
    bound = {loop.joints[0] for loop in loops}
    drives = tuple(name for name in joint_names(text, "urdf") if name not in bound) if loops else None
    return Description(name, text, "urdf", where, Sidecar(closed_loop=loops, drives=drives), warnings)


def joint_names(text: str, format: Format) -> tuple[str, ...]:
    """Return the joints of a canonical text that move by one coordinate, in its order."""
    if format == "mjcf":
        from robot_models import mjcf

        return tuple(name for name, kind in mjcf.joint_types(text) if kind not in mjcf.POSITIONS)
    kinds = urdf.joint_types(text)
    return tuple(joint for joint, kind in kinds.items() if kind in urdf.MOVING and kind not in urdf.MANY)


#: SHA-256 of the UTF-8 text of each robot that passed.
PASSED = {
    "wam4": "51fa08f4d8042949467159a164bae91e9a255ce1cdc69cb509743c1bb848d321",
    "wam7": "858ac1e59429c214b7b8b8118b47d6e2180854b5f351d19be857509c3c0a6ecb",
    "planar2": "60dab6452f27c3630a398e06bee26beb2ecc8011dc2811167b192e139f8ca9d8",
    "pointmass3": "9957ed631afe2e052f1e3a452638054a904ec10778bd7f131039614d5788d391",
    "four_bar": "5a78c709d9c3574796d8fa9525ca6357be1ce5c4f5f3b7e57cd9563e09837d84",
    "five_bar": "b478e922b6ebb59158c479ccf924e7444c3824cce451f604d0f52dd22f67fea7",
    "delta": "2916d2ff726879aa33ca628d5f0a1d67cf9764abeefe2f0e0417d4ad88527976",
    "stewart": "1e0cec012874a3e5de493e94123dbb3dd08e612a7a8ea0fcbf5ae62cccb79575",
    "two_arms": "03259728eb07cef196ffc88842ede01514d62bf12940a9f8c91f3ab6c6fa4736",
    "gripper": "7c916021ed179fdbd28be0fe96f0b32e525485a77fe1334f66b4f2538304b928",
    "peg_gantry": "c77e2d73997171a9c8739dedaf6721484bea945117679af828102a93799ed7ec",
    "fr3": "7a6748644b414d62171a36822e68a832ee780f38b657e2aad73a7372ea4ead4d",
    "kinova": "a9a0a8a1a21b82419b15293fca47b8a35c57e7200eaf1e39dadb6bfd7e44eabb",
    "panda": "63792d2679f22c4e41cda2c4d9d903644e628970ad0656b9eec8485113941555",
    "panda_collision": "582aea6f0dda13e6dca083a9f6776efc31c4782ecadbc92c1c5a586647368808",
    "ur10": "16e4d9c85f01d2533fa219d28e2e5a2ce93836be7afaf243b46be4ba76e0d4ea",
    "ur10_limited": "47efc7cc109c0d49d3d23d8845e602c3396bfe5e7f6f533909b29c318493dda1",
    "ur3": "679f2ee7e9b182e746a5a93b53a336ae8dffc63ec554c272b2c8ba3692d086eb",
    "ur3_gripper": "ed726f227992641e0f24b4991e0b4edece4b769880c965cf0e8ac19437c5b45c",
    "ur3_limited": "356dd55ebd3a83ed6bc7f55434acafa4876551eb66008adc1830aa7043beceda",
    "ur5": "cede880fc2a987ef9dd23bbcda3e0ad1e7b1df8b58d638d100cfbff8ebc806cb",
    "ur5_gripper": "9b312a5e616ee115c975e6a86df70f97c6b3aa7446f551016c6093186c97bfd1",
    "ur5_limited": "8b8daa5ee444419b44da46bbb994a4e7d41b496d2caa5c4bf996d1cd5706ba64",
}
#: Joints that were locked when it did.
_FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
_LOCKED = {"panda": _FINGERS, "panda_collision": _FINGERS}


def digest(text: str) -> str:
    """Return what `PASSED` has of a text."""
    return sha256(text.encode()).hexdigest()


def has_passed(text: str, locked: Collection[str]) -> bool:
    """Tell whether this very text has passed with these joints locked, or with fewer.

    Locking a joint more never adds a fault, so what passed with some joints locked passes with more.
    """
    own = digest(text)
    return any(passed == own and {*_LOCKED.get(name, ())} <= {*locked} for name, passed in PASSED.items())


def notes(
    text: str, format: str, joints: Collection[str], velocity_limit: NDArray[np.float64],
    effort_limit: NDArray[np.float64],
) -> tuple[str, ...]:  # fmt: skip
    """Return what a reader of a run should know about its robot.

    text, format: the canonical text, and "urdf" or "mjcf"
    joints: those that move
    velocity_limit, effort_limit: (n,), rad/s and N m; infinite where there is none
    """
    root = ET.fromstring(text)
    both = (*root.iter("joint"), *root.iter("fixed"))
    rubbing = {each.get("name", "") for each in both if each.get("damping") or each.get("frictionloss")}
    found = _rough_urdf(root) if format == "urdf" else rubbing
    tendons = [each.get("name", "") for each in root.iter("fixed")]
    rough = [name for name in (*joints, *tendons) if name in found]
    lines = []
    if rough:
        element = "<dynamics>" if format == "urdf" else "damping and frictionloss"
        lines.append(
            f"what the robot's file says of friction ({element}; {some(rough)}) does not act: "
            "friction is what the scenario says"
        )
    limits = [w for w, b in (("effort", effort_limit), ("velocity", velocity_limit)) if np.isfinite(b).any()]
    if limits:
        named = " and ".join(limits)
        lines.append(
            f"{named} limits of the robot's file do not act on the motion; the verdict names joints that exceed them"
        )
    return tuple(lines)


def _rough_urdf(root: ET.Element) -> set[str]:
    rough = set()
    for joint in root.findall("joint"):
        dynamics = joint.find("dynamics")
        values = [dynamics.get(key, "0") for key in ("damping", "friction")] if dynamics is not None else []
        if any(float(value) for value in values):
            rough.add(joint.get("name", ""))
    return rough
