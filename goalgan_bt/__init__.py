"""Goal GAN with a backtracking model: an automatic curriculum of goals for sparse rewards.

A whole run, as the command `python -m goalgan_bt.train` does it (`--help-all` lists every setting):

    import goalgan_bt
    trained = goalgan_bt.train("point_umaze", seed=0, total_steps=1_000_000, out="runs")
    policy = goalgan_bt.load_policy(trained.folder)
    action = policy.act(observation, goal)         # observation: the body's state
    run = goalgan_bt.open_run(trained.folder)      # in a notebook: run.plot(), run.show()

The curriculum alone, in a loop and a world of one's own. It proposes goals that are neither
mastered nor hopeless, and is told only how trying went:

    curriculum = goalgan_bt.GoalCurriculum(low, high, seed=0)      # any box, any dimension
    goals = curriculum.ask(n)                                      # (n, goal_dim)
    curriculum.tell(goals, success, visited=places)                # the GAN learns when it is due
    curriculum.success(goals)                                      # estimated, (n,)
    curriculum.save(path)
    curriculum = goalgan_bt.GoalCurriculum.load(path)

The same around an environment of Gymnasium's whose observations have goals:

    env = goalgan_bt.CurriculumGoals(env, curriculum)

The backtracking model alone: what state and action may have led to a state, unrolled backward.

    model = goalgan_bt.BacktrackingModel(state_dim, act_dim, seed=0)
    model.fit(states, actions, next_states, steps=2000)
    traces = goalgan_bt.recall_traces(model, seeds, length, valid=valid, repair=repair)

The same over places: which way leads from where the agent is to a goal, over where it has been.

    places = goalgan_bt.Places(low, high, success_radius)
    places.learn(origins, ends)                    # (n, T, goal_dim): where actions began and ended
    places.refresh()
    left, directions = places.ways(here, goals)    # a potential to shape rewards, and a heading

Callbacks for agents of Stable-Baselines3 are in `goalgan_bt.sb3`; `import goalgan_bt.gym` makes
Gymnasium know the environments. What a call can be given that
makes no sense is a `goalgan_bt.UsageError`, a folder that is no run a `goalgan_bt.RunError`; both
are `ValueError`s, as is a damaged file, and their message says what to do.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from goalgan_bt.curriculum.curriculum import GoalCurriculum
    from goalgan_bt.curriculum.gym_wrapper import CurriculumGoals
    from goalgan_bt.curriculum.settings import GanConfig, GoalsConfig
    from goalgan_bt.learners.run_config import Trained
    from goalgan_bt.learners.table import register_env
    from goalgan_bt.learners.trained_policy import TrainedPolicy, load_policy
    from goalgan_bt.notebook import OpenRun, open_run
    from goalgan_bt.recall.backtracking import BacktrackingModel
    from goalgan_bt.recall.places import Places, Ways
    from goalgan_bt.recall.settings import BacktrackingConfig, PlacesConfig
    from goalgan_bt.recall.traces import Traces, recall_traces
    from goalgan_bt.runs.errors import RunError, UsageError
    from goalgan_bt.train import train

__all__ = [
    "BacktrackingConfig",
    "BacktrackingModel",
    "CurriculumGoals",
    "GanConfig",
    "GoalCurriculum",
    "GoalsConfig",
    "OpenRun",
    "Places",
    "PlacesConfig",
    "RunError",
    "Traces",
    "Trained",
    "TrainedPolicy",
    "UsageError",
    "Ways",
    "load_policy",
    "open_run",
    "recall_traces",
    "register_env",
    "train",
]

# Imported when they are asked for: torch takes seconds.
_HOME = {
    "BacktrackingConfig": "recall.settings",
    "BacktrackingModel": "recall.backtracking",
    "CurriculumGoals": "curriculum.gym_wrapper",
    "GanConfig": "curriculum.settings",
    "GoalCurriculum": "curriculum.curriculum",
    "GoalsConfig": "curriculum.settings",
    "OpenRun": "notebook",
    "Places": "recall.places",
    "PlacesConfig": "recall.settings",
    "RunError": "runs.errors",
    "Traces": "recall.traces",
    "Trained": "learners.run_config",
    "TrainedPolicy": "learners.trained_policy",
    "UsageError": "runs.errors",
    "Ways": "recall.places",
    "load_policy": "learners.trained_policy",
    "open_run": "notebook",
    "recall_traces": "recall.traces",
    "register_env": "learners.table",
}


def __getattr__(name: str) -> Any:
    if name == "train":  # the module itself, which can be called
        return importlib.import_module("goalgan_bt.train")
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("goalgan_bt")
    if name not in _HOME:
        raise AttributeError(f"module 'goalgan_bt' has no attribute {name!r}")
    return getattr(importlib.import_module(f"goalgan_bt.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
