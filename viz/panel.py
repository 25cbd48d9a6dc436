"""The panel beside the scene: what is said, and what people can press."""

from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from goalgan_bt.viz.captions import settings_table
from goalgan_bt.viz.curves import Curves
from goalgan_bt.viz.layers import about, layers_of, legend
from goalgan_bt.viz.run import Run
from goalgan_bt.viz.tour import TOUR

SETTINGS = "### Settings\n\n"
# What the keyboard does: key, words, and the request with its value.
KEYS: tuple[tuple[str, str, str, Any], ...] = (
    ("pageup", "One report back", "step", -1),
    ("pagedown", "One report on", "step", 1),
    ("home", "The first report", "step", -(10**9)),
    ("T", "Try all tiles", "all", None),
    ("G", "Let the body choose its goals", "release", None),
    ("H", "The tour", "tour", None),
)


class Panel:
    """The panel of a page.

    Args:
        server: whose page it is.
        runs: what it is about.
        ask: told what somebody wishes, a word and a value; called in viser's threads.

    Attributes:
        doing, status, caption, outcome: texts (`content`), in markdown; slider, follow, play,
        speed: controls (`value`); curves.
    """

    def __init__(
        self, server: viser.ViserServer, runs: list[Run], ask: Callable[[str, Any], None]
    ) -> None:
        self._gui, self._runs, self._ask = server.gui, runs, ask
        self._kinds = list(dict.fromkeys(run.kind for run in runs))
        self._layers = layers_of(self._kinds)
        self._stop = -1  # of the tour; -1: nobody is on it
        self._theme(dark=True)
        gui = self._gui
        self.doing = gui.add_markdown("")
        self._add_tour()
        gui.add_html("".join(legend(kind) for kind in self._kinds))
        if len(runs) > 1:
            # Numbered: two folders may have the same name.
            self._names = [f"{i}: {run.task_and_method()}" for i, run in enumerate(runs, 1)]
            self._run: Any = gui.add_dropdown("Run", self._names, hint="Whose body is on show")
            self._run.on_update(self._chosen)
        self.status = gui.add_markdown("")
        # What the body is doing.
        self.outcome = gui.add_markdown("No policy yet.", visible=self._kinds != ["rooms"])
        tabs = gui.add_tab_group()
        self._reports = self._kinds != ["running"]
        with tabs.add_tab("Time" if self._reports else "Body"):
            self._add_time()
        if "goals" in self._kinds:
            with tabs.add_tab("Try"):
                self._add_try()
        with tabs.add_tab("Curves"):
            self.curves = Curves(gui, runs)
        with tabs.add_tab("About"):
            self._add_about()
        self._add_keys()

    def choose(self, index: int) -> None:
        """Have the panel speak of the run that has the body."""
        self._run.value = self._names[index]
        self._settings.content = SETTINGS + settings_table(self._runs[index].settings)

    def _theme(self, dark: bool) -> None:
        self._gui.configure_theme(
            control_width="medium", show_logo=False, show_share_button=False, dark_mode=dark
        )

    def _add_time(self) -> None:
        gui, there = self._gui, self._reports
        self.caption = gui.add_markdown("No report yet: the first one comes soon.", visible=there)
        # viser declares `value` read-only, which it is not.
        self.slider: Any = gui.add_slider("Report", 0, 1, 1, 0, visible=there)
        self.follow: Any = gui.add_checkbox("Follow live", True, visible=there)
        self.play: Any = gui.add_checkbox("Play", False, visible=there)
        self.speed = gui.add_slider("Reports per second", 1, 20, 1, 5, visible=there)
        with gui.add_folder("Layers", expand_by_default=not there):
            self._boxes: dict[str, Any] = {}
            for name, layer in self._layers.items():
                box = gui.add_checkbox(layer.label, layer.shown, hint=layer.hint)
                box.on_update(partial(self._layer_switched, name))
                self._boxes[name] = box
        self.slider.on_update(self._slid)
        self.play.on_update(lambda event: self._stop_following())

    def _add_try(self) -> None:
        gui = self._gui
        gui.add_markdown(
            "**Click on the floor to set a goal.** The policy tries it from the start, at real "
            "speed. The ring is where the goal counts as reached."
        )
        gui.add_button("Try all tiles").on_click(lambda _: self._ask("all", None))
        again = gui.add_button("Let it choose goals again")
        again.on_click(lambda _: self._ask("release", None))

    def _add_about(self) -> None:
        gui = self._gui
        gui.add_markdown("\n\n".join(about(kind) for kind in self._kinds))
        keys = [f"{key.title()}: {words.lower()}" for key, words, *_ in self._keys()]
        if self._reports:
            gui.add_markdown(f"**Keys.** {', '.join(['Space: play or stop', *keys])}.")
        light: Any = gui.add_checkbox("Light page", False)
        light.on_update(lambda event: self._theme(dark=event.target.value is not True))
        if self._reports:
            table = gui.add_button("This report as CSV")
            table.on_click(lambda event: self._ask("csv", event.client))
            page = gui.add_button("This run as one HTML page")
            page.on_click(lambda event: self._ask("page", event.client))
        self._settings = gui.add_markdown(SETTINGS + settings_table(self._runs[0].settings))

    def _keys(self) -> list[tuple[str, str, str, Any]]:
        """Those that do something here."""
        return [key for key in KEYS if key[2] == "step" or "goals" in self._kinds]

    def _add_keys(self) -> None:
        gui = self._gui
        if not self._reports:
            return
        gui.add_command("Play or stop", hotkey="space").on_trigger(lambda _: self._toggle_play())
        for key, words, request, value in self._keys():
            command = gui.add_command(words, hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(partial(self._key_pressed, request, value))

    def _key_pressed(self, request: str, value: Any, _: Any) -> None:
        if request == "step":
            self._stop_following()
        if request == "tour":
            self._next_stop()
        else:
            self._ask(request, value)

    def _toggle_play(self) -> None:
        self.play.value = not self.play.value
        self._stop_following()

    # The tour.

    def _add_tour(self) -> None:
        goals = "goals" in self._kinds
        self._told = self._gui.add_markdown("", visible=False)
        self._next = self._gui.add_button("New here? Show me around", visible=goals)
        self._next.on_click(lambda _: self._next_stop())
        self._leave = self._gui.add_button("End the tour", visible=False)
        self._leave.on_click(lambda _: self._end_tour())

    def _next_stop(self) -> None:
        """Go to the next stop of the tour, or begin it, or end it."""
        self._stop += 1
        if self._stop >= len(TOUR):
            self._end_tour()
            return
        title, text, layers = TOUR[self._stop]
        self._told.content = f"**{self._stop + 1} of {len(TOUR)}: {title}.** {text}"
        last = self._stop + 1 == len(TOUR)
        self._next.label = "That was it" if last else f"Next: {TOUR[self._stop + 1].title.lower()}"
        self._told.visible, self._leave.visible = True, not last
        self._ask("tour", {name: name in layers for name in self._layers})

    def _end_tour(self) -> None:
        self._stop = -1
        self._told.visible = self._leave.visible = False
        self._next.label = "Show me around again"
        self._ask("tour", {name: bool(box.value) for name, box in self._boxes.items()})

    # What people press.

    def _chosen(self, event: Any) -> None:
        if event.client is not None and event.target.value in self._names:
            self._ask("choose", self._names.index(event.target.value))

    def _layer_switched(self, name: str, event: Any) -> None:
        self._ask("layer", (name, event.target.value))

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # a person, not us
            self._stop_following()
            self._ask("slider", event.target.value)

    def _stop_following(self) -> None:
        self.follow.value = False
