"""The page that training opens: `python -m goalgan_bt.viz` as a child process."""

import contextlib
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.terminal import complain, say

UNTIL_ALONE = "until alone\n"  # what a page is told that shall stay while somebody looks


class PageProcess:
    """A page over a run in a process of its own.

    In a terminal it outlives a training that ended well for as long as somebody looks, or until
    Ctrl-C; otherwise it ends with this process, however that ends, so that no script waits for it.

    Args:
        host, port: where it shall listen.

    Attributes:
        ended_well: to be set when the training has.

    Raises:
        UsageError: if one cannot listen there at all.
    """

    def __init__(self, host: str, port: int) -> None:
        free_port(host, port)
        self._place = ["--host", host, "--port", str(port)]
        self._terminal = sys.stdout.isatty()
        self._process: subprocess.Popen[str] | None = None
        self._folder: Path | None = None
        self._address: str | None = None
        self._known = threading.Event()  # the address, or that there will be none
        self.ended_well = False

    def open(self, folder: Path) -> None:
        """Begin to show a run."""
        self._folder = folder
        command = [sys.executable, "-m", "goalgan_bt.viz", str(folder), *self._place]
        self._process = subprocess.Popen(
            [*command, "--with-parent"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        threading.Thread(target=self._listen, daemon=True).start()

    def wait(self, seconds: float) -> str | None:
        """Its address, as soon as it listens; None where it does not in that time."""
        self._known.wait(seconds)
        return self._address

    def close(self) -> None:
        """End the page; in a terminal, after a run that ended well, only when people are done."""
        if self._process is None:
            return
        with contextlib.suppress(KeyboardInterrupt):
            if self._terminal and self.ended_well and self._known.wait(30) and self._address:
                say(f"the page stays while somebody looks, or until Ctrl-C: {self._address}")
                assert self._process.stdin is not None
                with contextlib.suppress(OSError):  # it has ended by itself
                    self._process.stdin.write(UNTIL_ALONE)
                    self._process.stdin.flush()
                if self._process.wait() == 0:
                    say(f"nobody looks: python -m goalgan_bt.viz {self._folder} opens it again")
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=5)

    def _listen(self) -> None:
        assert self._process is not None and self._process.stdout is not None
        last = "it said nothing"
        for line in self._process.stdout:
            # Nobody may read our output any more; the page's must be read on, lest it block.
            with contextlib.suppress(OSError, ValueError):
                if line.startswith("view: "):
                    if self._address is None:
                        self._address = line.split()[1]
                        self._known.set()
                    say(line.strip())
                elif line.startswith("error: "):
                    complain(line.removeprefix("error: ").strip())
                last = line.strip() or last
        if self._address is None and self._process.wait() not in (0, 2, -signal.SIGTERM):
            complain(f"there is no page, training goes on: it ended with: {last}", "warning")
        self._known.set()


def free_port(host: str, port: int) -> int:
    """That port, or a later one if it is busy.

    Raises:
        UsageError: if one cannot listen at that address at all.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for candidate in [*range(port, min(port + 100, 65536)), 0]:
        try:
            socket.create_server((host, candidate), family=family).close()
            return candidate
        except OSError as error:
            reason = error
    raise UsageError(f"cannot listen on {host}: {reason}")
