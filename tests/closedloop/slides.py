"""The shipped scenarios in which the tip of an arm stays on a smooth surface under the paper's law.

`wam_through_singularity` passes a pose in which Eq. 24 has no row: see `test_singular`.
"""

import closedloop as cl
import robot_models

SLIDES = [
    name
    for name, scenario in ((name, cl.load_scenario(name)) for name in cl.shipped_scenarios())
    if name != "wam_through_singularity"
    and scenario.surface.contact == "bilateral"
    and scenario.law.kind == "paper"
    and scenario.compliance.kind == "none"
    and scenario.model_error.payload == 0.0
    and not robot_models.load(scenario.robot.model).loops
    and scenario.friction.kind == scenario.joint_friction.kind == "none"
]
