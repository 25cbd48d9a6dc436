"""Open a page over run folders: `python -m goalgan_bt.viz RUN [RUN ...]`."""

import os
import signal
import sys

if __name__ == "__main__":  # a page has nothing to lose: it goes at once, without a word
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    signal.signal(signal.SIGTERM, lambda *_: os._exit(2))

import socket
import threading
from dataclasses import dataclass
from pathlib import Path

import tyro

from goalgan_bt.command_line import UsageError, parse
from goalgan_bt.progress import complain, say


@dataclass(frozen=True)
class ViewConfig:
    """Watch runs in a browser, live or afterwards; nothing in the folders is changed."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders: one in full, or several side by side."""
    host: str = "127.0.0.1"
    """Where to listen; 0.0.0.0 lets everybody on the network in, without a password."""
    port: int = 8080
    """Port; if it is busy, the next free one is taken and printed. 0 takes any."""
    export: Path | None = None
    """Instead of a server, one HTML file that plays a run without any: scene, curves, settings."""
    movie: Path | None = None
    """Instead of a server, a .gif or .mp4 of the map as it grows (extras `plots` and `movie`)."""
    with_parent: bool = False
    """End when standard input closes: for a page that another program starts."""


def main() -> int:
    """The command line; returns the exit code."""
    try:
        cfg = from_command_line()
        if cfg.export is not None or cfg.movie is not None:
            return write(cfg)
        # Only now: this imports torch and MuJoCo, and --help shall not wait for them.
        from goalgan_bt.viz.run import Run
        from goalgan_bt.viz.view import View

        family = socket.AF_INET6 if ":" in cfg.host else socket.AF_INET
        socket.create_server((cfg.host, 0), family=family).close()  # can we listen there?
        view = View([Run(folder) for folder in cfg.runs], cfg.host, cfg.port)
        busy = cfg.port not in (0, view.server.get_port())
        say(f"view: {view.address}" + (f" (port {cfg.port} was busy)" if busy else ""))
        if cfg.host in ("0.0.0.0", "::"):
            say("view: everybody who can reach this machine can use it: there is no password")
        os.nice(19)  # looking must not slow learning
        if cfg.with_parent:
            threading.Thread(target=_wait_for_parent, daemon=True).start()
        # viser tells of every connection, and who started this may listen no more.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        view.spin()
    except OSError as error:
        complain(f"cannot listen on {cfg.host}: {error}")
        return 2
    except ValueError as error:
        complain(str(error))
        return 2
    return 0


def write(cfg: ViewConfig) -> int:
    """Write the files that were asked for; returns the exit code."""
    try:
        if cfg.export is not None:
            from goalgan_bt.viz.export import export
            from goalgan_bt.viz.run import Run

            export(Run(cfg.runs[0]), cfg.export)
            say(f"{cfg.export} ({cfg.export.stat().st_size / 1e6:.1f} MB)")
        if cfg.movie is not None:
            try:
                from goalgan_bt.viz.movie import movie
            except ImportError:
                raise UsageError(
                    'a movie needs the extra: pip install "goalgan_bt[plots]"'
                ) from None
            movie(cfg.runs[0], cfg.movie)
            say(f"{cfg.movie} ({cfg.movie.stat().st_size / 1e6:.1f} MB)")
    except OSError as error:
        complain(f"cannot write: {error}")
        return 2
    return 0


def from_command_line(argv: list[str] | None = None) -> ViewConfig:
    """What the command line asks for.

    Raises:
        UsageError: if it makes no sense.
        SystemExit: after `--help`.
    """
    cfg = parse(ViewConfig, argv, "python -m goalgan_bt.viz")
    if not cfg.runs:
        raise UsageError("name at least one run folder: python -m goalgan_bt.viz RUN")
    if len(cfg.runs) > 1 and (cfg.export is not None or cfg.movie is not None):
        raise UsageError("--export and --movie show one run: name only one")
    if not 0 <= cfg.port <= 65535:
        raise UsageError(f"--port must be between 0 and 65535, not {cfg.port}")
    return cfg


def _wait_for_parent() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
