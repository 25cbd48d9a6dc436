"""A trained policy as an ONNX file, for programs without torch, or its episodes as a data set of
Minari's, for offline learning.

python -m goalgan_bt.export runs/ant_umaze-20261122-101500-s0 --onnx policy.onnx
python -m goalgan_bt.export runs/ant_umaze-20261122-101500-s0 --minari ant/umaze-v0
"""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

import contextlib
import io
import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from goalgan_bt.runs.command_line import check_ranges, check_target, parse, run_command
from goalgan_bt.runs.errors import UsageError, require_installed
from goalgan_bt.runs.ranges import NOT_NEGATIVE, between
from goalgan_bt.runs.terminal import say

EPISODES = 100  # where no number is given


@dataclass(frozen=True)
class ExportConfig:
    """Write the policy of a run's last checkpoint as one graph, with the normaliser of its
    observations and, where it sees a heading, the ways of its places inside. Inputs are `state`
    (n, state_dim) and `goal` (n, goal_dim), float64; the output is `action` (n, act_dim), float32
    in [-1, 1]: what the motors do, without noise. Or let it act, and write the episodes as a data
    set of Minari's."""

    run: tyro.conf.Positional[Path]
    """Run folder of a maze or a box."""
    onnx: Path | None = None
    """File to write (extra `onnx`)."""
    minari: str | None = None
    """Id of a data set to create (extra `minari`), such as point/umaze-v0, among those on this
    machine: in MINARI_DATASETS_PATH, or where Minari keeps them."""
    episodes: Annotated[int | None, between(1, 100_000)] = None
    """Episodes of the data set; 100 by default."""
    deterministic: bool = False
    """In them, act without the noise of exploration."""
    seed: Annotated[int | None, NOT_NEGATIVE] = None
    """Seed of that noise and of the first episode; 0 by default. The next ones have the next."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg = parse(ExportConfig, argv, "python -m goalgan_bt.export")
    check_ranges(cfg)
    if cfg.onnx is not None and cfg.minari is None:
        if cfg.episodes is not None or cfg.deterministic or cfg.seed is not None:
            raise UsageError("--episodes, --deterministic and --seed go with --minari")
        write_graph(cfg.run, cfg.onnx)
    elif cfg.minari is not None and cfg.onnx is None:
        episodes = EPISODES if cfg.episodes is None else cfg.episodes
        write_episodes(cfg.run, cfg.minari, episodes, cfg.deterministic, cfg.seed or 0)
    else:
        raise UsageError("give one of --onnx FILE and --minari ID: what to write")


def write_graph(run: Path, path: Path) -> None:
    """The policy as an ONNX file.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    check_target(path, (".onnx",))
    require_installed("onnx", "onnxscript", "array_api_compat")
    from goalgan_bt.learners import onnx_policy

    logging.disable(logging.WARNING)  # torch tells of what nobody has asked for
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            onnx_policy.export(run, path)
    finally:
        logging.disable(logging.NOTSET)
    say(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")


def write_episodes(run: Path, name: str, episodes: int, deterministic: bool, seed: int) -> None:
    """Its episodes as a data set.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    require_installed("minari", "minari", "h5py")
    from goalgan_bt.learners import minari_dataset

    made = minari_dataset.record(run, name, episodes, deterministic, seed)
    size = sum(file.stat().st_size for file in made.folder.rglob("*") if file.is_file())
    say(
        f"{made.folder} ({size / 1e6:.1f} MB): {made.episodes} episodes, {made.steps} actions, "
        f"success {made.success:.3f}"
    )


if __name__ == "__main__":
    exit_with(main())
