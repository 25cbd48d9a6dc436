"""A run apart from what it learns: its limits, what is due when, what it writes, how it ends."""

import shutil

import numpy as np
import pytest
import torch

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.run_folder import write_meta
from goalgan_bt.runs.session import Limits, Schedule, Session
from goalgan_bt.runs.signals import Stop

EVERY = Schedule(lambda steps: steps + 300, first=2, report_every=3)


def begun(folder, limits, schedule=EVERY, **more):
    if not (folder / "meta.json").exists():
        write_meta(folder, None)
    return Session(folder, {"env": "none"}, limits, schedule, events=False, **more)


def live(run, steps=100):
    """Iterations of so many steps each: which of them measured."""
    measured = []
    while run.goes_on():
        run.count("train", steps)
        if run.measures():
            measured.append(run.iteration)
            run.count("eval", 7)
            run.note("eval", {"coverage": 0.5})
        frame = lambda: {"goals": np.zeros((1, 2))}  # noqa: E731
        run.report({"x": float(run.iteration)}, frame)
        if run.saves:
            run.save({"weights": torch.ones(2)})
    return measured


@pytest.mark.parametrize(
    ("limits", "last"),
    [
        (Limits(total_steps=1000), 10),
        (Limits(total_steps=950), 10),  # the iteration that passes it is finished
        (Limits(iterations=4, total_steps=1000), 4),
        (Limits(iterations=20, minutes=1e-9), 1),
    ],
)
def test_it_ends_at_the_first_limit_and_measures_there(tmp_path, limits, last):
    with begun(tmp_path, limits) as run:
        measured = live(run)
    assert run.iteration == last and measured[-1] == last and run.complete
    assert (tmp_path / "ended.txt").read_text() == "complete\n"
    _, rows = read_metrics(tmp_path)
    assert [int(row["iteration"]) for row in rows] == list(range(1, last + 1))
    assert rows[-1]["steps/train"] == str(100 * last) and rows[-1]["eval/coverage"] == "0.5"


def test_it_measures_where_that_is_due_and_reports_now_and_then(tmp_path):
    with begun(tmp_path, Limits(iterations=10)) as run:
        assert live(run) == [2, 5, 8, 10]  # not in the first; then every 300 steps; and at the end
    assert [int(path.stem) for path in frame_paths(tmp_path)] == [2, 3, 5, 6, 8, 9, 10]
    assert run.steps == {"train": 1000, "label": 0, "eval": 4 * 7}


def test_progress_leads_to_one_and_time_is_left_until_then(tmp_path):
    with begun(tmp_path, Limits(iterations=4)) as run:
        seen = []
        assert run.left() == np.inf
        while run.goes_on():
            seen.append(run.progress)
            run.measures()
            assert 0 <= run.left() < 100
        assert seen == [0.25, 0.5, 0.75, 1.0]


def test_it_goes_on_from_its_state_and_not_past_its_limits(tmp_path):
    with begun(tmp_path, Limits(iterations=4)) as run:
        live(run)
    saved = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert torch.equal(saved["weights"], torch.ones(2))
    with pytest.raises(RunError, match=r"has reached its limits \(4 iterations, 400 steps\)"):
        begun(tmp_path, Limits(iterations=4), state=saved["run"])
    with begun(tmp_path, Limits(iterations=6), state=saved["run"]) as run:
        assert not (tmp_path / "ended.txt").exists()
        assert live(run) == [6]  # the last one was at 400 steps: the next is due at 700
    assert run.steps["train"] == 600 and run.clock.total() >= saved["run"]["seconds"]
    assert len(read_metrics(tmp_path)[1]) == 6


def test_a_wish_to_stop_is_granted_after_the_iteration(tmp_path):
    stop = Stop()
    with begun(tmp_path, Limits(iterations=50), stop=stop) as run:
        while run.goes_on():
            stop.signal = 2 if run.iteration == 3 else None
            run.count("train", 100)
            run.measures()
            run.report({})
            if run.saves:
                run.save({})
    assert run.iteration == 3 and not run.complete
    assert (tmp_path / "ended.txt").read_text() == "stopped early: --resume goes on\n"
    assert (tmp_path / "checkpoint.pt").exists()


def test_what_goes_wrong_lets_go_of_the_folder_and_says_nothing_of_an_end(tmp_path):
    with pytest.raises(ZeroDivisionError), begun(tmp_path, Limits(iterations=5)) as run:
        run.goes_on()
        raise ZeroDivisionError
    assert not (tmp_path / "ended.txt").exists()
    with begun(tmp_path, Limits(iterations=1)) as run:
        live(run)
    assert len(read_metrics(tmp_path)[1]) == 1


def test_two_cannot_write_the_same_run(tmp_path):
    with (
        begun(tmp_path, Limits(iterations=1)),
        pytest.raises(RunError, match="is being trained by another process"),
    ):
        begun(tmp_path, Limits(iterations=1))


def test_a_folder_that_vanishes_is_told(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    with (
        pytest.raises(RunError, match="run has vanished: start again"),
        begun(folder, Limits(iterations=9)) as run,
    ):
        run.goes_on()
        shutil.rmtree(folder)
        run.measures()
        run.report({})


def test_who_does_not_record_counts_all_the_same():
    with Session(None, {}, Limits(total_steps=500), EVERY) as run:
        assert live(run) == [2, 5] and not run.records


def test_ranks_agree_before_anything_is_decided(tmp_path):
    """Clocks differ: what all have agreed on counts, and a wish of one is a wish of all."""
    with Session(None, {}, Limits(iterations=2), EVERY, agreed=lambda x: max(x, 0.6)) as run:
        assert run.goes_on() and run.progress == 0.6
        run.measures()  # some rank wants to stop: the mean is above 0
        assert not run.goes_on()
