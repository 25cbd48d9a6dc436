"""For agents of Stable-Baselines3 and sb3-contrib (extra `sb3`): a curriculum of goals, and recall
traces, as callbacks.

    from stable_baselines3 import SAC
    from goalgan_bt.sb3 import GoalGANCallback, RecallConfig, RecallTraces

The callbacks themselves are in `goalgan_bt.learners`: `curriculum_callback`, `stable_baselines`.
"""

from goalgan_bt.curriculum.gym_wrapper import CurriculumGoals
from goalgan_bt.envs.gym_goals import goal_as_attribute, goal_as_option
from goalgan_bt.recall.settings import RecallConfig

try:
    from goalgan_bt.learners.curriculum_callback import GoalGANCallback
    from goalgan_bt.learners.stable_baselines import RecallTraces
except ImportError as error:
    raise ImportError('goalgan_bt.sb3 needs its extra: pip install "goalgan_bt[sb3]"') from error

__all__ = [
    "CurriculumGoals",
    "GoalGANCallback",
    "RecallConfig",
    "RecallTraces",
    "goal_as_attribute",
    "goal_as_option",
]
