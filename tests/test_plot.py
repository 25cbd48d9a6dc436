import json
import shutil

import matplotlib.image
import pytest
from conftest import call, run_module

from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.viz import pictures
from goalgan_bt.viz.pictures import _title
from goalgan_bt.viz.run import Run


def plot(*arguments):
    return call("plot", *arguments)


def test_a_run_becomes_a_picture(folder, tmp_path):
    done = run_module("plot", folder, "--out", tmp_path / "c.png")
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert done.stdout == f"{tmp_path / 'c.png'}\n"
    pixels = matplotlib.image.imread(tmp_path / "c.png")
    assert min(pixels.shape[:2]) > 400
    assert len({tuple(p) for p in (pixels[::7, ::7, :3].reshape(-1, 3) * 255).astype(int)}) > 20


def test_the_maps_tiles_fill_the_free_cells(folder):
    figure = pictures.overview([folder], maps=2)
    ax = figure.axes[0]
    assert len(ax.patches) == 112
    assert ax.get_ylabel() == "point_umaze\nrecall_traces\ns0"  # what run it is
    assert ax.patches[0].get_width() == pytest.approx(0.5)


def test_maps_of_chosen_iterations(folder, tmp_path):
    (folder / "frames/000003.npz").unlink()  # reports may be every few iterations
    chosen = [f.stem for f in pictures.frames_at(folder, (3, 2, 4))]
    assert chosen == ["000002", "000002", "000004"]
    titles = [ax.get_title() for ax in pictures.overview([folder], at=(2, 4)).axes]
    assert titles[0].startswith("iteration 2: ") and titles[1].startswith("iteration 4: ")
    done = plot(folder, "--at", 1, 2, "--out", tmp_path / "c.png")
    assert done.returncode == 0, done.stderr
    assert plot(folder, "--at", 0).returncode == 2
    done = plot(folder, "--at", 99999)
    assert done.returncode == 2 and "has no report of iteration 99999: its last is 4" in done.stderr


def test_a_run_in_a_map_of_its_own_is_called_by_it(folder):
    settings = json.loads((folder / "config.json").read_text())
    assert _title(Run(folder)) == "point_umaze recall_traces s0"
    (folder / "config.json").write_text(json.dumps(settings | {"map": "/somewhere/my_$maze.txt"}))
    assert _title(Run(folder)) == r"point_my_\$maze recall_traces s0"
    assert plot(folder).returncode == 0


def test_runs_of_any_name_can_be_drawn(folder, tmp_path):
    """Also those for which nothing was ever published, and several together."""
    other = tmp_path / "ant_spiral-test"
    shutil.copytree(folder, other)
    done = plot(other, folder, "--out", tmp_path / "c.png")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("damage", ["frames", "meta", "metrics"])
def test_damaged_runs_are_one_line(folder, tmp_path, damage):
    other = tmp_path / "point_umaze-damaged"
    shutil.copytree(folder, other)
    if damage == "frames":
        frame = frame_paths(other)[1]
        frame.write_bytes(frame.read_bytes()[:100])
    elif damage == "meta":
        (other / "meta.json").write_text("{}")
    else:
        (other / "metrics.csv").write_bytes(bytes(range(256)))
    done = plot(other, *(["--at", 2] if damage == "frames" else []))
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr


@pytest.mark.parametrize(("run", "where"), [(run_module, "nowhere"), (call, ".")])
def test_a_folder_that_is_no_run_is_one_line(run, where, tmp_path):
    done = run("plot", tmp_path / where)
    assert done.returncode == 2
    assert "is no run" in done.stderr and len(done.stderr.strip().splitlines()) == 1
