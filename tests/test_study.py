"""Studies: the statistics by hand, and one small study from its file to its report."""

import csv
import shutil

import numpy as np
import pytest
from conftest import run_module

from goalgan_bt import study
from goalgan_bt.command_line import UsageError

evidence = pytest.importorskip("goalgan_bt.evidence")
Curve = evidence.Curve

TINY = """
envs = ["point_umaze"]
seeds = 2
flags = "--iterations 3 --rollout.num-envs 16 --coverage.rollouts 1 --coverage.every 5000"
[methods]
recall_traces = ""
goal_gan = "--method goal_gan"
"""


def curve(*coverage):
    steps = np.arange(len(coverage) + 1) * 1e6
    return Curve(steps, np.array([0.0, *coverage]))


def test_time_to_a_threshold_lies_on_the_line_between_reports():
    assert evidence.time_to(curve(0.2, 0.6, 0.5), 0.4) == pytest.approx(1.5e6)
    assert evidence.time_to(curve(0.2, 0.6, 0.5), 0.6) == pytest.approx(2e6)
    assert evidence.time_to(curve(0.5), 0.25) == pytest.approx(0.5e6)
    assert evidence.time_to(curve(0.2, 0.6), 0.61) == np.inf


def test_area_is_the_mean_coverage():
    assert evidence.area(curve(0.5, 0.5)) == pytest.approx((0.25 + 0.5) / 2)


def test_the_interquartile_mean_drops_the_extremes():
    assert evidence.iqm(np.array([100.0, 1, 2, 3, -50, 2, 2, 2])) == pytest.approx(2)


def test_ratios_are_paired_by_seed():
    """Seeds differ tenfold, each pair by a half: the interval is a point."""
    slow = [Curve(np.array([0, 1e6 * k, 9e7]), np.array([0, 0.5, 0.5])) for k in (1, 10, 4)]
    fast = [Curve(c.steps * [1, 0.5, 1], c.coverage) for c in slow]
    value, reached = evidence.ratio(fast, slow, 0.5)
    assert value == pytest.approx((0.5, 0.5, 0.5)) and reached == 6
    value, reached = evidence.ratio(slow, fast, 0.5)
    assert value == pytest.approx((2, 2, 2))
    never = [Curve(c.steps, c.coverage / 2) for c in slow]
    value, reached = evidence.ratio(fast, never, 0.5)
    assert reached == 3 and value.value < 0.1  # counted with all their steps


def test_the_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        found = evidence.interval(rng.normal(1.0, 1.0, 20), np.mean)
        assert found.low <= found.value <= found.high
        hits += found.low <= 1.0 <= found.high
    assert 0.85 < hits / 200 < 0.99
    assert np.isnan(evidence.interval(np.array([0.3])).low)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small study that has run."""
    root = tmp_path_factory.mktemp("study")
    (root / "tiny.toml").write_text(TINY)
    done = run_module("study", root / "tiny.toml", "--out", root / "out", "--runs", root / "runs")
    assert done.returncode == 0, done.stderr
    return root, done.stdout


def test_a_study_from_its_file_to_its_report(finished):
    root, printed = finished
    out = root / "out/tiny"
    assert printed.startswith("tiny: 4 runs of 4 to go") and "4/4 point_umaze" in printed
    with (out / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == ("env", "method", "seed", "steps", "coverage")
    keys = {(row["method"], row["seed"]) for row in rows}
    assert keys == {(m, s) for m in ("recall_traces", "goal_gan") for s in "01"}
    for key in keys:
        steps = [int(row["steps"]) for row in rows if (row["method"], row["seed"]) == key]
        assert len(steps) >= 2 and steps == sorted(steps)
    report = (out / "README.md").read_text()
    assert "| goal_gan | 2 |" in report and "recall_traces over goal_gan" in report
    assert (out / "curves.png").stat().st_size > 10_000
    with (out / "summary.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == ["recall_traces", "goal_gan"]


def test_what_is_finished_is_not_run_again(finished, tmp_path):
    root, _ = finished
    out = shutil.copytree(root / "out", tmp_path / "out")
    words = "study", root / "tiny.toml", "--out", out, "--runs", tmp_path / "runs"
    again = run_module(*words)
    assert again.returncode == 0 and "to go" not in again.stdout
    assert not (tmp_path / "runs").exists()
    # A run that is missing in the tables but finished on disk is only read in.
    for name in ("runs.csv", "costs.csv"):
        lines = (out / f"tiny/{name}").read_text().splitlines(keepends=True)
        kept = [line for line in lines if ",goal_gan,1," not in line]
        (out / f"tiny/{name}").write_text("".join(kept))
    words = "study", root / "tiny.toml", "--out", out, "--runs", root / "runs"
    again = run_module(*words)
    assert "tiny: 1 runs of 4 to go" in again.stdout
    assert (out / "tiny/runs.csv").read_text().count(",goal_gan,1,") >= 2
    # The same name with other flags would mix two experiments.
    (tmp_path / "tiny.toml").write_text(TINY.replace("--iterations 3", "--iterations 4"))
    other = run_module("study", tmp_path / "tiny.toml", "--out", out)
    assert other.returncode == 2 and other.stderr.count("\n") == 1
    assert "with the flags" in other.stderr


def test_a_run_that_was_cut_off_goes_on(finished, tmp_path):
    root, _ = finished
    spec = study.load(str(root / "tiny.toml"))
    run = study.grid(spec)[0]
    place = shutil.copytree(root / "runs/tiny/point_umaze/recall_traces-s0", tmp_path / "run")
    (folder,) = place.iterdir()
    (folder / "ended.txt").unlink()
    longer = run._replace(flags=run.flags)
    with pytest.raises(study.record.RunError, match="recall_traces, seed 0 failed: error: "):
        study.perform(longer, place)  # it had reached its limit: there is nothing to go on with
    (folder / "config.json").write_text(
        (folder / "config.json").read_text().replace('"iterations": 3', '"iterations": 4')
    )
    assert study.perform(run, place) == folder
    assert (folder / "metrics.csv").read_text().splitlines()[-1].startswith("4,")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("envs = ", "cannot read"),
        ('envs = ["point_umaze"]\nseeds = 1', "needs methods"),
        ('envs = ["moon"]\nseeds = 1\n[methods]\na = ""', "moon"),
        ('envs = ["point_umaze"]\nseeds = 1\n[methods]\na = "--speed 9"', "a: "),
        ('envs = ["point_umaze"]\nseeds = 1\n[methods]\na = 3', "texts"),
        (
            'envs = ["point_umaze"]\nseeds = 1\nbudget = 3\n[methods]\na = ""',
            "unknown key 'budget'",
        ),
    ],
)
def test_bad_files_end_in_one_line(text, words, tmp_path):
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(UsageError, match=words):
        study.load(str(tmp_path / "bad.toml"))


def test_unknown_and_unfinished_studies_end_in_one_line(tmp_path):
    for words in (["nothing"], ["point_umaze", "--report"], ["point_umaze", "--processes", "-1"]):
        done = run_module("study", *words, "--out", tmp_path)
        assert done.returncode == 2 and done.stderr.startswith("error: ")
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["point_umaze", "ant_umaze", "ablations"])
def test_the_studies_that_come_along_can_be_run(name):
    spec = study.load(name)
    assert len(study.grid(spec)) == spec.seeds * len(spec.methods) * len(spec.envs)
    assert "recall_traces" in spec.methods
