"""What runs that are kept in a file depend on beside what is asked for: robots, classes of users, versions."""

from collections.abc import Mapping, Sequence
from typing import Any

import robot_models
from closedloop.jit.cache_folder import cache_folder
from closedloop.jit.user_code import source_digest
from closedloop.record.save import package_versions
from closedloop.scenario.scenario import NO_ROBOT, Scenario, families
from closedloop.scenario.user_module import members_of_users
from robot_models.mesh_files import digest_of


def identity_of(scenario: Scenario, changes: Mapping[str, Sequence[Any]], engine: str) -> dict[str, Any]:
    """Return what the numbers of a scenario's runs depend on, as JSON has it, by names of `closedloop.record.save`.

    `changes`: values of the keys that change from run to run.
    `engine`: see `closedloop.simulate`.
    Raises ModelError if the robot is at fault, and no other is asked for.
    """
    # The text of a user's class, or a robot's file, may change between a kill and what follows.
    digests = {name: source_digest(families()[key].get(name)) for key, name in members(scenario, changes)}
    return {
        "scenario": scenario.to_toml(), "robot": _robots(scenario, changes), "engine": engine,
        "versions": package_versions(), "kernels": cache_folder().name, **({"members": digests} if digests else {}),
    }  # fmt: skip


def members(scenario: Scenario, changes: Mapping[str, Sequence[Any]]) -> tuple[tuple[str, str], ...]:
    """Return the keys that pick a user's class in any run, with its name."""
    found = list(members_of_users(scenario).items())
    for key, values in changes.items():
        if key in families():
            found += [(key, name) for name in values if isinstance(name, str) and ":" in name]
    return tuple(found)


def _robots(scenario: Scenario, changes: Mapping[str, Sequence[Any]]) -> dict[str, str]:
    """Return a digest of each robot that a run may load."""
    names = {str(value) for value in changes.get("robot.model", [scenario.robot.model])}
    digests = {}
    for name in sorted(names - {NO_ROBOT}):
        try:
            digests[name] = digest_of(robot_models.load(name))
        except Exception as error:  # of the runs with this robot, which say it, as long as there are others
            if len(names) == 1:
                raise
            digests[name] = f"{type(error).__name__}: {error}"
    return digests
