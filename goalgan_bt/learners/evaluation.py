"""How well a trained policy does, in its own world or in an environment of Gymnasium's."""

import contextlib
import io
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from goalgan_bt.agent.coverage import attempts
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.learners.maze_learner import load_policy
from goalgan_bt.learners.trained_policy import TrainedPolicy, world_of
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.terminal import complain

SIDE_BY_SIDE = 512  # simulations
PER_GOAL = 3  # episodes for each test goal where no number is given
ON = 100  # episodes elsewhere where no number is given


class Attempted(NamedTuple):
    """n episodes: success, fell: (n,) bool; seconds: (n,) how long each took."""

    success: BoolArray
    fell: BoolArray
    seconds: FloatArray


def at_home(
    folder: Path,
    episodes: int | None,
    deterministic: bool,
    seed: int,
    threads: int,
    horizon: int | None = None,
) -> dict[str, Any]:
    """Try the test goals of the run's own world, as coverage is measured, and tell what came of it.

    Args:
        folder: the run folder; its last checkpoint counts.
        episodes: in all, spread evenly over the test goals; three for each if None. Without noise
            at most one for each: all others would be the same.
        deterministic: without the noise of exploration.
        seed: of that noise.
        threads: simulation threads, 0 for one per core.
        horizon: steps of an episode; as many as in the run if None.

    Raises:
        RunError: if the folder is no run of a maze, or has no checkpoint that can be read.
        UsageError: for a horizon that is no whole number of actions.
    """
    cfg, one = world_of(folder, 1)
    if horizon is not None and horizon % cfg.action_repeat:
        raise UsageError(f"--horizon must be a multiple of the run's {cfg.action_repeat} steps")
    tested = one.test_goals()
    n = PER_GOAL * len(tested) if episodes is None else episodes
    if deterministic:
        n = min(n, len(tested))
    most = SIDE_BY_SIDE if one.settable else cfg.rollout.num_envs
    side_by_side = min(n, most)
    _, env = world_of(folder, side_by_side, threads, horizon)
    policy, iteration = load_policy(env, cfg, folder)
    goals = tested[spread(n, len(tested))]
    noise = None if deterministic else torch.Generator().manual_seed(seed)
    done = Attempted(np.zeros(n, bool), np.zeros(n, bool), np.zeros(n))
    for begin in range(0, n, side_by_side):
        for active, step in attempts(env, policy, goals[begin : begin + side_by_side], noise):
            now = begin + active
            done.seconds[now] += env.dt * env.action_repeat
            done.success[now] = step.rewards > 0
            done.fell[now] = step.terminated & (step.rewards == 0)
    return {"run": str(folder), "iteration": iteration, "world": env.name} | told(
        done, deterministic, seed
    )


def elsewhere(
    folder: Path, name: str, episodes: int | None, deterministic: bool, seed: int
) -> dict[str, Any]:
    """Let it act in an environment of Gymnasium's, one episode after the other.

    Args:
        folder: the run folder.
        name: the id of an environment with goals whose body is the run's: what it tells must be the
            state, or the state without its place, which then is the achieved goal.
        episodes: how many; 100 if None.
        deterministic: without the noise of exploration.
        seed: of that noise and of the first episode.

    Raises:
        RunError: as `at_home`.
        UsageError: for an environment that there is not, or in which it cannot act.
    """
    policy = TrainedPolicy(folder, seed)
    name = name.removeprefix("gymnasium_robotics:")
    env = made(name, policy.env)
    n = ON if episodes is None else episodes
    done = Attempted(np.zeros(n, bool), np.zeros(n, bool), np.zeros(n))
    returns = np.zeros(n)
    duration = step_seconds(env, policy.env)
    repeat = max(1, round(policy.env.action_repeat * policy.env.dt / duration))  # as long as there
    try:
        for i in range(n):
            obs, _ = env.reset(seed=seed + i)
            ended, action, actions = False, np.zeros(0), 0
            while not ended:
                if actions % repeat == 0:
                    state = state_of(obs, policy.env, name)
                    action = policy.act(state, obs["desired_goal"], deterministic)
                obs, reward, terminated, truncated, info = env.step(
                    action.astype(env.action_space.dtype)
                )
                actions += 1
                returns[i] += reward
                if not done.success[i]:  # some go on after success
                    done.success[i] = info.get("success", info.get("is_success", False))
                    done.seconds[i] = actions * duration
                ended = terminated or truncated
                done.fell[i] = terminated and not done.success[i]
    finally:
        env.close()
    found = {"run": str(folder), "iteration": policy.iteration, "world": name}
    return found | told(done, deterministic, seed) | {"return": float(returns.mean())}


def made(name: str, body: GoalEnv) -> Any:
    """The environment of Gymnasium's of that name, for a body.

    Raises:
        UsageError: if there is none, or its actions are another body's.
    """
    import gymnasium

    import goalgan_bt.gym  # noqa: F401  (its ids)

    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")  # of newer versions, and about other environments
            if name.startswith(("AntMaze", "PointMaze")):
                import gymnasium_robotics

                gymnasium.register_envs(gymnasium_robotics)
            env: Any = gymnasium.make(name)
    except Exception as error:  # each package has its own
        said = str(error).splitlines() or [type(error).__name__]
        raise UsageError(f"--on {name}: {said[0]}") from None
    if env.action_space.shape != (body.act_dim,):
        env.close()
        raise UsageError(
            f"--on {name}: its actions are of shape {env.action_space.shape}, and the run's body "
            f"takes {body.act_dim} numbers: choose an environment of the same body"
        )
    cells = cells_of(env)
    if cells is not None and body.maze is not None and cells != cells_of(body):
        complain(
            f"{name} has another maze than the run: the policy goes by the ways of its own",
            "warning",
        )
    return env


def cells_of(env: Any) -> set[tuple[float, ...]] | None:
    """The middles of the free cells, in gymnasium-robotics' mazes or ours; None where no maze is
    known."""
    inner = getattr(env, "unwrapped", env)
    maze: Any = getattr(getattr(inner, "sims", inner), "maze", None)
    if isinstance(maze, Maze):
        centres = maze.cell_centres()
    elif hasattr(maze, "maze_map"):
        free = [(r, c) for r, row in enumerate(maze.maze_map) for c, x in enumerate(row) if x != 1]
        centres = np.array([maze.cell_rowcol_to_xy(np.array(cell)) for cell in free])
    else:
        return None
    return {tuple((np.round(place, 6) + 0.0).tolist()) for place in centres}


def step_seconds(env: Any, body: GoalEnv) -> float:
    """How long a step of an environment is: as it says, or the robot inside it (gymnasium-robotics'
    mazes), or as the body's own."""
    inner = env.unwrapped
    known = (inner, *(getattr(inner, name, None) for name in ("point_env", "ant_env", "sims")))
    return next((float(one.dt) for one in known if hasattr(one, "dt")), body.dt)


def state_of(obs: Any, body: GoalEnv, name: str) -> NDArray[np.float64]:
    """The state of the body, (state_dim,), from what an environment tells.

    Raises:
        UsageError: where it does not tell it.
    """
    wanted = {"observation", "achieved_goal", "desired_goal"}
    if isinstance(obs, dict) and wanted <= set(obs):
        seen = np.asarray(obs["observation"], dtype=float)
        if name.startswith("AntMaze"):  # its contact forces stand behind the state
            seen = seen[: body.state_dim - body.goal_dim]
        if seen.shape == (body.state_dim,):
            return seen
        if seen.shape == (body.state_dim - body.goal_dim,):
            return np.concatenate([np.asarray(obs["achieved_goal"], dtype=float), seen])
    raise UsageError(
        f"--on {name}: it must tell goals and the {body.state_dim} numbers of the body's state"
    )


def spread(n: int, goals: int) -> NDArray[np.int64]:
    """n of so many goals, each as often as any other, or where n is less, evenly spaced; (n,)."""
    return np.asarray(np.arange(n) * goals // n)


def told(done: Attempted, deterministic: bool, seed: int) -> dict[str, Any]:
    """What came of episodes, as numbers that JSON knows."""
    n, reached = len(done.success), int(done.success.sum())
    interval = stats.binomtest(reached, n).proportion_ci(method="wilson")
    times = done.seconds[done.success]
    return {
        "policy": "deterministic" if deterministic else "stochastic",
        "seed": seed,
        "episodes": n,
        "success": reached / n,
        "interval_95": [float(interval.low), float(interval.high)],
        "fell": float(done.fell.mean()),
        "out_of_time": float((~done.success & ~done.fell).mean()),
        "seconds_to_goal": {
            "median": float(np.median(times)) if reached else None,
            "nine_of_ten": float(np.quantile(times, 0.9)) if reached else None,
        },
    }
