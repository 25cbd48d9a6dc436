"""The plug-in for Stable-Baselines3: three agents on a task that knows nothing of us."""

import copy
import time

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

pytest.importorskip("stable_baselines3")
sb3_contrib = pytest.importorskip("sb3_contrib")
from stable_baselines3 import DQN, PPO, SAC  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.logger import configure  # noqa: E402
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize  # noqa: E402

from goalgan_bt.learners import stable_baselines  # noqa: E402
from goalgan_bt.learners.gaussian_agent import Rows  # noqa: E402
from goalgan_bt.learners.stable_baselines import RecallTraces, Seen, Trajectory  # noqa: E402
from goalgan_bt.recall.settings import RecallConfig  # noqa: E402
from goalgan_bt.runs import checkpoint  # noqa: E402

FASTEST = np.array([0.2, 0.4], np.float32)
AGENTS = {"SAC": SAC, "TRPO": sb3_contrib.TRPO, "PPO": PPO}
RANDOM = -20.0  # a return that is no better than chance; at best it is about -4


class Reach(gymnasium.Env):
    """Walk to the middle of a square, at most 0.2 a step in each direction; 30 steps."""

    def __init__(self):
        self.observation_space = spaces.Box(-2 * np.ones(2, np.float32), 2 * np.ones(2, np.float32))
        self.action_space = spaces.Box(
            np.array([-0.2, -0.4]), np.array([0.2, 0.4]), dtype=np.float32
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._at, self._age = self.np_random.uniform(-1, 1, 2), 0
        return self._at.astype(np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action.astype(np.float32))
        self._at, self._age = np.clip(self._at + action, -2, 2), self._age + 1
        return self._at.astype(np.float32), -np.abs(self._at).sum(), False, self._age == 30, {}


def agent(name, env, **more):
    if name == "SAC":
        small = {"batch_size": 64, "policy_kwargs": {"net_arch": [32, 32]}}
        more = {"learning_starts": 200, "gamma": 0.9, "learning_rate": 3e-3} | small | more
    else:
        size = {"n_steps": 256, "batch_size": 256, "gamma": 0.9, "gae_lambda": 0.9}
        size |= {"learning_rate": 3e-3} if name == "PPO" else {}
        more = size | more
    return AGENTS[name]("MlpPolicy", env, seed=0, device="cpu", **more)


def recall(**more):
    return RecallTraces(RecallConfig(trace_length=5, min_steps=100, **more))


@pytest.mark.parametrize(
    ("name", "steps", "good"), [("SAC", 2000, -10), ("TRPO", 12000, -12), ("PPO", 12000, -12)]
)
def test_agents_learn_with_recall_traces(name, steps, good, tmp_path):
    """To a stated return; saved, loaded and continued; in vector environments."""
    env = make_vec_env(Reach, n_envs=1 if name == "SAC" else 4, seed=0)
    model, callback = agent(name, env), recall()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    before, _ = evaluate_policy(model, env, 20)
    model.learn(steps, callback=callback)
    after, _ = evaluate_policy(model, env, 20)
    assert before < RANDOM < good < after, (before, after)
    told = callback.turn()
    assert told["kl"] <= 0.005 and 0 < told["valid"] <= 1 and np.isfinite(told["log_ratio"])
    assert "recall/threshold" in (tmp_path / "progress.csv").read_text()

    model.save(tmp_path / "agent")
    callback.save(tmp_path / "recall.pt")
    model = AGENTS[name].load(tmp_path / "agent", env=env)
    again = RecallTraces.load(tmp_path / "recall.pt")
    assert again.cfg == callback.cfg
    again.save(tmp_path / "recall.pt")  # also before it has gone on
    assert len(again.trajectories) == len(callback.trajectories)
    model.learn(500, callback=again, reset_num_timesteps=False)
    for a, b in zip(callback.trajectories, again.trajectories, strict=False):
        np.testing.assert_array_equal(a.obs, b.obs)
    assert len(again.trajectories) > len(callback.trajectories)
    continued, _ = evaluate_policy(model, env, 20)
    assert continued > good - 4


def imitate(callback, states, actions, seen):
    """As a turn does, within the bound of the moment."""
    return callback.imitation.update(states, actions, seen, callback.max_kl())


def test_trajectories_are_what_happened():
    env = make_vec_env(Reach, n_envs=3, seed=0)
    callback = recall()
    agent("PPO", env).learn(1000, callback=callback)
    assert len(callback.trajectories) >= 30
    for obs, actions, rewards, terminated in callback.trajectories:
        assert not terminated
        assert obs.shape == (31, 2) and actions.shape == (30, 2)
        assert np.abs(actions).max() <= 1 + 1e-6
        moved = np.clip(obs[:-1] + actions * FASTEST, -2, 2)
        np.testing.assert_allclose(moved, obs[1:], atol=1e-5)
        np.testing.assert_allclose(rewards, -np.abs(obs[1:]).sum(axis=1), atol=1e-5)


def test_rewards_are_the_environments_own_where_they_are_normalised():
    env = VecNormalize(make_vec_env(Reach, n_envs=2, seed=0))
    callback = recall()
    agent("PPO", env).learn(1000, callback=callback)
    returns = [one.rewards.sum() for one in callback.trajectories]
    assert np.mean(returns) < RANDOM / 2  # normalised they would be about 1 a step


def test_the_threshold_is_a_percentile_and_the_memory_has_an_end():
    callback = RecallTraces(RecallConfig(top_percent=20, capacity=100, min_steps=20))
    for i in range(50):
        callback.remember(Trajectory(np.zeros((6, 2)), np.zeros((5, 2)), np.full(5, i % 10), False))
    assert sum(len(one.rewards) for one in callback.trajectories) == 100
    chosen, threshold = callback.best()
    assert threshold == 5 * 8 and len(chosen) == 4  # of 20 trajectories those of 8 and 9 a step
    callback = recall(top_percent=20)
    for i in range(100):  # sparse reward: one in twenty gets there
        won = np.array([float(i % 20 == 0)])
        callback.remember(Trajectory(np.zeros((2, 2)), np.zeros((1, 2)), won, True))
    chosen, threshold = callback.best()
    assert threshold == 1 and len(chosen) == 5
    callback.trajectories.clear()
    same = Trajectory(np.zeros((2, 2)), np.zeros((1, 2)), np.ones(1), True)
    callback.trajectories.extend([same, same])
    assert callback.best()[0] == []  # none is better than another


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_imitation_moves_the_mean(name):
    """Towards what was recalled, within the bound on the KL; the std stays where it is its own."""
    env = make_vec_env(Reach, n_envs=1, seed=0)
    model, callback = agent(name, env), recall(imitation_steps=50, max_kl=0.05, learning_rate=1e-3)
    model.learn(300, callback=callback)
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (400, 2))
    towards = np.tile([0.9, -0.9], (400, 1))
    obs = torch.as_tensor(states).float()

    def now():
        with torch.no_grad():
            found = callback.agent.gaussian(obs)
            mean = (
                torch.tanh(found.mean) if name == "SAC" else found.mean / torch.tensor([0.2, 0.4])
            )
        return mean.numpy(), found.stddev.numpy()

    (mean, std), kl = now(), 0.0
    for _ in range(10):
        kl = max(kl, imitate(callback, states, towards, states)["kl"])
    new_mean, new_std = now()
    assert 0 < kl <= 0.05
    gap, new_gap = (np.abs(x - towards).mean() for x in (mean, new_mean))
    assert new_gap < gap - 0.05
    if name == "PPO":
        np.testing.assert_array_equal(std, new_std)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_a_step_that_is_too_long_is_shortened(name):
    """SAC's policy is so narrow that each of Adam's may be; one that leads nowhere is undone."""
    callback = recall(imitation_steps=5, max_kl=1e-4, learning_rate=0.03)
    model = agent(name, make_vec_env(Reach, n_envs=1, seed=0))
    model.learn(300, callback=callback)
    states = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    towards = np.tile([0.5, -0.5], (400, 1))
    found = [imitate(callback, states, towards, states) for _ in range(20)]
    assert all(0 < one["kl"] <= 1e-4 for one in found)
    assert found[-1]["log_pi"] > found[0]["log_pi"]
    callback.imitation.optimiser.param_groups[0]["lr"] = 1e6
    known = [param.detach().clone() for param in callback.agent.actor.parameters()]
    assert imitate(callback, states, towards, states)["kl"] == 0
    assert all(map(torch.equal, known, callback.agent.actor.parameters()))


def test_agents_that_are_not_gaussian_are_refused():
    with pytest.raises(TypeError, match="Gaussian policy"):
        DQN("MlpPolicy", "CartPole-v1").learn(10, callback=RecallTraces())
    with pytest.raises(TypeError, match="Gaussian policy"):
        PPO("MlpPolicy", make_vec_env(Reach), use_sde=True).learn(10, callback=RecallTraces())
    with pytest.raises(TypeError, match="vectors of numbers"):
        PPO("MlpPolicy", "CartPole-v1").learn(10, callback=RecallTraces())
    narrow = make_vec_env(Reach)
    narrow.action_space = spaces.Box(np.float32([-1, 0]), np.float32([1, 0]))
    with pytest.raises(TypeError, match="can vary"):
        PPO("MlpPolicy", narrow).learn(10, callback=RecallTraces())
    stacked = VecFrameStack(VecNormalize(make_vec_env(Reach)), 4)
    with pytest.raises(TypeError, match=r"observations \(8,\) .* only \(2,\): let VecNormalize"):
        PPO("MlpPolicy", stacked).learn(10, callback=RecallTraces())
    with pytest.raises(ValueError, match="nothing was learned"):
        RecallTraces().save("nowhere")


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("PPO", "backward"),
        ("SAC", "backward"),
        ("TRPO", "forward"),
        pytest.param("TRPO", "backward", marks=pytest.mark.slow),
        pytest.param("SAC", "forward", marks=pytest.mark.slow),
    ],
)
def test_saved_and_loaded_it_goes_on_as_if_it_had_not_been(name, model, tmp_path):
    """Agent, callback and environments: bit for bit, in the middle of episodes."""

    def taught(loaded):
        env = make_vec_env(Reach, n_envs=1 if name == "SAC" else 2, seed=0)
        learner = agent(name, env, **({} if name == "SAC" else {"n_steps": 64, "batch_size": 64}))
        cfg = RecallConfig(trace_length=5, min_steps=20, every=128, model=model)
        callback = RecallTraces(cfg)
        learner.learn(407 if name == "SAC" else 512, callback=callback)
        assert callback.unfinished != [0] * env.num_envs
        if loaded:
            noise = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002 (its own)
            learner.save(tmp_path / "agent.zip")
            callback.save(tmp_path / "recall.pt")
            seen = getattr(learner, "replay_buffer", None)
            kind = AGENTS[name]
            learner = kind.load(tmp_path / "agent.zip", copy.deepcopy(env), force_reset=False)
            learner.replay_buffer = copy.deepcopy(seen)
            callback = RecallTraces.load(tmp_path / "recall.pt")
            torch.set_rng_state(noise[0])
            np.random.set_state(noise[1])  # noqa: NPY002
        learner.learn(512, callback=callback, reset_num_timesteps=False)
        return learner.policy.state_dict(), callback

    (one, first), (two, second) = taught(False), taught(True)
    assert first.last and first.last == second.last
    assert all(torch.equal(one[key], two[key]) for key in one)
    assert first._rng.random() == second._rng.random()


class ReachGoal(Reach):
    """The same with a goal beside it, in a dictionary."""

    def __init__(self):
        super().__init__()
        parts = ("observation", 2), ("desired_goal", 1), ("achieved_goal", 2)
        self.observation_space = spaces.Dict(
            {name: spaces.Box(-2, 2, (n,), np.float32) for name, n in parts}
        )

    def told(self, obs):
        goal = np.zeros(1, np.float32)
        return {"observation": obs, "desired_goal": goal, "achieved_goal": 2 * obs}

    def reset(self, **how):
        return self.told(super().reset(**how)[0]), {}

    def step(self, action):
        obs, *rest = super().step(action)
        return self.told(obs), *rest


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_observations_may_be_dictionaries(name, normalised):
    env = make_vec_env(ReachGoal, n_envs=1, seed=0)
    if normalised:
        env = VecNormalize(env)
    small = {"learning_starts": 100} if name == "SAC" else {"n_steps": 128, "batch_size": 64}
    learner = AGENTS[name]("MultiInputPolicy", env, seed=0, device="cpu", **small)
    callback = RecallTraces(RecallConfig(trace_length=5, min_steps=20, every=128))
    learner.learn(640, callback=callback)
    first = callback.trajectories[0].obs
    assert first.shape == (31, 5)  # by name: achieved_goal, desired_goal, observation
    assert first[:, :2] == pytest.approx(2 * first[:, 3:], abs=1e-5) and not first[:, 2].any()
    assert np.isfinite(callback.last["loss"]) and callback.last["valid"] > 0.5


def test_rows_go_back_to_what_they_were():
    rows = Rows(ReachGoal().observation_space)
    obs = {"observation": np.ones((3, 2)), "desired_goal": np.zeros((3, 1))}
    obs["achieved_goal"] = np.full((3, 2), 5.0)
    assert rows.size == 5 and rows.of(obs)[0].tolist() == [5, 5, 0, 1, 1]
    back = rows.back(rows.of(obs))
    assert all(np.array_equal(back[name], obs[name]) for name in obs)
    with pytest.raises(TypeError, match="observations that are vectors"):
        Rows(spaces.Dict({"a": spaces.Box(0, 1, (2, 2)), "b": spaces.Box(0, 1, (2,))}))


def test_it_says_once_what_it_waits_for(capsys):
    learner = agent("PPO", make_vec_env(Reach, seed=0), n_steps=64)
    learner.learn(400, callback=RecallTraces(RecallConfig(min_steps=500, every=64)))
    assert capsys.readouterr().out.count("RecallTraces waits: ") == 1


def test_what_was_saved_for_another_task_is_refused(tmp_path):
    callback = recall()
    agent("PPO", make_vec_env(Reach, seed=0)).learn(300, callback=callback)
    callback.save(tmp_path / "recall.pt")
    with pytest.raises(ValueError, match=r"numbers, the agent's have \(3, 1\)"):
        PPO("MlpPolicy", "Pendulum-v1").learn(
            10, callback=RecallTraces.load(tmp_path / "recall.pt")
        )
    with pytest.raises(ValueError, match="its model is backward, not forward"):
        RecallTraces.load(tmp_path / "recall.pt", RecallConfig(model="forward"))
    with pytest.raises(FileNotFoundError):
        RecallTraces.load(tmp_path / "nowhere.pt")
    with pytest.raises(FileNotFoundError):
        callback.save(tmp_path / "no folder" / "recall.pt")


def test_damaged_files_are_refused_in_one_line(tmp_path):
    callback = recall()
    agent("PPO", make_vec_env(Reach, seed=0)).learn(300, callback=callback)
    callback.save(tmp_path / "good.pt")
    RecallTraces.load(tmp_path / "good.pt")
    state, path = torch.load(tmp_path / "good.pt", weights_only=True), tmp_path / "bad.pt"
    obs, *others = state["trajectories"][0]
    nan = state["model"]["state_net.flat"] * np.nan
    for bad, why in (
        ((tmp_path / "good.pt").read_bytes()[:500], "damaged or cut short"),
        (b"", "damaged or cut short"),
        (b"text", "damaged or cut short"),
        ({"a": np.zeros(2)}, "Weights only load failed"),
        ({"a": 1}, "KeyError 'cfg'"),
        (state | {"trajectories": []}, "of one task"),
        (state | {"trajectories": [[obs[1:], *others]]}, "differ in length"),
        (state | {"trajectories": [[obs * np.nan, *others]]}, "trajectory has .* not finite"),
        (state | {"model": state["model"] | {"state_net.flat": nan}}, "model has"),
        (state | {"optimiser": [3]}, "the optimiser's part is none"),
    ):
        if isinstance(bad, bytes):
            path.write_bytes(bad)
        else:
            checkpoint.save(bad, path)
        with pytest.raises(ValueError, match=f"cannot load .*bad.pt: .*({why})") as told:
            RecallTraces.load(path)
        assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("name", "more"), [("SAC", {}), ("PPO", {"policy_kwargs": {"net_arch": [32]}})]
)
def test_what_was_saved_goes_with_another_agent_of_the_task(name, more, tmp_path):
    """The optimiser of the imitation begins anew: what it knows is of other weights."""
    callback, env = recall(top_percent=50), make_vec_env(Reach, seed=0)
    agent("PPO", env).learn(1200, callback=callback)
    assert callback.last["kl"] > 0
    callback.save(tmp_path / "recall.pt")
    other = RecallTraces.load(tmp_path / "recall.pt")
    agent(name, env, **more).learn(1200, callback=other)
    assert other.last["kl"] > 0 and len(other.trajectories) > len(callback.trajectories)


def test_before_an_episode_has_ended_any_task_will_do():
    callback = recall()
    agent("PPO", make_vec_env(Reach, seed=0), n_steps=4, batch_size=4).learn(4, callback=callback)
    assert not callback.trajectories
    PPO("MlpPolicy", "Pendulum-v1", n_steps=512, device="cpu").learn(1536, callback=callback)
    assert callback.trajectories[0].obs.shape[1] == 3 and "state_nll" in callback.last


def test_learning_goes_on_where_it_was_or_anew():
    """A second call of `learn` keeps the unfinished episodes; one that begins anew drops them."""
    env = make_vec_env(Reach, n_envs=2, seed=0)
    model, callback = agent("PPO", env, n_steps=40, batch_size=80), recall()
    model.learn(80, callback=callback)  # 40 steps each: an episode of 30 and 10 of the next
    assert callback.unfinished == [10, 10]
    model.learn(80, callback=callback, reset_num_timesteps=False)
    assert {len(one.rewards) for one in callback.trajectories} == {30}
    assert callback.unfinished == [20, 20]
    before = len(callback.trajectories)
    model.learn(80, callback=callback)
    assert {len(one.rewards) for one in callback.trajectories} == {30}
    assert len(callback.trajectories) == before + 2
    model.set_env(make_vec_env(Reach, n_envs=2, seed=1))  # whose first episodes may be any
    model.learn(160, callback=callback, reset_num_timesteps=False)
    for one in callback.trajectories:
        moved = np.clip(one.obs[:-1] + one.actions * FASTEST, -2, 2)
        np.testing.assert_allclose(moved, one.obs[1:], atol=1e-5)


def test_the_bound_fades_and_then_nothing_is_recalled():
    """On a line; imitation obeys it; of what is over nothing is said any more."""
    callback = recall(every=100, fade_steps=6000, max_kl=0.01)
    model = agent("PPO", make_vec_env(Reach, n_envs=2, seed=0))
    model.learn(4608, callback=callback)  # nine rollouts of 512 steps
    assert callback.last["kl"] > 0
    assert callback.max_kl() == pytest.approx(0.01 * (1 - 4608 / 6000))
    strong = {"imitation_steps": 200, "learning_rate": 1e-3, "max_kl": 0.01}
    callback.cfg = callback.imitation.cfg = RecallConfig(fade_steps=6000, **strong)
    states = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    callback.num_timesteps = 5990
    assert imitate(callback, states, np.ones((200, 2)), states)["kl"] <= 0.01 * 10 / 6000
    callback.num_timesteps = 3000
    assert imitate(callback, states, np.ones((200, 2)), states)["kl"] > 0.001
    model.learn(3000, callback=callback, reset_num_timesteps=False)
    assert callback.last == {} and callback.max_kl() == 0


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_every_call_of_learn_has_its_turns(name, monkeypatch):
    callback, turns = recall(every=100), []
    turn = callback.turn
    monkeypatch.setattr(callback, "turn", lambda: turns.append(1) or turn())
    model, counts = agent(name, make_vec_env(Reach, n_envs=2, seed=0)), []
    for _ in range(3):
        model.learn(1100, callback=callback)
        counts.append(len(turns))
        turns.clear()
    assert min(counts) >= 2 and max(counts) - min(counts) <= 1


def test_the_log_density_is_that_of_the_model():
    """Against torch's own Gaussian, in units of the actions."""
    callback = recall()
    agent("PPO", make_vec_env(Reach, n_envs=2, seed=0), n_steps=512).learn(4096, callback=callback)
    model = callback.dynamics
    following, actions = torch.rand(50, 2), 2 * torch.rand(50, 2) - 1
    with torch.no_grad():
        mean = model.action_net(model.state_scale.normalise(following))
    said = torch.distributions.Normal(model.action_scale.restore(mean), model.action_scale.std)
    found = model.action_log_density(following, actions)
    torch.testing.assert_close(found, said.log_prob(actions).sum(dim=1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_the_forward_control_imitates_what_it_imagined_to_end_well(name, monkeypatch):
    callback = recall(model="forward", traces=60, model_steps=200)
    model = agent(name, make_vec_env(Reach, n_envs=1, seed=0))
    model.learn(1600, callback=callback)
    assert {"forward_nll", "valid", "loss", "kl"} <= set(callback.last)
    # In a model in which nothing stands in the way: places add up, and it is good to be right.
    monkeypatch.setattr(callback.dynamics, "successors", lambda s, a: s + 0.1 * a)
    monkeypatch.setattr(callback.agent, "values", lambda obs: obs[:, 0])
    space = Seen(np.random.default_rng(0).uniform(-1, 1, (500, 2)), 2)

    def ends(ways):
        """How far to the right it gets on the mean, always from the same place."""
        monkeypatch.setattr(stable_baselines, "WAYS", ways)
        begins = np.full((1, 2), 0.1, np.float32)
        states, actions, valid = callback.imagine(callback.dynamics, space, begins)
        assert valid.shape == (5, 60 * ways) and valid.all() and abs(actions).max() <= 1
        paths, moves = states.reshape(5, 60, 2), actions.reshape(5, 60, 2)
        np.testing.assert_allclose(paths[1:], paths[:-1] + 0.1 * moves[:-1], rtol=1e-5, atol=1e-6)
        return (paths[-1] + 0.1 * moves[-1])[:, 0].mean()

    assert ends(4) > ends(1) + 0.03  # the actions are chosen, not the places


def learned_without(callback, name):
    """The first weights of an agent after two rollouts, in which nothing is recalled yet."""
    model = agent(name, make_vec_env(Reach, n_envs=2, seed=0))
    model.learn(300, callback=callback)
    return torch.cat([param.flatten() for param in model.policy.parameters()])


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_before_the_first_turn_an_agent_is_what_it_is_alone(name):
    callback = recall(every=10**6)
    assert torch.equal(learned_without(callback, name), learned_without(None, name))
    twin = recall(every=10**6)
    torch.rand(7)
    learned_without(twin, name)
    pairs = zip(callback.dynamics.parameters(), twin.dynamics.parameters(), strict=True)
    assert all(torch.equal(ours, theirs) for ours, theirs in pairs)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_what_is_remembered_is_not_normalised(name, monkeypatch):
    """Under VecNormalize: observations as they were, the critic's units where values are added."""
    env = VecNormalize(make_vec_env(Reach, n_envs=2, seed=0))
    callback, model = recall(), agent(name, env)
    model.learn(2000, callback=callback)
    for one in callback.trajectories:
        moved = np.diff(one.obs, axis=0)
        np.testing.assert_allclose(one.rewards, -np.abs(one.obs[1:]).sum(axis=1), atol=1e-4)
        inside = (np.abs(one.obs[1:]) < 1.99).all(axis=1)
        scaled = one.actions * FASTEST
        np.testing.assert_allclose(moved[inside], scaled[inside], atol=1e-4)
    told = []
    monkeypatch.setattr(
        callback.agent, "values", lambda obs: told.append(obs) or np.zeros(len(obs))
    )
    callback.turn()
    chosen, _ = callback.best()
    after = np.concatenate([one.obs[1:] for one in chosen])
    np.testing.assert_allclose(told[0], env.normalize_obs(after))


def test_traces_begin_where_it_pays_to_be(monkeypatch):
    """A state that ends an episode is worth its reward, whatever the critic says of it."""
    callback = recall(traces=1)
    model = agent("PPO", make_vec_env(Reach, n_envs=1, seed=0))
    model.learn(256, callback=callback)
    callback.agent.values = lambda obs: obs[:, 0] * 10  # the critic likes the right
    begun, unroll = [], stable_baselines.recall_traces
    monkeypatch.setattr(
        stable_baselines,
        "recall_traces",
        lambda model, seeds, *a, **k: begun.append(seeds[0]) or unroll(model, seeds, *a, **k),
    )
    callback.trajectories.clear()
    line = np.linspace(-1, 1, 201)
    obs = np.column_stack([line, line])
    for terminated in (True, False):
        callback.trajectories.append(Trajectory(obs, np.zeros((200, 2)), np.zeros(200), terminated))
        callback.trajectories.append(Trajectory(obs, np.zeros((200, 2)), -np.ones(200), terminated))
        callback.turn()
        callback.trajectories.clear()
    np.testing.assert_allclose(begun, [obs[-2], obs[-1]])


@pytest.mark.parametrize(
    "bad",
    [
        {"top_percent": 200},
        {"traces": 0},
        {"every": -1},
        {"capacity": 1000},
        {"model": "forwards"},
        {"seeds": "values"},
        {"trace_length": 2.5},
        {"trace_length": "20"},
        {"model_steps": None},
        {"learning_rate": np.inf},
        {"top_percent": True},
        {"fade_steps": 0},
        {"fade_steps": 2.5},
        {"trace_length": 10**9},
        {"imitation_batch": 10**9},
    ],
)
def test_settings_that_make_no_sense_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        RecallTraces(RecallConfig(**bad))


def test_numbers_of_numpy_are_numbers():
    RecallTraces(RecallConfig(trace_length=np.int64(5), learning_rate=np.float32(1e-4)))


def assert_whole(callback, least):
    """That every episode remembered is one: 30 steps, on end."""
    assert len(callback.trajectories) >= least
    for obs, actions, _, _ in callback.trajectories:
        assert len(actions) == 30
        np.testing.assert_allclose(np.clip(obs[:-1] + actions * FASTEST, -2, 2), obs[1:], atol=1e-5)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_an_episode_of_which_only_the_end_was_seen_is_forgotten(name):
    """Where the agent went on without us, or steps were lost when another callback stopped it."""
    small = {} if name == "SAC" else {"n_steps": 40, "batch_size": 80}
    model, callback = agent(name, make_vec_env(Reach, n_envs=2, seed=0), **small), recall()
    model.learn(80)  # 40 steps each, so that both are in the middle of an episode
    model.learn(160, callback=callback, reset_num_timesteps=False)  # to the 120th
    assert_whole(callback, 4)
    model.learn(80, reset_num_timesteps=False)  # without us, to the 160th
    model.learn(160, callback=callback, reset_num_timesteps=False)
    assert_whole(callback, 8)

    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls < 7

    model.learn(80, callback=[callback, Stop()], reset_num_timesteps=False)
    before = len(callback.trajectories)
    model.learn(160, callback=callback, reset_num_timesteps=False)
    assert_whole(callback, before + 2)

    class Interrupt(BaseCallback):  # as Ctrl-C: the environments have moved, nobody was told
        def _on_step(self):
            if self.n_calls == 7:
                raise KeyboardInterrupt
            return True

    with pytest.raises(KeyboardInterrupt):
        model.learn(80, callback=[Interrupt(), callback], reset_num_timesteps=False)
    before = len(callback.trajectories)
    model.learn(160, callback=callback, reset_num_timesteps=False)
    assert_whole(callback, before + 2)

    first = recall()
    agent(name, model.get_env(), **small).learn(80, callback=first, reset_num_timesteps=False)
    assert_whole(first, 2)  # nothing was missed


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_the_likelihood_told_is_that_of_the_policy(name):
    """Of Stable-Baselines3's own density of an action, in actions from -1 to 1."""
    model, callback = agent(name, make_vec_env(Reach, n_envs=1, seed=0)), recall()
    model.learn(300, callback=callback)
    rng = np.random.default_rng(0)
    states, actions = rng.uniform(-1, 1, (300, 2)), rng.uniform(-0.9, 0.9, (300, 2))
    obs, done = torch.as_tensor(states).float(), torch.as_tensor(actions).float()
    with torch.no_grad():
        if name == "SAC":
            mean, log_std, _ = model.actor.get_action_dist_params(obs)
            said = model.actor.action_dist.proba_distribution(mean, log_std).log_prob(done)
        else:  # whose actions are the environment's: a smaller unit, a higher density
            scale = torch.from_numpy(FASTEST)
            said = model.policy.evaluate_actions(obs, done * scale)[1] + scale.log().sum()
    told = imitate(callback, states, actions, states)
    assert told["log_pi"] == pytest.approx(said.mean().item(), rel=1e-4)


def test_the_ratio_told_is_of_policy_and_model(monkeypatch):
    """log pi(a | s) - log q(a | s'), s' the state after, over the steps before a trace ended."""
    callback, found = recall(), []
    model = agent("PPO", make_vec_env(Reach, n_envs=2, seed=0))
    model.learn(2048, callback=callback)
    unroll = stable_baselines.recall_traces

    def cut(model, seeds, *given, **more):
        traces = unroll(model, seeds, *given, **more)
        traces.valid[3:, ::2] = False
        found.append((seeds, traces))
        return traces

    monkeypatch.setattr(stable_baselines, "recall_traces", cut)
    monkeypatch.setattr(callback.imitation, "update", lambda s, a, seen, max_kl: {"log_pi": 7.0})
    told = callback.turn()
    ((seeds, (states, actions, valid)),) = [(s, t[:3]) for s, t in found]
    densities = []
    for i in range(len(seeds)):
        after = seeds[i]
        for t in range(5):
            if valid[t, i]:
                at, did = (torch.as_tensor(x[None]).float() for x in (after, actions[t, i]))
                densities.append(callback.dynamics.action_log_density(at, did).item())
            after = states[t, i]
    assert len(densities) == valid.sum() and 0 < told["valid"] < 1
    assert told["log_ratio"] == pytest.approx(7 - np.mean(densities), rel=1e-4)


def test_states_far_from_what_was_seen_are_not_valid():
    obs = np.array([[0.0, 10.0], [2.0, 30.0]])  # mean 1 and 20, std 1 and 10
    space = Seen(obs, 1)
    near = [[1.0, 20.0], [1 + 2.9, 20 + 29], [1 + 4.2, 20.0]]  # at most 3 deviations, on average
    far = [[1 + 3.1, 20 - 31], [1 + 4.3, 20.0], [1.0, np.nan], [np.inf, 20.0]]
    assert space.valid(np.array(near + far)).tolist() == [True] * 3 + [False] * 4
    cut = space.repair(np.array([[1.5, 25.0], [100.0, -1000.0]]))
    np.testing.assert_allclose(cut, [[1.5, 25.0], [6.0, -30.0]], atol=0.01)


def test_the_optimiser_goes_on_where_it_was(tmp_path):
    model, callback = agent("PPO", make_vec_env(Reach, seed=0)), recall()
    model.learn(2048, callback=callback)
    callback.save(tmp_path / "recall.pt")
    again = RecallTraces.load(tmp_path / "recall.pt")
    for _ in range(2):  # what it held before is replaced
        again.load_state_dict(callback.state_dict())
    assert len(again.trajectories) == len(callback.trajectories)
    again.init_callback(model)
    ours, theirs = (one.imitation.optimiser.state_dict()["state"] for one in (callback, again))
    assert ours and ours.keys() == theirs.keys()
    assert all(torch.equal(ours[i]["exp_avg"], theirs[i]["exp_avg"]) for i in ours)


def test_rewards_and_values_are_added_in_the_critics_units(monkeypatch):
    """Where rewards are normalised, its values are of normalised ones."""
    env = VecNormalize(make_vec_env(Reach, n_envs=2, seed=0))
    callback, begun, unroll = recall(traces=1), [], stable_baselines.recall_traces
    agent("PPO", env).learn(1024, callback=callback)
    monkeypatch.setattr(
        stable_baselines,
        "recall_traces",
        lambda model, seeds, *a, **k: begun.append(seeds[0]) or unroll(model, seeds, *a, **k),
    )
    callback.agent.values = lambda obs: 1.0 * (obs[:, 0] > np.median(obs[:, 0]))
    line = np.linspace(-1, 1, 201)
    obs, rewards = np.column_stack([line, line]), np.zeros(200)
    rewards[50] = 5.0  # in the half of no value
    callback.trajectories.clear()
    for less in (0, 1):
        callback.trajectories.append(Trajectory(obs, np.zeros((200, 2)), rewards - less, False))
    for variance in (27.7, 40.0):  # a reward of 5 is 0.95, or 0.79; a value of 1 is 0.9 before it
        env.ret_rms.var = variance
        callback.turn()
    middle = env.normalize_obs(np.zeros(2))[0]
    left, right = (x - middle for x, _ in begun)
    assert left < 0 < right


def test_the_value_beside_sac_is_the_lower_of_its_critics():
    model, callback = agent("SAC", make_vec_env(Reach, n_envs=1, seed=0)), recall()
    model.learn(300, callback=callback)
    states = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    obs = torch.as_tensor(states).float()
    with torch.no_grad():
        both = model.critic(obs, model.actor(obs, deterministic=True))
    lower = torch.minimum(*both)[:, 0]
    assert not torch.equal(lower, both[0][:, 0])
    np.testing.assert_allclose(callback.agent.values(states), lower, rtol=1e-5)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_imitation_ends_where_the_bound_is_reached(name):
    """After the step that had to be shortened, and one that is not finite is not taken."""
    callback = recall(imitation_steps=5, max_kl=1e-4, learning_rate=0.03)
    model = agent(name, make_vec_env(Reach, n_envs=1, seed=0))
    model.learn(300, callback=callback)
    states = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    assert imitate(callback, states, np.full((400, 2), 0.5), states)["kl"] > 0
    (taken,) = {int(one["step"]) for one in callback.imitation.optimiser.state.values()}
    assert taken == 1
    callback.imitation.optimiser.param_groups[0]["lr"] = np.nan
    known = [param.detach().clone() for param in callback.agent.actor.parameters()]
    assert imitate(callback, states, np.full((400, 2), 0.5), states)["kl"] == 0
    assert all(map(torch.equal, known, callback.agent.actor.parameters()))


def test_every_turn_learns_from_all_that_is_remembered_and_its_time_counts(monkeypatch):
    callback, seen = recall(), []
    model = agent("PPO", make_vec_env(Reach, n_envs=2, seed=0))
    model.learn(1024, callback=callback)
    fit, before = callback.dynamics.fit, callback.seconds
    monkeypatch.setattr(
        callback.dynamics, "fit", lambda *data: seen.append(len(data[0])) or fit(*data)
    )
    turn = callback.turn
    monkeypatch.setattr(callback, "turn", lambda: time.sleep(0.5) or turn())
    model.learn(1536, callback=callback, reset_num_timesteps=False)
    assert len(seen) >= 2 and seen == sorted(seen) and callback.seconds - before > 0.5 * len(seen)
    best, _ = callback.best()
    assert seen[-1] <= sum(len(one.rewards) for one in best)
