"""A policy that `python -m goalgan_bt.export` wrote, at work without torch.

python examples/run_onnx.py policy.onnx goalgan_bt/PointUMaze-v0 4 0
"""

import sys

import gymnasium
import numpy as np
import onnxruntime

import goalgan_bt.gym  # noqa: F401  (the ids)

path, name, *goal = sys.argv[1:]
act = onnxruntime.InferenceSession(path).run
env = gymnasium.make(name, action_repeat=2 if "Ant" in name else 4)  # as in training
obs, info = env.reset(options={"goal": np.array(goal, float)})
ended, actions = False, 0
while not ended:
    (action,) = act(None, {"state": obs["observation"][None], "goal": obs["desired_goal"][None]})
    obs, _, terminated, truncated, info = env.step(action[0])
    ended, actions = terminated or truncated, actions + 1
print("reached" if info["success"] else "not reached", f"after {actions} actions")
