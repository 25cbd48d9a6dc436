"""The settings that every learner has, with the same meaning."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from goalgan_bt.envs.maze import Maze
from goalgan_bt.runs.ranges import ABOVE_ZERO, NOT_NEGATIVE, Range


@dataclass(frozen=True)
class RunConfig:
    """What is learned, for how long, and where it is written and shown."""

    env: str
    """Environment. Picks the preset."""
    method: str
    """What to learn with. Picks settings; other flags come on top."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Seed of everything random."""
    total_steps: Annotated[int | None, ABOVE_ZERO] = None
    """Stop after this many environment steps of training; the batch that passes it is finished."""
    out: Path = Path("runs")
    """Folder of runs; this run gets a folder of its own in it."""
    resume: Path | None = None
    """Go on with this run (its folder), with its settings."""
    track: bool = False
    """Give the metrics to Weights & Biases, too (extra `wandb`): offline, in the run folder, unless
    WANDB_MODE says otherwise. To be said again with --resume."""
    viz: Literal["browser", "none"] = "browser"
    """Where to watch: a page in the browser, in a process of its own, or nowhere."""
    viz_host: str = "127.0.0.1"
    """Where the page listens; 0.0.0.0 lets everybody on the network in, without a password."""
    viz_port: Annotated[int, Range("between 0 and 65535", 0, 65535)] = 8080
    """The page's port; if it is busy, the next free one is taken and printed."""


class World(NamedTuple):
    """What a run folder is told of its world: how it is called, and its maze, if it has walls."""

    name: str
    maze: Maze | None


class Trained(NamedTuple):
    """A run at its end: its folder; the last `value` of what it measures, `coverage` or `return`;
    environment steps of training."""

    folder: Path | None
    measure: str
    value: float
    steps: int
