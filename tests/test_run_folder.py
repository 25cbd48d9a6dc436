import csv
import json
import resource
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from goalgan_bt.envs import maze as mazes
from goalgan_bt.runs import checkpoint, files, run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.run_writer import RunWriter


def row(iteration, **more):
    return {"iteration": iteration, "steps/train": 100 * iteration, **more}


def cells(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_columns_grow_without_losing_a_value(tmp_path):
    records = RunWriter(tmp_path)
    records.metrics(row(1))
    records.metrics(row(2, **{"eval/coverage": 0.5}))
    records.metrics(row(3, **{"trpo/kl": float("nan"), "gan/loss": 1.25}))
    records.metrics(row(4))
    table = cells(tmp_path)
    assert [r["iteration"] for r in table] == ["1", "2", "3", "4"]
    assert [r["eval/coverage"] for r in table] == ["", "0.5", "", ""]
    assert table[2]["gan/loss"] == "1.25" and table[2]["trpo/kl"] == ""
    columns, rows = read_metrics(tmp_path)
    assert columns[:2] == ["iteration", "steps/train"] and len(rows) == 4


def test_a_resumed_record_drops_what_came_after_its_checkpoint(tmp_path):
    run_folder.write_meta(tmp_path, None)
    records = RunWriter(tmp_path)
    for i in range(1, 6):
        records.metrics(row(i))
        records.frame(i, goals=np.zeros((1, 2)))
    with pytest.raises(RunError, match="by another process"):
        RunWriter(tmp_path, iteration=3)
    records.close("stopped early")
    resumed = RunWriter(tmp_path, iteration=3)
    resumed.metrics(row(4, new=1.0))
    assert [r["iteration"] for r in cells(tmp_path)] == ["1", "2", "3", "4"]
    assert [f.stem for f in frame_paths(tmp_path)] == ["000001", "000002", "000003"]


def test_the_commit_is_that_of_the_code(tmp_path):
    """Changed code shows, changed tables do not; a repository that it is no part of does not."""

    def git(*words):
        given = ["git", "-c", "user.name=x", "-c", "user.email=x", *words]
        return subprocess.run(given, cwd=tmp_path, check=True, capture_output=True, text=True)

    package, other = tmp_path / "package", tmp_path / "other"
    for place in (package, other, tmp_path / "viz"):
        place.mkdir()
        (place / "code.py").write_text("a = 1")
    table = tmp_path / "table.csv"
    assert run_folder.code_commit(package) is None
    git("init")
    git("add", "package", "viz")
    assert run_folder.code_commit(package) is None  # there is no commit yet
    git("commit", "-m", "first")
    commit = git("rev-parse", "HEAD").stdout.strip()
    table.write_text("a")
    assert run_folder.code_commit(package) == commit
    assert run_folder.code_commit(other) is None  # an installed package, say
    for changed in (package / "code.py", package / "new.py", tmp_path / "viz/code.py"):
        changed.write_text("a = 2")
        assert run_folder.code_commit(package) == f"{commit}-dirty"
        git("add", ".")
        git("commit", "-m", "next")
        commit = git("rev-parse", "HEAD").stdout.strip()
        assert run_folder.code_commit(package) == commit


def test_without_git_there_is_no_commit(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run_folder.code_commit(Path(run_folder.__file__).parent) is None


def test_a_last_row_cut_short_is_left_out(tmp_path):
    records = RunWriter(tmp_path)
    records.metrics(row(1, x=1.0))
    records.metrics(row(2, x=2.0))
    path = tmp_path / "metrics.csv"
    path.write_text(path.read_text().rsplit(",", 1)[0])
    assert len(read_metrics(tmp_path)[1]) == 1


def test_frames_round_trip(tmp_path):
    records = RunWriter(tmp_path)
    traces = np.full((2, 3, 2), np.nan, np.float32)
    records.frame(7, goals=np.eye(2), traces=traces)
    (path,) = frame_paths(tmp_path)
    with np.load(path, allow_pickle=False) as frame:
        assert np.array_equal(frame["goals"], np.eye(2))
        assert np.array_equal(frame["traces"], traces, equal_nan=True)


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def fail(file):
        file.write(b"ne")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        files.write_atomically(path, fail)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_checkpoint_that_does_not_fit_on_the_disk_says_so(tmp_path):
    """torch's archive hides what stopped it behind an error of its own."""
    path, state = tmp_path / "checkpoint.pt", {"weights": torch.zeros(100_000)}
    checkpoint.save({"weights": torch.ones(1)}, path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            checkpoint.save(state, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert torch.load(path, weights_only=True)["weights"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_folders_of_the_same_second_do_not_collide(tmp_path):
    folders = {run_folder.create_folder(tmp_path, "ant_umaze", 3) for _ in range(3)}
    assert len(folders) == 3
    assert all(f.name.startswith("ant_umaze-") and "-s3" in f.name for f in folders)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="--out"):
        run_folder.create_folder(tmp_path / "file", "ant_umaze", 0)


def test_meta_holds_the_maze_and_the_versions(tmp_path):
    run_folder.write_meta(tmp_path, mazes.layout("spiral"))
    meta = run_folder.read_meta(tmp_path)
    assert tuple(meta["maze"]["rows"]) == mazes.layout("spiral").rows
    assert meta["versions"]["mujoco"][0].isdigit()


def test_a_run_that_is_taken_up_with_other_code_says_so(tmp_path, monkeypatch):
    for commit, iteration in (("first", 0), ("first", 2), ("second", 5)):
        monkeypatch.setattr(run_folder, "code_commit", lambda _, commit=commit: commit)
        if not iteration:
            run_folder.write_meta(tmp_path, None)
        RunWriter(tmp_path, iteration).close("killed")
    assert run_folder.commits(tmp_path) == "first+second"
    assert len(run_folder.read_meta(tmp_path)["resumed"]) == 2


@pytest.mark.parametrize("read", [read_metrics, run_folder.read_meta])
def test_a_folder_that_is_no_run_says_so(tmp_path, read):
    with pytest.raises(RunError, match="is no run"):
        read(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "iteration,steps/train\n1,5\n2,6,7\n",
        "iteration,eval/return\n1,5\n",
        "iteration,steps/train\n1,many\n",
        "iteration,steps/train\n\u00b2,5\n",
    ],
)
def test_a_damaged_table_says_so(tmp_path, text):
    (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(RunError, match=r"metrics\.csv is damaged"):
        read_metrics(tmp_path)


@pytest.mark.parametrize("resumed", [5, ["x"], [{}]])
def test_damaged_meta_says_so(tmp_path, resumed):
    (tmp_path / "meta.json").write_text(json.dumps({"commit": None, "resumed": resumed}))
    with pytest.raises(RunError, match=r"meta\.json is damaged"):
        run_folder.read_meta(tmp_path)


def test_a_lost_row_is_told(tmp_path, capsys):
    run_folder.write_meta(tmp_path, None)
    records = RunWriter(tmp_path)
    for i in (1, 2, 3):
        records.metrics(row(i))
    records.close("stopped early")
    RunWriter(tmp_path, iteration=3).close("stopped early")
    assert not capsys.readouterr().err
    table = tmp_path / "metrics.csv"
    table.write_text(table.read_text().rsplit(",", 1)[0])  # of the third row
    RunWriter(tmp_path, iteration=3).close("stopped early")
    assert "1 have no row" in capsys.readouterr().err
    table.unlink()
    RunWriter(tmp_path, iteration=3).close("stopped early")
    assert "3 have no row" in capsys.readouterr().err


def test_a_run_without_a_report_yet_says_so(tmp_path):
    run_folder.write_meta(tmp_path, mazes.layout("spiral"))
    with pytest.raises(RunError, match="holds no report yet"):
        read_metrics(tmp_path)


def test_tensorboard_forgets_what_a_resumed_run_does_again(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run_folder.write_meta(tmp_path, None)
    first = RunWriter(tmp_path)
    for i in (1, 2, 3):
        first.metrics({"iteration": i, "steps/train": 100 * i, "trpo/kl": 0.1 * i})
    first.close("killed")
    again = RunWriter(tmp_path, 1)
    again.metrics({"iteration": 2, "steps/train": 200, "trpo/kl": 0.7})
    again.close("complete")
    events = accumulator.EventAccumulator(str(tmp_path)).Reload().Scalars("trpo/kl")
    assert [(e.step, round(e.value, 3)) for e in events] == [(100, 0.1), (200, 0.7)]
