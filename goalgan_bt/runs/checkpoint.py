"""Checkpoints: the whole training state in one file, read without pickles.

A file is what `torch.save` writes, so that `torch.load` reads it, and behind it, as the comment of
that archive, its version and its checksum: torch itself checks none, and loads a file with a
flipped bit. It is written beside the old one, which stays as `checkpoint_previous.pt`.
"""

import contextlib
import hashlib
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import torch

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.files import open_own, written_beside
from goalgan_bt.runs.terminal import complain

VERSION = 2  # of what is in it; 1 had no checksum
NAME, PREVIOUS = "checkpoint.pt", "checkpoint_previous.pt"
SEAL = re.compile(rb"goalgan_bt (\d{3}) sha256 ([0-9a-f]{64})")
SEALED = len(f"goalgan_bt 000 sha256 {'0' * 64}")
CHUNK = 2**20
MOST = 32 * 2**30  # bytes: SAC's replay of the largest body is a tenth of it


def save(state: dict[str, Any], path: Path) -> None:
    """Write a state; an old one stays in place until the new one is complete.

    Raises:
        OSError: where that fails, as on a full disk.
    """
    with _new(state, path) as part:
        part.replace(path)


def save_run(state: dict[str, Any], folder: Path) -> None:
    """Write a run's checkpoint and keep the one before it, if that is sound.

    Raises:
        OSError: where that fails; both old ones are then as they were.
    """
    path, kept = folder / NAME, folder / f"{PREVIOUS}.part"
    with _new(state, path) as part:
        if is_sound(path):
            kept.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # without hard links there is no previous one
                kept.hardlink_to(path)
                kept.replace(folder / PREVIOUS)
        part.replace(path)
    directory = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(directory)  # or a power cut could take back the new name
    finally:
        os.close(directory)


@contextmanager
def _new(state: dict[str, Any], path: Path) -> Iterator[Path]:
    """A state beside the file whose place it shall take."""
    try:
        with written_beside(path, lambda file: _write(state, file)) as part:
            yield part
    except RuntimeError as error:  # of torch's archive, which hides what stopped it
        raise (error.__context__ or error) from None


def _write(state: dict[str, Any], file: IO[bytes]) -> None:
    writer: Any = _Hashing(file)
    torch.save(state, writer)
    seal = f"goalgan_bt {VERSION:03d} sha256 {writer.hash.hexdigest()}".encode()
    file.seek(-2, os.SEEK_END)  # the length of the archive's comment, which is its last field
    file.write(len(seal).to_bytes(2, "little") + seal)


class _Hashing:
    """A file that only grows, and the checksum of what it holds."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.hash = file, hashlib.sha256()

    def write(self, data: Any) -> int:
        self.hash.update(data)
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()


def is_sound(path: Path) -> bool:
    """Whether there is a checkpoint as it was written."""
    try:
        with open_own(path) as file:
            check_seal(file)
    except (OSError, ValueError):
        return False
    return True


def check_seal(file: IO[bytes]) -> None:
    """See that a file is as it was written.

    Raises:
        ValueError: if it is not, or of another version.
    """
    size = file.seek(0, os.SEEK_END) - SEALED
    if size > MOST:
        raise ValueError(f"it has more than {MOST:,} bytes")
    file.seek(max(size, 0))
    seal = SEAL.fullmatch(file.read())
    if seal is None:
        file.seek(0)
        with contextlib.suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
            if not archive.comment:
                raise ValueError("it is of an older version of goalgan_bt: start a new run")
        raise ValueError("it is damaged or cut short")
    if int(seal[1]) != VERSION:
        raise ValueError(f"it is of format {int(seal[1])}, and this version reads {VERSION}")
    found, left = hashlib.sha256(), size - 2
    file.seek(0)
    while left > 0 and (chunk := file.read(min(CHUNK, left))):
        found.update(chunk)
        left -= len(chunk)
    found.update(b"\0\0")  # where the comment's length stands now
    if found.hexdigest() != seal[2].decode():
        raise ValueError("it is damaged: its checksum is another")


def read(path: Path) -> Any:
    """What `save` wrote.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if it is damaged or of another version.
    """
    with open_own(path) as file:
        check_seal(file)
        file.seek(0)
        with zipfile.ZipFile(file) as archive:  # ours are not compressed: no more than the file
            if sum(part.file_size for part in archive.infolist()) > os.fstat(file.fileno()).st_size:
                raise ValueError("it is no checkpoint: what it holds is larger than itself")
        file.seek(0)
        try:
            state = torch.load(file, weights_only=True)
        except Exception as error:  # torch raises many kinds
            raise ValueError(f"it is damaged ({reason(error)})") from None
    for tensor in tensors_of(state):
        if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise ValueError("it is no checkpoint: a tensor is larger than what is stored of it")
    return state


def tensors_of(state: Any) -> Iterator[torch.Tensor]:
    """All tensors of a nested state."""
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict | list | tuple):
        for part in state.values() if isinstance(state, dict) else state:
            yield from tensors_of(part)


def restore(module: Any, state: dict[str, Any]) -> None:
    """Put a state into a network, or the moments of one into an optimiser, whose settings stay what
    they are: a run that goes on may have changed its learning rate.

    Raises:
        ValueError: for moments that are none of its parameters: torch would believe their sizes,
            and read and write where nothing of its own is.
    """
    if isinstance(module, torch.optim.Optimizer):
        parameters = [param for group in module.param_groups for param in group["params"]]
        for i, moments in state["state"].items():
            for name, moment in moments.items():
                shape = torch.Size() if name == "step" else parameters[i].shape
                if moment.shape != shape or moment.dtype != torch.float32:
                    raise ValueError(f"{name} of an optimiser is of another size")
        state = {"state": state["state"], "param_groups": module.state_dict()["param_groups"]}
    module.load_state_dict(state)


@contextmanager
def loaded(path: Path) -> Iterator[Any]:
    """What `save` wrote, while it is taken over.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: for whatever goes wrong while it is read and taken over.
    """
    try:
        state = read(path)
    except ValueError as error:
        raise ValueError(f"cannot load {path}: {error}") from None
    try:
        yield state
    except Exception as error:  # of whatever it is put into
        raise ValueError(f"cannot load {path}: {OTHER} ({reason(error)})") from error


OTHER = "it is damaged or of other settings or another version"


@contextmanager
def saved(folder: Path) -> Iterator[dict[str, Any]]:
    """A run's checkpoint, while it is taken over; the one before where the last is damaged, which
    is then told.

    Raises:
        RunError: for whatever goes wrong while it is read and taken over.
    """
    path, previous = folder / NAME, folder / PREVIOUS
    try:
        state = read(path)
    except (OSError, ValueError) as error:
        missing = not os.path.lexists(path)
        if not previous.is_file():
            if missing:
                raise RunError(
                    f"{folder} has no checkpoint.pt to resume from: start a new run"
                ) from None
            raise RunError(f"cannot resume from {path}: {error}") from None
        try:
            state = read(previous)
        except (OSError, ValueError) as other:
            raise RunError(
                f"cannot resume from {path}: {error}; nor from {previous.name}: {other}"
            ) from None
        why = "there is none" if missing else error
        complain(f"{path}: {why}; the one before it is used, {previous.name}", "warning")
        path = previous
    try:
        yield state
    except Exception as error:  # of whatever it is put into
        raise RunError(f"cannot resume from {path}: {OTHER} ({reason(error)})") from None


def reason(error: Exception) -> str:
    """What went wrong with a file, in a few words: torch's errors have pages."""
    words = (str(error).strip().splitlines() or [""])[0].split(". ")[0][:160]
    return words if len(words.split()) > 1 else f"{type(error).__name__} {words}".strip()
