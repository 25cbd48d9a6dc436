"""Four rooms as a Gymnasium environment."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from goalgan_bt.envs.four_rooms import ACTIONS, FourRooms

CELL = 16  # pixels of a side of a cell in a picture
WALL, FLOOR, GOAL, AGENT = (60, 60, 70), (235, 235, 235), (220, 60, 60), (40, 100, 220)  # RGB


class FourRoomsEnv(gymnasium.Env[Any, Any]):
    """Walk from one corner to the opposite one: reward 1 there, which ends the episode, else 0.

    Observations are numbers of free cells, actions 0 to 3: up, right, down, left.

    Args:
        render_mode: `rgb_array`, `ansi` (text), or None.
        size: cells of a side, 7 to 51.
        horizon: steps of an episode.

    Raises:
        ValueError: for settings that there are not.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array", "ansi"],
        "render_fps": 10,
    }

    def __init__(self, render_mode: str | None = None, *, size: int = 11, horizon: int = 200):
        self.rooms, self._horizon = FourRooms(size), horizon
        if horizon < 1:
            raise ValueError(f"horizon must be 1 or more, not {horizon}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is rgb_array, ansi or None, not {render_mode!r}")
        self.render_mode = render_mode
        self.observation_space = spaces.Discrete(len(self.rooms.cells))
        self.action_space = spaces.Discrete(len(ACTIONS))
        self._state, self._elapsed = self.rooms.start, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Begin an episode; options: `state`, if it shall not be the start."""
        super().reset(seed=seed)
        options = options or {}
        state = options.get("state", self.rooms.start)
        if set(options) - {"state"} or not self.observation_space.contains(state):
            raise ValueError(f"reset takes a 'state' of {self.observation_space}, not {options!r}")
        self._state, self._elapsed = int(state), 0
        return self._state, {"success": False, "is_success": False}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Take a step; into a wall it leads nowhere."""
        if not self.action_space.contains(action):
            raise ValueError(f"an action is a number from 0 to 3, not {action!r}")
        self._state = int(self.rooms.next_state[self._state, action])
        self._elapsed += 1
        success = self._state == self.rooms.goal
        truncated = not success and self._elapsed >= self._horizon
        info = {"success": success, "is_success": success}
        return self._state, float(success), success, truncated, info

    def render(self) -> NDArray[np.uint8] | str | None:
        """The rooms, the goal and the agent: (pixels, pixels, 3), or text."""
        if self.render_mode is None:
            return None
        agent, goal = self.rooms.cells[[self._state, self.rooms.goal]]
        if self.render_mode == "ansi":
            text = np.where(self.rooms.free, ".", "#")
            text[tuple(goal)], text[tuple(agent)] = "G", "A"
            return "\n".join(map("".join, text))
        picture = np.where(self.rooms.free[..., None], FLOOR, WALL).astype(np.uint8)
        picture[tuple(goal)], picture[tuple(agent)] = GOAL, AGENT
        return picture.repeat(CELL, axis=0).repeat(CELL, axis=1)
