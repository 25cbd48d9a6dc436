"""The README's picture: coverage maps over a run, and the trained Ant on its way through the maze.

    MUJOCO_GL=osmesa python benchmarks/picture.py runs/ant_umaze-... docs/ant_umaze.png

Rendering needs one of MuJoCo's offscreen backends (egl, osmesa or glfw).
"""

import sys
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure

from goalgan_bt.viz import pictures
from goalgan_bt.viz.player import Player


def walk(folder: Path, goal: tuple[float, float], every: int) -> np.ndarray:
    """The Ant at several moments of one deterministic episode, in one image from above."""
    player = Player(folder)
    if not player.take_newest():
        raise SystemExit(f"error: {folder} has no policy to show")
    states = player.attempt(np.array([goal]), deterministic=True).states[:, 0]
    poses = [*states[: -every // 2 : every], states[-1]]

    model = player.model
    model.vis.global_.offwidth = model.vis.global_.offheight = 900
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = [2, 2, 0], 12
    camera.elevation, camera.azimuth = -70, 90
    with mujoco.Renderer(model, 900, 900, max_geom=2000) as renderer:
        for i, state in enumerate(poses):
            data.qpos[:] = state[: model.nq]
            mujoco.mj_forward(model, data)
            if i == 0:
                renderer.update_scene(data, camera)
            else:  # one more Ant in the same scene
                mujoco.mjv_addGeoms(
                    model,
                    data,
                    mujoco.MjvOption(),
                    mujoco.MjvPerturb(),
                    mujoco.mjtCatBit.mjCAT_DYNAMIC,
                    renderer.scene,
                )
        return renderer.render()


def main() -> None:
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    frames = pictures.measured_frames(folder)
    picks = np.unique(np.linspace(0, len(frames) - 1, 4).round().astype(int))
    figure = Figure(figsize=(13, 3.1), layout="constrained")
    axes = figure.subplots(1, 5)
    for ax, pick in zip(axes, picks, strict=False):
        image = pictures.coverage_map(ax, folder, frames[pick])
    axes[0].legend(fontsize=6, loc="upper left")
    figure.colorbar(image, ax=axes[3], label="success", shrink=0.8)
    axes[4].imshow(walk(folder, (4.0, 2.0), every=50))
    axes[4].set_axis_off()
    axes[4].set_title("an episode, every 2 s", fontsize=9)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
