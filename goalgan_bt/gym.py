"""The environments under their Gymnasium ids. Importing this registers them.

    import gymnasium
    import goalgan_bt.gym

    env = gymnasium.make("goalgan_bt/AntUMaze-v0", render_mode="rgb_array")
    envs = gymnasium.make_vec("goalgan_bt/AntUMaze-v0", num_envs=64)

`goalgan_bt.envs.gymnasium_env` has the single ones, `goalgan_bt.envs.gymnasium_vector` the vectors.
"""

import gymnasium

from goalgan_bt import envs

BODIES = {"point": "Point", "ant": "Ant"}
SINGLE = "goalgan_bt.envs.gymnasium_env:GoalGymEnv"
MANY = "goalgan_bt.envs.gymnasium_vector:GoalVectorEnv"


def env_id(name: str) -> str:
    """The id of an environment by its name: `ant_umaze` is `goalgan_bt/AntUMaze-v0`."""
    if name == "point_nd":
        return "goalgan_bt/PointND-v0"
    body, layout = name.split("_")
    return f"goalgan_bt/{BODIES[body]}{'UMaze' if layout == 'umaze' else layout.title()}-v0"


def register() -> tuple[str, ...]:
    """Make the ids known to Gymnasium; those that are already stay as they are.

    Returns:
        All of them.
    """
    four_rooms = "goalgan_bt/FourRooms-v0"
    ours = [name for name in envs.NAMES if name not in envs.OFFICIAL]  # those have ids already
    known = {env_id(name): name for name in ours}
    for one, name in known.items():
        if one not in gymnasium.registry:
            gymnasium.register(
                one, entry_point=SINGLE, vector_entry_point=MANY, kwargs={"name": name}
            )
    if four_rooms not in gymnasium.registry:
        gymnasium.register(four_rooms, entry_point="goalgan_bt.envs.four_rooms_env:FourRoomsEnv")
    return *known, four_rooms


IDS = register()
