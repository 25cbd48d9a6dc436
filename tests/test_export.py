"""A run as one page and as a movie."""

import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest
from conftest import call, run_module

from goalgan_bt.runs import run_folder
from goalgan_bt.viz.export import export
from goalgan_bt.viz.run import Run


def island(page):
    """The data in an exported page."""
    text = page.read_text()
    begin = text.index('<script type="application/json" id="run">')
    return json.loads(text[text.index(">", begin) + 1 : text.index("</script>", begin)])


def test_a_page_holds_the_whole_run(folder, tmp_path):
    out = tmp_path / "run.html"
    done = run_module("viz", folder, "--export", out)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[-1].startswith(str(out))
    run = island(out)
    reports = [r["text"] for r in run["reports"]]
    assert [text.split(" · ")[0] for text in reports[:4]] == [
        f"Iteration {i}" for i in (1, 2, 3, 4)
    ]
    assert all("The last policy goes to" in text for text in reports[4:]) and len(reports) == 8
    times = [r["time"] for r in run["reports"]]
    assert times == sorted(times) and times[0] == 0
    measured = run["plots"][0]["curves"][0]["y"]
    assert measured[-1] == pytest.approx(Run(folder).metrics.column("eval/coverage")[-1], abs=1e-3)
    assert [level["y"] for level in run["plots"][0]["levels"]] == [0.78, 0.96]
    assert ["env", "point_umaze"] in run["settings"]
    assert "__VISER_EMBED_DATA__" in run["scene"]


def test_names_in_a_run_folder_are_text_not_html(folder, tmp_path):
    evil = folder.rename(tmp_path / "a<!--<script>x")
    config = json.loads((evil / "config.json").read_text())
    config["env"] = "</script><script>alert(1)</script>"
    (evil / "config.json").write_text(json.dumps(config))
    out = tmp_path / "run.html"
    export(Run(evil), out)
    assert "</script><script>alert" not in out.read_text()
    assert out.read_text().count("</script>") == 2
    assert island(out)["name"] == evil.name
    assert ["env", config["env"]] in island(out)["settings"]


def test_a_run_without_a_policy_is_exported_without_its_episodes(folder, tmp_path):
    (folder / "checkpoint.pt").unlink()
    (folder / "frames/000002.npz").write_bytes(b"half")
    export(Run(folder), tmp_path / "run.html")
    texts = [r["text"] for r in island(tmp_path / "run.html")["reports"]]
    assert [text.split(" · ")[0] for text in texts] == ["Iteration 1", "Iteration 3", "Iteration 4"]


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_a_movie_shows_every_report_and_holds_the_last(folder, tmp_path, kind):
    out = tmp_path / f"map.{kind}"
    done = call("viz", folder, "--movie", out)
    assert done.returncode == 0, done.stderr
    pictures = iio.imread(out).astype(int)
    assert pictures.shape[0] >= 4 and pictures.shape[3] == 3
    if kind == "mp4":
        assert len(pictures) == 4 + 25
        assert np.abs(pictures[-1] - pictures[4]).mean() < 2
    assert np.abs(pictures[0] - pictures[-1]).mean() > 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--export", "nowhere/run.html"], "cannot write"),
        (["--export", "run.txt"], "must end in .html"),
        (["--export", "."], "must end in .html"),
        (["--movie", "map.avi"], ".gif or .mp4"),
        (["--movie", "nowhere/map.gif"], "cannot write"),
    ],
)
def test_what_cannot_be_written_is_one_line(folder, tmp_path, flags, message):
    done = call("viz", folder, flags[0], tmp_path / flags[1])
    assert done.returncode == 2 and message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.glob("map*")) and not list(tmp_path.glob("*.part"))


def test_a_run_without_a_report_or_a_maze_is_refused(folder, tmp_path):
    shutil.rmtree(folder / "frames")
    for flags in (["--export", "run.html"], ["--movie", "map.gif"]):
        done = call("viz", folder, flags[0], tmp_path / flags[1])
        assert done.returncode == 2 and "holds no report yet" in done.stderr
    other = shutil.copytree(folder, tmp_path / "other")
    done = call("viz", folder, other, "--export", tmp_path / "run.html")
    assert done.returncode == 2 and "name only one" in done.stderr


def test_a_run_without_walls_is_exported_too(folder, tmp_path):
    run_folder.write_meta(folder, None)
    export(Run(folder), tmp_path / "run.html")
    assert len(island(tmp_path / "run.html")["reports"]) == 8
    done = call("viz", folder, "--movie", tmp_path / "map.gif")
    assert done.returncode == 2 and "no maze to draw" in done.stderr
