"""`python -m goalgan_bt.demo`: trained policies that come along."""

import re
import runpy
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from conftest import call, started

from goalgan_bt.demo import HOME, RUNS
from goalgan_bt.learners.evaluation import at_home
from goalgan_bt.runs.frames import frame_paths, read_frame

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", RUNS)
def test_what_comes_along_is_trained_and_names_no_path(name):
    found = at_home(HOME / name, 112, True, 0, 2)
    assert found["success"] > 0.9
    for file in (HOME / name).glob("*.json"):
        assert not re.search(r'"/\w+/', file.read_text()), file
    assert len(frame_paths(HOME / name)) > 20
    assert all("coverage" in read_frame(frame) for frame in frame_paths(HOME / name)[::8])


def test_it_is_small():
    assert sum(f.stat().st_size for f in HOME.rglob("*") if f.is_file()) < 4e6


@pytest.mark.parametrize("name", RUNS)
def test_without_a_page_it_walks_and_tells(name):
    done = call("demo", "--headless", "--env", name)
    assert done.returncode == 0, done.stderr
    *goals, last = done.stdout.splitlines()
    assert len(goals) == 14 and all(re.match(r"goal \(.+\): (not )?reached", g) for g in goals)
    reached = int(re.fullmatch(rf"{name}: (\d+) of 14 goals reached", last)[1])
    assert reached >= 12


def test_the_page_opens_within_seconds():
    begin = time.monotonic()
    with started("demo", "--port", "0", stdout=subprocess.PIPE) as page:
        line = page.stdout.readline()
        assert line.startswith("Click on the floor")
        address = re.search(r"http://127\.0\.0\.1:\d+", page.stdout.readline())[0]
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert answer.status == 200
        assert time.monotonic() - begin < 20  # beside other tests; alone it takes a few seconds


@pytest.mark.parametrize(
    ("words", "problem"),
    [("--env hopper", "ant_umaze"), ("--port 99999", "--port must be between 0 and 65535")],
)
def test_bad_words_end_in_one_line(words, problem):
    done = call("demo", *words.split())
    assert done.returncode == 2 and problem in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_shipping_tells_no_paths():
    ship = runpy.run_path(str(ROOT / "benchmarks/ship.py"))["without_paths"]
    words = [
        "--seed",
        "0",
        "--out",
        "/home/x/runs",
        "--map=/home/x/my.txt",
        "--out=/y",
        "--iterations",
        "4",
    ]
    assert ship(words) == ["--seed", "0", "--iterations", "4"]


def test_shipping_keeps_what_the_demo_needs_and_no_more(folder, tmp_path):
    out = tmp_path / "shipped"
    words = [sys.executable, ROOT / "benchmarks/ship.py", folder, out]
    subprocess.run(words, check=True, timeout=120)
    assert at_home(out, 16, True, 0, 1) == at_home(folder, 16, True, 0, 1) | {"run": str(out)}
    assert (out / "checkpoint.pt").stat().st_size < (folder / "checkpoint.pt").stat().st_size / 2
    assert (out / "metrics.csv").read_bytes() == (folder / "metrics.csv").read_bytes()
