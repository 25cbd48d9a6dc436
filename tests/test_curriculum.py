"""The curriculum by asking and telling: where it leads, what it remembers, what it refuses."""

import numpy as np
import pytest

import goalgan_bt
from goalgan_bt import GoalCurriculum, GoalsConfig, UsageError

LOW, HIGH = np.array([-1.0, 0.0, 100.0]), np.array([3.0, 0.4, 900.0])  # each axis of its own size


def lived(rounds, n=64, seed=0, visits=True, **settings):
    """Told by an agent whose reach grows from the corner of the box, round by round; the last goals
    as shares of the box."""
    curriculum, rng = GoalCurriculum(LOW, HIGH, seed=seed, **settings), np.random.default_rng(seed)
    for i in range(rounds):
        goals = curriculum.ask(n)
        far = np.linalg.norm((goals - LOW) / (HIGH - LOW), axis=1)
        success = rng.random(n) < 1 / (1 + np.exp(20 * (far - 0.4 - 0.01 * i)))
        told = curriculum.tell(goals, success, visited=goals[success] if visits else None)
    return curriculum, (goals - LOW) / (HIGH - LOW), told


@pytest.mark.parametrize("visits", [True, False])
def test_it_proposes_what_is_neither_mastered_nor_hopeless(visits):
    """Starting from nothing: the share of goals at the edge of what is reached grows."""
    curriculum, _, told = lived(40, visits=visits)
    imagined = (curriculum.propose(1000) + 5) / 10  # inside, the box is a cube of ten metres
    edge = np.abs(np.linalg.norm(imagined, axis=1) - 0.75) < 0.15
    uniform = np.random.default_rng(0).uniform(size=(20_000, 3))
    chance = (np.abs(np.linalg.norm(uniform, axis=1) - 0.75) < 0.15).mean()
    assert edge.mean() > 0.75 > 2.5 * chance
    assert 0 < told["intermediate"] < 1 and np.isfinite(told["gan_generator_loss"])
    near, beyond = LOW + 0.1 * (HIGH - LOW), HIGH
    success = curriculum.success(np.array([near, beyond]))
    assert success[0] > 0.8 and success[1] < 0.2
    assert len(curriculum.replay) > 10


def test_until_something_was_reached_goals_are_anywhere():
    curriculum = GoalCurriculum(LOW, HIGH)
    for _ in range(5):
        goals = curriculum.ask(200)
        assert ((goals >= LOW) & (goals <= HIGH)).all()
        assert np.abs(((goals - LOW) / (HIGH - LOW)).mean(axis=0) - 0.5).max() < 0.1
        assert curriculum.tell(goals, np.zeros(200)) == {}
    assert np.isnan(GoalCurriculum(LOW, HIGH).success([LOW])).all()


def test_it_takes_goals_one_by_one_in_any_order():
    curriculum, goals = GoalCurriculum([0, 0], [1, 1], every=50), []
    goals = [curriculum.ask(1)[0] for _ in range(60)]
    told = [curriculum.tell([goal], [goal[0] < 0.5], visited=[goal]) for goal in goals[::-1]]
    assert sum(map(bool, told)) == 1
    assert curriculum.ask(0).shape == (0, 2)


def test_the_same_seed_asks_the_same_and_nobody_elses_numbers_change():
    import torch

    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = (lived(4, seed=seed)[1] for seed in (1, 1, 2))
    assert np.array_equal(first, second) and not np.array_equal(first, other)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("settings", [{}, {"goals": GoalsConfig(near=50.0)}])
def test_what_was_saved_goes_on_the_same(tmp_path, settings):
    curriculum, _, _ = lived(3, n=70, **settings)
    curriculum.save(tmp_path / "goals.pt")
    loaded = GoalCurriculum.load(tmp_path / "goals.pt")
    for _ in range(3):
        goals = curriculum.ask(40)
        assert np.array_equal(loaded.ask(40), goals)
        success = goals[:, 0] < 1
        assert loaded.tell(goals, success) == curriculum.tell(goals, success)
    assert np.array_equal(loaded.success(goals), curriculum.success(goals))


@pytest.mark.parametrize("damage", ["empty", "nonsense", 3000, 50_000, "places", "weights"])
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path, damage):
    path = tmp_path / "goals.pt"
    curriculum, _, _ = lived(2)
    if damage == "places":
        curriculum.visited.goals = np.zeros((3, 2))
    elif damage == "weights":
        curriculum.gan.generator.flat.data[0] = np.nan
    curriculum.save(path)
    if damage in ("empty", "nonsense"):
        path.write_bytes(b"nonsense" if damage == "nonsense" else b"")
    elif isinstance(damage, int):
        path.write_bytes(path.read_bytes()[:damage])
    with pytest.raises(ValueError, match=r"cannot load .*goals\.pt") as error:
        GoalCurriculum.load(path)
    assert "\n" not in str(error.value)
    with pytest.raises(OSError, match="No such file"):
        GoalCurriculum.load(tmp_path / "none.pt")


def of(**settings):
    return GoalCurriculum(LOW, HIGH, goals=GoalsConfig(**settings))


def asked():
    curriculum = GoalCurriculum(LOW, HIGH)
    curriculum.ask(1)
    return curriculum


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: GoalCurriculum(LOW, HIGH).tell([LOW], [1]), r"call ask\(\) first"),
        (lambda: asked().tell([LOW, LOW], [1]), "one number for each of the 2 goals"),
        (lambda: asked().tell([LOW], [2]), "0 to 1"),
        (lambda: asked().tell([LOW], [np.nan]), "0 to 1"),
        (lambda: asked().tell([LOW - 1], [1]), r"goal 0 is .* outside of the box"),
        (lambda: asked().tell([LOW * np.nan], [1]), "outside of the box"),
        (lambda: asked().tell([[1.0, 2.0]], [1]), "rows of 3 numbers"),
        (lambda: asked().tell([LOW], [1], visited=[1.0]), "visited must be rows of 3"),
        (lambda: asked().success(LOW), "rows of 3 numbers"),
        (lambda: asked().ask(-1), "0 or more, not -1"),
        (lambda: asked().ask(1.5), "not 1.5"),
        (lambda: of(source="oracle").ask(1), "need to know the world"),
        (lambda: of(r_min=0.9, r_max=0.1), "r_min must be less than r_max"),
        (lambda: of(neighbours=2000), "neighbours must not be more than episodes"),
        (lambda: GoalCurriculum(LOW, HIGH, seed=1.5), "seed must be a whole number"),
        (lambda: GoalCurriculum(LOW, HIGH, every=0), "every must be a whole number from 1"),
        (lambda: GoalCurriculum(LOW, HIGH, goals={"near": 1}), "must be a GoalsConfig"),
        (lambda: GoalCurriculum([-1e308], [1e308]), "both finite"),
        (lambda: GoalCurriculum(HIGH, LOW), "low must be less than high"),
        (lambda: GoalCurriculum([0.0], [np.inf]), "both finite"),
        (lambda: GoalCurriculum([0.0], [1.0, 2.0]), "corners of a box"),
        (lambda: GoalCurriculum(0.0, 1.0), "corners of a box"),
        (lambda: GoalCurriculum(LOW, HIGH, goals=GoalsConfig(r_max=2.0)), "r_max must be between"),
    ],
)
def test_what_makes_no_sense_names_the_mend(call, words):
    with pytest.raises(UsageError, match=words):
        call()


def test_what_is_refused_is_not_taken_in():
    curriculum = asked()
    with pytest.raises(UsageError):
        curriculum.tell([LOW, HIGH + 1], [1, 1], visited=[LOW])
    assert len(curriculum.estimator.goals) == 0 and len(curriculum.visited) == 0


def test_places_out_of_the_box_are_no_goals_but_no_error():
    curriculum = asked()
    curriculum.tell([LOW], [0], visited=[LOW, HIGH + 1])
    assert len(curriculum.visited) == 1


def test_many_dimensions_need_no_map_of_places():
    curriculum = GoalCurriculum(np.zeros(8), np.ones(8))
    for _ in range(4):
        goals = curriculum.ask(100)
        curriculum.tell(goals, goals[:, 0] < 0.5, visited=goals)
    assert len(curriculum.visited) == 1 and len(curriculum.replay) > 0
    assert goalgan_bt.GoalCurriculum is GoalCurriculum
