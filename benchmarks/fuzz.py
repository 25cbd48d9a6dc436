"""Nonsense for all that reads files, flags and calls: each works, or ends in the clear error.

    python benchmarks/fuzz.py --cases 100000

What is sound is damaged at random: characters, bytes, numbers, whole values. A traceback of any
other kind, a case of more than 10 s, a file elsewhere or more than 2 GiB of memory is a failure.
"""

import io
import json
import math
import resource
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from common import told

from goalgan_bt import envs
from goalgan_bt.curriculum.curriculum import GoalCurriculum
from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners import maze, maze_learner, table
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.recall.places import Places
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import Metrics, read_metrics, sound_rows
from goalgan_bt.study import plan
from goalgan_bt.viz.run import Run, labels, success
from goalgan_bt.viz.run import places as ends_of

TINY = (
    "--env point_umaze --iterations 4 --rollout.num-envs 16 --rollout.steps 20 --threads 1 "
    "--coverage.rollouts 1 --gan.pretrain-steps 20 --gan.steps 5 --viz none "
    "--backtracking.min-transitions 50 --imitation.source traces --backtracking.buffer 2000"
)
CLEAR = (ValueError,)  # UsageError, RunError, MapError and PhysicsError are such
NUMBERS = (0, -1, 1, 2, 3.5, -0.0, 1e-9, 1e9, 1e12, 1e308, 2**63, 10**30, math.nan, math.inf)
WORDS = ("", "x", "nan", "inf", "-inf", "None", "True", "../..", "/dev/null", "\0", "ä", "9" * 400)
PATIENCE = 10  # seconds


@dataclass(frozen=True)
class FuzzConfig:
    """Damage whatever can be read, and see what is said."""

    cases: int = 100_000
    """In all; the kinds share them by what a case of each costs."""
    seed: int = 0
    """Of the damage."""
    json: Path | None = None
    """Where to write the counts."""


Rng = np.random.Generator


def damaged(data: bytes, rng: Rng) -> bytes:
    """Bytes with some flipped, put in, taken out, or the end cut off."""
    out = bytearray(data)
    for _ in range(pick((1, 1, 1, 2, 4), rng)):
        at, kind = int(rng.integers(len(out) + 1)), rng.integers(6)
        if kind == 0 and out:
            out[at % len(out)] ^= 1 << rng.integers(8)
        elif kind == 1:
            out[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 2:
            del out[at : at + int(rng.integers(1, 40))]
        elif kind == 3 and rng.random() < 0.3:
            del out[at:]
        elif kind == 4:
            piece = out[at : at + int(rng.integers(1, 60))]
            out[at:at] = piece * int(rng.integers(1, 4))
        else:
            word = str(pick(NUMBERS + WORDS, rng)).encode(errors="replace")
            out[at : at + int(rng.integers(0, 6))] = word
    return bytes(out)


def pick(choices: Any, rng: Rng) -> Any:
    return choices[int(rng.integers(len(choices)))]


def spoilt(value: Any, rng: Rng, depth: int = 0) -> Any:
    """A nested value with one of its values replaced."""
    if isinstance(value, dict) and value and (depth == 0 or rng.random() < 0.95):
        key = pick(list(value), rng)
        if rng.random() < 0.05:
            return {k: v for k, v in value.items() if k != key}
        return value | {key: spoilt(value[key], rng, depth + 1)}
    if isinstance(value, list | tuple) and value and rng.random() < 0.8:
        at = int(rng.integers(len(value)))
        return type(value)([*value[:at], spoilt(value[at], rng, depth + 1), *value[at + 1 :]])
    if isinstance(value, torch.Tensor) and rng.random() < 0.9:
        return spoilt_tensor(value, rng)
    other = (None, [], {}, [1, 2], {"a": 1}, True, torch.zeros(3), torch.zeros(0))
    return pick(NUMBERS + WORDS + other, rng)


def spoilt_tensor(x: torch.Tensor, rng: Rng) -> torch.Tensor:
    kind = rng.integers(5)
    if kind == 0:
        return x[: len(x) // 2] if x.ndim else x[None]
    if kind == 1:
        return x.reshape(-1)
    if kind == 2:
        return x.to(pick((torch.float32, torch.float64, torch.int64, torch.int8), rng))
    x = x.clone()
    if x.numel():
        whole = not x.is_floating_point()
        number = pick((0, 1, 100) if x.dtype == torch.uint8 else (-1, 0, 1, 10**6), rng)
        x.view(-1)[int(rng.integers(x.numel()))] = torch.tensor(
            number if whole else float(pick(NUMBERS, rng)), dtype=None if whole else torch.float64
        ).to(x.dtype)
    return x


class Subjects:
    """What is damaged, by kind: each takes a generator and does one case."""

    def __init__(self, place: Path) -> None:
        self.folder = place / "run"
        self.folder.mkdir()
        run_folder.write_meta(self.folder, mazes.layout("umaze"))
        self.cfg = table.from_command_line(TINY.split())
        maze.train(self.cfg, self.folder)
        self._good = {
            name: (self.folder / name).read_bytes()
            for name in ("config.json", "meta.json", "metrics.csv", "checkpoint.pt")
        }
        self._frame = frame_paths(self.folder)[-1]
        self._good["frame"] = self._frame.read_bytes()
        self._state = checkpoint.read(self.folder / checkpoint.NAME)
        self._learner = MazeLearner(make_env(self.cfg, 16), self.cfg)
        self._collector = maze.collector_of(self._learner, self._learner_env())
        self._flags = [
            word.split()[0] for word in _help(place).splitlines() if word.strip().startswith("--")
        ]
        self._study = (Path(plan.__file__).parent / "point_umaze.toml").read_bytes()
        self._curriculum = GoalCurriculum([-1, -1], [1, 1], seed=0)
        self._curriculum.ask(4)

    def _learner_env(self) -> Any:
        return make_env(self.cfg, 16)

    def map(self, rng: Rng) -> None:
        text = pick(list(mazes.LAYOUTS.values()), rng)
        path = self.folder / "map.txt"
        path.write_bytes(damaged(text.encode(), rng))
        mazes.load(path, float(pick((0.5, 2.0, 4.0), rng)))

    def env(self, rng: Rng) -> None:
        envs.make(
            pick(("point_umaze", "point_nd", "umaze", "", "x:y", "point_nd "), rng),
            int(pick((1, 2), rng)),
            threads=1,
            horizon=pick((None, 5, 0, -1), rng),
            dim=pick((2, 3, 9, 0), rng),
        )

    def flags(self, rng: Rng) -> None:
        words = []
        for _ in range(rng.integers(1, 4)):
            words += [pick(self._flags, rng), str(pick(NUMBERS + WORDS, rng)).replace("\0", "")]
        if not any("resume" in word or "help" in word for word in words):
            table.from_command_line(words)

    def settings(self, rng: Rng) -> None:
        self._put("config.json", rng)
        table.load(self.folder)

    def values(self, rng: Rng) -> None:
        value = spoilt(json.loads(self._good["config.json"]), rng)
        text = json.dumps(value, default=str)
        (self.folder / "config.json").write_text(text, errors="replace")
        table.load(self.folder)

    def meta(self, rng: Rng) -> None:
        self._put("meta.json", rng)
        run_folder.maze_of(self.folder)
        run_folder.commits(self.folder)

    def metrics(self, rng: Rng) -> None:
        self._put("metrics.csv", rng)
        sound_rows(self.folder)
        live = Metrics(self.folder / "metrics.csv")
        live.refresh()
        live.column("eval/coverage")
        read_metrics(self.folder)

    def run(self, rng: Rng) -> None:
        self._put(pick(("config.json", "meta.json", "metrics.csv"), rng), rng)
        found = Run(self.folder)
        found.refresh()
        found.box()

    def frame(self, rng: Rng) -> None:
        self._frame.write_bytes(damaged(self._good["frame"], rng))
        read_frame(self._frame)

    def arrays(self, rng: Rng) -> None:
        """A frame that is an archive of arrays, one of which is another."""
        with np.load(io.BytesIO(self._good["frame"])) as data:
            arrays = {name: torch.from_numpy(data[name]) for name in data.files}
        spoiled = spoilt(arrays, rng)
        if not isinstance(spoiled, dict):
            return
        made = {name: np.asarray(x) for name, x in spoiled.items() if not isinstance(x, dict)}
        with self._frame.open("wb") as file:
            np.savez(file, **made)
        frame = read_frame(self._frame)
        success(frame), labels(frame), ends_of(frame, "traces", 3)

    def bytes_of_checkpoint(self, rng: Rng) -> None:
        self._put("checkpoint.pt", rng)
        checkpoint.read(self.folder / checkpoint.NAME)
        if (self.folder / checkpoint.NAME).read_bytes() != self._good["checkpoint.pt"]:
            raise AssertionError("a checkpoint that was damaged has been loaded")

    def state(self, rng: Rng) -> None:
        """A checkpoint that was made to be wrong, with its checksum right."""
        state = spoilt(self._state, rng)
        checkpoint.save(state, self.folder / checkpoint.NAME)
        maze_learner.load(self._learner, self.folder, self._collector)

    def resume(self, rng: Rng) -> None:
        """Training that goes on from such a checkpoint."""
        state = spoilt(self._state, rng)
        for name, data in self._good.items():
            if name not in ("frame", "checkpoint.pt"):
                (self.folder / name).write_bytes(data)
        checkpoint.save(state, self.folder / checkpoint.NAME)
        maze.train(replace(self.cfg, resume=self.folder, iterations=5), self.folder)

    def places(self, rng: Rng) -> None:
        env = self._collector.env
        found = Places(env.goal_low, env.goal_high, env.success_radius, self.cfg.places)
        try:
            found.load_state_dict(spoilt(self._state["learner"]["places"], rng))
        except (KeyError, TypeError, AttributeError, RuntimeError, IndexError, OverflowError):
            return  # of which `checkpoint.saved` makes one line
        found.ways(np.zeros((2, 2)), np.ones((2, 2)))

    def study(self, rng: Rng) -> None:
        path = self.folder / "study.toml"
        path.write_bytes(damaged(self._study, rng))
        plan.load(str(path))

    def tell(self, rng: Rng) -> None:
        told = [[0.5, 0.5], [0.1, -0.2]]
        self._curriculum.tell(
            *(
                spoilt(pick((told, [1.0, 0.0], np.array(told)), rng), rng)
                if rng.random() < 0.7
                else told
                for _ in range(int(rng.integers(2, 4)))
            )
        )

    def ask(self, rng: Rng) -> None:
        n = pick((*NUMBERS, *WORDS, None, True), rng)
        if not (isinstance(n, int | float) and n > 1e6):
            self._curriculum.ask(n)

    def _put(self, name: str, rng: Rng) -> None:
        for other, data in self._good.items():
            if other != "frame" and other != "checkpoint.pt":
                (self.folder / other).write_bytes(data)
        (self.folder / name).write_bytes(damaged(self._good[name], rng))


# Of a thousand cases so many of each kind: a flag costs 30 ms, a map 30 us.
SHARES = {
    "map": 270,
    "env": 20,
    "flags": 8,
    "settings": 60,
    "values": 60,
    "meta": 100,
    "metrics": 100,
    "run": 60,
    "frame": 80,
    "arrays": 40,
    "bytes_of_checkpoint": 60,
    "state": 20,
    "resume": 4,
    "places": 51,
    "study": 7,
    "tell": 40,
    "ask": 20,
}


def _help(place: Path) -> str:
    text = io.StringIO()
    with redirect_stdout(text), suppress(SystemExit):
        table.from_command_line(["--env", "point_umaze", "--help"])
    return "\n".join(line.strip("│ ") for line in text.getvalue().splitlines())


def too_long(*_: object) -> None:
    raise TimeoutError(f"more than {PATIENCE} s")


def one(case: Callable[[Rng], None], rng: Rng) -> str:
    """Do a case: `fine`, `clear error`, or what went wrong."""
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            case(rng)
    except CLEAR as error:
        return "clear error" if "\n" not in str(error) else f"more than one line: {error!r}"
    except (Exception, SystemExit):
        return traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "fine"


def fuzz(cfg: FuzzConfig) -> dict[str, dict[str, int]]:
    """The counts of all kinds; what went wrong goes to standard error."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGALRM, too_long)
    counts: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        with redirect_stdout(io.StringIO()):
            subjects = Subjects(place)
        resource.setrlimit(resource.RLIMIT_DATA, (2 * 2**30, resource.RLIM_INFINITY))
        (place / "other").write_text("as it was")
        for number, (kind, share) in enumerate(SHARES.items()):
            counts[kind] = {"cases": 0, "fine": 0, "clear error": 0, "wrong": 0}
            for i in range(math.ceil(cfg.cases * share / sum(SHARES.values()))):
                said = one(getattr(subjects, kind), np.random.default_rng([cfg.seed, number, i]))
                counts[kind]["cases"] += 1
                counts[kind][said if said in counts[kind] else "wrong"] += 1
                if said not in counts[kind] and counts[kind]["wrong"] <= 3:
                    print(f"{kind}, case {i}:\n{said}", file=sys.stderr)
            print(kind, counts[kind], file=sys.stderr, flush=True)
        if sorted(path.name for path in place.iterdir()) != ["other", "run"]:
            raise SystemExit("a case has written outside of its run folder")
        (place / "other").read_text()
    return counts


def main(cfg: FuzzConfig) -> None:
    counts = fuzz(cfg)
    told(counts, cfg.json)
    sys.exit(any(kind["wrong"] for kind in counts.values()))


if __name__ == "__main__":
    main(tyro.cli(FuzzConfig, description=__doc__))
