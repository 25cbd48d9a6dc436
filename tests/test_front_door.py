"""`goalgan-bt COMMAND`, and folders of runs in the place of runs."""

import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from conftest import call

from goalgan_bt.__main__ import COMMANDS
from goalgan_bt.runs.run_folder import runs_in

SCRIPT = Path(sysconfig.get_path("scripts")) / "goalgan-bt"


def door(*words, **settings):
    command = [sys.executable, "-m", "goalgan_bt", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **settings)


def test_without_a_command_it_lists_them():
    done = door()
    assert done.returncode == 0 and done.stderr == "" and len(done.stdout.splitlines()) < 60
    assert [line.split()[0] for line in done.stdout.splitlines() if line[:2] == "  "] == [*COMMANDS]


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_is_the_module_of_its_name(command):
    one, other = door(command, "--help"), call(command, "--help")
    assert one.returncode == other.returncode == 0
    assert one.stdout == other.stdout and f"python -m goalgan_bt.{command}" in one.stdout


def test_a_command_that_is_none_is_one_line():
    done = door("trian")
    assert done.returncode == 2 and "did you mean train?" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    done = door("plot", "nowhere")
    assert done.returncode == 2 and "nowhere is no run" in done.stderr


@pytest.mark.skipif(not SCRIPT.exists(), reason="needs the package installed")
def test_the_console_command_trains(tmp_path):
    words = [
        "train",
        "--env",
        "point_umaze",
        "--iterations",
        "1",
        "--viz",
        "none",
        "--method",
        "uniform",
        "--out",
    ]
    done = subprocess.run([SCRIPT, *words, tmp_path], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    assert re.fullmatch(r"point_umaze-uniform-\d{8}-\d{6}-s0", folder.name)


def test_a_run_of_the_usual_method_is_called_by_its_task_alone(tmp_path):
    words = "--env", "four_rooms_7", "--total-steps", 320, "--viz", "none", "--out", tmp_path
    assert call("train", *words).returncode == 0
    assert call("train", *words, "--method", "per").returncode == 0
    names = sorted(re.sub(r"\d{8}-\d{6}", "T", folder.name) for folder in tmp_path.iterdir())
    assert names == ["four_rooms_7-T-s0", "four_rooms_7-per-T-s0"]


def test_runs_are_found_in_folders_and_stand_for_themselves(tmp_path):
    for name in ("b", "a", "study/uniform-s0"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.json").write_text("{}")
    a, b, deep = tmp_path / "a", tmp_path / "b", tmp_path / "study/uniform-s0"
    assert runs_in([tmp_path]) == [a, b, deep]
    assert runs_in([b, tmp_path]) == [b, a, deep]
    assert runs_in([tmp_path / "nowhere"]) == [tmp_path / "nowhere"]  # who reads it says so
