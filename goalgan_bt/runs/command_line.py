"""Command lines from dataclasses, whose mistakes end in one line, and how every command ends."""

import contextlib
import errno
import io
import os
import re
import signal
import sys
import typing
from collections.abc import Callable
from dataclasses import field, fields, make_dataclass
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, TypeVar

import tyro

from goalgan_bt.envs.goal_env import PhysicsError
from goalgan_bt.envs.maze import MapError
from goalgan_bt.envs.own import OwnEnvError
from goalgan_bt.runs.errors import InterruptedRun, RunError, UsageError
from goalgan_bt.runs.ranges import faults
from goalgan_bt.runs.signals import SIGNALS
from goalgan_bt.runs.terminal import complain

T = TypeVar("T")
FLOATING = re.compile(r"\d+(\.\d+)?[eE]\+?\d{1,2}")
ALL = "--help-all"
NO_MEMORY = "out of memory: use smaller settings, for example fewer simulations or smaller networks"


def parse(
    kind: type[T],
    argv: list[str] | None,
    prog: str,
    default: T | None = None,
    often: tuple[str, ...] = (),
    more: str = "",
) -> T:
    """What a command line asks for.

    Args:
        kind: the dataclass of its flags.
        argv: its words; those of this process if None.
        prog: how the command is called, for its help.
        default: values of the flags that are not given; else those of the class.
        often: the flags that `--help` explains; by default all, as `--help-all` always does.
        more: what the help says at its end.

    Raises:
        UsageError: for an unknown flag or a bad value.
        SystemExit: after `--help` or `--help-all`.
    """
    printed, argv = io.StringIO(), whole_numbers(sys.argv[1:] if argv is None else argv)
    defaults: dict[str, Any] = {} if default is None else {"default": default}
    asked: Any = kind
    if ALL in argv:
        argv = ["--help"]
    elif often and {"--help", "-h"} & set(argv):
        argv, asked, defaults = ["--help"], _shortened(kind, default or kind(), often), {}
        more = f"{more}{ALL} explains every setting, each with its default."
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            given: T = tyro.cli(asked, args=argv, prog=prog, **defaults)
            return given
    except SystemExit as stop:
        if not stop.code:  # --help
            lines = printed.getvalue().rstrip().splitlines()
            sys.stdout.write(
                "\n".join(line.rstrip() for line in [*lines, "", more]).rstrip() + "\n"
            )
            raise
        raise UsageError(_one_line(printed.getvalue())) from None


def _shortened(kind: type[T], default: T, often: tuple[str, ...]) -> Any:
    """The same dataclass with other defaults, of which only some flags are in the help."""
    hints = typing.get_type_hints(kind, include_extras=True)
    all_fields = [
        (
            f.name,
            hints[f.name] if f.name in often else Annotated[hints[f.name], tyro.conf.Suppress],
            field(default=getattr(default, f.name)),
        )
        for f in fields(typing.cast(Any, kind))
    ]
    short = make_dataclass(kind.__name__, all_fields, bases=(kind,), frozen=True)
    short.__doc__ = kind.__doc__
    return short


def whole_numbers(argv: list[str]) -> list[str]:
    """The same with whole numbers in digits that were given to flags as 1e6 or 2.5e6."""
    told = []
    for before, word in pairwise(["", *argv]):
        flag, equals, number = word.rpartition("=") if word.startswith("--") else ("", "", word)
        given = equals or before.startswith("--")
        if given and FLOATING.fullmatch(number) and float(number).is_integer():
            word = f"{flag}{equals}{int(float(number))}"
        told.append(word)
    return told


def check_ranges(settings: Any) -> None:
    """Refuse settings that are out of their ranges.

    Raises:
        UsageError: naming the first such setting as a flag.
    """
    for name, problem in faults(settings):
        raise UsageError(f"--{name.replace('_', '-')} {problem}")


def check_target(path: Path, kinds: tuple[str, ...]) -> None:
    """See that a file can be written, before the work that goes into it.

    Args:
        path: the file.
        kinds: how its name may end, such as `.gif`.

    Raises:
        UsageError: saying what to choose instead.
    """
    if path.suffix.lower() not in kinds:
        raise UsageError(f"cannot write '{path}': its name must end in {' or '.join(kinds)}")
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise UsageError(f"cannot write '{path}': choose a file in a folder that can be written")


def run_command(work: Callable[[], int | None], go_on: Callable[[], str] | None = None) -> int:
    """Do a command's work; whatever its user can mend is told in one line.

    Args:
        work: what to do; it may give an exit code.
        go_on: tells how to go on where the work was cut short; without it Ctrl-C, which then loses
            nothing, ends it without a word.

    Returns:
        The exit code: 0, 2 for what went wrong, 130 for Ctrl-C.
    """

    def stop(number: int, _: FrameType | None) -> None:
        raise KeyboardInterrupt(number)

    def told(problem: str) -> int:
        complain(f"{problem}: {go_on()}" if go_on is not None and go_on() else problem)
        return 2

    for number in SIGNALS:
        signal.signal(number, stop)
    try:
        return work() or 0
    except KeyboardInterrupt as stopped:
        if go_on is not None:
            told("interrupted")
        return 2 if signal.SIGTERM in stopped.args else 130
    except MemoryError:
        complain(NO_MEMORY)
    except RuntimeError as error:
        if "can't allocate memory" not in str(error):  # torch has no kind of its own for it
            raise
        complain(NO_MEMORY)
    except BrokenPipeError:
        sys.stdout = sys.stderr  # nobody reads standard output any more
        return told("standard output was closed")
    except InterruptedRun as error:
        return told(str(error))
    except (UsageError, RunError, MapError, PhysicsError, OwnEnvError) as error:
        complain(str(error))
    except OSError as error:
        full = error.errno == errno.ENOSPC
        return told("the disk is full: free some space" if full else str(error))
    return 2


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
        return f"{wrong[1]} cannot be {value!r}; --help-all tells what it takes"
    line = (
        line.removeprefix("Invalid choice ")
        .removeprefix("Parsing error ")
        .removeprefix("Unrecognized options ")
    )
    return line.split(" For full helptext")[0][:300] + "; --help-all lists every setting"
