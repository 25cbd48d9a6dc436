"""A curriculum of goals for agents of Stable-Baselines3: import it as `goalgan_bt.sb3`."""

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from goalgan_bt.curriculum.curriculum import GoalCurriculum
from goalgan_bt.curriculum.gym_wrapper import TRIED, tell

AHEAD = 2  # goals queued in each environment: one is taken as soon as an episode ends


class GoalGANCallback(BaseCallback):
    """Gives goals of a curriculum to environments in `CurriculumGoals`, in this process or others,
    and tells it how trying them went.

    Args:
        curriculum: `save` it with the agent, and `load` it to go on.
        verbose: as Stable-Baselines3's.

    Raises:
        TypeError: when learning begins, for environments that are not in `CurriculumGoals`.
    """

    def __init__(self, curriculum: GoalCurriculum, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.curriculum = curriculum

    def _on_training_start(self) -> None:
        envs = self.training_env
        if not envs.has_attr("queue_goals"):
            raise TypeError(
                "put each environment into goalgan_bt.CurriculumGoals, for example by "
                "make_vec_env(..., wrapper_class=CurriculumGoals)"
            )
        for i in range(envs.num_envs):
            envs.env_method("queue_goals", self.curriculum.ask(AHEAD), anew=True, indices=[i])

    def _on_step(self) -> bool:
        ended = [i for i, info in enumerate(self.locals["infos"]) if TRIED in info]
        if not ended:
            return True
        episodes = [self.locals["infos"][i][TRIED] for i in ended]
        for name, value in tell(self.curriculum, episodes).items():
            self.logger.record(f"curriculum/{name}", value)
        self.logger.record_mean(
            "curriculum/success", float(np.mean([episode["success"] for episode in episodes]))
        )
        for i, goal in zip(ended, self.curriculum.ask(len(ended)), strict=True):
            self.training_env.env_method("queue_goals", goal, indices=[i])
        return True
