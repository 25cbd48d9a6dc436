"""The page over a policy that is trained already: `python -m goalgan_bt.demo`."""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

from dataclasses import dataclass
from typing import Annotated, Literal

from goalgan_bt.demo import HOME
from goalgan_bt.runs.command_line import check_ranges, parse, run_command
from goalgan_bt.runs.ranges import Range
from goalgan_bt.runs.terminal import say


@dataclass(frozen=True)
class DemoConfig:
    """Watch a trained policy in the browser: click on the floor, and the body walks there."""

    env: Literal["ant_umaze", "point_umaze"] = "ant_umaze"
    """Which of the two that come along."""
    host: str = "127.0.0.1"
    """Where to listen; 0.0.0.0 lets everybody on the network in, without a password."""
    port: Annotated[int, Range("between 0 and 65535", 0, 65535)] = 8080
    """Port; if it is busy, the next free one is taken and printed. 0 takes any."""
    headless: bool = False
    """No page: let it walk to some goals, print how that went, and end."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError: saying what is wrong.
    """
    cfg = parse(DemoConfig, argv, "python -m goalgan_bt.demo")
    check_ranges(cfg)
    run = HOME / cfg.env
    if cfg.headless:
        walk(cfg)
        return
    from goalgan_bt.viz import __main__ as viz

    say('Click on the floor, or on "Try all tiles" under "Try".')
    viz.work([str(run), "--host", cfg.host, "--port", str(cfg.port)])


def walk(cfg: DemoConfig) -> None:
    """Try some goals without a page."""
    from goalgan_bt.viz.player import Player

    player = Player(HOME / cfg.env)
    player.take_newest()
    goals = player.env.test_goals()[::8]
    attempt = player.attempt(goals, deterministic=True)
    for goal, reached, end in zip(goals, attempt.reached, attempt.ends, strict=True):
        how = "reached" if reached else "not reached"
        say(f"goal ({goal[0]:.2f}, {goal[1]:.2f}): {how} after {end * attempt.dt:.1f} s")
    say(f"{cfg.env}: {attempt.reached.sum()} of {len(goals)} goals reached")


if __name__ == "__main__":
    exit_with(main())
