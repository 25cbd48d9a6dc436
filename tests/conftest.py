"""What several test files share: commands in processes of their own, and a tiny finished run."""

import shutil
import subprocess
import sys

import pytest
import torch

from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners import table
from goalgan_bt.learners.maze import train
from goalgan_bt.runs import run_folder

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


def serve(folder):
    """A page over a run in a process that ends when its standard input closes; its address."""
    words = [sys.executable, "-m", "goalgan_bt.viz", folder, "--port", "0", "--with-parent"]
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
