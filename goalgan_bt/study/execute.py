"""The runs of a study: each a process of one thread, several at a time."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from goalgan_bt.learners.table import load
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.run_folder import ENDED
from goalgan_bt.study.plan import UNSEEN, StudyConfig, Trial, settings, words

TRAININGS: list["subprocess.Popen[str]"] = []  # what this process runs at present


def perform(run: Trial, folder: Path) -> Path:
    """Train in a process of its own with one simulation thread, or go on with what was cut off.

    Args:
        run: what to train.
        folder: of this run alone; its run folder is made in it.

    Returns:
        The run folder.

    Raises:
        RunError: if training failed, with its last words, or was begun with other settings.
    """
    flags = [*words(run), "--out", str(folder)]
    if whole := [end.parent for end in folder.glob(f"*/{ENDED}") if _of(end.parent, run)]:
        return whole[-1]
    begun = max((kept.parent for kept in folder.glob("*/checkpoint.pt")), default=None)
    if begun is not None:
        asked = settings(run)
        if replace(load(begun), out=asked.out, resume=None) != asked:
            raise RunError(f"{begun} was begun with other settings: remove it")
        flags = ["--resume", str(begun), *UNSEEN]
    folder.mkdir(parents=True, exist_ok=True)
    with subprocess.Popen(
        [sys.executable, "-m", "goalgan_bt.train", *flags],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as training:
        TRAININGS.append(training)
        _, errors = training.communicate()
    TRAININGS.remove(training)
    finished = begun and "has reached its limits" in errors  # killed just before it said so
    if training.returncode != 0 and not finished:
        last = (errors.strip().splitlines() or ["it said nothing"])[-1]
        raise RunError(f"{run.env}, {run.method}, seed {run.seed} failed: {last}")
    return begun or max(folder.glob("*/config.json"), key=os.path.getmtime).parent


def _of(place: Path, run: Trial) -> bool:
    """Whether a run folder is complete and was made with the settings of a run."""
    try:
        made = json.loads((place / "config.json").read_text())
        complete = (place / ENDED).read_text().startswith("complete")
    except (OSError, ValueError):
        return False
    asked = json.loads(json.dumps(asdict(settings(run)), default=str))
    free = {"out": None, "resume": None}
    return complete and isinstance(made, dict) and {**made, **free} == {**asked, **free}


def finished(
    cfg: StudyConfig, runs: list[Trial], folder: Path
) -> Iterator[tuple[Trial, "Future[Path]"]]:
    """Perform runs, several at a time; gives each as it ends."""
    places = [folder / run.env.replace(" ", "_") / f"{run.method}-s{run.seed}" for run in runs]
    if cfg.engine == "here":
        pool = ThreadPoolExecutor(cfg.processes or len(os.sched_getaffinity(0)))
        jobs: dict[Any, Trial] = {
            pool.submit(perform, run, place): run for run, place in zip(runs, places, strict=True)
        }
        try:
            for job in as_completed(jobs):
                yield jobs[job], job
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            ended: list[Any] = []
            while not all(job.done() for job in jobs):  # where this was interrupted
                for training in [one for one in TRAININGS if one not in ended]:
                    training.terminate()  # each saves what it can
                    ended.append(training)
                time.sleep(0.02)  # another may be about to begin
            pool.shutdown()
        return
    try:
        import submitit
    except ImportError:
        raise UsageError('submitit is missing: pip install "goalgan_bt[study]"') from None
    executor = submitit.AutoExecutor(folder=folder / "submitit")
    if executor.cluster != "slurm":
        raise UsageError("there is no SLURM here: leave --engine away")
    slurm = {} if cfg.partition is None else {"slurm_partition": cfg.partition}
    limits = {} if not cfg.processes else {"slurm_array_parallelism": cfg.processes}
    executor.update_parameters(cpus_per_task=1, timeout_min=24 * 60, **slurm, **limits)
    jobs = dict(zip(executor.map_array(perform, runs, places), runs, strict=True))
    for job in submitit.helpers.as_completed(list(jobs)):
        yield jobs[job], job
