"""A robot that is not ours in a maze: dm_control's quadruped (docs/custom_env.md says it step by
step).

    pip install dm_control
    python -m goalgan_bt.train --env quadruped:Quadruped --map field.txt
"""

from importlib.util import find_spec
from pathlib import Path

import mujoco

from goalgan_bt.envs.robot_maze import RobotMaze


class Quadruped(RobotMaze):
    """Four legs of three joints each; 12 actuators, which set lengths of tendons or angles."""

    healthy_z = (0.25, 1.5)  # metres: an episode ends when the torso is elsewhere,
    upright = 0.3  # or leans by more than 73 degrees
    success_radius = 1.0  # metres from the goal to the torso

    @classmethod
    def robot(cls):
        package = find_spec("dm_control")
        assert package is not None and package.origin is not None, "pip install dm_control"
        path = Path(package.origin).parent / "suite/quadruped.xml"
        spec = mujoco.MjSpec.from_file(str(path))
        # Away with what belongs to dm_control's tasks: a ball, hills, walls, a target, sensors.
        spec.delete(spec.body("ball"))
        for thing in [*spec.worldbody.geoms, *spec.hfields, *spec.worldbody.sites, *spec.sensors]:
            if thing.name != "floor":
                spec.delete(thing)
        return spec
