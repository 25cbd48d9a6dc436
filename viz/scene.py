"""The 3D scene of a run: the maze, the map on its floor, goals, ways, traces, where a body went.

Each layer is one node that is replaced in place; a frame of a run fills them all.
"""

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.viz.layers import MARK, OF_KIND, OLD_TRACE, PATH, START, TRACE, TRAIL
from goalgan_bt.viz.palette import GOALS, RGB, colours
from goalgan_bt.viz.run import Frame, Run, drawn, floor_of, labels, of_goals, places

REPLAYED, WALL, FLOOR = (190, 190, 190), (105, 110, 120), (45, 48, 54)
FAR_BELOW = np.full((1, 1, 3), -100, dtype=np.float32)  # where a layer with nothing in it is
GROUND = 1.0  # metres from line to line of the ground on which bodies run
FADES = 60  # steps in which a trail grows dim
PIXELS = 16  # per tile of the coverage map
ARROW = 0.32  # metres
WALL_HEIGHT = 0.25  # metres: low, so that no wall hides the map


def tile_image(
    maze: Maze, tiles: FloatArray, rate: FloatArray, all_tiles: int = 0
) -> NDArray[np.uint8]:
    """The coverage map as an RGBA image over the maze's box, top row first.

    Args:
        maze: the layout.
        tiles: (K, 2) centres, metres.
        rate: (K,) success.
        all_tiles: how many there would be on the whole floor, where these are only some.
    """
    rows, columns = maze.free.shape
    side = maze.tile_side(all_tiles or len(tiles))
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
        run: whose maze, or box without walls.
        prefix: name of the node under which all is drawn.
        offset: (x, y) of this run's maze in the scene, metres.
        colour: of a strip under the run's name, where several stand side by side.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        run: Run,
        prefix: str = "/run",
        offset: tuple[float, float] = (0.0, 0.0),
        colour: str | None = None,
    ) -> None:
        self._scene, self._maze, self._prefix, self._kind = server.scene, run.maze, prefix, run.kind
        self._ground = 40.0 if colour is None else 10.0  # metres, beside others less
        box = run.box()
        self._low, self._high = box[:, :2]
        self._first, self._last = drawn(run.maze, box)
        self._scene.add_frame(prefix, show_axes=False, position=(*offset, 0.0))
        self._groups = {
            name: self._scene.add_frame(f"{prefix}/{name}", show_axes=False, visible=layer.shown)
            for name, layer in OF_KIND[run.kind].items()
        }
        if run.kind == "running":
            self.roll(0.0, 0.0)
        elif run.maze is None:
            self._draw_axes(box.shape[1])
        else:
            self._draw_maze(run.maze)
        if colour is not None:
            self._draw_name(run.task_and_method(), colour)

    @property
    def size(self) -> float:
        """The longer side of what is drawn, metres."""
        return float((self._last - self._first).max())

    @property
    def centre(self) -> FloatArray:
        """The middle of what is drawn, (2,), metres."""
        return np.asarray((self._first + self._last) / 2)

    def show(self, layer: str, visible: bool) -> None:
        """Show or hide a layer, if there is such a one."""
        if layer in self._groups:
            self._groups[layer].visible = visible

    def visible(self, layer: str) -> bool:
        """Whether a layer is shown."""
        return layer in self._groups and bool(self._groups[layer].visible)

    def draw(self, frame: Frame) -> None:
        """Fill all layers from a frame; what a frame of an older version lacks stays empty."""
        self._draw_tiles("coverage", frame["test_goals"], floor_of(frame)[0], 0.005)
        if self._kind == "rooms":
            self._draw_policy(frame)
            return
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
        one = goals if len(goals) == 1 else goals[:0]
        self._ring("body", one, radius)
        self._points("body", one, MARK, 0.1, 0.1, "pin")

    def roll(self, x: float, y: float) -> None:
        """Draw the ground under a body that is kept in the middle and is at a place, metres."""
        whole = f"{self._prefix}/ground"
        known = self._scene.get_handle_by_name(whole)
        place = -(x % GROUND), -(y % GROUND), 0.0
        if known is not None:
            known.position = place
            return
        self._scene.add_grid(
            whole,
            width=self._ground,
            height=self._ground,
            cell_size=GROUND,
            cell_color=WALL,
            section_color=WALL,
            position=place,
        )

    def draw_trail(self, places: FloatArray) -> None:
        """Draw where a body went, (T, goal_dim), the last places brightest; none clear it."""
        points, step = segments(places[:, None])
        fade = np.clip(1 - (len(places) - step) / FADES, 0.5, 1)[:, None]
        shade = (np.array(TRAIL) * fade).astype(np.uint8)
        self._lines("body", points, np.repeat(shade[:, None], 2, axis=1), 3.0, "trail")

    def draw_tried(self, goals: FloatArray, reached: BoolArray, ended: BoolArray) -> None:
        """Draw how an attempt at each of many goals, (n, goal_dim), ended, where it has; none
        clear it."""
        self._draw_tiles("tried", goals[ended], reached[ended].astype(float), 0.012, len(goals))

    def draw_ways(self, places: FloatArray, directions: FloatArray) -> None:
        """Draw a field of arrows: where, and in which directions of length 1, each (n, goal_dim);
        none clear it."""
        self._lines("ways", arrows(places, directions), MARK, 1.5)

    def _name(self, layer: str, node: str = "node") -> str:
        return f"{self._prefix}/{layer}/{node}"

    def _draw_maze(self, maze: Maze) -> None:
        width, height = self._last - self._first + 0.08 * self.size
        self._scene.add_box(
            f"{self._prefix}/floor",
            color=FLOOR,
            dimensions=(width, height, 0.02),
            position=(*self.centre, -0.02),
            cast_shadow=False,
            receive_shadow=False,
        )
        for i, box in enumerate(maze.walls()):
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
            f"{self._prefix}/start", radius=0.1, color=START, position=(*maze.start, 0.1)
        )

    def _draw_axes(self, dims: int) -> None:
        """Where there are no walls: the box of the goals and what its two axes are."""
        (x0, y0), (x1, y1) = self._first, self._last
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        points, _ = segments(corners[:, None])
        self._lines("walls", points - np.array([0, 0, 0.25], np.float32), (150, 150, 150), 2.0)
        beyond = 0.05 * self.size
        for axis, (x, y) in enumerate((((x0 + x1) / 2, y0 - beyond), (x0 - beyond, (y0 + y1) / 2))):
            self._label(f"axis{axis}", f"dimension {axis + 1} of {dims}, m", x, y, size=0.03)
            for value in (self._first[axis], self._last[axis]):
                there = (value, y0 - beyond) if axis == 0 else (x0 - beyond, value)
                self._label(f"axis{axis}_{value:.0f}", f"{value:g}", *there, size=0.03)

    def _draw_name(self, name: str, colour: str) -> None:
        """A run's name above its maze, in the colour of its curve."""
        red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
        top = self._last[1] + 0.07 * self.size
        self._scene.add_box(
            f"{self._prefix}/name/strip",
            color=(red, green, blue),
            dimensions=(self._last[0] - self._first[0], 0.035 * self.size, 0.02),
            position=(self.centre[0], top, 0.0),
            cast_shadow=False,
            receive_shadow=False,
        )
        self._label("name/text", name, self.centre[0], top + 0.08 * self.size)

    def _label(self, node: str, text: str, x: float, y: float, size: float = 0.06) -> None:
        """A text at a place, as high as that share of the scene's size."""
        self._scene.add_label(
            f"{self._prefix}/{node}",
            text,
            position=(x, y, 0.0),
            anchor="center-center",
            font_size_mode="scene",
            font_scene_height=size * self.size,
        )

    def _draw_tiles(
        self, layer: str, tiles: FloatArray, rate: FloatArray, height: float, all_tiles: int = 0
    ) -> None:
        """A map as an image of tiles, or as dots where there is no maze; of `all_tiles` tiles these
        are some."""
        if self._maze is None:
            self._points(layer, tiles, colours(rate), 0.14, 0.01)
            return
        width, height_of_map = self._high - self._low
        self._scene.add_image(
            self._name(layer),
            tile_image(self._maze, tiles, rate, all_tiles),
            render_width=float(width),
            render_height=float(height_of_map),
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            position=(*(self._low + self._high) / 2, height),
            wxyz=(0.0, 1.0, 0.0, 0.0),  # viser's images look down; seen from above, y is up
        )

    def _draw_policy(self, frame: Frame) -> None:
        """Where the policy goes from each cell, and the goal."""
        cells, policy = frame["test_goals"], places(frame, "policy", 2)
        fits = policy.shape == cells.shape
        lines = arrows(cells, policy * 2) if fits else np.empty((0, 2, 3), dtype=np.float32)
        self._lines("policy", lines, MARK, 1.5)
        self._ring("policy", frame["goals"][:1], 0.4)

    def _ring(self, layer: str, goals: FloatArray, radius: float) -> None:
        """A circle around each of some goals, (n, goal_dim)."""
        angle = np.linspace(0, 2 * np.pi, 49)
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points, _ = segments(np.swapaxes(goals[:, None, :2] + circle, 0, 1))
        self._lines(layer, points, MARK, 3.0, "goal")

    def _draw_goals(self, frame: Frame) -> None:
        goals, kinds = frame["goals"], labels(frame)
        # Those in walls are told in words: here they would lie on walls, or float beside the maze.
        seen = np.ones(len(goals), bool) if self._maze is None else self._maze.is_free(goals[:, :2])
        old = of_goals(frame, "replayed", np.zeros(len(goals))) > 0
        for label, kind in GOALS.items():
            for node, rows, size in (("new", ~old, 0.07), ("old", old, 0.045)):
                these, name = goals[rows & seen & (kinds == label)], f"{kind.shape}_{node}"
                # They float: a disc that faces the camera would stick in the floor. The rim lets
                # them be seen on any colour.
                self._points("goals", these, kind.rim, size * 1.3, 0.1, name + "_rim", kind.shape)
                self._points("goals", these, kind.fill, size, 0.11, name, kind.shape)

    def _points(
        self,
        layer: str,
        points: FloatArray,
        colour: NDArray[np.uint8] | RGB,
        size: float,
        height: float,
        node: str = "node",
        shape: Any = "circle",
    ) -> None:
        places = on_floor(points, height)
        if not len(places):  # the page wants as many colours as points, and one of each
            places, colour = FAR_BELOW[0], np.zeros((1, 3), dtype=np.uint8)
        self._scene.add_point_cloud(
            self._name(layer, node),
            places,
            colour,
            point_size=size,
            point_shape=shape,
            point_shading="flat",
            precision="float32",
        )

    def _lines(
        self,
        layer: str,
        points: NDArray[np.float32],
        colour: NDArray[np.uint8] | RGB,
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
    camera.position = (centre[0], centre[1] - 0.4 * size, 0.97 * size)
    camera.look_at = (centre[0], centre[1], 0.0)
