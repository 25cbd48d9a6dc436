"""A trained policy as a folder to share, with a model card, on the Hugging Face hub or elsewhere.

python -m goalgan_bt.share runs/ant_umaze-20261122-101500-s0 --out shared --to user/ant_umaze

    folder = goalgan_bt.share.fetch("user/ant_umaze")
    policy = goalgan_bt.load_policy(folder)
"""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

import json
import os
import shlex
import shutil
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from goalgan_bt.runs.command_line import parse, run_command
from goalgan_bt.runs.errors import UsageError, require_installed
from goalgan_bt.runs.files import read_own
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.run_folder import commits, read_meta, write_settings
from goalgan_bt.runs.terminal import say

if TYPE_CHECKING:
    from goalgan_bt.learners.maze_config import MazeConfig

# All that is shared and all that is fetched. The checkpoint alone is a pickle, and is read with
# `weights_only=True`.
FILES = ("README.md", "config.json", "meta.json", "checkpoint.pt", "metrics.csv", "frames/*.npz")
SMALL = 2_000_000  # bytes of a frame that is taken along
TAGS = ("reinforcement-learning", "goal-conditioned", "sparse-reward", "curriculum-learning")
MEASURED = {  # column of metrics.csv: what it is called in the card
    "eval/coverage": "coverage, with the noise of exploration",
    "eval/coverage_deterministic": "coverage, without",
}


@dataclass(frozen=True)
class ShareConfig:
    """Write what others need of a run into a folder: settings, checkpoint, metrics, the last frame,
    and a model card (extra `hub`). No path of this machine is in it."""

    run: tyro.conf.Positional[Path]
    """Run folder of a maze or a box."""
    out: Path
    """Folder to write, which is not there yet or empty."""
    to: str | None = None
    """Also upload it as this repository of the Hugging Face hub, user/name, with the account of
    `hf auth login`. One that is not there yet is made, for everybody to see."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg = parse(ShareConfig, argv, "python -m goalgan_bt.share")
    require_installed("hub", "huggingface_hub")
    if cfg.to is not None:
        check_name(cfg.to)
    write(cfg.run, cfg.out, cfg.to)
    size = sum(file.stat().st_size for file in cfg.out.rglob("*") if file.is_file())
    say(f"{cfg.out} ({size / 1e6:.1f} MB)")
    if cfg.to is not None:
        say(upload(cfg.out, cfg.to))


def check_name(name: str) -> None:
    """See that a repository can be called so.

    Raises:
        UsageError: if it cannot.
    """
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]

    try:
        validate_repo_id(name)
        fits = name.count("/") == 1
    except ValueError:
        fits = False
    if not fits:
        raise UsageError(f"{name!r} is no repository of the hub: it must be user/name")


def write(run: Path, out: Path, name: str | None = None) -> None:
    """Write the folder.

    Args:
        run: the run folder; its last checkpoint counts.
        out: where to; it is not there yet or empty.
        name: how the repository will be called, user/name, if it is known.

    Raises:
        RunError: if `run` is no run of a maze, or has no checkpoint that can be read.
        UsageError: if there is something at `out`.
        OSError: if it cannot be written; nothing is left of it then.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"--out {out} is there already and not empty: choose another folder")
    from goalgan_bt.learners.table import load
    from goalgan_bt.learners.trained_policy import TrainedPolicy
    from goalgan_bt.runs import checkpoint

    policy, cfg = TrainedPolicy(run), load(run)  # what does not load is not shared
    meta = public_meta(run, cfg)
    text = card(run, cfg, policy.iteration, meta, name)
    out.mkdir(parents=True, exist_ok=True)
    try:
        write_settings(out, asdict(public(cfg)))
        (out / "meta.json").write_text(json.dumps(meta, indent=2) + "\n")
        with checkpoint.saved(run) as state:  # the one that was loaded, whatever lies beside it
            checkpoint.save(state, out / "checkpoint.pt")
        (out / "metrics.csv").write_bytes(read_own(run / "metrics.csv"))
        for frame in frame_paths(run)[-1:]:
            if frame.lstat().st_size <= SMALL:
                (out / "frames").mkdir()
                (out / "frames" / frame.name).write_bytes(read_own(frame))
        (out / "README.md").write_text(text, encoding="utf-8")
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise


def upload(folder: Path, name: str) -> str:
    """Upload what `write` wrote as a repository of the hub, which is made if need be.

    Returns:
        Its address.

    Raises:
        UsageError: if that does not work; the folder stays.
    """
    from huggingface_hub import HfApi

    api = HfApi()
    try:
        made = api.create_repo(name, exist_ok=True)
        api.upload_folder(
            repo_id=name, folder_path=folder, allow_patterns=[*FILES], commit_message="goalgan_bt"
        )
    except Exception as error:  # of the client, of its HTTP library, of the network
        raise UsageError(
            f"cannot upload to {name} ({reason(error)}): {folder} is written; to try again, "
            f"hf upload {name} {shlex.quote(str(folder))}"
        ) from None
    return str(made)


def fetch(name: str, revision: str | None = None, local_files_only: bool = False) -> Path:
    """Download a shared run from the hub, if it is not there already.

    Args:
        name: of the repository, user/name.
        revision: a branch, tag or commit of it; the newest if None.
        local_files_only: take what was downloaded before, and ask nobody.

    Returns:
        Its folder, for `goalgan_bt.load_policy` and all commands that take a run, beside the
        client's cache: a copy, since the cache is made of links, which no run may be.

    Raises:
        UsageError: if the extra is missing, and for what there is not or cannot be had.
    """
    require_installed("hub", "huggingface_hub")
    check_name(name)
    from huggingface_hub import constants, snapshot_download

    try:
        cached = Path(
            snapshot_download(
                name,
                revision=revision,
                local_files_only=local_files_only,
                allow_patterns=[*FILES],
            )
        )
    except Exception as error:  # of the client, of its HTTP library, of the network
        raise UsageError(f"cannot fetch {name} ({reason(error)})") from None
    folder = Path(constants.HF_HOME) / "goalgan_bt" / name.replace("/", "--") / cached.name
    if not folder.exists():
        part = folder.with_name(f"{folder.name}.{os.getpid()}.part")
        shutil.copytree(cached, part)
        part.rename(folder)
    return folder


def reason(error: Exception) -> str:
    """What the hub's client says, without its advice: the first line that is one."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines or [type(error).__name__])[0].rstrip(".:")


# Nothing of the machine is told: a command line may hold paths, and one from Python anything.


def public(cfg: "MazeConfig") -> "MazeConfig":
    """The settings, without those that say where it was written and shown. A maze of one's own is
    in `meta.json`."""
    from goalgan_bt.learners.run_config import RunConfig

    learned = ("env", "method", "seed", "total_steps")
    usual = RunConfig(cfg.env, cfg.method)
    others = {
        field.name: getattr(usual, field.name)
        for field in fields(RunConfig)
        if field.name not in learned
    }
    return replace(cfg, **others, map=None, threads=0)


def public_meta(run: Path, cfg: "MazeConfig") -> dict[str, Any]:
    """The run's `meta.json` with the command that its settings amount to in the place of those that
    were typed."""
    meta = read_meta(run)
    names = ("commit", "python", "versions", "maze")
    kept: dict[str, Any] = {name: meta[name] for name in names if name in meta}
    told: dict[str, Any] = {"argv": command(cfg), **kept}
    if "resumed" in meta:
        told["resumed"] = [
            {"argv": ["--resume", "RUN"], "commit": call["commit"]} for call in meta["resumed"]
        ]
    return told


def command(cfg: "MazeConfig") -> list[str]:
    """The flags of `python -m goalgan_bt.train` that give these settings."""
    from goalgan_bt.learners import maze_config

    usual = maze_config.preset(cfg.env)
    words = ["--env", cfg.env]
    if cfg.method != usual.method:
        words += ["--method", cfg.method]
    words += flags(public(cfg), public(maze_config.preset(cfg.env, cfg.method)))
    return words + ([] if cfg.map is None else ["--map", cfg.map.name])


def flags(settings: Any, usual: Any, prefix: str = "") -> list[str]:
    """Flags for the settings that are not the usual ones."""
    words: list[str] = []
    for field in fields(settings):
        value, before = getattr(settings, field.name), getattr(usual, field.name)
        name = prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            words += flags(value, before, f"{name}.")
        elif value == before:
            continue
        elif isinstance(value, bool):
            words.append(f"--{name}" if value else f"--{prefix}no-{name.removeprefix(prefix)}")
        else:
            values = value if isinstance(value, tuple) else (value,)
            words += [f"--{name}", *map(str, values)]
    return words


# The card.


def card(
    run: Path, cfg: "MazeConfig", iteration: int, meta: dict[str, Any], name: str | None
) -> str:
    """The model card: front matter as the hub reads it, and what a person wants to know.

    Args:
        run: the run folder.
        cfg: its settings.
        iteration: the one that made the policy.
        meta: what is told of how it was made.
        name: of the repository, if it is known.
    """
    from huggingface_hub import EvalResult, ModelCardData

    measured, steps = measurements(run, iteration)
    title = f"{cfg.env}, seed {cfg.seed}"
    source = '"FOLDER"' if name is None else f'goalgan_bt.share.fetch("{name}")  # or its folder'
    results = [
        EvalResult(
            task_type="reinforcement-learning",
            task_name="reaching every place",
            dataset_type=cfg.env,
            dataset_name=cfg.env,
            metric_type=column.removeprefix("eval/"),
            metric_name=MEASURED[column],
            metric_value=value,
        )
        for column, value in measured.items()
    ]
    data = ModelCardData(
        library_name="goalgan_bt",
        pipeline_tag="reinforcement-learning",
        tags=[*TAGS, cfg.method, cfg.env],
        model_name=name or title,
        eval_results=results or None,
    )
    rows = [("environment", f"`{cfg.env}`"), ("method", f"`{cfg.method}`"), ("seed", cfg.seed)]
    rows.append(("training steps", f"{steps:,} (iteration {iteration})"))
    rows += [(MEASURED[column], f"{value:.3f}") for column, value in measured.items()]
    table = "\n".join(f"| {label} | {value} |" for label, value in rows)
    versions = ", ".join(
        f"{package} {meta['versions'][package]}"
        for package in ("goalgan_bt", "mujoco", "torch")
        if package in meta.get("versions", {})
    )
    return f"""---
{data.to_yaml()}
---

# A policy that reaches every place: {title}

goalgan_bt has trained it: a curriculum of goals, and TRPO on a reward that is 1 on reaching the
goal, else 0. Coverage is the share of the free space that it reaches from the start.

| | |
|---|---|
{table}

## How it was trained

```sh
{shlex.join(["python", "-m", "goalgan_bt.train", *meta["argv"]])}
```

Commit {commits(run)}; {versions}.
{drawn(meta, cfg)}
## How to use it

```python
import goalgan_bt
import goalgan_bt.share

folder = {source}
policy = goalgan_bt.load_policy(folder)
action = policy.act(observation, goal)  # the state of the body, and where it shall go, metres
```

`policy.env` is one simulation of its world. `python -m goalgan_bt.viz FOLDER` shows it at work.
"""


def drawn(meta: dict[str, Any], cfg: "MazeConfig") -> str:
    """What the card says of the world: its map, and whose code it needs."""
    text = ""
    if meta.get("maze"):
        rows = "\n".join(meta["maze"]["rows"])
        text = f"\nThe maze, in cells of {meta['maze']['cell_size']:g} m:\n\n```\n{rows}\n```\n"
    if ":" in cfg.env:
        text += f"\nThe code of `{cfg.env}` is not here, and has to be there and allowed to run.\n"
    return text


def measurements(run: Path, iteration: int) -> tuple[dict[str, float], int]:
    """What was measured last until an iteration, by column, and the training steps until then."""
    _, rows = read_metrics(run)
    rows = [row for row in rows if int(row["iteration"]) <= iteration]
    found = {}
    for column in MEASURED:
        values = [row[column] for row in rows if row.get(column) not in (None, "", "nan")]
        if values:
            found[column] = float(values[-1])
    return found, int(rows[-1]["steps/train"]) if rows else 0


if __name__ == "__main__":
    exit_with(main())
