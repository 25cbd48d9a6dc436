"""The worlds: physics against MuJoCo itself, the reward, resets, walls."""

import mujoco
import numpy as np
import pytest
import torch

from goalgan_bt import envs
from goalgan_bt.envs import ant_maze
from goalgan_bt.envs.maze import MapError

ALL = ["point_umaze", "ant_umaze", "point_nd"]


def everyone(env):
    return np.arange(env.num_envs)


@pytest.mark.parametrize("name", envs.NAMES)
def test_every_environment_steps(name):
    env = envs.make(name, 4, threads=1)
    rng = np.random.default_rng(0)
    ids = everyone(env)
    env.reset(ids, env.test_goals()[-4:])
    for _ in range(5):
        step = env.step(ids, rng.uniform(-1, 1, (4, env.act_dim)))
        states = step.states
        assert states.shape == (4, env.state_dim)
        assert env.observe(ids).shape == (4, env.obs_dim)
        assert env.observe(ids).dtype == np.float32
    assert env.elapsed.tolist() == [5] * 4
    assert np.isfinite(states).all()
    assert step.rewards.dtype == np.float32
    assert env.feasible(env.test_goals()).all()


def test_settings_of_the_paper():
    point, ant = envs.make("point_umaze", 1), envs.make("ant_umaze", 1)
    assert (point.horizon, ant.horizon) == (200, 500)
    assert (point.success_radius, ant.success_radius) == (0.3, 1.0)
    assert point.dt == ant.dt == 0.02
    assert point.model.body_mass.sum() == pytest.approx(0.419, abs=1e-3)
    assert ant.model.body_mass.sum() == pytest.approx(0.911, abs=1e-3)
    assert ant.start_state[:15].tolist() == [0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1]
    assert (ant.model.actuator_gear[:, 0] == 150).all()
    assert envs.make("point_spiral", 1).horizon == 500  # as the original


@pytest.mark.parametrize("dim", [2, 3, 4, 5, 6])
def test_point_nd_sizes(dim):
    env = envs.make("point_nd", 3, dim=dim)
    assert (env.goal_dim, env.act_dim, env.obs_dim) == (dim, dim, 3 * dim)
    assert env.success_radius == pytest.approx(0.3 * np.sqrt(dim / 2))
    env.reset(everyone(env), env.test_goals()[:3])
    for _ in range(300):
        states = env.step(everyone(env), np.ones((3, dim))).states
    assert np.allclose(states[:, :dim], ([1.0, 5.0] + [0.3] * 4)[:dim])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"name": "ant_nowhere"}, "unknown environment"), ({"name": "point_nd", "dim": 7}, "2 to 6")],
)
def test_bad_names(kwargs, message):
    with pytest.raises(ValueError, match=message):
        envs.make(num_envs=1, **kwargs)


def test_a_users_map(tmp_path):
    path = tmp_path / "hall.txt"
    path.write_text("######\n#S...#\n######\n")
    env = envs.make("point_umaze", 2, map_file=path)
    assert env.name == "point_hall" and len(env.test_goals()) == 64
    path.write_text("######\n#S..x#\n######\n")
    with pytest.raises(MapError, match="row 2, column 5"):
        envs.make("ant_umaze", 2, map_file=path)


@pytest.mark.parametrize("name", ALL)
def test_a_state_has_one_future(name):
    """Reading a state and writing it elsewhere gives the same trajectory, bit for bit."""
    env = envs.make(name, 6, threads=2)
    rng = np.random.default_rng(1)
    ids = everyone(env)
    env.reset(ids, np.zeros((6, env.goal_dim)))
    for _ in range(30):
        env.step(ids, rng.uniform(-1, 1, (6, env.act_dim)))
    states = env.read_states(ids)
    futures = []
    for _ in range(2):
        replay = np.random.default_rng(2)
        env.reset(ids, np.zeros((6, env.goal_dim)), states)
        assert np.array_equal(env.read_states(ids), states)
        for _ in range(20):
            final = env.step(ids, replay.uniform(-1, 1, (6, env.act_dim))).states
        futures.append(final)
    assert np.array_equal(*futures)


@pytest.mark.parametrize("name", ALL)
def test_one_simulation_does_not_touch_another(name):
    env = envs.make(name, 4, threads=1)
    ids = everyone(env)
    env.reset(ids, np.zeros((4, env.goal_dim)))
    some = np.array([1, 3])
    for _ in range(10):
        env.step(some, np.ones((2, env.act_dim)))
    states = env.read_states(ids)
    assert np.array_equal(states[[0, 2]], np.tile(env.start_state, (2, 1)))
    assert not np.array_equal(states[1], env.start_state)
    env.reset(np.array([3]), np.ones((1, env.goal_dim)))
    assert np.array_equal(env.read_states(ids)[3], env.start_state)
    assert np.array_equal(env.read_states(ids)[1], states[1])
    assert env.elapsed.tolist() == [0, 10, 0, 0]


def test_threads_do_not_change_the_physics():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 8, 8))
    finals = []
    for threads in (1, 2):
        env = envs.make("ant_umaze", 8, threads=threads)
        env.reset(everyone(env), np.zeros((8, 2)))
        for a in actions:
            states = env.step(everyone(env), a).states
        finals.append(states)
    assert np.array_equal(*finals)


@pytest.mark.parametrize("name", ["point_umaze", "ant_umaze"])
def test_batched_physics_is_mujocos(name):
    """Away from walls, the batch does what one MjData does under mj_step."""
    env = envs.make(name, 1, threads=1)
    env.reset(np.array([0]), np.full((1, 2), 6.0))
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = np.split(env.start_state, [env.model.nq])
    rng = np.random.default_rng(0)
    for _ in range(40):
        action = rng.uniform(-1, 1, env.act_dim)
        step = env.step(np.array([0]), action[None])
        data.ctrl[:] = step.actions[0]
        mujoco.mj_step(env.model, data)
    assert np.array_equal(step.states[0], np.concatenate([data.qpos, data.qvel]))


def test_the_ants_achieved_goal_is_mujocos_centre_of_mass():
    env = envs.make("ant_umaze", 32, threads=1)
    rng = np.random.default_rng(0)
    env.reset(everyone(env), np.zeros((32, 2)))
    for _ in range(50):
        states = env.step(everyone(env), rng.uniform(-1, 1, (32, 8))).states
    data = mujoco.MjData(env.model)
    torso = env.model.body("torso").id
    for state, achieved in zip(states, env.achieved_goals(states), strict=True):
        data.qpos[:] = state[:15]
        mujoco.mj_kinematics(env.model, data)
        mujoco.mj_comPos(env.model, data)
        assert achieved == pytest.approx(data.subtree_com[torso][:2], abs=1e-9)


def test_how_far_implicitfast_is_from_rk4():
    """The default integrator against the original's, same actions: mean distance in metres."""

    def apart(name, steps):
        finals = []
        for integrator in ("implicitfast", "rk4"):
            env = envs.make(name, 64, threads=1, integrator=integrator)
            rng = np.random.default_rng(0)
            env.reset(everyone(env), np.full((64, 2), 6.0))
            for _ in range(steps):
                states = env.step(everyone(env), rng.uniform(-1, 1, (64, env.act_dim))).states
            finals.append(env.achieved_goals(states))
        return np.linalg.norm(finals[0] - finals[1], axis=1).mean()

    # Measured: the point 3.7 mm after half a second; the Ant 4.3 mm after 0.1 s and 80 mm after
    # half a second, since its contacts multiply any difference.
    assert 0 < apart("point_umaze", 25) < 0.006
    assert 0 < apart("ant_umaze", 5) < 0.01
    assert 0 < apart("ant_umaze", 25) < 0.2


def test_reward_success_and_end():
    env = envs.make("point_umaze", 3, threads=1)
    ids = everyone(env)
    # In reach; free but far; in reach, but inside the wall: never reached.
    goals = np.array([[0.2, 0.0], [4.0, 4.0], [0.0, 1.05]])
    start = np.zeros((3, 4))
    start[2, 1] = 0.85
    env.reset(ids, goals, start)
    step = env.step(ids, np.zeros((3, 2)))
    assert step.rewards.tolist() == [1, 0, 0]
    assert step.terminated.tolist() == [True, False, False]
    assert not step.truncated.any()
    for _ in range(env.horizon - 1):
        step = env.step(ids[1:], np.zeros((2, 2)))
    assert step.truncated.all() and not step.terminated.any()


def test_an_ant_that_leaves_its_height_fails_without_reward():
    env = envs.make("ant_umaze", 4, threads=1)
    ids = everyone(env)
    states = np.tile(env.start_state, (4, 1))
    states[1, 2] = 0.2
    states[2, 2] = 1.2
    states[3, 20] = np.nan
    env.reset(ids, np.zeros((4, 2)), states)
    step = env.step(ids, np.zeros((4, 8)))
    assert step.rewards.tolist() == [1, 0, 0, 0]
    assert step.terminated.all()
    # A diverged simulation recovers at its reset and hurt no other.
    env.reset(np.array([3]), np.full((1, 2), 6.0))
    step = env.step(ids[3:], np.zeros((1, 8)))
    states = step.states
    assert np.isfinite(states).all() and not step.terminated.any()


def ant_states(n=24):
    """Varied states of an Ant that walked at random, turned to all sides."""
    env = envs.make("ant_umaze", n, threads=1)
    rng = np.random.default_rng(0)
    ids, yaw = everyone(env), rng.uniform(-np.pi, np.pi, n)
    start = np.tile(env.start_state, (n, 1))
    start[:, 3], start[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    env.reset(ids, np.full((n, 2), 6.0), start)
    for _ in range(15):
        states = env.step(ids, rng.uniform(-0.5, 0.5, (n, 8))).states
    return env, states, rng.uniform(env.goal_low, env.goal_high, (n, 2))


def test_renumbering_the_ants_legs_changes_nothing_physical():
    """Stepping renumbered states under renumbered torques is renumbering the stepped states."""
    env, states, _ = ant_states()
    ids, n = everyone(env), len(states)
    states[:, :2] = 0.0  # away from walls
    actions = np.random.default_rng(1).uniform(-1, 1, (n, 8))
    env.write_states(ids, states)
    env.advance(ids, actions)
    after = env.read_states(ids)
    for k in range(4):
        turns = np.full(n, k)
        assert np.allclose(
            env.achieved_goals(ant_maze.renumbered(states, turns)), env.achieved_goals(states)
        )
        env.write_states(ids, ant_maze.renumbered(states, turns))
        env.advance(ids, ant_maze._renumber_actions(actions, turns))
        same = ant_maze.renumbered(after, turns)
        mine = ant_maze.renumbered(env.read_states(ids), np.zeros(n, dtype=int))
        assert np.allclose(mine, same, atol=1e-9)


def test_the_front_points_at_the_goal():
    env, states, goals = ant_states()
    turned = ant_maze.renumbered(states, ant_maze.quarter_turns(states, goals))
    assert (ant_maze.quarter_turns(turned, goals) == 0).all()
    ahead, left = env.observations(states, goals)[:, 33:35].T
    assert (ahead > 0).all() and (np.abs(left) < ahead + 0.1).all()  # of the centre of mass


def test_actions_go_to_the_body_and_back():
    env, states, goals = ant_states()
    actions = np.random.default_rng(1).uniform(-1, 1, (len(states), 8))
    there = env.to_body(actions, states, goals)
    assert not np.allclose(there, actions)
    assert np.allclose(env.from_body(there, states, goals), actions)
    env.reset(everyone(env), goals, states)
    step = env.step(everyone(env), actions)
    assert np.allclose(step.actions, there)


def test_the_ants_observation_holds_state_and_goal():
    env = envs.make("ant_umaze", 1)
    states = np.tile(env.start_state, (2, 1))
    half = np.sqrt(0.5)
    states[1, 3:7] = half, 0, 0, half  # turned left by a quarter
    states[:, 15:17] = 0.5, 0.1
    offset = np.array([3.0, 4.0])  # 5 m away: told as a sixth of it
    obs = env.observations(states, env.achieved_goals(states) + offset)
    # The goal is to the left: the Ant that faces left already is told as it is.
    assert np.allclose(obs[1, :29], states[1], atol=1e-6)
    assert np.allclose(obs[0, :7], states[1, :7], atol=1e-6)  # renumbered, it is the same Ant
    assert np.allclose(obs[0, 29:31], [0.5, 4 / 6])
    assert np.allclose(obs[:, 31:33], [0, 1], atol=1e-6)
    assert np.allclose(obs[0, 33:35], [4 / 6, -0.5], atol=1e-6)
    assert np.allclose(obs[:, 35:37], [0.1, -0.5], atol=1e-6)
    assert np.allclose(obs[:, 37:39], 0, atol=1e-6)


def to_the_left(places, goals):
    """A way that begins to the left of the goal, twice as long as the straight line."""
    x, y = (goals - places).T
    return 2 * np.stack([-y, x], axis=1)


def test_with_a_heading_the_ant_faces_the_way_and_still_sees_where_the_goal_is():
    env, states, goals = ant_states()
    env.heading = to_the_left
    obs = env.observations(states, goals)
    assert obs.shape == (len(states), env.obs_dim) == (len(states), 29)
    offset = goals - env.achieved_goals(states)
    along = to_the_left(0 * offset, offset)
    # The straight offset and twice as far to the left of it, each squashed, in the Ant's frame.
    straight, way = obs[:, 21:23], obs[:, 23:25]
    far = np.linalg.norm(offset, axis=1)
    assert np.allclose(np.linalg.norm(straight, axis=1), far / (1 + far), atol=1e-6)
    assert np.allclose(np.linalg.norm(way, axis=1), 2 * far / (1 + 2 * far), atol=1e-6)
    turned = np.stack([-straight[:, 1], straight[:, 0]], axis=1) / far[:, None]
    assert np.allclose(turned * (1 + far)[:, None], way * ((1 + 2 * far) / (2 * far))[:, None])
    ahead, left = way.T
    assert (ahead > 0).all() and (np.abs(left) < ahead + 0.1).all()
    actions = np.random.default_rng(1).uniform(-1, 1, (len(states), 8))
    there = env.to_body(actions, states, goals)
    assert np.allclose(env.from_body(there, states, goals), actions)
    turned = states[:, :2] + along
    assert np.allclose(
        there, ant_maze._renumber_actions(actions, -ant_maze.quarter_turns(states, turned))
    )


def test_with_a_heading_the_ant_is_told_the_same_wherever_it_is_and_whichever_way_it_faces():
    env, states, goals = ant_states()
    env.heading = to_the_left
    obs = env.observations(states, goals)
    plain = env.observations(states + np.eye(29)[0], goals + np.eye(2)[0])
    assert np.allclose(plain, obs, atol=1e-5)
    angle = 1.234  # the world turned to the left about the start
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    turned = states.copy()
    turned[:, :2], turned[:, 15:17] = states[:, :2] @ turn, states[:, 15:17] @ turn
    half_cos, half_sin = np.cos(angle / 2), np.sin(angle / 2)
    w, x, y, z = states[:, 3:7].T
    turned[:, 3] = half_cos * w - half_sin * z
    turned[:, 4] = half_cos * x - half_sin * y
    turned[:, 5] = half_cos * y + half_sin * x
    turned[:, 6] = half_cos * z + half_sin * w
    assert np.allclose(env.observations(turned, goals @ turn), obs, atol=1e-5)


@pytest.mark.parametrize("name", ["point_umaze", "point_nd"])
def test_with_a_heading_a_point_sees_the_way_and_not_where_it_is(name):
    env = envs.make(name, 1)
    states = np.array([[0.1, 0.2, 1.0, -1.0]])
    goals = np.array([[3.1, 4.2]])
    plain = env.observations(states, goals)
    assert plain.shape == (1, env.obs_dim) and np.allclose(plain, [0.1, 0.2, 1, -1, 3, 4])
    env.heading = to_the_left
    obs = env.observations(states, goals)
    way = np.array([-8.0, 6.0]) / 10.3  # 10 m, within 0.3
    assert obs.shape == (1, env.obs_dim) and np.allclose(obs, [*way, 1, -1, 3, 4], atol=1e-6)


def test_a_heading_is_asked_for_tensors_too():
    env, states, goals = ant_states(5)
    env.heading = to_the_left
    as_tensors = torch.from_numpy(states), torch.from_numpy(goals)
    assert np.allclose(env.observations(*as_tensors), env.observations(states, goals), atol=1e-5)


@pytest.mark.parametrize("name", ALL)
def test_place_puts_a_state_onto_a_goal(name):
    env = envs.make(name, 1)
    rng = np.random.default_rng(0)
    states = np.tile(env.start_state, (5, 1))
    goals = rng.uniform(-0.5, 0.5, (5, env.goal_dim))
    placed = env.place(states, goals)
    assert np.allclose(env.achieved_goals(placed), goals)
    moved = np.abs(placed - states).max(axis=0) > 1e-12
    assert moved.sum() == env.goal_dim  # nothing else changed


def test_valid_ant_states_keep_torso_and_feet_out_of_walls():
    env = envs.make("ant_umaze", 1)
    states = np.tile(env.start_state, (3, 1))
    states[1, 1] = 0.8  # the torso's rim is in the wall above the start
    states[2, 1] = 0.5  # the torso is clear, two feet are not
    assert env.valid(states).tolist() == [True, False, False]
