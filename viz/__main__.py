"""Open a page over run folders: `python -m goalgan_bt.viz RUN [RUN ...]`."""

from goalgan_bt.runs.signals import leave_at_once

if __name__ == "__main__":
    leave_at_once()

import os
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from goalgan_bt.runs.command_line import check_ranges, check_target, parse, run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.ranges import Range
from goalgan_bt.runs.run_folder import runs_in
from goalgan_bt.runs.terminal import say
from goalgan_bt.viz import video
from goalgan_bt.viz.page_process import UNTIL_ALONE, free_port

MOST_RUNS = 16  # side by side
ALONE = 15.0  # seconds without a visitor after which nobody looks: more than a reload takes


@dataclass(frozen=True)
class ViewConfig:
    """Watch runs in a browser, live or afterwards; nothing in the folders is changed."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders of runs, of which all runs are taken: one run in full, or up to 16
    side by side."""
    host: str = "127.0.0.1"
    """Where to listen; 0.0.0.0 lets everybody on the network in, without a password."""
    port: Annotated[int, Range("between 0 and 65535", 0, 65535)] = 8080
    """Port; if it is busy, the next free one is taken and printed. 0 takes any."""
    export: Path | None = None
    """Instead of a server, one HTML file that plays a run without any: scene, curves, settings."""
    movie: Path | None = None
    """Instead of a server, a .gif or .mp4 of the map as it grows (extras `plots` and `movie`)."""
    with_parent: bool = False
    """End when standard input closes: for a page that another program starts."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError, OSError: saying what is wrong.
    """
    cfg = from_command_line(argv)
    parted = threading.Event()  # the parent has ended well: stay while somebody looks
    if cfg.with_parent:
        threading.Thread(target=_wait_for_parent, args=(parted,), daemon=True).start()
    if cfg.export is not None or cfg.movie is not None:
        write(cfg)
    else:
        leave_at_once()  # a page has nothing to lose
        serve(cfg, parted)


def serve(cfg: ViewConfig, parted: threading.Event) -> None:
    """Keep a page alive until a signal ends this process, or until nobody looks any more once its
    parent has `parted`.

    Raises:
        ValueError: if a folder is no run, or one cannot listen at that address.
    """
    # Only now: this imports torch and MuJoCo, and --help shall not wait for them.
    from goalgan_bt.viz.run import Run
    from goalgan_bt.viz.server import is_loopback
    from goalgan_bt.viz.view import View

    runs = [Run(folder) for folder in cfg.runs]
    runs.sort(key=lambda run: (run.task, str(run.settings.get("method", ""))))  # stable
    os.nice(19)  # looking must not slow learning; threads take it from the one that starts them
    port = free_port(cfg.host, cfg.port)
    view = View(runs, cfg.host, port)
    busy = cfg.port not in (0, view.server.get_port())
    say(f"view: {view.address}" + (f" (port {cfg.port} was busy)" if busy else ""))
    if not is_loopback(cfg.host):
        say("view: everybody who can reach this machine can use it: there is no password")
    # viser tells of every connection, and who started this may listen no more.
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    view.spin(until=parted)
    last_seen = time.monotonic()
    while time.monotonic() - last_seen < ALONE:
        view.spin(seconds=0.5)
        if view.visitors:
            last_seen = time.monotonic()


def write(cfg: ViewConfig) -> None:
    """Write the files that were asked for.

    Raises:
        ValueError: if the run holds nothing to show, or a library is missing.
        OSError: if a file cannot be written.
    """
    if cfg.export is not None:
        check_target(cfg.export, (".html", ".htm"))
    if cfg.movie is not None:
        check_target(cfg.movie, video.KINDS)
        video.check_libraries(cfg.movie)
    if cfg.export is not None:
        from goalgan_bt.viz.export import export
        from goalgan_bt.viz.run import Run

        export(Run(cfg.runs[0]), cfg.export)
        say(f"{cfg.export} ({cfg.export.stat().st_size / 1e6:.1f} MB)")
    if cfg.movie is not None:
        from goalgan_bt.viz.movie import movie

        movie(cfg.runs[0], cfg.movie)
        say(f"{cfg.movie} ({cfg.movie.stat().st_size / 1e6:.1f} MB)")


def from_command_line(argv: list[str] | None = None) -> ViewConfig:
    """What the command line asks for.

    Raises:
        UsageError: if it makes no sense.
        SystemExit: after `--help`.
    """
    cfg = parse(ViewConfig, argv, "python -m goalgan_bt.viz")
    if not cfg.runs:
        raise UsageError("name at least one run folder: python -m goalgan_bt.viz RUN")
    cfg = replace(cfg, runs=tuple(runs_in(cfg.runs)))
    if len(cfg.runs) > MOST_RUNS:
        raise UsageError(f"a page shows at most {MOST_RUNS} runs, and there are {len(cfg.runs)}")
    if len(cfg.runs) > 1 and (cfg.export is not None or cfg.movie is not None):
        raise UsageError("--export and --movie show one run: name only one")
    if not cfg.host:
        raise UsageError("--host must name an address: 127.0.0.1 is this machine alone")
    check_ranges(cfg)
    return cfg


def _wait_for_parent(parted: threading.Event) -> None:
    """End when standard input closes, or set the event when it says so."""
    for line in sys.stdin:
        if line == UNTIL_ALONE:
            parted.set()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
