"""Studies: the statistics by hand, and one small study from its file to its report."""

import contextlib
import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace

import numpy as np
import pytest
from conftest import call, run_module

from goalgan_bt.learners import locomotion, table
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.study import __main__, execute, plan
from goalgan_bt.study.tables import Tables

statistics = pytest.importorskip("goalgan_bt.study.statistics")
report = pytest.importorskip("goalgan_bt.study.report")
Curve = statistics.Curve

TINY = """
envs = ["point_umaze"]
seeds = 1
flags = "--iterations 25 --rollout.num-envs 16 --updates 2 --horizon 40 --gan.steps 5"
[methods]
recall_traces = ""
goal_gan = "--method goal_gan"
"""
ROOMS = """
envs = ["four_rooms_7", "four_rooms_9 --horizon 100"]
seeds = 2
flags = "--total-steps 3000"
[methods]
recall_traces = ""
actor_critic = "--method actor_critic"
"""
METHODS = "recall_traces", "actor_critic"


def curve(*coverage):
    steps = np.arange(len(coverage) + 1) * 1e6
    return Curve(steps, np.array([0.0, *coverage]))


def test_time_to_a_threshold_lies_on_the_line_between_reports():
    assert statistics.time_to(curve(0.2, 0.6, 0.5), 0.4) == pytest.approx(1.5e6)
    assert statistics.time_to(curve(0.2, 0.6, 0.5), 0.6) == pytest.approx(2e6)
    assert statistics.time_to(curve(0.5), 0.25) == pytest.approx(0.5e6)
    assert statistics.time_to(curve(0.2, 0.6), 0.61) == np.inf


def test_area_is_the_mean_coverage():
    assert statistics.area(curve(0.5, 0.5)) == pytest.approx((0.25 + 0.5) / 2)


def test_the_interquartile_mean_drops_the_extremes():
    assert statistics.iqm(np.array([100.0, 1, 2, 3, -50, 2, 2, 2])) == pytest.approx(2)


def test_ratios_are_paired_by_seed():
    """Seeds differ tenfold, each pair by a half: the interval is a point."""
    slow = [Curve(np.array([0, 1e6 * k, 9e7]), np.array([0, 0.5, 0.5])) for k in (1, 10, 4)]
    fast = [Curve(c.steps * [1, 0.5, 1], c.values) for c in slow]
    halved = statistics.ratio(fast, slow, 0.5)
    assert halved.estimate == pytest.approx((0.5, 0.5, 0.5)) and halved.reached == (3, 3)
    assert str(halved) == "0.50 [0.50, 0.50] (3, 3)"
    assert statistics.ratio(slow, fast, 0.5).estimate == pytest.approx((2, 2, 2))
    never = [Curve(c.steps, c.values / 2) for c in slow]
    assert str(statistics.ratio(fast, never, 0.5)) == "(3, 0)"  # no figure: theirs never arrive


@pytest.mark.parametrize("n", [5, 10])
def test_the_ratios_interval_covers_the_truth_as_often_as_it_says(n):
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(1000):
        times = np.exp(rng.normal([[np.log(0.7)], [0.0]], 0.4, (2, n))) * 1e6
        pair = [
            [Curve(np.array([0, t, 1e9]), np.array([0, 0.5, 0.5])) for t in row] for row in times
        ]
        found = statistics.ratio(*pair, 0.5).estimate
        hits += found.low <= 0.7 <= found.high
    assert 0.93 < hits / 1000 < 0.97


def test_the_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        found = statistics.interval(rng.normal(1.0, 1.0, 20))
        assert found.low <= found.value <= found.high
        hits += found.low <= 1.0 <= found.high
    assert 0.85 < hits / 200 < 0.99
    assert np.isnan(statistics.interval(np.array([0.3])).low)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small study that has run."""
    root = tmp_path_factory.mktemp("study")
    (root / "tiny.toml").write_text(ROOMS)
    done = run_module("study", root / "tiny.toml", "--out", root / "out", "--runs", root / "runs")
    assert done.returncode == 0 and not done.stderr, done.stderr
    return root, done.stdout


def keys_of(rows):
    return {(row["env"], row["method"], row["seed"]) for row in rows}


def test_a_study_from_its_file_to_its_report(finished):
    root, printed = finished
    out, envs = root / "out/tiny", plan.load(str(root / "tiny.toml")).envs
    assert printed.startswith("tiny: 8 runs of 8 to go") and " 8/8 four_rooms_" in printed
    with (out / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == ("env", "method", "seed", "steps", "coverage")
    assert keys_of(rows) == {(e, m, s) for e in envs for m in METHODS for s in "01"}
    for key in keys_of(rows):
        steps = [int(row["steps"]) for row in rows if keys_of([row]) == {key}]
        assert len(steps) >= 2 and steps == sorted(steps)
    text = (out / "README.md").read_text()
    assert "| actor_critic | 2 |" in text and "recall_traces over actor_critic" in text
    assert "## four_rooms_9 --horizon 100" in text
    assert "From `python -m goalgan_bt.study tiny.toml`." in text  # without where it lay
    assert (out / "curves.png").stat().st_size > 10_000
    with (out / "summary.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == [*METHODS, *METHODS]


def test_what_is_finished_is_not_run_again(finished, tmp_path):
    root, _ = finished
    out = shutil.copytree(root / "out", tmp_path / "out")
    words = "study", root / "tiny.toml", "--out", out, "--runs", tmp_path / "runs"
    again = call(*words)
    assert again.returncode == 0 and "to go" not in again.stdout
    assert not (tmp_path / "runs").exists()
    # A run that is missing in the tables but finished on disk is only read in.
    missing = "four_rooms_7,actor_critic,1,"
    for name in ("runs.csv", "costs.csv"):
        lines = (out / f"tiny/{name}").read_text().splitlines(keepends=True)
        kept = [line for line in lines if not line.startswith(missing)]
        (out / f"tiny/{name}").write_text("".join(kept))
    runs = sorted(root.glob("runs/**/*"))
    words = "study", root / "tiny.toml", "--out", out, "--runs", root / "runs"
    again = call(*words)
    assert "tiny: 1 runs of 8 to go" in again.stdout
    assert (out / "tiny/runs.csv").read_text().count(missing) >= 2
    assert sorted(root.glob("runs/**/*")) == runs
    # The same name with other flags would mix two experiments.
    (tmp_path / "tiny.toml").write_text(ROOMS.replace("steps 3000", "steps 4000"))
    other = call("study", tmp_path / "tiny.toml", "--out", out)
    assert other.returncode == 2 and other.stderr.count("\n") == 1
    assert "with the flags" in other.stderr


def test_a_study_of_returns(tmp_path):
    pytest.importorskip("sb3_contrib")
    methods = 'recall_traces = ""\nsac = "--backtracking.trace-length 0"'
    flags = "--method sac --total-steps 50 --episodes 1"
    study = f'envs = ["hopper"]\nseeds = 1\nflags = "{flags}"\n[methods]\n{methods}'
    (tmp_path / "run.toml").write_text(study)
    words = "study", tmp_path / "run.toml", "--out", tmp_path, "--runs", tmp_path / "runs"
    spec = plan.load(str(tmp_path / "run.toml"))
    by_hand = plan.words(plan.grid(spec)[0])
    call("train", *by_hand, "--out", tmp_path / "runs/run/hopper/recall_traces-s0")
    done = call(*words)  # it trains the other one
    assert done.returncode == 0 and "2/2 hopper" in done.stdout, done.stderr
    with (tmp_path / "run/runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == ("env", "method", "seed", "steps", "return")
    assert sorted({int(row["steps"]) for row in rows}) == list(range(2, 51, 2))
    text = (tmp_path / "run/README.md").read_text()
    assert "| recall_traces less sac | 1 |" in text and "to 0.63" not in text
    assert "Not finished" not in text
    # A finished run leaves no checkpoint, and is only read in all the same.
    made = sorted((tmp_path / "runs").glob("*/*/*/*/ended.txt"))
    for name in ("runs.csv", "costs.csv"):
        lines = (tmp_path / f"run/{name}").read_text().splitlines(keepends=True)
        (tmp_path / f"run/{name}").write_text(
            "".join(line for line in lines if ",sac,0," not in line)
        )
    part = call(*words, "--report")
    assert part.returncode == 0, part.stderr
    assert "**Not finished: 1 of 2 runs are in.**" in (tmp_path / "run/README.md").read_text()
    again = call(*words)
    assert again.returncode == 0 and "1 runs of 2 to go" in again.stdout
    assert len(made) == 2 == len(sorted((tmp_path / "runs").glob("*/*/*/*/ended.txt")))
    # In the picture there are the curves.
    drawn = report.draw(spec, report.curves(Tables(tmp_path / "run", "return")))
    low, high = drawn.axes[0].get_ylim()
    returns = [float(row["return"]) for row in rows]
    assert low < min(returns) and high > np.mean(returns)


@pytest.mark.parametrize("value", ["abc", "nan", ""])
def test_a_damaged_table_is_one_line(finished, value, tmp_path):
    root, _ = finished
    out = shutil.copytree(root / "out", tmp_path / "out")
    text = (out / "tiny/runs.csv").read_text().rstrip()
    (out / "tiny/runs.csv").write_text(text[: text.rindex(",") + 1] + value + "\n")
    done = call("study", root / "tiny.toml", "--out", out, "--report")
    assert done.returncode == 2 and "runs.csv is damaged" in done.stderr
    assert done.stderr.count("\n") == 1


def test_differences_are_paired_by_seed():
    """Seeds differ by hundreds, each pair by ten: the interval is a point."""
    steps = np.array([1e6, 2e6])
    of = {
        name: {seed: Curve(steps, np.array([0.0, more + 100 * seed])) for seed in range(3)}
        for name, more in (("recall_traces", 10.0), ("trpo", 0.0), ("forward_model", 4.0))
    }
    assert report._differences(of)[4:] == [
        "| recall_traces less trpo | 3 | 5.00 [5.00, 5.00] | 10 [10, 10] |",
        "| forward_model less trpo | 3 | 2.00 [2.00, 2.00] | 4.00 [4.00, 4.00] |",
        "| recall_traces less forward_model | 3 | 3.00 [3.00, 3.00] | 6.00 [6.00, 6.00] |",
    ]
    assert statistics.area(Curve(steps[:1], np.array([7.0]))) == 7.0


def test_a_run_that_was_cut_off_goes_on(tmp_path):
    flags = "--iterations 2 --rollout.num-envs 16 --updates 2 --horizon 40 --gan.steps 5"
    run = plan.Trial("point_umaze", "recall_traces", 0, flags)
    assert call("train", *plan.words(run), "--out", tmp_path).returncode == 0
    (folder,) = tmp_path.iterdir()
    (folder / "ended.txt").unlink()
    assert execute.perform(run, tmp_path) == folder  # it was killed just before it could say so
    longer = run._replace(flags=flags.replace("--iterations 2", "--iterations 3"))
    with pytest.raises(RunError, match="was begun with other settings"):
        execute.perform(longer, tmp_path)
    settings = (folder / "config.json").read_text()
    (folder / "config.json").write_text(settings.replace('"iterations": 2', '"iterations": 3'))
    assert execute.perform(longer, tmp_path) == folder
    assert (folder / "metrics.csv").read_text().splitlines()[-1].startswith("3,")
    assert (folder / "ended.txt").read_text().startswith("complete")


@contextlib.contextmanager
def interrupted(number, code, runs, *words):
    """A study that a signal ends as soon as two trainings have begun; gives their tables."""
    process = subprocess.Popen(
        [sys.executable, "-m", "goalgan_bt.study", *map(str, words)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 90
        while len(begun := list(runs.glob("**/metrics.csv"))) < 2:
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
        with pytest.raises(ProcessLookupError):
            os.killpg(process.pid, 0)  # nobody is left
        assert process.returncode == code
        assert errors == "error: interrupted: the same command goes on with what is missing\n"
        yield begun
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def study_of(text, folder):
    """The words of a study `tiny` in a folder, two runs at a time."""
    (folder / "tiny.toml").write_text(text)
    places = "--out", folder / "out", "--runs", folder / "runs"
    return folder / "tiny.toml", *places, "--processes", 2


def test_an_interrupted_study_ends_its_trainings(tmp_path):
    """They have left their checkpoints when it ends, so that the same command goes on."""
    words = study_of(TINY, tmp_path)
    with interrupted(signal.SIGINT, 130, tmp_path / "runs", *words) as begun:
        assert all((metrics.parent / "checkpoint.pt").exists() for metrics in begun)
    again = call("study", *words)
    assert again.returncode == 0 and not again.stderr
    assert sorted(tmp_path.glob("runs/**/metrics.csv")) == sorted(begun)  # none was begun twice
    assert all(each.read_text().splitlines()[-1].startswith("25,") for each in begun)
    assert "recall_traces over goal_gan" in (tmp_path / "out/tiny/README.md").read_text()


def test_a_study_that_is_killed_ends_its_trainings(tmp_path):
    words = study_of(ROOMS.replace("steps 3000", "steps 1000000000"), tmp_path)
    with interrupted(signal.SIGTERM, 2, tmp_path / "runs", *words):
        pass


def test_a_training_that_is_just_being_started_ends_too(tmp_path, monkeypatch):
    start = subprocess.Popen

    def slowly(words, **more):
        time.sleep(0.5)
        return start(["sleep", "60"], **more)

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", slowly)
    known = signal.signal(signal.SIGALRM, interrupt)
    begin = time.monotonic()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        runs = [plan.Trial("hopper", "recall_traces", seed, "") for seed in range(3)]
        cfg = __main__.StudyConfig("tiny", processes=2)
        with pytest.raises(KeyboardInterrupt):
            next(execute.finished(cfg, runs, tmp_path))
    finally:
        signal.signal(signal.SIGALRM, known)
    assert time.monotonic() - begin < 10 and not execute.TRAININGS


def test_settings_are_known_to_every_thread():
    """Two command lines parsed at a time spoil each other, and where standard output goes."""
    runs = plan.grid(plan.load("locomotion_lengths")) + plan.grid(plan.load("ablations"))
    output, interval = sys.stdout, sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(plan.settings, runs))
    finally:
        sys.setswitchinterval(interval)
        spoilt, sys.stdout = sys.stdout is not output, output
    assert not spoilt
    for run, cfg in list(zip(runs, found, strict=True))[::7]:
        words = plan.words(run)
        assert cfg == table.from_command_line(words)


def test_locomotion_that_was_cut_off_goes_on(tmp_path):
    pytest.importorskip("sb3_contrib")
    flags = "--method sac --total-steps 200 --backtracking.trace-length 0 --episodes 1"
    run = plan.Trial("hopper", "sac", 0, flags)
    cfg = replace(plan.settings(run), out=tmp_path)
    folder = run_folder.new_run(tmp_path, "hopper", 0, asdict(cfg))
    agent, _ = locomotion.make(cfg)
    agent.learn(80)
    steps = {"train": 80, "label": 0, "eval": 0}
    run_state = {"iteration": 10, "steps": steps, "seconds": 1.0, "next_measurement": 0.0}
    run_state["metrics"] = {}
    done = {"run": run_state, "return": 0.0}
    checkpoint.save(done | locomotion.state_dict(agent, None), folder / "checkpoint.pt")
    assert execute.perform(run, tmp_path) == folder
    _, rows = read_metrics(folder)
    assert rows[0]["iteration"] == "11" and rows[0]["steps/train"] == "88"
    assert rows[-1]["iteration"] == "25" and rows[-1]["steps/train"] == "200"
    (resumed,) = run_folder.read_meta(folder)["resumed"]
    assert resumed["argv"] == ["--resume", str(folder), "--viz", "none"]

    agent.learn(1)
    checkpoint.save(done | locomotion.state_dict(agent, None), folder / "checkpoint.pt")
    (folder / run_folder.ENDED).unlink()
    with pytest.raises(RunError, match="begun with other settings"):
        execute.perform(run._replace(flags=flags + " --hidden 8"), tmp_path)


def test_a_report_names_its_commits():
    def row(commit, method):
        return {"commit": commit, "method": method, "env": "e"}

    ours, other = 40 * "a", 40 * "b"
    assert report._commits([row(ours, "x")]) == f"Commit: {ours[:12]}."
    several = [row(f"{other}-dirty", "y"), row(ours, "x"), row(ours, "y"), row("", "z")]
    several.append(row(f"{ours}+{other}", "z"))  # resumed
    assert report._commits(several) == (
        f"Commit: {ours[:12]}; {other[:12]}-dirty for 1 of the runs of y of e; "
        f"unknown for 1 of the runs of z of e; {ours[:12]}+{other[:12]} for 1 of the runs of "
        "z of e."
    )


def test_a_run_that_fails_says_why(tmp_path):
    run = plan.Trial("point_umaze", "mine", 3, "--rollout.num-envs 8 --iterations 1")
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="point_umaze, mine, seed 3 failed: error: can"):
        execute.perform(run._replace(flags=run.flags + f" --map {tmp_path}"), tmp_path / "runs")


def test_two_studies_do_not_share_a_table(finished):
    root, _ = finished
    tables = Tables(root / "out/tiny", "coverage")
    words = "study", root / "tiny.toml", "--out", root / "out"
    other = call(*words)
    assert other.returncode == 2 and "another study's at work" in other.stderr
    del tables


def test_a_table_cut_off_between_its_files_mends_itself(finished, tmp_path):
    root, _ = finished
    out = shutil.copytree(root / "out/tiny", tmp_path / "tiny")
    lines = (out / "costs.csv").read_text().splitlines(keepends=True)
    cut = "four_rooms_7,actor_critic,0,"
    (out / "costs.csv").write_text("".join(line for line in lines if not line.startswith(cut)))
    keys = keys_of(Tables(out, "coverage").curves)
    assert len(keys) == 7 and ("four_rooms_7", "actor_critic", "0") not in keys


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TINY.replace("seeds = 1", "seeds = true"), "seeds is a number"),
        (TINY.replace("seeds = 1", "seeds = 2\nfirst_seed = -1"), "first_seed from 0"),
        (TINY.replace("seeds = 1", f"seeds = 2\nfirst_seed = {10**13}"), "--seed must be"),
        (TINY.replace("goal_gan =", '"../a" ='), "a method's name"),
        (TINY.replace("--method goal_gan", "--seed 7"), "--seed is the study's own"),
        (TINY.replace('"point_umaze"', '"point_umaze --seed 7"'), "--seed is the study's own"),
        (TINY.replace("--method goal_gan", "--help"), "--help is the study's own"),
        (TINY.replace("--method goal_gan", "'"), "No closing quotation"),
        (TINY.replace('["point_umaze"]', '["point_umaze", "point_umaze"]'), "twice"),
        (TINY.replace('["point_umaze"]', '["point_umaze", "hopper"]'), "others a return"),
        ("envs = ", "cannot read"),
        ('envs = ["point_umaze"]\nseeds = 1', "needs methods"),
        (ROOMS.replace("four_rooms_7", "four_rooms_5"), "four_rooms_5"),
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
        plan.load(str(tmp_path / "bad.toml"))


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (call, ["nothing"]),
        (call, ["point_umaze", "--report"]),
        (run_module, ["point_umaze", "--processes", "-1"]),
    ],
)
def test_unknown_and_unfinished_studies_end_in_one_line(run, words, tmp_path):
    done = run("study", *words, "--out", tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", [path.stem for path in plan.SHIPPED.glob("*.toml")])
def test_the_studies_that_come_along_can_be_run(name):
    spec = plan.load(name)
    assert len(plan.grid(spec)) == len(spec.seeds) * len(spec.methods) * len(spec.envs)
    assert {"recall_traces", "traces_only"} & spec.methods.keys()


def test_a_study_of_a_map_of_ones_own_is_titled_by_it(tmp_path):
    """And nothing that was published for the usual maze is drawn over it."""
    (tmp_path / "my.txt").write_text("#####\n#S..#\n#####\n")
    (tmp_path / "own.toml").write_text(
        TINY.replace("--iterations 25", f"--iterations 25 --map {tmp_path / 'my.txt'}")
    )
    curve = Curve(np.array([0.0, 50.0, 100.0]), np.array([0.0, 0.2, 0.5]))
    runs = {("point_umaze", "goal_gan"): {0: curve}}
    own, usual = (plan.load(str(path)) for path in (tmp_path / "own.toml", tiny_file(tmp_path)))
    (ax,) = report.draw(own, runs).axes
    assert ax.get_title() == "point_my" and not ax.texts
    (ax,) = report.draw(usual, runs).axes
    assert ax.get_title() == "point_umaze" and len(ax.texts) == 2


def tiny_file(folder):
    (folder / "tiny.toml").write_text(TINY)
    return folder / "tiny.toml"


def test_a_band_by_hand():
    """Each run counts from its first report to its last."""
    curves = [
        Curve(np.array([0.0, 10.0]), np.array([0.0, 1.0])),
        Curve(np.array([0.0, 5.0]), np.array([0.2, 0.4])),
    ]
    found = statistics.band(curves, np.array([-1.0, 0.0, 5.0, 10.0]))
    assert np.isnan(found[0]).all()
    assert found[1:3, 0] == pytest.approx([0.1, 0.45])
    assert found[1, 1] == pytest.approx(0.0) and found[1, 2] == pytest.approx(0.2)
    assert found[3, 0] == 1.0 and np.isnan(found[3, 1:]).all()  # one run has no interval
