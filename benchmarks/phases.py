"""Where the time of whole training goes, phase by phase.

    python benchmarks/phases.py --markdown docs/profile.md

Functions are wrapped with timers while training runs as always. A phase has the time of its own
functions without that of other phases that they call, except that `WHOLE` phases keep everything
inside. A row tells the thread that a phase ran in; `CPU` is that thread's. What simulation threads
(and torch's own, where it has several) did for them is the row of `worker threads`: they have no
wall time of their own.
"""

import contextlib
import functools
import io
import pkgutil
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from common import machine

from goalgan_bt.learners import maze_config
from goalgan_bt.learners.maze import Trained, train
from goalgan_bt.learners.maze_config import MazeConfig

# Functions by phase, as they are looked up when they are called: a function that another module
# has imported by name is wrapped there.
PHASES = {
    "simulation": (
        "goalgan_bt.envs.mujoco_env:MujocoEnv.advance",
        "goalgan_bt.envs.point_maze:PointMaze.advance",
        "goalgan_bt.envs.point_nd:PointND.advance",
    ),
    "observation": (
        "goalgan_bt.envs.goal_env:GoalEnv.observe",
        "goalgan_bt.envs.ant_maze:AntMaze.observations",
        "goalgan_bt.envs.ant_maze:AntMaze.achieved_goals",
        "goalgan_bt.envs.ant_maze:AntMaze.to_body",
        "goalgan_bt.envs.point_maze:PointMaze.observations",
        "goalgan_bt.envs.point_nd:PointND.observations",
    ),
    "policy inference": ("goalgan_bt.agent.policy:Actor.__call__",),
    "bookkeeping of rollouts": ("goalgan_bt.agent.rollout:Collector.collect",),
    "advantages": ("goalgan_bt.learners.maze:advantages_and_returns",),
    "TRPO": ("goalgan_bt.agent.trpo:update",),
    "value function": ("goalgan_bt.agent.policy:ValueFunction.fit",),
    "backtracking model": ("goalgan_bt.recall.backtracking:BacktrackingModel.fit",),
    "GAN": ("goalgan_bt.curriculum.gan:GoalGAN.fit", "goalgan_bt.curriculum.gan:GoalGAN.sample"),
    "labels": (
        "goalgan_bt.learners.maze_learner:MazeLearner.remember",
        "goalgan_bt.curriculum.curriculum:GoalCurriculum.judge",
        "goalgan_bt.curriculum.curriculum:GoalCurriculum.propose",
        "goalgan_bt.curriculum.curriculum:GoalCurriculum.recollect",
        "goalgan_bt.curriculum.goals:SuccessEstimator.__call__",
        "goalgan_bt.curriculum.goals:GoalMemory.add",
    ),
    "places": (
        "goalgan_bt.recall.places:Places.learn",
        "goalgan_bt.recall.places:Places.refresh",
        "goalgan_bt.recall.places:Places.ways",
        "goalgan_bt.recall.places:Places.heading",
    ),
    "decoder and recall traces": (
        "goalgan_bt.learners.maze:decode",
        "goalgan_bt.learners.maze:recall_traces",
        "goalgan_bt.recall.transitions:Steps.lesson",
    ),
    "imitation": ("goalgan_bt.recall.imitation:Imitation.update",),
    "evaluation": ("goalgan_bt.learners.maze:coverage", "goalgan_bt.learners.maze:consistency"),
    "recording": (
        "goalgan_bt.runs.run_writer:RunWriter.metrics",
        "goalgan_bt.runs.run_writer:RunWriter.frame",
        "goalgan_bt.recall.traces:Traces.paths",
        "goalgan_bt.curriculum.curriculum:GoalCurriculum.mapped",
        "goalgan_bt.runs.terminal:Terminal.report",
    ),
    "checkpoint": ("goalgan_bt.runs.checkpoint:save",),
    "waiting for the second thread": ("concurrent.futures:Future.result",),
}
WHOLE = set(PHASES) - {"bookkeeping of rollouts", "observation"}
REST = "the rest of training"


@dataclass(frozen=True)
class Settings:
    """Tell where the time of training goes."""

    env: tuple[str, ...] = ("point_umaze", "ant_umaze")
    """Environments."""
    threads: int = 0
    """Simulation threads; 0 is one per core."""
    train_steps: int = 3_000_000
    """Environment steps of each run; the warm-up is one iteration."""
    markdown: Path | None = None
    """Also write the tables to this file."""


@dataclass
class Spent:
    """What a phase took in one thread: calls, wall and CPU seconds without other phases."""

    calls: int = 0
    wall: float = 0.0
    cpu: float = 0.0


class Timers:
    """Times functions, each thread by itself."""

    def __init__(self) -> None:
        self.spent: dict[tuple[str, str], Spent] = defaultdict(Spent)  # by phase and thread
        self._local = threading.local()

    def wrap(self, function: Callable[..., Any], phase: str) -> Callable[..., Any]:
        """The function with its time counted as that phase's."""

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            stack = self._local.__dict__.setdefault("stack", [])
            if stack and stack[-1][0] in WHOLE:
                return function(*args, **kwargs)
            inside = [phase, 0.0, 0.0]  # wall and CPU time of other phases in this call
            stack.append(inside)
            wall, cpu = time.perf_counter(), time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
                stack.pop()
                if stack:
                    stack[-1][1] += wall
                    stack[-1][2] += cpu
                main = threading.current_thread() is threading.main_thread()
                spent = self.spent[phase, "main" if main else "beside"]
                spent.calls += 1
                spent.wall += wall - inside[1]
                spent.cpu += cpu - inside[2]

        return timed


def look_up(name: str) -> tuple[Any, str, Callable[..., Any]]:
    """The owner of a function, its attribute there, and the function itself.

    Raises:
        ImportError, AttributeError, KeyError: if there is no such function.
    """
    owner_name, _, attribute = name.replace(":", ".").rpartition(".")
    owner = pkgutil.resolve_name(owner_name)
    return owner, attribute, vars(owner)[attribute]


@contextlib.contextmanager
def wrapped(timers: Timers) -> Iterator[None]:
    """Everything in `PHASES` timed meanwhile."""
    found = [(phase, look_up(name)) for phase, names in PHASES.items() for name in names]
    for phase, (owner, attribute, original) in found:
        setattr(owner, attribute, timers.wrap(original, phase))
    try:
        yield
    finally:
        for _, (owner, attribute, original) in found:
            setattr(owner, attribute, original)


def quiet(cfg: MazeConfig, run: Callable[..., Any]) -> int:
    """Train in a folder of no importance and without a word; returns the steps."""
    silence = contextlib.redirect_stdout(io.StringIO())
    with tempfile.TemporaryDirectory() as folder, silence:
        return run(cfg, Path(folder)).steps


def profile(cfg: MazeConfig) -> str:
    """Train once; a table in Markdown of where the time went."""
    quiet(replace(cfg, total_steps=1), train)
    timers = Timers()
    wall = cpu = 0.0

    def timed(cfg: MazeConfig, folder: Path) -> Trained:  # without what becomes of the folder
        nonlocal wall, cpu
        wall, cpu = time.perf_counter(), time.process_time()
        trained = timers.wrap(train, REST)(cfg, folder)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return trained

    with wrapped(timers):
        steps = quiet(cfg, timed)
    rows = [
        (phase, thread, f"{s.calls:,}", f"{s.wall:.2f}", f"{s.wall / wall:.1%}", f"{s.cpu:.2f}")
        for (phase, thread), s in sorted(timers.spent.items(), key=lambda item: -item[1].wall)
    ]
    others = cpu - sum(s.cpu for s in timers.spent.values())
    rows.append(("worker threads", "", "", "", "", f"{others:.2f}"))
    heads = ("phase", "thread", "calls", "wall s", "of the run", "CPU s")
    lines = [heads, ("---", "---", "---:", "---:", "---:", "---:"), *rows]
    return (
        f"## {cfg.env}, {cfg.num_threads} simulation threads\n\n"
        f"{steps:,} steps in {wall:.1f} s of wall time, {steps / wall:,.0f} steps/s; "
        f"{cpu:.1f} s of CPU time, {cpu / wall:.2f} cores busy.\n\n"
        + "\n".join(f"| {' | '.join(line)} |" for line in lines)
        + "\n"
    )


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    words = "`python benchmarks/phases.py`"
    parts = [f"# Where the time of training goes\n\n{machine()}. From {words}.\n\n{notes()}\n"]
    print(parts[0], flush=True)
    for env in settings.env:
        cfg = maze_config.preset(env)
        cfg = replace(cfg, threads=settings.threads, total_steps=settings.train_steps)
        parts.append(profile(cfg))
        print(parts[-1], flush=True)
    if settings.markdown is not None:
        settings.markdown.write_text("\n".join(parts))


def notes() -> str:
    """How the tables are to be read: the last paragraph of this file's description."""
    return (__doc__ or "").strip().split("\n\n")[-1]


if __name__ == "__main__":
    main()
