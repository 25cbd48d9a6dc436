"""Frames: what a report shows, as arrays, a file each."""

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.files import LARGE, open_own

NUMBER = re.compile(r"[0-9]{1,18}")


def frame_paths(folder: Path) -> list[Path]:
    """The frames of a run, oldest first; none where their folder is a link."""
    if (folder / "frames").is_symlink():
        return []
    return sorted(f for f in (folder / "frames").glob("*.npz") if NUMBER.fullmatch(f.stem))


def read_frame(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays of a frame (see `RunWriter.frame`).

    Raises:
        RunError: if it cannot be read.
    """
    try:
        with open_own(path) as file, zipfile.ZipFile(file) as archive:
            if sum(part.file_size for part in archive.infolist()) > LARGE:
                raise ValueError("what it holds is too large for a frame")
            file.seek(0)
            with np.load(file, allow_pickle=False) as data:
                arrays = {name: np.asarray(data[name]) for name in data.files}
    except Exception as error:  # a damaged archive raises many kinds
        raise RunError(f"cannot read the frame {path}: {error}") from None
    for name, dims in (("goals", 2), ("test_goals", 2), ("coverage", 1)):
        array = arrays.get(name)
        if array is None or array.dtype.kind not in "fiub" or array.ndim != dims:
            raise RunError(f"{path} is no frame of a run: its {name} are missing or damaged")
    if len(arrays["coverage"]) != len(arrays["test_goals"]) or arrays["test_goals"].shape[1] < 2:
        raise RunError(f"{path} is no frame of a run: coverage and test_goals do not fit")
    return arrays
