"""A run as one HTML page that plays without a server: `python -m goalgan_bt.viz RUN --export`."""

import contextlib
import io
import json
import math
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import viser
from rich.progress import track
from viser.infra import StateSerializer

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.files import write_atomically
from goalgan_bt.runs.terminal import complain
from goalgan_bt.viz.body import Bodies
from goalgan_bt.viz.captions import caption, settings_rows, state
from goalgan_bt.viz.curves import PLOTS, levels, series
from goalgan_bt.viz.layers import OF_KIND, legend
from goalgan_bt.viz.palette import RUNS
from goalgan_bt.viz.player import Player
from goalgan_bt.viz.run import Frame, Run, places
from goalgan_bt.viz.scene import Scene, look_at
from goalgan_bt.viz.server import start_server

MOST_REPORTS = 300
LENGTH = 30.0  # seconds in which all reports pass
TRACES, PATHS = 24, 12  # lines of each kind that are kept of a frame
GOALS = 4  # to which the last policy goes at the end


def export(run: Run, path: Path) -> None:
    """Write the page.

    Args:
        run: its reports, at most 300 of them, evenly spread, and its last policy are shown.
        path: the HTML file.

    Raises:
        RunError: if the run holds no report.
        OSError: if the file cannot be written.
    """
    if run.kind == "running":
        raise RunError(f"{run.folder} is a run of locomotion: it has no map to export")
    if not run.iterations:
        raise RunError(f"{run.folder} holds no report yet: wait for its first one")
    server = start_server("127.0.0.1", 0)
    try:
        scene = Scene(server, run)
        look_at(server.initial_camera, scene.centre, scene.size)
        picks = np.linspace(0, len(run.iterations) - 1, min(len(run.iterations), MOST_REPORTS))
        pause = float(np.clip(LENGTH / len(picks), 0.1, 1.0))
        recording = server.get_scene_serializer()
        reports, time = [], 0.0
        for i in track(picks.round().astype(int), "export", transient=True):
            frame = run.frame(run.iterations[i])
            if frame is None:
                complain(f"report {run.iterations[i]} of {run.folder} is damaged", "warning")
                continue
            scene.draw(_smaller(frame))
            steps = run.metrics.at(run.iterations[i], "steps/train") / 1e6
            text = caption(run, run.iterations[i]).replace("**", "")
            reports.append({"time": time, "steps": _known(steps) or 0.0, "text": text})
            recording.insert_sleep(pause)
            time += pause
        if not reports:
            raise RunError(f"{run.folder} holds no report that can be read")
        for seconds, words in _last_policy(run, server, scene, recording):
            reports.append({"time": time, "steps": reports[-1]["steps"], "text": words})
            time += seconds
        html = recording.as_html()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it stops
            server.stop()
    text = json.dumps(_beside(run) | {"reports": reports, "scene": html}, allow_nan=False)
    page = resources.files("goalgan_bt.viz").joinpath("export.html").read_text(encoding="utf-8")
    page = page.replace("RUN</script>", text.replace("<", "\\u003c") + "</script>", 1)
    write_atomically(path, lambda file: file.write(page.encode()))


def _last_policy(
    run: Run, server: viser.ViserServer, scene: Scene, recording: StateSerializer
) -> Iterator[tuple[float, str]]:
    """Let the last policy go to some goals; yields the seconds and the caption of each."""
    try:
        player = Player(run.folder)
    except (OSError, ValueError):
        return
    if not player.take_newest():
        return
    bodies = Bodies(server, player.model)
    goals = player.env.test_goals()
    for row in np.linspace(0, len(goals) - 1, GOALS).round().astype(int):
        goal = goals[row : row + 1]
        attempt = player.attempt(goal)
        scene.mark(goal, player.env.success_radius)
        every = max(1, round(1 / 12 / attempt.dt))  # 12 pictures per second
        seconds = 0.0
        for states in attempt.states[::every]:
            bodies.draw(states)
            recording.insert_sleep(every * attempt.dt)
            seconds += every * attempt.dt
        x, y = goal[0, :2]
        yield seconds, f"The last policy goes to ({x:.1f}, {y:.1f}): {attempt.outcome(0)}"


def _smaller(frame: Frame) -> Frame:
    """A frame with fewer lines, in centimetres."""
    small = dict(frame)
    for name, most in (("traces", TRACES), ("paths", PATHS)):
        if name in frame:
            small[name] = places(frame, name, 3)[:, :most].round(2)
    return small


def _beside(run: Run) -> dict[str, Any]:
    """What stands beside the scene."""
    plots = []
    for plot in PLOTS[run.kind]:
        steps, *values = series(run, plot)
        curves = [
            {"name": name, "colour": colour, "y": [_known(y) for y in column]}
            for (_, name), colour, column in zip(plot.curves, RUNS, values, strict=False)
        ]
        lines = [{"name": name, "y": y} for name, y in levels(run, plot)]
        plots.append({"title": plot.title, "share": plot.share, "curves": curves, "levels": lines})
    return {
        "name": run.name,
        "state": state(run),
        "legend": legend(run.kind),
        "about": [(layer.label, layer.hint) for layer in OF_KIND[run.kind].values()],
        "settings": settings_rows(run.settings),
        "steps": [_known(x) or 0.0 for x in steps],
        "plots": plots,
    }


def _known(x: float) -> float | None:
    """A number as JSON has it: four digits, null where it is not known."""
    return float(f"{x:.4g}") if math.isfinite(x) else None
