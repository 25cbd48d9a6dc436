"""Recall traces for agents of Stable-Baselines3 and sb3-contrib (extra `sb3`).

    from stable_baselines3 import SAC
    from goalgan_bt.sb3 import RecallConfig, RecallTraces

The callback itself is `goalgan_bt.learners.stable_baselines`.
"""

from goalgan_bt.learners.stable_baselines import RecallTraces
from goalgan_bt.recall.settings import RecallConfig

__all__ = ["RecallConfig", "RecallTraces"]
