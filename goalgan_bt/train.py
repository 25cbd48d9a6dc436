"""Training: from a terminal, from Python, or from a notebook.

    python -m goalgan_bt.train --env ant_umaze
    goalgan_bt.train("ant_umaze", seed=0, total_steps=1_000_000, out="runs")

Any environment of the table of learners (`goalgan_bt.learners.table`): mazes, four rooms,
locomotion. The maze learner's loop is `goalgan_bt.learners.maze.train`.
"""

import sys

from goalgan_bt.runs.signals import exit_with, leave_at_once, nothing_to_lose

if __name__ == "__main__":
    leave_at_once("interrupted: nothing new was saved, give the same command again")

import contextlib
import importlib
import inspect
import os
import resource
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

from goalgan_bt.learners.run_config import RunConfig, Trained, World
from goalgan_bt.learners.table import from_command_line, learner_of
from goalgan_bt.runs.command_line import run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.files import check_own
from goalgan_bt.runs.run_folder import ended, mend_meta, new_run
from goalgan_bt.runs.signals import Stop
from goalgan_bt.runs.terminal import complain, say
from goalgan_bt.runs.torchrun import records
from goalgan_bt.viz import page_process

Begun = Callable[[Path], None]
NOTHING = "nothing new was saved, give the same command again"


def train(env: str = "ant_umaze", *, viz: str = "none", **settings: Any) -> Trained:
    """Train as the command does, and wait for the end of it. It seeds torch's own random numbers
    and sets the number of its threads.

    Args:
        env: the environment.
        viz: `browser` for a page to watch it, which ends with the training.
        settings: as the command's flags, with underscores: seed=0, total_steps=1_000_000,
            out="runs", method="goal_gan"; those of a part as `**{"trpo.max_kl": 0.02}`;
            resume="runs/..." goes on with a run, whose environment then counts.

    Returns:
        The run's folder, what it measures (coverage or return) and its last value, and the
        environment steps of training.

    Raises:
        UsageError: for settings that make no sense.
        RunError: for a folder that is no run, or has nothing left to do.
        KeyboardInterrupt: for Ctrl-C, after a checkpoint.
    """
    if settings.get("resume", "") is None:  # as the default of somebody's own argument
        del settings["resume"]
    words = [] if "resume" in settings else ["--env", str(env)]
    for name, value in {"viz": viz, **settings}.items():
        flag = name.replace("_", "-")
        if name in ("help", "h"):
            raise UsageError(
                "help() explains goalgan_bt.train; its settings are the command's flags"
            )
        if isinstance(value, bool):
            *parts, last = flag.split(".")
            words.append("--" + ".".join([*parts, last if value else f"no-{last}"]))
        else:
            many = isinstance(value, tuple | list)
            words += [f"--{flag}", *map(str, value)] if many else [f"--{flag}={value}"]
    cfg = from_command_line(words)
    module = importlib.import_module(learner_of(cfg.env).module)
    stop = Stop()
    trained = run(cfg, module, stop, lambda _: None)
    if stop.requested:
        raise KeyboardInterrupt
    return trained


def run(cfg: RunConfig, module: Any, stop: Stop, begun: Begun) -> Trained:
    """Make the run folder, or take up the one to go on with, open the page and train.

    Args:
        cfg: settings.
        module: of their learner.
        stop: asked now and then whether to end early.
        begun: told the folder as soon as there is one.
    """
    with contextlib.ExitStack() as at_last, module.prepared(cfg) as world:
        folder, page = cfg.resume, None
        if records():
            if cfg.viz == "browser":
                page = page_process.PageProcess(cfg.viz_host, cfg.viz_port)
                at_last.callback(page.close)
            if folder is None:
                folder = new_run(cfg.out, name(cfg, world), cfg.seed, asdict(cfg), world.maze)
            else:
                check_own(folder)
                mend_meta(folder, world.maze)
            begun(folder)
            say(f"run folder: {folder}")
            if page is not None:
                page.open(folder)
        with stop:
            trained: Trained = module.train(cfg, folder, stop)
        if folder is not None and not stop.requested:
            value, steps = trained.value, trained.steps
            say(f"{trained.measure} {value:.3f} after {steps:,} training steps: {folder}")
            if page is not None:
                page.ended_well = True
        return trained


def name(cfg: RunConfig, world: World) -> str:
    """What a run's folder is called by: the task, and the method where it is not the usual one."""
    usual = learner_of(cfg.env).preset(cfg.env, None).method
    return world.name if cfg.method == usual else f"{world.name}-{cfg.method}"


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    folder: Path | None = None

    def begun(there: Path) -> None:
        nonlocal folder
        folder = there

    def work() -> int:
        bound_memory()
        cfg = from_command_line(sys.argv[1:] if argv is None else argv)
        with nothing_to_lose(f"interrupted: {NOTHING}"):  # torch takes seconds to import
            module = importlib.import_module(learner_of(cfg.env).module)
        stop = Stop(goodbye=True)
        run(cfg, module, stop, begun)
        if not stop.requested:
            return 0
        if records():
            complain(f"stopped by {stop.name}: {how_to_go_on(folder)}")
        return stop.code

    return run_command(work, lambda: how_to_go_on(folder))


def bound_memory() -> None:
    """Let this process have no more memory than the machine has: settings that want more then end
    in one line, where the system would let them begin and kill something later."""
    limit, most = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), resource.RLIM_INFINITY
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    known = [bound for bound in (limit, soft, hard) if bound != most]
    resource.setrlimit(resource.RLIMIT_DATA, (min(known), hard))


def how_to_go_on(folder: Path | None) -> str:
    """The end of a message about a run that stopped early."""
    if folder is None and not records():
        return ""  # only the first rank knows
    if folder is not None and ended(folder) == "complete":
        return f"the run is complete: {folder}"
    if folder is None or not (folder / "checkpoint.pt").exists():
        return NOTHING
    return f"go on from the last checkpoint with --resume {folder}"


class _Command(ModuleType):
    """This module, which can also be called: its name is the command's as well as the function's,
    whichever of the two `goalgan_bt.train` was asked for first."""

    def __call__(self, *args: Any, **settings: Any) -> Trained:
        return train(*args, **settings)


sys.modules[__name__].__class__ = _Command
sys.modules[__name__].__signature__ = inspect.signature(train)  # type: ignore[attr-defined]

if __name__ == "__main__":
    exit_with(main())
