"""The map of a run as it grows, as a GIF or MP4: `python -m goalgan_bt.viz RUN --movie out.gif`."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray
from rich.progress import track

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.viz import pictures, video

PICTURES = 100  # of the run, evenly spread over its reports
PER_SECOND = 10
HOLD = 25  # times that the last picture is shown


def movie(folder: Path, path: Path) -> None:
    """Draw the map beside the curve, report by report.

    Args:
        folder: the run; it must have a maze.
        path: an .mp4 file, which needs the extra `movie`, or a .gif.

    Raises:
        RunError: if the run has no maze or no report.
        OSError: if the file cannot be written.
    """
    frames = frame_paths(folder)
    if not frames:
        raise RunError(f"{folder} holds no report yet: wait for its first one")
    picks = np.unique(np.linspace(0, len(frames) - 1, PICTURES).round().astype(int))
    images = [_picture(folder, frames[i]) for i in track(picks, "movie", transient=True)]
    images += [images[-1]] * HOLD
    video.save(images, path, PER_SECOND)


def _picture(folder: Path, frame: Path) -> NDArray[np.uint8]:
    """One report, (height, width, 3)."""
    layout = ConstrainedLayoutEngine(rect=(0, 0, 1, 0.97))  # room for the map's title
    figure = Figure(figsize=(9, 4), dpi=90, layout=layout)  # MP4 wants even sides
    canvas = FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.2])
    image = pictures.coverage_map(left, folder, frame, goals=16)
    if left.get_legend_handles_labels()[0]:  # goals; four rooms show none
        low = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.01)}
        left.legend(fontsize=7, ncols=3, frameon=False, **low)
    run = pictures.measured(folder)
    figure.colorbar(image, ax=left, label=pictures.SCALE[run.run.kind], shrink=0.8)
    pictures.curve(right, [run], until=int(frame.stem))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
