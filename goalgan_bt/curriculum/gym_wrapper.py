"""Goals of a curriculum for an environment of Gymnasium's.

    env = CurriculumGoals(gymnasium.make("goalgan_bt/PointUMaze-v0"), curriculum)

In a loop of one's own the wrapper asks the curriculum before each episode and tells it how the
episode went. Where environments run in other processes, they have no curriculum: goals are queued
ahead, since an episode that ends is followed by the next one at once, and the info with which an
episode ends holds what the curriculum shall hear (`goalgan_bt.sb3.GoalGANCallback` does both).
"""

from collections import deque
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from goalgan_bt.curriculum.curriculum import GoalCurriculum
from goalgan_bt.envs.gym_goals import Begin, goal_as_option
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.runs.errors import UsageError

TRIED = "goal_tried"  # the key of an info that tells how an episode went
EVERY = 10  # steps between two places that the curriculum hears of


class CurriculumGoals(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Lets episodes have the goals of a curriculum.

    Args:
        env: whose observations have `achieved_goal` and `desired_goal`, and whose info has
            `is_success` or `success`.
        curriculum: that is asked and told; if None, goals are those of `queue_goals`, and the
            environment's own where none is left.
        begin: how an episode begins with a goal.

    Raises:
        UsageError: for an environment without goals.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        curriculum: GoalCurriculum | None = None,
        begin: Begin = goal_as_option,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, curriculum=curriculum, begin=begin, _disable_deepcopy=True
        )
        gymnasium.Wrapper.__init__(self, env)
        spaces = getattr(env.observation_space, "spaces", {})
        if not {"achieved_goal", "desired_goal"} <= set(spaces):
            raise UsageError("observations must have an achieved_goal and a desired_goal")
        self._goal = np.zeros(spaces["desired_goal"].shape)
        if curriculum is not None and curriculum.low.shape != self._goal.shape:
            raise UsageError(
                f"the curriculum's goals have {len(curriculum.low)} numbers, "
                f"the environment's {self._goal.shape}"
            )
        self._curriculum, self._start = curriculum, begin
        self._queued: deque[FloatArray] = deque()
        self._visited: list[FloatArray] = []
        self._success, self._steps = False, 0

    def queue_goals(self, goals: ArrayLike, anew: bool = False) -> None:
        """Goals for the next episodes, (n, goal_dim) or one of them; those that are queued already
        come first, or with `anew` are dropped.

        Raises:
            UsageError: for arrays that are no such goals.
        """
        rows = np.atleast_2d(np.array(goals, dtype=float))
        if rows.ndim != 2 or rows.shape[1:] != self._goal.shape:
            raise UsageError(f"goals must be rows of {self._goal.shape} numbers, not {rows.shape}")
        if anew:
            self._queued.clear()
        self._queued.extend(rows)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with the next goal; with options of one's own they count instead."""
        if options is None and not self._queued and self._curriculum is not None:
            self.queue_goals(self._curriculum.ask(1))
        if options is None and self._queued:
            obs, info = self._start(self.env, self._queued.popleft(), seed)
        else:
            obs, info = self.env.reset(seed=seed, options=options)
        self._goal = np.array(obs["desired_goal"], dtype=float)
        self._visited, self._success, self._steps = [], False, 0
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step; the info of an episode's last has `goal_tried`: the goal, whether it was
        reached, and places that were passed, a list of (goal_dim,).

        Raises:
            UsageError: where the info does not say whether the goal is reached.
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        if "is_success" not in info and "success" not in info:
            raise UsageError("the info of a step must have is_success or success")
        self._success |= bool(info.get("is_success", info.get("success")))
        self._steps += 1
        ended = terminated or truncated
        if ended or self._steps % EVERY == 0:
            self._visited.append(np.array(obs["achieved_goal"], dtype=float))
        if ended:
            tried = {
                "goal": self._goal,
                "success": self._success,
                "visited": self._visited,
            }
            info = info | {TRIED: tried}
            if self._curriculum is not None:
                tell(self._curriculum, [tried])
        return obs, reward, terminated, truncated, info


def tell(curriculum: GoalCurriculum, episodes: list[dict[str, Any]]) -> dict[str, float]:
    """Tell a curriculum of episodes as `goal_tried` has them; returns what it tells."""
    goals: NDArray[Any] = np.stack([episode["goal"] for episode in episodes])
    success = [episode["success"] for episode in episodes]
    visited = np.array([place for episode in episodes for place in episode["visited"]])
    inside = ((goals >= curriculum.low) & (goals <= curriculum.high)).all(axis=1)
    return curriculum.tell(goals[inside], np.array(success, dtype=float)[inside], visited)
