"""What several test files share: commands, here or in processes of their own, and a tiny run."""

import contextlib
import importlib
import io
import shutil
import signal
import subprocess
import sys
import warnings

import pytest
import torch

from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners import table
from goalgan_bt.learners.maze import train
from goalgan_bt.runs import run_folder
from goalgan_bt.runs.signals import SIGNALS

# Many small networks: threads would only wait for each other.
torch.set_num_threads(1)

TINY = (
    "--env point_umaze --iterations 4 --rollout.num-envs 16 --rollout.steps 20 "
    "--threads 1 --coverage.rollouts 1 --gan.pretrain-steps 20 --gan.steps 5 "
    "--backtracking.min-transitions 50"
)


def run_module(name, *arguments):
    """`python -m goalgan_bt.<name>` until it ends: its exit code, what it printed."""
    words = [sys.executable, "-m", f"goalgan_bt.{name}", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=120)


@contextlib.contextmanager
def started(name, *arguments, **how):
    """The same while it goes on; it does not outlive the test."""
    words = [sys.executable, "-m", f"goalgan_bt.{name}", *map(str, arguments)]
    process = subprocess.Popen(words, text=True, **how)
    try:
        yield process
    finally:
        process.kill()
        process.wait(timeout=20)
        for pipe in filter(None, (process.stdin, process.stdout, process.stderr)):
            pipe.close()


def call(name, *arguments):
    """The same without a process, and so without the seconds of its imports: for all but what
    happens to the process itself. Signal handlers are put back; a warning counts as printed."""
    module = importlib.import_module(f"goalgan_bt.{name}")
    if hasattr(module, "__path__"):
        module = importlib.import_module(f"goalgan_bt.{name}.__main__")
    words, printed, complaints = [*map(str, arguments)], io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        with (
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(complaints),
            warnings.catch_warnings(record=True) as warned,
        ):
            as_in_a_process()
            code = module.main(words)
    except SystemExit as stop:  # --help
        code = stop.code or 0
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    complaints.writelines(f"{warning.category.__name__}: {warning.message}\n" for warning in warned)
    return subprocess.CompletedProcess(words, code, printed.getvalue(), complaints.getvalue())


def as_in_a_process():
    """Warn of what Python warns of, where pytest would have it otherwise."""
    warnings.resetwarnings()
    for quiet in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", quiet)


def serve(folder):
    """A page over a run in a process that ends when its standard input closes; its address.

    It has the priority of the tests: with its own, the lowest, it answers after minutes where other
    work holds all cores.
    """
    page = "import os; os.nice = int; from goalgan_bt.viz.__main__ import main; main()"
    words = [sys.executable, "-c", page, folder, "--port", "0", "--with-parent"]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    return process, process.stdout.readline().removeprefix("view: ").strip()


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A finished run of four iterations; not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "point_umaze-test-s0"
    folder.mkdir()
    run_folder.write_meta(folder, mazes.layout("umaze"))
    train(table.from_command_line(TINY.split()), folder)
    return folder


@pytest.fixture
def folder(trained, tmp_path):
    """The same as a copy to break."""
    return shutil.copytree(trained, tmp_path / trained.name)
