"""Ctrl-C and `kill`: at once while nothing is lost, after the iteration while something is."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def leave_at_once(words: str | None = None) -> None:
    """From now on a signal ends this process at once, with code 130 for Ctrl-C and 2 for `kill`.

    For the seconds in which a command imports its libraries, and for commands that have nothing to
    lose.

    Args:
        words: what is then told on standard error; nothing if None.
    """

    def leave(number: int, _: FrameType | None) -> None:
        if words is not None:
            os.write(2, f"error: {words}\n".encode())
        os._exit(130 if number == signal.SIGINT else 2)

    for number in SIGNALS:
        signal.signal(number, leave)


@contextmanager
def nothing_to_lose(words: str) -> Iterator[None]:
    """Inside, a signal ends this process at once (see `leave_at_once`)."""
    alone = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in SIGNALS if alone}
    if alone:
        leave_at_once(words)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Stop:
    """Turns Ctrl-C and `kill` into a wish that the loop grants after its iteration.

    A second signal ends at once. Installs its handlers on entry and puts the old ones back; in
    another thread than the main one, where Python allows none, it does nothing.

    Args:
        goodbye: for a process that after an error has only its last words left, which a launcher's
            `kill` shall not cut off: it is then ignored.
    """

    def __init__(self, goodbye: bool = False) -> None:
        self.signal: int | None = None
        self._goodbye = goodbye

    @property
    def requested(self) -> bool:
        """Whether the run shall end."""
        return self.signal is not None

    @property
    def name(self) -> str:
        """What the signal is called that was caught."""
        return signal.Signals(self.signal or 0).name

    @property
    def code(self) -> int:
        """The exit code of who was stopped by it."""
        return 130 if self.signal == signal.SIGINT else 2

    def __enter__(self) -> "Stop":
        alone = threading.current_thread() is threading.main_thread()
        self._old = {s: signal.signal(s, self._note) for s in SIGNALS if alone}
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for number, handler in self._old.items():
            last_words = self._goodbye and kind is not None and number == signal.SIGTERM
            signal.signal(number, signal.SIG_IGN if last_words else handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt(number)
        self.signal = number
        if sys.stderr.isatty():  # a person, who should not wonder
            os.write(2, b"\nstopping after this iteration; once more stops at once\n")


def exit_with(code: int) -> NoReturn:
    """End the process with an exit code. What was done is done: a signal in the second that this
    may take changes neither the code nor the last line."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    sys.exit(code)
