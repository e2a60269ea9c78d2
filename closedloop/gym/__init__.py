"""Environments of Gymnasium over hard contact.

    import gymnasium
    import closedloop.gym

    env = gymnasium.make("closedloop/Press-v0")
    envs = gymnasium.make_vec("closedloop/Slide-v0", num_envs=256)

Importing this module registers the environments; it needs ``pip install "closedloop[gym]"``.
"""

try:
    import gymnasium
except ImportError:  # the extra is not installed
    raise ImportError('closedloop.gym needs Gymnasium: pip install "closedloop[gym]"') from None

from closedloop.gym.terms import TASKS, Now, Range, Task

__all__ = ["TASKS", "Now", "Range", "Task"]

for _name in (*TASKS, "scenario"):
    gymnasium.register(
        f"closedloop/{_name.capitalize()}-v0",
        entry_point="closedloop.gym.env:ContactEnv",
        vector_entry_point="closedloop.gym.env:ContactVectorEnv",
        kwargs={"task": _name} if _name in TASKS else {},
    )
