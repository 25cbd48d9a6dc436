"""PPO in one file on the point's U-maze, with the curriculum or without: a loop to begin from.

    python examples/ppo_goals.py                    # a minute on one core
    python examples/ppo_goals.py --steps 600000 --seed 1 --no-curriculum

The maze's vector environment resets nothing by itself here. After each action the loop looks at how
episodes ended, and begins the next one of just those simulations, each with a goal of its own.

Coverage of seeds 0, 1, 2 after the 300,000 actions of the default: 0.96, 0.73, 0.79 with the
curriculum (50 seconds on one core), 0.75, 1.00, 0.77 with free goals (40 seconds), which only
somebody who knows the maze can draw; with the curriculum after 600,000: 1.00, 0.71, 0.79. More
actions do not help the seeds that come to no more.
"""

import argparse
from itertools import pairwise

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn
from torch.distributions import Normal

import goalgan_bt.gym  # noqa: F401  (the ids)
from goalgan_bt import GoalCurriculum

ENV = "goalgan_bt/PointUMaze-v0"
ENVS, ROLLOUT = 32, 64  # simulations side by side; actions of each between two updates
EPOCHS, MINIBATCHES = 10, 8
RATE, GAMMA, LAMBDA = 1e-3, 0.99, 0.95
CLIP, ENTROPY, VALUE, GRADIENT = 0.2, 0.01, 0.5, 0.5


def make(num_envs: int) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        ENV,
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.DISABLED,
        action_repeat=4,  # an episode is 50 actions
        threads=1,
    )


def features(obs: dict) -> torch.Tensor:
    """What the networks see: the state, and which way the goal lies and how far."""
    offset = obs["desired_goal"] - obs["achieved_goal"]
    return torch.as_tensor(np.concatenate([obs["observation"], offset], axis=1)).float() / 3


def network(*sizes: int, last: float) -> nn.Sequential:
    layers = []
    for before, after in pairwise(sizes):
        layer = nn.Linear(before, after)
        nn.init.orthogonal_(layer.weight, 2**0.5)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    nn.init.orthogonal_(layer.weight, last)
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    def __init__(self, seen: int, actions: int) -> None:
        super().__init__()
        self.mean = network(seen, 64, 64, actions, last=0.01)
        self.value = network(seen, 64, 64, 1, last=1.0)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))

    def policy(self, seen: torch.Tensor) -> Normal:
        return Normal(self.mean(seen), self.log_std.exp())


class Loop:
    """Simulations that go on from one rollout to the next."""

    def __init__(self, seed: int, with_curriculum: bool) -> None:
        torch.manual_seed(seed)
        self.envs = make(ENVS)
        sims = self.envs.unwrapped.sims
        self.curriculum = (
            GoalCurriculum(sims.goal_low, sims.goal_high, seed=seed) if with_curriculum else None
        )
        self.goals = np.zeros((ENVS, sims.goal_dim))
        self.envs.reset(seed=seed)  # of the goals that the simulations draw themselves
        self.obs = self.begin(np.ones(ENVS, dtype=bool))
        self.agent = Agent(features(self.obs).shape[1], sims.act_dim)

    def begin(self, ended: np.ndarray) -> dict:
        """The next episodes of simulations that have ended; the others go on untouched."""
        options = {"reset_mask": ended}
        if self.curriculum is not None:
            self.goals[ended] = self.curriculum.ask(int(ended.sum()))
            options["goal"] = self.goals  # of which only the rows in the mask are read
        return self.envs.reset(options=options)[0]

    def rollout(self) -> list[torch.Tensor]:
        """(ROLLOUT, ENVS, ...): seen before and after actions, actions, rewards, ends, deaths."""
        columns, tried, success, visited = [], [], [], []
        for step in range(ROLLOUT):
            seen = features(self.obs)
            with torch.no_grad():
                action = self.agent.policy(seen).sample()
            after, reward, terminated, truncated, _ = self.envs.step(action.numpy())
            ended = terminated | truncated
            rows = (np.float32(reward), ended, terminated)
            columns.append((seen, features(after), action, *map(torch.as_tensor, rows)))
            if step % 10 == 0:
                visited.append(after["achieved_goal"])
            self.obs = after
            if ended.any():
                tried.append(after["desired_goal"][ended])
                success.append(terminated[ended])  # the point cannot fall: it has come to its goal
                self.obs = self.begin(ended)
        if self.curriculum is not None and tried:
            told = np.concatenate(tried), np.concatenate(success)
            self.curriculum.tell(*told, visited=np.concatenate(visited))
        return [torch.stack(column) for column in zip(*columns, strict=True)]


def advantages(agent: Agent, seen, after, rewards, ended, terminated) -> torch.Tensor:
    """Generalised advantage estimation. An episode that was cut short would have gone on: it counts
    what its last observation is worth, which is in `after`; one that terminated counts nothing."""
    with torch.no_grad():
        values, later = agent.value(seen)[..., 0], agent.value(after)[..., 0]
    surprise = rewards + GAMMA * later * ~terminated - values
    gained, carried = torch.zeros_like(surprise), torch.zeros(ENVS)
    for t in reversed(range(ROLLOUT)):
        gained[t] = carried = surprise[t] + GAMMA * LAMBDA * carried * ~ended[t]
    return gained


def learn(agent: Agent, optimiser: torch.optim.Optimizer, batch: list[torch.Tensor]) -> None:
    seen, after, actions, rewards, ended, terminated = batch
    gained = advantages(agent, seen, after, rewards, ended, terminated)
    with torch.no_grad():
        returns = gained + agent.value(seen)[..., 0]
        before = agent.policy(seen).log_prob(actions).sum(-1)
    flat = [x.flatten(0, 1) for x in (seen, actions, before, gained, returns)]
    for _ in range(EPOCHS):
        for rows in torch.randperm(ENVS * ROLLOUT).chunk(MINIBATCHES):
            seen, actions, before, gained, returns = (x[rows] for x in flat)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(actions).sum(-1) - before).exp()
            gained = (gained - gained.mean()) / (gained.std() + 1e-8)
            gain = torch.min(ratio * gained, ratio.clamp(1 - CLIP, 1 + CLIP) * gained).mean()
            error = (agent.value(seen)[..., 0] - returns).square().mean()
            loss = VALUE * error - gain - ENTROPY * policy.entropy().sum(-1).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), GRADIENT)
            optimiser.step()


def train(steps: int, seed: int, with_curriculum: bool) -> Agent:
    loop = Loop(seed, with_curriculum)
    optimiser = torch.optim.Adam(loop.agent.parameters(), eps=1e-5)
    updates = max(1, steps // (ENVS * ROLLOUT))
    for update in range(updates):
        optimiser.param_groups[0]["lr"] = RATE * (1 - update / updates)
        learn(loop.agent, optimiser, loop.rollout())
    return loop.agent


def coverage(agent: Agent) -> float:
    """The share of the tiles of the free space that the policy, without noise, reaches."""
    goals = make(1).unwrapped.sims.test_goals()
    envs = make(len(goals))  # all of them at once
    obs, _ = envs.reset(options={"goal": goals})
    reached, over = np.zeros((2, len(goals)), dtype=bool)
    while not over.all():
        with torch.no_grad():
            obs, _, terminated, truncated, _ = envs.step(agent.mean(features(obs)).numpy())
        reached |= terminated & ~over
        ended = terminated | truncated
        over |= ended
        if ended.any():
            # No simulation steps on before these begin again; what they do then does not count.
            obs, _ = envs.reset(options={"goal": goals, "reset_mask": ended})
    return float(reached.mean())


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--steps", type=int, default=300_000, help="actions of training, in all")
    words.add_argument("--seed", type=int, default=0)
    words.add_argument("--curriculum", action=argparse.BooleanOptionalAction, default=True)
    given = words.parse_args()
    covered = coverage(train(given.steps, given.seed, given.curriculum))
    name = "curriculum" if given.curriculum else "free goals"
    print(f"{name}: coverage {covered:.2f} after {given.steps} actions")
