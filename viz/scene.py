"""The 3D scene: the maze, the coverage map on its floor, goals, recall traces, paths.

Each layer is one node that is replaced in place; a frame of a run fills them all.
"""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from goalgan_bt.envs.maze import FloatArray, Maze
from goalgan_bt.viz.run import Frame, drawn, labels, of_goals, places, success

# Red (never reached) over pale yellow to blue (mastered): ColorBrewer's RdYlBu, made to be told
# apart by colour-blind people.
STOPS = np.array(
    [[165, 0, 38], [244, 109, 67], [254, 224, 144], [171, 217, 233], [69, 117, 180], [49, 54, 149]]
)
TOO_HARD, INTERMEDIATE, TOO_EASY, REPLAYED = (
    (214, 39, 40),
    (255, 255, 255),
    (31, 119, 180),
    (120, 120, 120),
)
TRACE, OLD_TRACE = (255, 150, 0), (25, 12, 12)  # at the goal, and farthest back
PATH, MARK = (90, 90, 100), (255, 0, 170)
WALL, FLOOR, START = (105, 110, 120), (45, 48, 54), (255, 255, 255)
FAR_BELOW = np.full((1, 1, 3), -100, dtype=np.float32)  # where a layer with nothing in it is
PIXELS = 16  # per tile of the coverage map
ARROW = 0.32  # metres
WALL_HEIGHT = 0.35  # metres: low, so that no wall hides the map

# name: (label in the panel, what one is looking at, shown at first)
LAYERS = {
    "coverage": (
        "Coverage map",
        "The floor: how often the policy reaches each 0.5 m tile from the start. Measured where "
        "the caption says so, otherwise the learner's own estimate from its recent episodes.",
        True,
    ),
    "goals": (
        "Goals",
        "What the policy trains on now: imagined by the GAN, white of intermediate difficulty, "
        "blue too easy, red too hard; remembered ones are smaller.",
        True,
    ),
    "traces": (
        "Recall traces",
        "Imagined by the backtracking model: bright at the goal, fading backward in time.",
        True,
    ),
    "ways": (
        "Recalled ways",
        "Which way leads from each place to the goal that the body goes for, as the backtracking "
        "model over places recalls it. The policy sees that direction.",
        True,
    ),
    "paths": ("Paths", "Where some of the last training episodes went.", False),
    "replay": (
        "Replay memory",
        "Every goal that once was of intermediate difficulty; some are tried again.",
        False,
    ),
    "walls": ("Walls", "The maze, drawn low so that it hides nothing.", True),
    "body": ("Body", "The newest policy on its way to a goal, at real speed, over and over.", True),
}


def colours(rate: FloatArray) -> NDArray[np.uint8]:
    """Success in [0, 1], (...), as RGB (..., 3); grey where it is not known."""
    rate = np.asarray(rate, dtype=float)
    stops = np.linspace(0, 1, len(STOPS))
    rgb = np.stack([np.interp(rate, stops, channel) for channel in STOPS.T], axis=-1)
    rgb[~np.isfinite(rate)] = 150
    return rgb.round().astype(np.uint8)


def tile_image(maze: Maze, tiles: FloatArray, rate: FloatArray) -> NDArray[np.uint8]:
    """The coverage map as an RGBA image over the maze's box, top row first.

    Args:
        maze: the layout.
        tiles: (K, 2) centres, metres.
        rate: (K,) success.
    """
    rows, columns = maze.free.shape
    side = maze.tile_side(len(tiles))
    per_cell = round(maze.cell_size / side)
    image = np.zeros((rows * per_cell, PIXELS, columns * per_cell, PIXELS, 4), dtype=np.uint8)
    index = np.floor((tiles - maze.low) / side).astype(int)
    c = np.clip(index[:, 0], 0, columns * per_cell - 1)
    r = np.clip(rows * per_cell - 1 - index[:, 1], 0, rows * per_cell - 1)
    edge = slice(1, None)  # a hairline between the tiles
    for row, column, colour in zip(r, c, colours(rate), strict=True):
        image[row, edge, column, edge, :3], image[row, edge, column, edge, 3] = colour, 255
    return image.reshape(rows * per_cell * PIXELS, columns * per_cell * PIXELS, 4)


def on_floor(points: FloatArray, height: float) -> NDArray[np.float32]:
    """Goals (..., goal_dim) as places in the scene (..., 3): their first two components."""
    out = np.full((*points.shape[:-1], 3), height, dtype=np.float32)
    out[..., :2] = points[..., :2]
    return out


def segments(lines: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Lines (L, n, goal_dim) with NaN gaps as segments.

    Returns:
        (S, 2, 3) points, and (S,) the step of the line at which each begins.
    """
    lines = on_floor(np.asarray(lines, dtype=np.float32), 0.05)
    both = np.stack([lines[:-1], lines[1:]], axis=2)  # (L - 1, n, 2, 3)
    step = np.broadcast_to(np.arange(max(len(lines) - 1, 0))[:, None], both.shape[:2])
    whole = np.isfinite(both).all(axis=(2, 3))
    return both[whole], step[whole]


def arrows(places: FloatArray, directions: FloatArray) -> NDArray[np.float32]:
    """Arrows with their middle on places as segments, (3 n, 2, 3).

    Args:
        places: (n, goal_dim) metres.
        directions: (n, goal_dim); an arrow is as long as it is here, times `ARROW`.
    """
    ahead = ARROW * np.asarray(directions, dtype=float)[:, :2]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    tip = np.asarray(places, dtype=float)[:, :2] + ahead / 2
    tails = tip - ahead, tip - 0.35 * ahead + 0.2 * left, tip - 0.35 * ahead - 0.2 * left
    lines = [np.stack([tail, tip], axis=1) for tail in tails]
    return on_floor(np.concatenate(lines), 0.04)


class Scene:
    """The layers of one run in a viser scene.

    Args:
        server: whose scene it is.
        maze: the layout, or None where there are no walls.
        box: (2, goal_dim) low and high corner of the goals.
        prefix: name of the node under which all is drawn.
        offset: (x, y) of this run's maze in the scene, metres.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        maze: Maze | None,
        box: FloatArray,
        prefix: str = "/run",
        offset: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._scene, self._maze, self._prefix = server.scene, maze, prefix
        self._low, self._high = np.asarray(box)[:, :2]
        self._first, self._last = drawn(maze, box)
        self._scene.add_frame(prefix, show_axes=False, position=(*offset, 0.0))
        self._groups = {
            name: self._scene.add_frame(f"{prefix}/{name}", show_axes=False, visible=shown)
            for name, (_, _, shown) in LAYERS.items()
        }
        self._draw_maze()

    @property
    def size(self) -> float:
        """The longer side of what is drawn, metres."""
        return float((self._last - self._first).max())

    @property
    def centre(self) -> FloatArray:
        """The middle of what is drawn, (2,), metres."""
        return np.asarray((self._first + self._last) / 2)

    def show(self, layer: str, visible: bool) -> None:
        """Show or hide a layer."""
        self._groups[layer].visible = visible

    def visible(self, layer: str) -> bool:
        """Whether a layer is shown."""
        return bool(self._groups[layer].visible)

    def draw(self, frame: Frame) -> None:
        """Fill all layers from a frame; what a frame of an older version lacks stays empty."""
        rate, _ = success(frame)
        self._draw_coverage(frame["test_goals"], rate)
        self._draw_goals(frame)
        self._points("replay", places(frame, "replay", 2), REPLAYED, 0.012, 0.03)
        traces = places(frame, "traces", 3)
        points, step = segments(traces)
        fade = (1 - step / max(1, len(traces) - 2))[:, None]
        shade = (OLD_TRACE + np.subtract(TRACE, OLD_TRACE) * fade).astype(np.uint8)
        self._lines("traces", points, np.repeat(shade[:, None], 2, axis=1), 2.5)
        points, _ = segments(places(frame, "paths", 3))
        self._lines("paths", points, PATH, 1.0)

    def mark(self, goals: FloatArray, radius: float) -> None:
        """Draw a ring of that radius around a goal, (1, goal_dim); none around many."""
        angle = np.linspace(0, 2 * np.pi, 49)
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        few = goals[:1, None, :2] if len(goals) == 1 else np.empty((0, 1, 2))
        points, _ = segments(np.swapaxes(few + circle, 0, 1))
        self._lines("body", points, MARK, 3.0, "goal")

    def draw_ways(self, places: FloatArray, directions: FloatArray) -> None:
        """Draw a field of arrows: where, and in which directions of length 1, each (n, goal_dim);
        none clear it."""
        self._lines("ways", arrows(places, directions), MARK, 1.5)

    def _name(self, layer: str, node: str = "node") -> str:
        return f"{self._prefix}/{layer}/{node}"

    def _draw_maze(self) -> None:
        width, height = self._last - self._first + 0.08 * self.size
        self._scene.add_box(
            f"{self._prefix}/floor",
            color=FLOOR,
            dimensions=(width, height, 0.02),
            position=(*self.centre, -0.02),
            cast_shadow=False,
            receive_shadow=False,
        )
        boxes: Sequence[FloatArray] = [] if self._maze is None else list(self._maze.walls())
        for i, box in enumerate(boxes):
            x0, y0 = np.maximum(box[:2], self._first)
            x1, y1 = np.minimum(box[2:], self._last)
            self._scene.add_box(
                self._name("walls", str(i)),
                color=WALL,
                dimensions=(x1 - x0, y1 - y0, WALL_HEIGHT),
                position=((x0 + x1) / 2, (y0 + y1) / 2, WALL_HEIGHT / 2),
                cast_shadow=False,
                receive_shadow=False,
            )
        self._scene.add_icosphere(
            f"{self._prefix}/start", radius=0.1, color=START, position=(0.0, 0.0, 0.1)
        )

    def _draw_coverage(self, tiles: FloatArray, rate: FloatArray) -> None:
        if self._maze is None:
            self._points("coverage", tiles, colours(rate), 0.14, 0.01)
            return
        width, height = self._high - self._low
        self._scene.add_image(
            self._name("coverage"),
            tile_image(self._maze, tiles, rate),
            render_width=float(width),
            render_height=float(height),
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            position=(*(self._low + self._high) / 2, 0.005),
            wxyz=(0.0, 1.0, 0.0, 0.0),  # viser's images look down; seen from above, y is up
        )

    def _draw_goals(self, frame: Frame) -> None:
        goals = frame["goals"]
        shade = np.array([TOO_HARD, INTERMEDIATE, TOO_EASY], dtype=np.uint8)[labels(frame) + 1]
        old = of_goals(frame, "replayed", np.zeros(len(goals))) > 0
        for node, rows, size in (("new", ~old, 0.09), ("old", old, 0.05)):
            # A dark rim, so that white goals are seen on a pale floor.
            # They float: a disc that faces the camera would stick in the floor.
            self._points("goals", goals[rows], (20, 20, 20), size * 1.3, 0.1, node + "_rim")
            self._points("goals", goals[rows], shade[rows], size, 0.11, node)

    def _points(
        self,
        layer: str,
        points: FloatArray,
        colour: NDArray[np.uint8] | tuple[int, int, int],
        size: float,
        height: float,
        node: str = "node",
    ) -> None:
        places = on_floor(points, height)
        if not len(places):  # the page wants as many colours as points, and one of each
            places, colour = FAR_BELOW[0], np.zeros((1, 3), dtype=np.uint8)
        self._scene.add_point_cloud(
            self._name(layer, node),
            places,
            colour,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _lines(
        self,
        layer: str,
        points: NDArray[np.float32],
        colour: NDArray[np.uint8] | tuple[int, int, int],
        width: float,
        node: str = "node",
    ) -> None:
        if not len(points):
            points, colour = FAR_BELOW.repeat(2, axis=1), np.zeros((1, 2, 3), dtype=np.uint8)
        self._scene.add_line_segments(
            self._name(layer, node),
            points,
            colour,
            thickness=width,
            thickness_units="screen",
        )


def look_at(
    camera: viser.InitialCameraConfig | viser.CameraHandle, centre: FloatArray, size: float
) -> None:
    """Put a camera where a square of the floor is seen: its middle, (2,), and side, metres."""
    camera.position = (centre[0], centre[1] - 0.5 * size, 0.92 * size)
    camera.look_at = (centre[0], centre[1], 0.0)


def legend() -> str:
    """The colours of the map as HTML."""
    stops = ", ".join(
        f"rgb({r},{g},{b}) {100 * i / (len(STOPS) - 1):.0f}%" for i, (r, g, b) in enumerate(STOPS)
    )
    dot = "display:inline-block;width:10px;height:10px;border-radius:5px;border:1px solid #333"
    dots = " ".join(
        f'<span style="white-space:nowrap"><span style="{dot};background:rgb{colour}"></span> '
        f"{text}</span>&nbsp;"
        for text, colour in (
            ("too hard", TOO_HARD),
            ("intermediate", INTERMEDIATE),
            ("too easy", TOO_EASY),
        )
    )
    return (
        '<div style="font-size:12px;padding:4px 12px"><div style="display:flex;gap:8px;'
        'align-items:center"><span>never</span>'
        f'<div style="flex:1;height:10px;border-radius:5px;background:linear-gradient(90deg,'
        f'{stops})"></div><span>always reached</span></div><div style="margin-top:4px">{dots}'
        "</div></div>"
    )
