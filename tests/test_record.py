"""`python -m goalgan_bt.record`: a film of a trained policy."""

import numpy as np
import pytest
from conftest import call, run_module

iio = pytest.importorskip("imageio.v3")
pytest.importorskip("av")


def filmed(folder, *words):
    """In a process of its own: MuJoCo chooses its OpenGL when it is imported."""
    done = run_module("record", folder, *words)
    if "pictures need OpenGL" in done.stderr:
        pytest.skip("no EGL here")
    return done


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_a_film_shows_the_body_on_its_way_and_says_how_it_ended(folder, tmp_path, kind):
    path = tmp_path / f"x.{kind}"
    done = filmed(folder, "--video", path, "--goal", "0.2", "0.5", "0", "4", "--size", "96")
    assert done.returncode == 0, done.stderr
    first, second, last = done.stdout.splitlines()
    assert first.startswith("to 0.2 0.5: ") and second.startswith("to 0 4: ")
    assert last.startswith(str(path))
    film = iio.imread(path, **({"plugin": "pyav"} if kind == "mp4" else {}))
    assert film.shape[1:3] == (96, 96) and len(film) > 20
    changed = np.abs(film[-1].astype(int) - film[0]).max(axis=-1) > 60
    assert 10 < changed.sum() < 0.5 * changed.size  # the body and the goal, not the maze


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("--video x.avi", "its name must end in .gif or .mp4"),
        ("--video /nowhere/x.mp4", "choose a file in a folder that can be written"),
        ("--video x.mp4 --goal 1", "--goal takes 2 numbers for each goal, not 1"),
        ("--video x.mp4 --goal 0 2", "--goal 0 2 is inside a wall"),
        ("--video x.mp4 --size 65", "--size must be even"),
        ("--video x.mp4 --size 2048" + " --goal" + 999 * " 0 0", "may be too long for memory"),
        ("--video x.mp4 --size 10", "--size must be between 64 and 2048"),
        ("", "--video"),
    ],
)
def test_bad_words_end_in_one_line(folder, tmp_path, monkeypatch, words, problem):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "egl")  # what the command sets stays as it was
    done = call("record", folder, *words.split())
    assert done.returncode == 2 and problem in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not [*tmp_path.glob("x.*")]
