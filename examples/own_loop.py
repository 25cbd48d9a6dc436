"""A curriculum of goals in a loop of one's own: PPO on a reacher in three dimensions."""

import gymnasium as gym
import numpy as np
import torch

from goalgan_bt import GoalCurriculum

CUBE, SLAB = np.full(3, 2.0), np.array([2.0, 2.0, 0.2])  # where goals may be, where the hand may


class Reach(gym.Env):  # a hand that moves 0.1 m a step; reward 1 within 0.3 m of its goal, else 0
    observation_space = gym.spaces.Box(-2.0, 2.0, (6,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (3,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.hand, self.goal = np.zeros(3), options["goal"]
        return np.concatenate([self.hand, self.goal]), {}

    def step(self, action):
        self.hand = np.clip(self.hand + 0.1 * np.clip(action, -1, 1), -SLAB, SLAB)
        won = bool(np.linalg.norm(self.goal - self.hand) < 0.3)
        return np.concatenate([self.hand, self.goal]), float(won), won, False, {}


def episode(env, net, goal, noise):  # observations, actions, returns (T, ...); success; its end
    (obs, _), path, done = env.reset(options={"goal": goal}), [], False
    while not done:
        mean = net(torch.as_tensor(obs).float()).detach()[:3]
        path.append((obs, (mean + noise * torch.randn(3)).numpy()))
        obs, reward, terminated, truncated, _ = env.step(path[-1][1])
        done = terminated or truncated
    returns = reward * 0.97 ** np.arange(len(path))[::-1]
    return *zip(*path, strict=True), returns, reward, env.unwrapped.hand


def learn(with_curriculum, rounds=40, n=64, seed=0):  # the share of goals reached in the end
    rng, _ = np.random.default_rng(seed), torch.manual_seed(seed)
    curriculum, env = GoalCurriculum(-CUBE, CUBE, seed), gym.wrappers.TimeLimit(Reach(), 40)
    net = torch.nn.Sequential(torch.nn.Linear(6, 64), torch.nn.Tanh(), torch.nn.Linear(64, 4))
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    for _ in range(rounds):
        goals = curriculum.ask(n) if with_curriculum else rng.uniform(-CUBE, CUBE, (n, 3))
        *columns, success, ends = zip(*(episode(env, net, g, 0.5) for g in goals), strict=True)
        if with_curriculum:
            curriculum.tell(goals, success, visited=ends)
        obs, acts, returns = (torch.as_tensor(np.concatenate(x)).float() for x in columns)
        old = net(obs).detach()
        advantages = (returns - old[:, 3]) / (returns - old[:, 3]).std().add(1e-6)
        for _ in range(20):
            out = net(obs)
            ratio = (((acts - old[:, :3]) ** 2 - (acts - out[:, :3]) ** 2).sum(1) / 0.5).exp()
            gain = torch.min(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages).mean()
            loss = (returns - out[:, 3]).square().mean() - gain
            optimiser.zero_grad(), loss.backward(), optimiser.step()
    return np.mean([episode(env, net, g, 0.0)[3] for g in rng.uniform(-SLAB, SLAB, (200, 3))])


print(f"reached with the curriculum {learn(True):.2f}, with uniform goals {learn(False):.2f}")
