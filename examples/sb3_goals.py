"""SAC with hindsight of Stable-Baselines3 on the point's U-maze, with the curriculum and without.

    python examples/sb3_goals.py                    # a minute or two each
    python examples/sb3_goals.py --steps 100000 --seed 1

Without it, goals are uniform over the free space, which only somebody who knows the maze can draw;
the curriculum is told nothing but how trying went.
"""

import argparse

import gymnasium
import numpy as np
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env

import goalgan_bt.gym  # noqa: F401  (the ids)
from goalgan_bt import CurriculumGoals, GoalCurriculum
from goalgan_bt.sb3 import GoalGANCallback

ENV = "goalgan_bt/PointUMaze-v0"
HOW = {"action_repeat": 4}  # an episode is 50 actions


def train(steps: int, seed: int, with_curriculum: bool) -> SAC:
    envs = make_vec_env(ENV, 4, seed=seed, wrapper_class=CurriculumGoals, env_kwargs=HOW)
    agent = SAC(
        "MultiInputPolicy",
        envs,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=1000,
        seed=seed,
        device="cpu",
    )
    callback = None
    if with_curriculum:
        bodies = gymnasium.make(ENV).unwrapped.sims
        callback = GoalGANCallback(GoalCurriculum(bodies.goal_low, bodies.goal_high, seed=seed))
    return agent.learn(steps, callback=callback)


def coverage(agent: SAC) -> float:
    """The share of the tiles that the agent reaches from the start."""
    env = gymnasium.make(ENV, **HOW)
    reached = []
    for goal in env.unwrapped.sims.test_goals():
        obs, _ = env.reset(options={"goal": goal})
        ended = False
        while not ended:
            action, _ = agent.predict(obs, deterministic=True)
            obs, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        reached.append(info["is_success"])
    return float(np.mean(reached))


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--steps", type=int, default=20_000, help="actions of training")
    words.add_argument("--seed", type=int, default=0)
    given = words.parse_args()
    for with_curriculum in (True, False):
        name = "curriculum" if with_curriculum else "free goals"
        covered = coverage(train(given.steps, given.seed, with_curriculum))
        print(f"{name}: coverage {covered:.2f} after {given.steps} actions", flush=True)
