"""Command lines from dataclasses, whose mistakes end in one line instead of tyro's box."""

import contextlib
import errno
import io
import re
import signal
import sys
from collections.abc import Callable
from itertools import pairwise
from operator import attrgetter
from typing import Any, NoReturn, TypeVar

import tyro

from goalgan_bt.progress import complain
from goalgan_bt.record import RunError

T = TypeVar("T")


class UsageError(ValueError):
    """A command line that makes no sense; the message says which part of it."""


def parse(kind: type[T], argv: list[str] | None, prog: str, default: T | None = None) -> T:
    """What a command line asks for.

    Args:
        kind: the dataclass of its flags.
        argv: its words; those of this process if None.
        prog: how the command is called, for its help.
        default: values of the flags that are not given; else those of the class.

    Raises:
        UsageError: for an unknown flag or a bad value.
        SystemExit: after `--help`.
    """
    printed = io.StringIO()
    defaults: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            return tyro.cli(kind, args=argv, prog=prog, **defaults)
    except SystemExit as stop:
        if not stop.code:  # --help
            sys.stdout.write(printed.getvalue())
            raise
        raise UsageError(_one_line(printed.getvalue())) from None


def fault(cfg: Any, names: str, good: Callable[[Any], bool], what: str) -> str | None:
    """What is wrong with the first of some settings that is not good; None if all are.

    Args:
        cfg: the settings.
        names: which of them, as attributes with dots; their values are numbers, tuples of them, or
            None, which is always good.
        good: whether a number is.
        what: the words for it.
    """
    for name in names.split():
        value, flag = attrgetter(name)(cfg), "--" + name.replace("_", "-")
        for x in value if isinstance(value, tuple) else (value,):
            if x is not None and not isinstance(x, (int, float)):
                return f"{flag} must be a number, not {x!r}"
            if x is not None and not good(x):
                return f"{flag} must be {what}, not {x}"
    return None


def exit_code(
    work: Callable[[], None],
    interrupted: Callable[[], str] = lambda: "what was measured is in the run folder; start again",
) -> int:
    """Do some work; whatever its user can mend is told in one line, with exit code 2, or 130 for
    Ctrl-C.

    Args:
        work: what to do.
        interrupted: tells how to go on, where the work was cut short.
    """
    asked = signal.SIGINT

    def stop(number: int, _: object) -> None:
        nonlocal asked
        asked = signal.Signals(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        work()
    except KeyboardInterrupt:
        complain(f"interrupted: {interrupted()}")
        return 130 if asked == signal.SIGINT else 2
    except MemoryError:
        complain("out of memory: use smaller settings")
        return 2
    except BrokenPipeError:
        sys.stdout = sys.stderr  # nobody reads standard output any more
        complain(f"standard output was closed: {interrupted()}")
        return 2
    except OSError as error:
        full = error.errno == errno.ENOSPC
        complain(f"{'the disk is full: free some space' if full else error}; {interrupted()}")
        return 2
    except (UsageError, RunError) as error:
        complain(str(error))
        return 2
    return 0


def exit_with(code: int) -> NoReturn:
    """End the process with an exit code. What was done is done: a signal in the second that this
    may take changes neither the code nor the last line."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(code)


def value_of(argv: list[str], flag: str) -> str | None:
    """The value given to a flag, as `--flag value` or `--flag=value`; the last one counts."""
    value = None
    for word, following in pairwise([*argv, ""]):
        if word == flag and following and not following.startswith("--"):
            value = following
        elif word.startswith(flag + "="):
            value = word.split("=", 1)[1]
    return value


def _one_line(text: str) -> str:
    """What tyro prints in a box, without the box and without what repeats."""
    words = "".join(" " if c in "╭╮╰╯│─━┃\n" else c for c in text).split()
    line = " ".join(word for word in words if set(word) != {"-"})
    wrong = re.search(r"Error parsing (--\S+): .*?(?:\['(.+?)'\]|: '(.+?)')", line)
    if wrong:
        value = (wrong[2] or wrong[3]).replace("', '", " ")
        return f"{wrong[1]} cannot be {value!r}; --help tells what it takes"
    line = (
        line.removeprefix("Invalid choice ")
        .removeprefix("Parsing error ")
        .removeprefix("Unrecognized options ")
    )
    return line.split(" For full helptext")[0][:300] + "; --help lists every setting"
