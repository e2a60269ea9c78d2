"""The robots that come with the package: one folder each, a URDF and its sidecar."""

from pathlib import Path

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
