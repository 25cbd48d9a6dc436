"""A trained policy as an ONNX file, for programs without torch.

python -m goalgan_bt.export runs/ant_umaze-20261122-101500-s0 --onnx policy.onnx
"""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

import contextlib
import importlib.util
import io
import logging
import warnings
from dataclasses import dataclass
from pathlib import Path

import tyro

from goalgan_bt.runs.command_line import check_target, parse, run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.terminal import say


@dataclass(frozen=True)
class ExportConfig:
    """Write the policy of a run's last checkpoint as one graph, with the normaliser of its
    observations and, where it sees a heading, the ways of its places inside. Inputs are `state`
    (n, state_dim) and `goal` (n, goal_dim), float64; the output is `action` (n, act_dim), float32
    in [-1, 1]: what the motors do, without noise."""

    run: tyro.conf.Positional[Path]
    """Run folder of a maze or a box."""
    onnx: Path
    """File to write (extra `onnx`)."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg = parse(ExportConfig, argv, "python -m goalgan_bt.export")
    check_target(cfg.onnx, (".onnx",))
    if importlib.util.find_spec("onnxscript") is None:
        raise UsageError('onnxscript is missing: pip install "goalgan_bt[onnx]"')
    from goalgan_bt.learners import onnx_policy

    logging.disable(logging.WARNING)  # torch tells of what nobody has asked for
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            onnx_policy.export(cfg.run, cfg.onnx)
    finally:
        logging.disable(logging.NOTSET)
    say(f"{cfg.onnx} ({cfg.onnx.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    exit_with(main())
