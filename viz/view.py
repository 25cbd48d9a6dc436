"""The live view: a viser page over one or several run folders.

One thread, the one that calls `View.spin`, reads the runs and writes the scene. What happens in a
browser only puts a request into a queue; nothing that comes from there becomes a path or code.
"""

import contextlib
import math
import queue
import threading
import time
from functools import partial
from typing import Any

import numpy as np
import viser

from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.runs.terminal import complain
from goalgan_bt.viz.body import Bodies
from goalgan_bt.viz.captions import caption, plain, settings_table, state
from goalgan_bt.viz.curves import Curves
from goalgan_bt.viz.download import Export, as_csv
from goalgan_bt.viz.player import Attempt, Player
from goalgan_bt.viz.run import Frame, Run, drawn
from goalgan_bt.viz.scene import LAYERS, Scene, legend, look_at
from goalgan_bt.viz.server import start_server

LOOK_EVERY = 1.0  # seconds between two looks at the run folders
TICK = 1 / 25  # seconds between two pictures of the body
RETRY = 10.0  # seconds after which a run that cannot be played is looked at again
PAUSE = 1.0  # seconds for which a finished attempt stands still
HOLD = 30.0  # the same for one that somebody asked for, with ring and verdict
GAP = 1.15  # distance of two mazes side by side, in sides of one


class View:
    """A page.

    Args:
        runs: one in full, or several side by side.
        host, port: where to listen; a busy port is replaced by a free one.
    """

    def __init__(self, runs: list[Run], host: str = "127.0.0.1", port: int = 8080) -> None:
        self.runs = runs
        self.server = start_server(host, port, ", ".join(run.name for run in runs))
        self._requests: queue.Queue[tuple[str, Any]] = queue.Queue(maxsize=100)
        boxes = [run.box() for run in runs]
        # Metres from one maze to the next, the same for all: GAP sides of the largest.
        sides = [np.ptp(drawn(run.maze, box), axis=0) for run, box in zip(runs, boxes, strict=True)]
        self._spread = GAP * float(np.max(sides))
        self._scenes = [
            Scene(self.server, run.maze, box, f"/run{i}", offset=(i * self._spread, 0.0))
            for i, (run, box) in enumerate(zip(runs, boxes, strict=True))
        ]
        self._drawn: list[Frame | None] = [None] * len(runs)  # the frame in each scene
        self._shown: int | None = None  # index of the report on show
        self._playing_since = 0.0
        self._player: Player | None = None
        self._bodies: Bodies | None = None
        self._attempt: Attempt | None = None
        self._attempt_began = 0.0
        self._next_try = 0.0  # when to look for a policy again
        self._asked = False  # whether the attempt is one that somebody asked for
        self._last_look = 0.0
        self._trouble: list[str] = []
        self._export: Export | None = None  # one at a time, whoever asks
        self._place_camera()
        self._build_panel()
        self.server.scene.on_click()(self._clicked)
        self._look(first=True)

    @property
    def address(self) -> str:
        """Where the page is."""
        host = self.server.get_host()
        host = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.server.get_port()}"

    # The loop.

    @property
    def visitors(self) -> int:
        """How many browsers look."""
        return len(self.server.get_clients())

    def spin(self, seconds: float = math.inf, until: threading.Event | None = None) -> None:
        """Keep the page alive for some seconds, or until something happens; by default for ever."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not (until is not None and until.is_set()):
            begin = time.monotonic()
            self.tick(begin)
            time.sleep(max(0.0, TICK - (time.monotonic() - begin)))

    def tick(self, now: float) -> None:
        """Do what is due at that time (of `time.monotonic`).

        A page outlives whatever stands in a folder or comes from a browser: what goes wrong is told
        once, if it happens more than once (viser's threads get in each other's way at times).
        """
        tasks = [self._serve_all, self._look_again, self._play_time]
        if self.visitors:
            tasks.append(self._play_body)
        for task in tasks:
            try:
                task(now)
            except Exception as error:
                self._trouble.append(f"{type(error).__name__}: {error}")
                if self._trouble.count(self._trouble[-1]) == 2:
                    complain(f"the page leaves something out: {self._trouble[-1]}")
                del self._trouble[:-100]

    def close(self) -> None:
        """Stop the server."""
        if self._export is not None:
            self._export.cancel()
        self.server.stop()

    # Time: which report is on show.

    def _look_again(self, now: float) -> None:
        if now - self._last_look >= LOOK_EVERY:
            self._last_look = now
            self._look()
        if self._export is not None and self._export.done():
            self._export = None

    def _look(self, first: bool = False) -> None:
        """Look for news in the folders, and show them."""
        news = [run.refresh() for run in self.runs]
        if any(news) or first:
            last = max(0, len(self._longest.iterations) - 1)
            self._slider.max = max(1, last)
            self._slider.disabled = last == 0
            if self._follow.value and self._slider.value != last:
                self._slider.value = last
            self._curves.refresh()
        if self._follow.value or self._shown is None:
            self._show(len(self._longest.iterations) - 1)
        self._status.content = self._describe()

    @property
    def _longest(self) -> Run:
        """The run whose reports the slider counts."""
        return max(self.runs, key=lambda run: len(run.iterations))

    def _show(self, index: int) -> None:
        """Draw that report, of the run with most of them, and what the others had by then."""
        run = self._longest
        if not run.iterations:
            return
        last = len(run.iterations) - 1
        index = int(np.clip(index, 0, last))
        steps = run.metrics.at(run.iterations[index], "steps/train") if index < last else np.inf
        with self.server.atomic():
            for i, (other, scene) in enumerate(zip(self.runs, self._scenes, strict=True)):
                frame = other.frame(
                    run.iterations[index] if other is run else report_at(other, steps)
                )
                if frame is None or frame is self._drawn[i]:
                    continue
                scene.draw(frame)
                self._drawn[i] = frame
        self._shown = index
        old = index < last and len(self.runs) == 1
        body = " · the body and its arrows show the newest policy" if old else ""
        self._caption.content = caption(run, run.iterations[index]) + body

    def _play_time(self, now: float) -> None:
        if not self._play.value:
            self._playing_since = now
            return
        speed = self._speed.value
        if now - self._playing_since < 1 / (speed if speed in range(1, 21) else 1):
            return
        self._playing_since = now
        here = 0 if self._shown is None else self._shown + 1
        self._slider.value = here if here < len(self._longest.iterations) else 0
        self._show(self._slider.value)

    # The body, and the goals that people set.

    def _play_body(self, now: float) -> None:
        if len(self.runs) > 1 or not (self._scenes[0].visible("body") or self._asked):
            return
        pause = HOLD if self._asked else PAUSE
        if self._attempt is None or now - self._attempt_began > self._attempt.seconds + pause:
            if not self._ready():
                return
            if self._asked:
                self._outcome.content = "The body goes for goals of its own again."
            self._asked = False
            assert self._player is not None
            self._begin(self._player.some_goal())
        assert self._attempt is not None and self._bodies is not None
        step = max(0, int((now - self._attempt_began) / self._attempt.dt))
        self._bodies.draw(self._attempt.states[min(step, len(self._attempt.states) - 1)])
        if self._asked:
            self._outcome.content = self._describe_attempt(now)

    def _ready(self) -> bool:
        """Whether there is a policy to play; takes up the newest."""
        if self._player is None:
            if time.monotonic() < self._next_try:
                return False
            try:
                self._player = Player(self.runs[0].folder)
            except Exception:  # the settings are another version's, or nonsense
                self._next_try = time.monotonic() + RETRY
                return False
        return self._player.take_newest()

    def _begin(self, goals: FloatArray) -> None:
        assert self._player is not None
        if self._bodies is None:
            self._bodies = Bodies(self.server, self._player.model, "/run0/body/points")
            self._bodies.show(self._scenes[0].visible("body"))
        self._attempt = self._player.attempt(goals)
        self._attempt_began = time.monotonic()
        self._scenes[0].mark(goals, self._player.env.success_radius)
        one = len(goals) == 1  # no field leads to all of them
        self._scenes[0].draw_ways(*self._player.ways(goals) if one else (goals[:0], goals[:0]))

    def _serve_all(self, now: float) -> None:
        attempt = None
        while not self._requests.empty():
            request = self._requests.get()
            if request[0] in ("goal", "all"):
                attempt = request  # one at a time: the last one counts
            else:
                # A browser may send any value for any control: nonsense is dropped.
                with contextlib.suppress(TypeError, ValueError, OverflowError):
                    self._serve(*request)
        if attempt is not None:
            self._serve(*attempt)

    def _serve(self, request: str, value: Any) -> None:
        if request == "slider":
            self._show(int(value))
        elif request == "csv" and value is not None:
            self._send_csv(value)
        elif request == "page" and value is not None and self._export is None:
            self._export = Export(self.runs[0].folder, value)
        elif request == "layer":
            for scene in self._scenes:
                scene.show(value[0], bool(value[1]))
            if value[0] == "body" and self._bodies is not None:
                self._bodies.show(bool(value[1]))
        elif request in ("goal", "all") and len(self.runs) == 1:
            if not self._ready():
                self._outcome.content = (
                    "There is no policy to play: none was saved yet, or by another version."
                )
                return
            assert self._player is not None
            env = self._player.env
            goals = env.test_goals()
            if request == "goal":
                goals = np.zeros((1, env.goal_dim))
                goals[0, :2] = value
                if not env.feasible(goals)[0]:
                    self._outcome.content = "No body can be there: click on a free place."
                    return
            self._outcome.content = "..."
            self._begin(goals)
            self._asked = True

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        if direction[2] < -1e-6:  # it meets the floor
            place = origin - direction * origin[2] / direction[2]
            self._ask("goal", place[:2])

    def _ask(self, request: str, value: Any) -> None:
        with contextlib.suppress(queue.Full):  # clicks faster than anything can be shown
            self._requests.put_nowait((request, value))

    # The panel.

    def _place_camera(self) -> None:
        first, last = self._scenes[0], self._scenes[-1]
        row = self._spread * (len(self._scenes) - 1)
        width = first.size + row
        size = max(first.size, width / 1.25)  # a page is wide
        middle = (first.centre + last.centre) / 2
        middle[0] += row / 2
        # The panel covers the right of the page, and on a phone its lower half.
        look_at(self.server.initial_camera, middle + np.array([0.11 * width, 0.0]), size)

        def fit(client: viser.ClientHandle) -> None:
            if (aspect := client.camera.aspect) < 1:
                size_seen = size / max(aspect, 0.2)
                look_at(client.camera, middle - np.array([0.0, 0.3 * size_seen]), 0.75 * size_seen)

        self.server.on_client_connect(fit)

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(
            control_width="medium", show_logo=False, show_share_button=False, dark_mode=True
        )
        self._status = gui.add_markdown("")
        gui.add_html(legend())
        tabs = gui.add_tab_group()
        with tabs.add_tab("Time"):
            self._caption = gui.add_markdown("No report yet: the first one comes soon.")
            # viser declares `value` read-only, which it is not.
            self._slider: Any = gui.add_slider("Report", min=0, max=1, step=1, initial_value=0)
            self._follow: Any = gui.add_checkbox("Follow live", True)
            self._play: Any = gui.add_checkbox("Play", False)
            self._speed = gui.add_slider("Reports per second", 1, 20, 1, 5)
            with gui.add_folder("Layers"):
                for name, (label, hint, shown) in LAYERS.items():
                    box = gui.add_checkbox(label, shown, hint=hint)
                    box.on_update(partial(self._layer_switched, name))
        self._slider.on_update(self._slid)
        self._play.on_update(lambda event: self._stop_following())
        if len(self.runs) == 1:
            with tabs.add_tab("Try"):
                gui.add_markdown(
                    "**Click on the floor to set a goal.** The newest policy tries it from the "
                    "start, at real speed. The ring is where the goal counts as reached."
                )
                button = gui.add_button("Try all tiles")
                button.on_click(lambda _: self._ask("all", None))
                self._outcome = gui.add_markdown("No goal set yet.")
        with tabs.add_tab("Curves"):
            self._curves = Curves(gui, self.runs)
        with tabs.add_tab("About"):
            gui.add_markdown(about())
            table = gui.add_button("This report as CSV")
            table.on_click(lambda event: self._ask("csv", event.client))
            page = gui.add_button("This run as one HTML page")
            page.on_click(lambda event: self._ask("page", event.client))
            gui.add_markdown("### Settings\n\n" + settings_table(self.runs[0].settings))

    def _layer_switched(self, name: str, event: Any) -> None:
        self._ask("layer", (name, event.target.value))

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # a person, not us
            self._stop_following()
            self._ask("slider", event.target.value)

    def _stop_following(self) -> None:
        self._follow.value = False

    def _send_csv(self, client: viser.ClientHandle) -> None:
        run = self.runs[0]
        if self._shown is None or self._shown >= len(run.iterations):
            return
        frame = run.frame(run.iterations[self._shown])
        if frame is not None:
            client.send_file_download("coverage.csv", as_csv(frame))

    # Words.

    def _describe(self) -> str:
        return "\n\n".join(f"**{plain(run.name)}** {plain(state(run))}" for run in self.runs)

    def _describe_attempt(self, now: float) -> str:
        attempt = self._attempt
        assert attempt is not None and self._player is not None
        done = max(0.0, now - self._attempt_began)
        whose = f"Policy of iteration {self._player.iteration:,}. "
        if len(attempt.goals) == 1:
            x, y = attempt.goals[0, :2]
            if done < attempt.seconds:
                return f"{whose}Goal ({x:.1f}, {y:.1f}): on its way, {done:.1f} s"
            why = attempt.outcome(0)
            return f"{whose}Goal ({x:.1f}, {y:.1f}): **{why}** after {attempt.seconds:.1f} s"
        ended = attempt.ends * attempt.dt <= done
        reached = int((attempt.reached & ended).sum())
        return f"{whose}All tiles: **{reached} of {len(ended)}** reached, {ended.sum()} ended"


def report_at(run: Run, steps: float) -> int:
    """The iteration of the last report that a run had made after so many steps."""
    before = [i for i in run.iterations if not run.metrics.at(i, "steps/train") > steps]
    return before[-1] if before else (run.iterations[0] if run.iterations else 0)


def about() -> str:
    """What one is looking at."""
    return "\n\n".join(f"**{label}.** {text}" for label, text, _ in LAYERS.values())
