"""The worlds: batched goal-reaching tasks on numpy and MuJoCo; nothing of learning in them.

`make` builds one by name; `GoalEnv` in `goalgan_bt.envs.goal_env` is the contract.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from goalgan_bt.envs import maze as mazes
from goalgan_bt.envs import own

if TYPE_CHECKING:
    from goalgan_bt.envs.goal_env import GoalEnv

HORIZON = {"point": 200, "ant": 500}  # steps of an episode in the U-maze
OFFICIAL = tuple(f"{b}_{layout}_gym" for b in HORIZON for layout in ("umaze", "medium", "large"))
NAMES = (
    *(f"{body}_{layout}" for body in HORIZON for layout in mazes.LAYOUTS),
    *OFFICIAL,  # gymnasium-robotics' own
    "point_nd",
)


def make(
    name: str,
    num_envs: int,
    *,
    threads: int = 0,
    horizon: int | None = None,
    action_repeat: int = 1,
    integrator: str | None = None,
    dim: int = 2,
    cell_size: float = 2.0,
    map_file: Path | None = None,
    maze: mazes.Maze | None = None,
    physics: str = "mujoco",
    device: str = "auto",
) -> "GoalEnv":
    """N simulations of the environment of that name.

    Args:
        name: one of `NAMES`, or one's own (see `goalgan_bt.envs.own`).
        num_envs: N.
        threads: simulation threads, 0 for one per core.
        horizon: steps of an episode; None: 200 (point) or 500 (Ant), more in long or official mazes.
        action_repeat: steps for which each action is held.
        integrator: `implicitfast`, `rk4` or the body's `own`; None: `own` in official tasks only.
        dim: dimensions of `point_nd`, 2 to 6.
        cell_size: side of a cell of a maze, metres.
        map_file: a text map that replaces the layout (see `goalgan_bt.envs.maze`).
        maze: a maze that replaces both, for example the one that a run has recorded.
        physics: `mujoco`, or `warp` for mujoco-warp (extra `gpu`), for MuJoCo bodies.
        device: of mujoco-warp: `cpu`, `cuda`, ...; `auto` is a GPU where there is one.

    Raises:
        ValueError: for an unknown name or a dim out of range.
        PhysicsError: for `warp` where there is none (see `goalgan_bt.envs.warp_batch`).
        MapError: for a map that is not a maze, or that is too narrow for the body.
    """
    mine = own.find(name)
    if mine is None and name not in NAMES:
        raise ValueError(f"unknown environment {name!r}: choose one of {', '.join(NAMES)}")
    # Only now: MuJoCo takes half a second to import, and `--help` needs the names only.
    from goalgan_bt.envs import official
    from goalgan_bt.envs.ant_maze import AntMaze
    from goalgan_bt.envs.goal_env import PhysicsError
    from goalgan_bt.envs.mujoco_env import MazeEnv
    from goalgan_bt.envs.point_maze import PointMaze
    from goalgan_bt.envs.point_nd import PointND

    if name == "point_nd":
        if not 2 <= dim <= 6:
            raise ValueError(f"point_nd has 2 to 6 dimensions, not {dim}")
        if physics == "warp":
            raise PhysicsError("point_nd is no MuJoCo model: warp goes with point_... and ant_...")
        return PointND(dim, num_envs, horizon or 200, action_repeat)
    how = action_repeat, threads, physics, device
    if name in OFFICIAL:
        return official.make(name, maze, integrator or "own", num_envs, horizon, *how)
    make_body: Any
    if mine is None:
        body, layout = name.split("_")
        make_body = {"point": PointMaze, "ant": AntMaze}[body]
    else:
        make_body, layout = mine.make, "umaze"
        body = name.rpartition(":")[2].lower()
        if not (isinstance(make_body, type) and issubclass(make_body, MazeEnv)):
            if map_file is not None:
                raise mazes.MapError(f"{name} has no maze: it takes no map")
            if physics == "warp":
                raise PhysicsError(f"{name} is no maze of ours: it has physics of its own")
            env = own.made(name, make_body, num_envs, horizon, action_repeat, threads)
            env.name = body
            return env
    if maze is None:
        named = mazes.layout(layout) if map_file is None else mazes.load(map_file)
        maze = mazes.Maze(named.rows, cell_size)
    if horizon is None:
        horizon = _horizon(HORIZON[body] if mine is None else make_body.usual_horizon, maze)
    settings = maze, integrator or "implicitfast", num_envs, horizon, *how
    env = make_body(*settings) if mine is None else own.made(name, make_body, *settings)
    env.name = f"{body}_{layout if map_file is None else map_file.stem}"
    return env if mine else _standing(env, body)


def _standing(env: Any, body: str) -> Any:
    """The same environment, unless its cells are too narrow for the body to stand in.

    Raises:
        MapError: saying how wide they are.
    """
    if not env.valid(env.start_state[None])[0]:
        side = env.maze.cell_size
        raise mazes.MapError(f"the {body} does not fit into cells of {side:g} m: make them larger")
    return env


def _horizon(usual: int, maze: mazes.Maze) -> int:
    """Steps of an episode: more than in the U-maze where the longest way is longer, in proportion,
    so that a body has the same time for each metre everywhere."""
    scale = maze.longest_way / mazes.layout("umaze").longest_way
    return max(usual, 100 * round(usual * scale / 100))
