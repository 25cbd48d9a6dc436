import json
import re
import shutil

import matplotlib.image
import pytest
from conftest import call, run_module

from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.run_folder import runs_in
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
    assert titles[0].startswith("iteration 2\n") and titles[1].startswith("iteration 4\n")
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


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_figures_for_print_have_their_size(folder, tmp_path, kind):
    path = tmp_path / f"figure.{kind}"
    done = plot(folder, "--out", path, "--width", 85, "--maps", 2)
    assert done.returncode == 0, done.stderr
    data = path.read_bytes()
    if kind == "png":
        assert matplotlib.image.imread(path).shape[1] == pytest.approx(85 / 25.4 * 600, abs=2)
    elif kind == "svg":  # points, and letters that can be changed
        width = float(re.search(rb'width="([\d.]+)pt"', data)[1])
        assert width == pytest.approx(85 / 25.4 * 72, abs=0.1) and b"<text" in data
    else:
        box = [float(x) for x in re.search(rb"/MediaBox \[([^]]*)\]", data)[1].split()]
        assert box[2] == pytest.approx(85 / 25.4 * 72, abs=0.1)


def test_other_kinds_of_pictures_are_refused(folder, tmp_path):
    done = plot(folder, "--out", tmp_path / "figure.jpg")
    assert done.returncode == 2 and ".png or .svg or .pdf" in done.stderr
    done = plot(folder, "--width", 3)
    assert done.returncode == 2 and "--width must be between 60 and 1000" in done.stderr


def several(folder, out, methods, seeds):
    """Copies of a run as runs of those methods and seeds, each with other figures."""
    for method in methods:
        for seed in range(seeds):
            copy = shutil.copytree(folder, out / f"{method}-s{seed}")
            settings = json.loads((copy / "config.json").read_text())
            (copy / "config.json").write_text(
                json.dumps(settings | {"method": method, "seed": seed})
            )
            table = (copy / "metrics.csv").read_text().splitlines()
            column = table[0].split(",").index("eval/coverage")
            rows = [line.split(",") for line in table[1:]]
            for row in rows:
                row[column] = row[column] and str(0.1 * seed)
            (copy / "metrics.csv").write_text("\n".join([table[0], *map(",".join, rows)]) + "\n")
    return out


def test_many_runs_are_a_line_per_method_with_its_interval(folder, tmp_path):
    out = several(folder, tmp_path / "runs", ("recall_traces", "uniform"), 5)
    figure = pictures.overview(runs_in([out]), maps=2)
    curves = next(ax for ax in figure.axes if ax.get_xlabel())
    named = [line.get_label() for line in curves.lines]
    assert named[:2] == ["recall_traces (5 seeds)", "uniform (5 seeds)"]
    assert curves.lines[0].get_ydata() == pytest.approx(0.2)  # the middle of five seeds
    assert len(curves.collections) == 2 and curves.get_title() == "point_umaze"
    rows = {ax.get_ylabel() for ax in figure.axes if ax.patches and ax.get_ylabel()}
    assert rows == {"point_umaze\nrecall_traces\ns0", "point_umaze\nuniform\ns0"}


def test_few_runs_of_a_folder_have_a_line_each(folder, tmp_path):
    out = several(folder, tmp_path / "runs", ("recall_traces", "uniform"), 2)
    curves = next(ax for ax in pictures.overview(runs_in([out])).axes if ax.get_xlabel())
    assert len([line for line in curves.lines if "published" not in line.get_label()]) >= 4


def test_a_seed_that_ended_early_does_not_cut_the_others_off(folder, tmp_path):
    out = several(folder, tmp_path / "runs", ("recall_traces",), 7)
    early = out / "recall_traces-s6/metrics.csv"
    early.write_text("".join(early.read_text().splitlines(keepends=True)[:3]))
    figure = pictures.overview(runs_in([out]), maps=2)
    curves = next(ax for ax in figure.axes if ax.get_xlabel())
    steps = Run(folder).metrics.column("steps/train")
    assert curves.lines[0].get_xdata()[-1] == steps[-1]
    assert curves.lines[0].get_ydata()[-1] == pytest.approx(0.25)  # of six seeds, 0 to 0.5


def test_runs_without_a_report_are_left_out_and_told(folder, tmp_path, capsys):
    out = several(folder, tmp_path / "runs", ("recall_traces", "uniform"), 1)
    shutil.rmtree(out / "uniform-s0/frames")
    for name in ("metrics.csv", "frames"):
        path = shutil.copytree(folder, out / f"without-{name}") / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    done = run_module("plot", out, "--out", tmp_path / "c.png")
    assert done.returncode == 0, done.stderr
    done = run_module("plot", out / "without-frames", "--out", tmp_path / "d.png")
    assert done.returncode == 2 and "no report yet" in done.stderr


def test_more_than_six_runs_are_grouped_whatever_their_methods(folder, tmp_path):
    out = several(folder, tmp_path / "runs", tuple("abcdefg"), 1)
    curves = next(ax for ax in pictures.overview(runs_in([out])).axes if ax.get_xlabel())
    assert curves.get_title() == "point_umaze" and len(curves.collections) == 7


def test_coverage_and_return_have_a_panel_each(folder, tmp_path):
    hopper = tmp_path / "hopper"
    hopper.mkdir()
    (hopper / "config.json").write_text('{"env": "hopper", "method": "trpo", "seed": 0}')
    (hopper / "meta.json").write_text('{"commit": "x", "maze": null}')
    (hopper / "metrics.csv").write_text("iteration,steps/train,eval/return\n1,100,5\n2,200,7\n")
    panels = [ax for ax in pictures.overview([folder, hopper]).axes if ax.get_xlabel()]
    assert [ax.get_ylabel() for ax in panels] == ["coverage", "return"]
