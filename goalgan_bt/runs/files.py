"""Files of a folder that may come from a stranger: read whole and within a size, written all or
nothing, and never through a link that leads elsewhere."""

import json
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO, TextIO

from goalgan_bt.runs.errors import RunError

LARGE = 256 * 2**20  # bytes: no table, frame or text of ours is larger


def open_own(path: Path) -> BinaryIO:
    """Open a file for reading, if it is one: no link, no pipe, no device, none of which a run
    writes.

    Raises:
        OSError: if it is none, or cannot be opened.
    """
    # A pipe without a writer would keep a plain open waiting for ever.
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(f"{path} is no file")
    return os.fdopen(file, "rb")


def open_to_write(path: Path) -> TextIO:
    """Open a file to append text, if it is none yet or one, and no link.

    Raises:
        OSError: if it is something else, or cannot be written.
    """
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "a", newline="")


def read_own(path: Path, most: int = LARGE) -> bytes:
    """What a file holds.

    Raises:
        OSError: if it cannot be read, is no file (see `open_own`) or is larger than `most` bytes.
    """
    with open_own(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise OSError(f"{path} has {size:,} bytes, where at most {most:,} make sense")
        return file.read(size)  # for more, as much memory would be taken at once


def check_own(folder: Path) -> None:
    """See that a folder that is going to be written into holds files and folders of its own: what
    is written to a link would land elsewhere.

    Raises:
        RunError: naming the first entry that is something else.
    """
    for place in (folder, folder / "frames", folder / "policies"):
        for entry in os.scandir(place) if place.is_dir() else ():
            plain = entry.is_file(follow_symlinks=False) or entry.is_dir(follow_symlinks=False)
            if not plain:
                kind = "a link" if entry.is_symlink() else "no file"
                raise RunError(f"{entry.path} is {kind}: a run writes into files of its own only")


def write_atomically(path: Path, write: Callable[[Any], object]) -> None:
    """Call `write(binary file)` on a temporary file that then takes `path`'s place."""
    with written_beside(path, write) as part:
        part.replace(path)


@contextmanager
def written_beside(path: Path, write: Callable[[Any], object]) -> Iterator[Path]:
    """A temporary file on which `write(binary file)` was called, complete and on the disk, for who
    lets it take `path`'s place; else it goes."""
    part = path.with_name(path.name + ".part")
    try:
        with new_file(part) as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        yield part
    finally:
        part.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON, all or nothing; what JSON does not know as text."""
    text = json.dumps(value, indent=2, default=str) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def new_file(path: Path) -> IO[bytes]:
    """A new file in the place of whatever is there, which may be a link, or of a run that was
    killed."""
    path.unlink(missing_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "w+b")
