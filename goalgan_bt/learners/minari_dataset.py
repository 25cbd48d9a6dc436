"""Episodes of a trained policy as a data set of Minari's, for offline learning.

They are recorded in the Gymnasium environment of the run's world. The data set holds what makes
that environment again, and the seed of each episode.
"""

import shutil
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id
from minari.storage import get_dataset_path

import goalgan_bt.gym
from goalgan_bt import envs
from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners.trained_policy import TrainedPolicy, settings_of
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.run_folder import commits, env_of


class Recorded(NamedTuple):
    """folder: where the data set is; episodes, steps: how many; success: the share of episodes
    that reached their goal."""

    folder: Path
    episodes: int
    steps: int
    success: float


def record(folder: Path, name: str, episodes: int, deterministic: bool, seed: int) -> Recorded:
    """Let the policy of a run act, and create a data set of what came of it.

    Args:
        folder: the run folder; its last checkpoint counts.
        name: the id of the data set, as Minari takes it.
        episodes: how many; their goals are uniform over the free space.
        deterministic: without the noise of exploration.
        seed: of that noise and of the first episode; the next ones have the next seeds.

    Raises:
        RunError: if the folder is no run of a maze, or has no checkpoint that can be read.
        UsageError: for an id that Minari does not take or has already, and for an environment that
            is not built in.
    """
    place = free_place(name)
    made_in = env_of(folder)
    if made_in and made_in not in envs.NAMES:
        raise UsageError(
            f"{folder} is a run of {made_in}: --minari goes with the mazes and boxes that come "
            "along, which Gymnasium can make again elsewhere"
        )
    if made_in in envs.OFFICIAL:
        raise UsageError(
            f"{folder} is a run of {made_in}, whose environment is gymnasium-robotics' own: "
            "--minari goes with the mazes and boxes that come along"
        )
    policy = TrainedPolicy(folder, seed)
    env = environment(folder, policy)
    tried = [attempt(env, policy, seed + i, deterministic) for i in range(episodes)]
    success = float(np.mean([episode.rewards[-1] for episode in tried]))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Minari's wishes, such as for an e-mail address
            data = minari.create_dataset_from_buffers(
                name,
                tried,
                env,
                algorithm_name=f"TRPO, goalgan_bt --method {settings_of(folder).method}",
                author="goalgan_bt",
                description=described(folder, policy, success, deterministic),
                requirements=[f"mujoco=={metadata.version('mujoco')}"],  # bit for bit only there
            )
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)  # half of one would be in the way of the next
        raise
    return Recorded(place, episodes, int(data.total_steps), success)


def free_place(name: str) -> Path:
    """Where a data set of that id will be.

    Raises:
        UsageError: for an id that Minari does not take, or that is taken.
    """
    try:
        parse_dataset_id(name)
    except (TypeError, ValueError):  # the former for one without a version
        raise UsageError(
            f"--minari {name}: Minari takes no such id; one that it takes is point/umaze-v0"
        ) from None
    place = Path(get_dataset_path(name))
    if place.exists():
        raise UsageError(
            f"--minari {name}: {place} is there already: remove it with `minari delete {name}`, "
            "or choose another id, such as the next version"
        )
    return place


def environment(folder: Path, policy: TrainedPolicy) -> Any:
    """The run's world in Gymnasium: its maze, its time, and actions that are held as long."""
    cfg, world = settings_of(folder), policy.env
    settings: dict[str, Any] = {"horizon": world.horizon, "action_repeat": world.action_repeat}
    if world.maze is None:
        settings["dim"] = cfg.dim
    else:
        settings["integrator"] = cfg.integrator
        if world.maze.rows != mazes.layout(cfg.env.split("_")[1]).rows:
            settings["map_rows"] = list(world.maze.rows)
        if world.maze.cell_size != mazes.Maze.cell_size:
            settings["cell_size"] = world.maze.cell_size
    return gymnasium.make(goalgan_bt.gym.env_id(cfg.env), **settings)


def attempt(env: Any, policy: TrainedPolicy, seed: int, deterministic: bool) -> EpisodeBuffer:
    """One episode, as arrays: what `minari.DataCollector` would record, which needs all of JAX to
    append to lists."""
    steps: list[tuple[Any, ...]] = []
    obs, info = env.reset(seed=seed)
    seen, told, ended = [obs], [info], False
    while not ended:
        action = policy.act(obs["observation"], obs["desired_goal"], deterministic)
        action = action.astype(env.action_space.dtype)
        obs, reward, terminated, truncated, info = env.step(action)
        seen.append(obs)
        told.append(info)
        steps.append((action, reward, terminated, truncated))
        ended = terminated or truncated
    actions, rewards, terminations, truncations = map(list, zip(*steps, strict=True))
    return EpisodeBuffer(
        seed=seed,
        observations=columns(seen),
        actions=np.array(actions),
        rewards=rewards,
        terminations=terminations,
        truncations=truncations,
        infos=columns(told),
    )


def columns(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """A dictionary of arrays from dictionaries of their rows."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def described(folder: Path, policy: TrainedPolicy, success: float, deterministic: bool) -> str:
    """The description that the data set holds."""
    noise = "without" if deterministic else "with"
    return (
        f"Episodes in {policy.env.name} of a policy that goalgan_bt has trained (method "
        f"{settings_of(folder).method}, iteration {policy.iteration}, commit {commits(folder)}), "
        f"{noise} the noise of exploration. They begin at the start of the maze, with goals "
        f"uniform over the free space. The reward is 1 on reaching the goal, which ends the "
        f"episode, else 0; {success:.1%} of the episodes reach it."
    )
