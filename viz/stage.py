"""The body in the scene of a run: episodes over and over, or one that somebody asked for."""

import math
import time
from typing import Any

import numpy as np
import viser

from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.runs.errors import RunError
from goalgan_bt.viz.body import Bodies
from goalgan_bt.viz.player import Attempt, Player
from goalgan_bt.viz.run import Run, labels, success
from goalgan_bt.viz.scene import Scene

RETRY = 10.0  # seconds after which a run that cannot be played is looked at again
PAUSE = 1.0  # seconds for which a finished attempt stands still
AROUND = 0.2  # seconds between two pictures of the trail
LEGIBLE = 4.0  # seconds for which a refusal is told
NEAR = 0.3  # metres within which a click means a goal


class Stage:
    """Plays a run's policies in its scene.

    Args:
        server: whose scene it is.
        scene: that of the run.
        run: the run.
        offset: (x, y) of its maze in the scene, metres.

    Attributes:
        asked: whether somebody asked for what is on show, which then stays; words: how it stands,
        in markdown.
    """

    def __init__(
        self, server: viser.ViserServer, scene: Scene, run: Run, offset: tuple[float, float]
    ) -> None:
        self._server, self._scene, self._run, self._offset = server, scene, run, offset
        self._player: Any = None  # a Player or a Walker
        self._bodies: Bodies | None = None
        self._attempt: Attempt | None = None
        self._began, self._next_try, self._ended = 0.0, 0.0, -1
        self._trail: FloatArray = np.empty((0, 2))
        self.asked, self.words = False, "No policy yet: the first one comes soon."
        self._around = -math.inf  # when what is around the body was last drawn
        self._refused = -math.inf  # until when it is told that a wish cannot be granted
        self.report: int | None = None  # whose policy it shall be; None: the newest

    def play(self, now: float) -> None:
        """Draw what is due at that time (of `time.monotonic`)."""
        if not (self._scene.visible("body") or self.asked):
            return
        over = self._attempt is None or now - self._began > self._attempt.seconds + PAUSE
        if over and not self.asked:
            if not self.ready(now):
                return
            self.begin(self._player.some_goal(), now)
        assert self._attempt is not None and self._bodies is not None
        step = max(0, int((now - self._began) / self._attempt.dt))
        step = min(step, len(self._attempt.states) - 1)
        self._bodies.draw(self._attempt.states[step])
        if self._run.kind == "running":
            self._scene.roll(*self._bodies.middle)
        # Trail, tiles and words follow some times a second: all costs the training beside.
        if abs(now - self._around) < AROUND and step < len(self._attempt.states) - 1:
            return
        self._around = now
        if self._run.kind == "goals":
            self._draw_around(step)
        if now > self._refused:
            self.words = self._describe(now)

    def ready(self, now: float) -> bool:
        """Whether there is a policy to play; takes up the one that is due."""
        if self._player is None:
            if now < self._next_try:
                return False
            try:
                self._player = self._make_player()
            except Exception:  # the settings are another version's, or nonsense
                self._next_try = now + RETRY
                return False
        return bool(self._player.take(self.report))

    def ask(self, place: FloatArray | None, now: float) -> None:
        """Let the body go to a place, (2,) metres, or one body to each tile (None)."""
        if not self.ready(now):
            self._refuse(
                "There is no policy to play: none was saved yet, or by another version.", now
            )
            return
        goals = self._player.env.test_goals()
        if place is not None:
            goals = np.zeros((1, self._player.env.goal_dim))
            goals[0, :2] = place
            if not self._player.env.feasible(goals)[0]:
                self._refuse("No body can be there: click on a free place.", now)
                return
        self.begin(goals, now)
        self.asked, self._refused = True, -math.inf
        self.words = self._describe(now)

    def _refuse(self, why: str, now: float) -> None:
        self.words, self._refused = why, now + LEGIBLE

    def release(self) -> None:
        """Let the body go for goals of its own again."""
        self.asked, self._attempt = False, None
        self.words = "The body goes for goals of its own."

    def begin(self, goals: FloatArray, now: float) -> None:
        """Begin an attempt at each of some goals, (n, goal_dim)."""
        if self._bodies is None:
            kept = None if self._run.kind == "running" else self._offset
            self._bodies = Bodies(self._server, self._player.model, kept)
        self._bodies.show(self._scene.visible("body"))
        began = time.monotonic()
        self._attempt = self._player.attempt(goals)
        # Many take some seconds to be computed: what is shown begins after that.
        self._began = now + time.monotonic() - began
        tried, self._ended, self._around = self._ended >= 0, -1, -math.inf
        if self._run.kind != "goals":
            return
        one = len(goals) == 1  # no field leads to all of them, and no trail is one
        self._trail = self._player.trail(self._attempt) if one else np.empty((0, 2))
        self._scene.mark(goals, self._player.env.success_radius)
        self._scene.draw_ways(*self._player.ways(goals) if one else (goals[:0], goals[:0]))
        if tried:
            self._clear_tried()

    def show_body(self, visible: bool) -> None:
        """Show or hide the body."""
        if self._bodies is not None:
            self._bodies.show(visible)

    def close(self) -> None:
        """Take everything of it out of the scene."""
        if self._bodies is not None:
            self._bodies.remove()
        none = np.empty((0, 2))
        self._scene.mark(none, 0.0)
        self._scene.draw_ways(none, none)
        self._scene.draw_trail(none)
        self._clear_tried()

    def _clear_tried(self) -> None:
        self._scene.draw_tried(np.empty((0, 2)), np.empty(0, bool), np.empty(0, bool))

    def _make_player(self) -> Any:
        if self._run.kind == "running":
            from goalgan_bt.viz.walker import Walker  # Stable-Baselines3, where it is installed

            return Walker(self._run.folder)
        if self._run.kind == "rooms":
            raise RunError("a table of states has no body")
        return Player(self._run.folder)

    def _draw_around(self, step: int) -> None:
        """The trail up to a step; which of many attempts have ended."""
        attempt = self._attempt
        assert attempt is not None
        if len(attempt.goals) == 1:
            self._scene.draw_trail(self._trail[: step + 1])
            return
        ended = attempt.ends <= step
        if ended.sum() != self._ended:
            self._ended = int(ended.sum())
            self._scene.draw_tried(attempt.goals, attempt.reached, ended)

    def _describe(self, now: float) -> str:
        attempt, player = self._attempt, self._player
        assert attempt is not None
        done = max(0.0, now - self._began)
        if self._run.kind == "running":
            if done < attempt.seconds:
                return f"An episode of the newest policy, {done:.1f} s"
            how = "until it fell" if attempt.fell[0] else "standing"
            return f"An episode: return **{player.returned:,.0f}**, {attempt.seconds:.1f} s {how}"
        whose = f"Policy of iteration {player.iteration:,}. "
        if len(attempt.goals) == 1:
            x, y = attempt.goals[0, :2]
            known = self._known(attempt.goals[0]) if self.asked else ""
            if done < attempt.seconds:
                return f"{whose}Goal ({x:.1f}, {y:.1f}): on its way, {done:.1f} s{known}"
            why = attempt.outcome(0)
            return f"{whose}Goal ({x:.1f}, {y:.1f}): **{why}** after {attempt.seconds:.1f} s{known}"
        ended = attempt.ends * attempt.dt <= done
        reached = int((attempt.reached & ended).sum())
        return f"{whose}All tiles: **{reached} of {len(ended)}** reached, {ended.sum()} ended"

    def _known(self, goal: FloatArray) -> str:
        """What the report on show says of a place: of its tile, of the goal that is nearest."""
        iterations = self._run.iterations
        frame = self._run.frame(self.report or iterations[-1]) if iterations else None
        if frame is None or not len(frame["test_goals"]):
            return ""
        rate, measured = success(frame)
        tile = int(np.linalg.norm(frame["test_goals"] - goal, axis=1).argmin())
        how = "measured" if measured else "estimated"
        told = f"\n\nThis tile is reached in **{rate[tile]:.0%}** ({how})."
        away = np.linalg.norm(frame["goals"] - goal, axis=1)
        if len(away) and away.min() < NEAR:
            kind = {-1: "too hard", 0: "of intermediate difficulty", 1: "too easy"}
            told += f" The goal beside it is {kind[int(labels(frame)[away.argmin()])]}."
        return told
