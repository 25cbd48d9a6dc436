"""What the benchmarks share: a stopwatch, and the words for the machine and its software."""

import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import active_children
from pathlib import Path
from typing import Any, NamedTuple

PACKAGES = "mujoco torch numpy gymnasium gymnasium-robotics stable-baselines3 sb3-contrib envpool"


class Unavailable(Exception):
    """A measurement that cannot be had here; the message says why."""


class Sample(NamedTuple):
    """One measurement.

    steps: environment steps taken; seconds: wall time spent; cpu: processor time spent, seconds;
    dt: seconds that a step simulates.
    """

    steps: int
    seconds: float
    cpu: float
    dt: float


def clocked(step: Callable[[], int], durations: Iterable[float], dt: float) -> Iterator[Sample]:
    """One sample per duration.

    Args:
        step: does some of the work and returns how many environment steps it took.
        durations: seconds; at least one step is taken, and the last one is finished.
        dt: seconds that one environment step simulates.
    """
    for duration in durations:
        steps, spent, cpu, begin = 0, 0.0, cpu_seconds(), time.perf_counter()
        while not steps or spent < duration:
            steps += step()
            spent = time.perf_counter() - begin
        yield Sample(steps, spent, cpu_seconds() - cpu, dt)


def cpu_seconds() -> float:
    """Processor time of this process and its children so far, those that still run included."""
    ticks = sum(sum(_ticks(child.pid)) for child in active_children() if child.pid is not None)
    return sum(os.times()[:4]) + ticks / os.sysconf("SC_CLK_TCK")


def _ticks(pid: int) -> tuple[int, int]:
    """User and system time of a process, clock ticks."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:  # no /proc, or the process has gone
        return 0, 0
    return int(fields[11]), int(fields[12])


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def machine() -> str:
    """The processor, the cores that this process may use, and the versions of what is measured."""
    found = [f"python {platform.python_version()}"]
    for package in PACKAGES.split():
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return f"{_processor()}, {cores()} cores; {', '.join(found)}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def told(counts: dict[str, Any], path: Path | None) -> None:
    """Print counts as JSON, and write them to a file if one is named."""
    print(json.dumps(counts))
    if path is not None:
        path.write_text(json.dumps(counts, indent=1) + "\n")
