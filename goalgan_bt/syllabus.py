"""The curriculum of goals for training loops with Syllabus (the package `syllabus-rl`).

    from syllabus.core import GymnasiumSyncWrapper, make_multiprocessing_curriculum
    from goalgan_bt.syllabus import GoalGANCurriculum, GoalTasks

    tasks = GoalGANCurriculum(GoalCurriculum(low, high, seed=0))
    shared = make_multiprocessing_curriculum(tasks)
    env = GymnasiumSyncWrapper(GoalTasks(env), tasks.task_space, shared.components)

A task of Syllabus is a goal here, (goal_dim,), and whether it was reached is its progress.
"""

from typing import Any

import gymnasium
import numpy as np

try:
    from syllabus.core import Curriculum, TaskWrapper
    from syllabus.task_space import BoxTaskSpace, TaskSpace
except ImportError as error:
    wanted = 'goalgan_bt.syllabus needs its extra: pip install "goalgan_bt[syllabus]"'
    raise ImportError(wanted) from error

from goalgan_bt.curriculum.curriculum import GoalCurriculum
from goalgan_bt.envs.gym_goals import Begin, goal_as_option
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.runs.errors import UsageError


class GoalGANCurriculum(Curriculum):  # type: ignore[misc]  # Syllabus has no types
    """Lets Syllabus sample the goals of a curriculum, and tells that how they went.

    Args:
        curriculum: `save` it with the agent, and `load` it to go on.
        task_space: a `BoxTaskSpace` of the goals' size that holds the curriculum's whole box;
            without it that box itself.

    Raises:
        UsageError: for a task space that does not hold all goals.
    """

    def __init__(self, curriculum: GoalCurriculum, task_space: TaskSpace | None = None) -> None:
        low, high = curriculum.low, curriculum.high
        if task_space is None:
            task_space = BoxTaskSpace(gymnasium.spaces.Box(low, high, dtype=np.float64))
        box = task_space.gym_space if isinstance(task_space, BoxTaskSpace) else None
        if (
            box is None
            or box.shape != low.shape
            or (low < box.low).any()
            or (high > box.high).any()
        ):
            raise UsageError(
                "task_space must be a BoxTaskSpace that holds the goals "
                f"from {low.tolist()} to {high.tolist()}"
            )
        super().__init__(task_space)
        self.curriculum = curriculum
        self._learned: dict[str, float] = {}  # what the GAN's last lesson came to

    def sample(self, k: int = 1) -> list[FloatArray]:
        """The next k goals to try."""
        return list(self.curriculum.ask(k))

    def update_on_episode(
        self,
        episode_return: float,
        length: int,
        task: Any,
        progress: float,
        env_id: int | None = None,
    ) -> None:
        """Take in an episode that has ended: its goal, and whether that was reached, or how often.

        Syllabus does not say where the agent has been: goals that were reached count as visited.

        Raises:
            UsageError: for a goal or a progress that cannot be.
        """
        self._learned |= self.curriculum.tell(np.asarray(task)[None], [float(progress)])

    def log_metrics(
        self,
        writer: Any,
        logs: list[tuple[str, float]] | None,
        step: int | None = None,
        log_n_tasks: int = 1,
    ) -> list[tuple[str, float]]:
        """Write what the GAN's last lesson came to. Syllabus's own figures are one for each task,
        and goals are more than can be counted."""
        told = [(f"curriculum/{name}", value) for name, value in self._learned.items()]
        logs = [*(logs or []), *told]
        for name, value in logs:
            if hasattr(writer, "add_scalar"):  # TensorBoard's
                writer.add_scalar(name, value, step)
            else:  # the module wandb
                writer.log({name: value})
        return logs


class GoalTasks(TaskWrapper):  # type: ignore[misc]
    """Lets episodes of a goal environment of Gymnasium's have the tasks of Syllabus as goals.

    Args:
        env: whose observations have a `desired_goal`, and whose info has `is_success` or `success`.
        begin: how an episode begins with a goal.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], begin: Begin = goal_as_option) -> None:
        super().__init__(env)
        self._start = begin

    def reset(
        self,
        new_task: FloatArray | None = None,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with that goal; without one as the environment itself would."""
        self.task_completion = 0.0
        if new_task is None:
            obs, info = self.env.reset(seed=seed, options=options)
        else:
            obs, info = self._start(self.env, new_task, seed)
        self.task = np.array(obs["desired_goal"], dtype=float)
        return obs, info | {"task": self.task, "task_completion": 0.0}

    def _task_completion(
        self, obs: Any, rew: float, term: bool, trunc: bool, info: dict[str, Any]
    ) -> float:
        """1 once the goal has been reached in this episode, also where it then goes on."""
        reached = float(info.get("is_success", info.get("success", False)))
        return max(self.task_completion, reached)
