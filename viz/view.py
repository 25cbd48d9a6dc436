"""The live view: a viser page over one or several run folders.

One thread, the one that calls `View.spin`, reads the runs and writes the scene. What happens in a
browser only puts a request into a queue; nothing that comes from there becomes a path or code.
"""

import contextlib
import math
import queue
import threading
import time
from typing import Any

import numpy as np
import viser

from goalgan_bt.runs.terminal import complain
from goalgan_bt.viz.captions import caption, doing, plain, state
from goalgan_bt.viz.download import Export, as_csv
from goalgan_bt.viz.palette import RUNS
from goalgan_bt.viz.panel import Panel
from goalgan_bt.viz.run import Frame, Run
from goalgan_bt.viz.scene import Scene, look_at
from goalgan_bt.viz.server import start_server
from goalgan_bt.viz.stage import Stage

LOOK_EVERY = 1.0  # seconds between two looks at the run folders
TICK = 1 / 25  # seconds between two pictures of the body
GAP = 1.15  # distance of two mazes side by side, in sides of one
ROOM_FOR_NAME = 0.2  # more of it from row to row


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
        self._columns = math.ceil(math.sqrt(len(runs)))
        many = len(runs) > 1
        # Metres from one maze to the next, the same for all: GAP sides of the largest.
        self._spread = GAP * max(run.side() for run in runs)
        self._offsets = [self._offset(i) for i in range(len(runs))]
        self._scenes = [
            Scene(self.server, run, f"/run{i}", offset, RUNS[i % len(RUNS)] if many else None)
            for i, (run, offset) in enumerate(zip(runs, self._offsets, strict=True))
        ]
        self._drawn: list[Frame | None] = [None] * len(runs)  # the frame in each scene
        self._reports = [0] * len(runs)  # its iteration, 0 before there is one
        self._shown: int | None = None  # index of the report on show
        self._playing_since = 0.0
        self._chosen = 0  # the run whose body is on show
        self.stage = self._stage_of(0)
        self._last_look = 0.0
        self._trouble: list[str] = []
        self._export: Export | None = None  # one at a time, whoever asks
        self._place_camera()
        self.panel = Panel(self.server, runs, self._ask)
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
        panel, news = self.panel, [run.refresh() for run in self.runs]
        if any(news) or first:
            last = max(0, len(self._longest.iterations) - 1)
            panel.slider.max = max(1, last)
            panel.slider.disabled = last == 0
            if panel.follow.value and panel.slider.value != last:
                panel.slider.value = last
            panel.curves.refresh()
        if panel.follow.value or self._shown is None:
            self._show(len(self._longest.iterations) - 1)
        self._tell()

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
                report = run.iterations[index] if other is run else report_at(other, steps)
                self._reports[i] = report
                if i == self._chosen:  # the body is of this report, or of the newest policy
                    self.stage.report = None if index == last else report
                frame = other.frame(report)
                if frame is None or frame is self._drawn[i]:
                    continue
                scene.draw(frame)
                self._drawn[i] = frame
        self._shown = index
        chosen = self.runs[self._chosen]
        if report := self._reports[self._chosen]:
            whose = f"{plain(chosen.task_and_method())}: " if len(self.runs) > 1 else ""
            self.panel.caption.content = whose + caption(chosen, report)

    def _play_time(self, now: float) -> None:
        if not self.panel.play.value:
            self._playing_since = now
            return
        speed = self.panel.speed.value
        if now - self._playing_since < 1 / (speed if speed in range(1, 21) else 1):
            return
        self._playing_since = now
        self._go_to(0 if self._shown is None else self._shown + 1)

    def _go_to(self, index: int) -> None:
        """Show a report, and have the slider say so; after the last one comes the first."""
        last = len(self._longest.iterations) - 1
        self.panel.slider.value = index if index <= last else 0
        self._show(int(self.panel.slider.value))

    # The body, and what people wish.

    def _play_body(self, now: float) -> None:
        self.stage.play(now)
        if self.panel.outcome.content != self.stage.words:
            self.panel.outcome.content = self.stage.words

    def _stage_of(self, index: int) -> Stage:
        scene, run, offset = self._scenes[index], self.runs[index], self._offsets[index]
        return Stage(self.server, scene, run, offset)

    def _serve_all(self, now: float) -> None:
        attempt = None
        while not self._requests.empty():
            request = self._requests.get()
            if request[0] in ("goal", "all"):
                attempt = request  # one at a time: the last one counts
            else:
                # A browser may send any value for any control: nonsense is dropped.
                with contextlib.suppress(TypeError, ValueError, OverflowError):
                    self._serve(*request, now)
        if attempt is not None:
            self._try(attempt[1], now)

    def _serve(self, request: str, value: Any, now: float) -> None:
        if request == "slider":
            self._show(int(value))
        elif request == "step" and self._shown is not None:
            self._go_to(max(0, self._shown + int(value)))
        elif request == "csv" and value is not None:
            self._send_csv(value)
        elif request == "page" and value is not None and self._export is None:
            self._export = Export(self.runs[self._chosen].folder, value)
        elif request == "layer":
            self._show_layer(value[0], bool(value[1]))
        elif request == "tour":
            for layer, shown in value.items():
                self._show_layer(layer, shown)
        elif request == "choose":
            self._choose(int(value))
        elif request == "release":
            self.stage.release()

    def _show_layer(self, layer: str, visible: bool) -> None:
        for scene in self._scenes:
            scene.show(layer, visible)
        if layer == "body":
            self.stage.show_body(visible)

    def _choose(self, index: int) -> None:
        """Let another run have the body, and the words about it."""
        if index != self._chosen:
            self.stage.close()
            self._chosen, self.stage = range(len(self.runs))[index], self._stage_of(index)
            self.panel.choose(self._chosen)
            if self._shown is not None:
                self._show(self._shown)  # the body is that of the report on show
            self._tell()

    def _try(self, place: Any, now: float) -> None:
        """Let the body try a place in the scene, (2,), or all (None)."""
        if place is not None and len(self.runs) > 1:
            there = np.asarray(place)
            away = [np.abs(there - offset - scene.centre).max() for offset, scene in self._placed()]
            self._choose(int(np.argmin(away)))
        if self.runs[self._chosen].kind == "goals":
            self.panel.outcome.content = "One moment ..."  # many attempts take some seconds
            offset = np.array(self._offsets[self._chosen])
            self.stage.ask(None if place is None else np.asarray(place) - offset, now)
            self.panel.outcome.content = self.stage.words

    def _placed(self) -> list[tuple[np.ndarray, Scene]]:
        return [(np.array(o), s) for o, s in zip(self._offsets, self._scenes, strict=True)]

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        if direction[2] < -1e-6:  # it meets the floor
            place = origin - direction * origin[2] / direction[2]
            self._ask("goal", place[:2])

    def _ask(self, request: str, value: Any) -> None:
        with contextlib.suppress(queue.Full):  # clicks faster than anything can be shown
            self._requests.put_nowait((request, value))

    def _send_csv(self, client: viser.ClientHandle) -> None:
        run, report = self.runs[self._chosen], self._reports[self._chosen]
        frame = run.frame(report) if report else None
        if frame is not None:
            client.send_file_download("coverage.csv", as_csv(frame))

    # The camera, and words.

    def _offset(self, index: int) -> tuple[float, float]:
        """Where a run's maze is in the scene: in rows, as one reads."""
        row, column = divmod(index, self._columns)
        aside = (
            self.runs[0].middle() - self.runs[index].middle()
        )  # mazes begin anywhere in their box
        place = np.array([column * self._spread, -row * (1 + ROOM_FOR_NAME) * self._spread])
        return float((place + aside)[0]), float((place + aside)[1])

    def _place_camera(self) -> None:
        if self.runs[0].kind == "running" and len(self.runs) == 1:
            camera = self.server.initial_camera
            camera.position, camera.look_at = (1.0, -4.5, 1.6), (0.6, 0.0, 0.7)
            return
        first, last = self._scenes[0], self._scenes[-1]
        rows = (1 + ROOM_FOR_NAME) * self._spread * ((len(self.runs) - 1) // self._columns)
        width = first.size + (self._columns - 1) * self._spread
        # A page is wide, and what is far away looks smaller.
        size = max(first.size + 0.75 * rows, width / 1.25)
        middle = first.centre + np.array([(width - first.size) / 2, -rows / 2])
        if len(self.runs) == 1:
            middle = (first.centre + last.centre) / 2
        # The panel covers the right of the page, and on a phone its lower half.
        look_at(self.server.initial_camera, middle + np.array([0.11 * width, 0.0]), size)

        def fit(client: viser.ClientHandle) -> None:
            if (aspect := client.camera.aspect) < 1:
                size_seen = size / max(aspect, 0.2)
                look_at(client.camera, middle - np.array([0.0, 0.3 * size_seen]), 0.75 * size_seen)

        self.server.on_client_connect(fit)

    def _tell(self) -> None:
        """Say what goes on in the chosen run."""
        run = self.runs[self._chosen]
        self.panel.doing.content = doing(run)
        self.panel.status.content = f"**{plain(run.name)}** {plain(state(run))}"


def report_at(run: Run, steps: float) -> int:
    """The iteration of the last report that a run had made after so many steps."""
    before = [i for i in run.iterations if not run.metrics.at(i, "steps/train") > steps]
    return before[-1] if before else (run.iterations[0] if run.iterations else 0)
