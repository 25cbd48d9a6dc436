"""How well a trained policy does.

python -m goalgan_bt.evaluate runs/ant_umaze-20261122-101500-s0
"""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from goalgan_bt.runs.command_line import check_ranges, check_target, parse, run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.files import write_json
from goalgan_bt.runs.ranges import NOT_NEGATIVE, between
from goalgan_bt.runs.terminal import say


@dataclass(frozen=True)
class EvaluateConfig:
    """Try the goals over which coverage is measured, with the policy of a run's last checkpoint."""

    run: tyro.conf.Positional[Path]
    """Run folder of a maze or a box."""
    episodes: Annotated[int | None, between(1, 1_000_000)] = None
    """Episodes in all, spread evenly over the goals; by default three each, or 100 with --on."""
    deterministic: bool = False
    """Act without the noise of exploration, and so at most once for each goal."""
    on: str | None = None
    """Act in this environment of Gymnasium's instead, such as goalgan_bt/AntUMaze-v0: one with
    goals whose body is the run's. Success is what its info says."""
    horizon: Annotated[int | None, between(1, 10**6)] = None
    """Steps of an episode; by default as many as in the run. Not with --on, which has its own."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Seed of the noise, and of the episodes with --on."""
    threads: Annotated[int, between(0, 1000)] = 0
    """Simulation threads; 0 is one per core."""
    json: Path | None = None
    """Also write the figures to this file."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg = parse(EvaluateConfig, argv, "python -m goalgan_bt.evaluate")
    check_ranges(cfg)
    if cfg.on is not None and cfg.horizon is not None:
        raise UsageError("--horizon: an environment given with --on has its own")
    if cfg.json is not None:
        check_target(cfg.json, (".json",))
    from goalgan_bt.learners import evaluation  # torch takes seconds

    if cfg.on is None:
        found = evaluation.at_home(
            cfg.run, cfg.episodes, cfg.deterministic, cfg.seed, cfg.threads, cfg.horizon
        )
    else:
        found = evaluation.elsewhere(cfg.run, cfg.on, cfg.episodes, cfg.deterministic, cfg.seed)
    say(sentence(found))
    if cfg.json is not None:
        write_json(cfg.json, found)
        say(str(cfg.json))


def sentence(found: dict[str, Any]) -> str:
    """The figures in words."""
    low, high = found["interval_95"]
    times = found["seconds_to_goal"]
    said = (
        f"{found['world']}, iteration {found['iteration']}, {found['policy']}: success "
        f"{found['success']:.3f} [{low:.3f}, {high:.3f}] in {found['episodes']} episodes; "
    )
    if times["median"] is not None:
        said += (
            f"goals reached after {times['median']:.1f} s (median), "
            f"{times['nine_of_ten']:.1f} s (nine of ten); "
        )
    said += f"{found['fell']:.1%} fell, {found['out_of_time']:.1%} ran out of time"
    return said + (f"; return {found['return']:.3f}" if "return" in found else "")


if __name__ == "__main__":
    exit_with(main())
