"""Moving pictures as files: GIF (extra `plots`) or MP4 (extra `movie`)."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.runs import files
from goalgan_bt.runs.errors import UsageError

KINDS = (".gif", ".mp4")


def check_libraries(path: Path) -> None:
    """See that a file of this kind can be written here.

    Raises:
        UsageError: naming the extra that is missing.
    """
    needs = ("matplotlib", "imageio") + (("av",) if path.suffix.lower() == ".mp4" else ())
    if missing := [name for name in needs if importlib.util.find_spec(name) is None]:
        extra = "movie" if "av" in missing else "plots"
        raise UsageError(f'{missing[0]} is missing: pip install "goalgan_bt[{extra}]"')


def save(images: Sequence[NDArray[np.uint8]], path: Path, per_second: float) -> None:
    """Write pictures (height, width, 3), with even sides for MP4, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
    """
    import imageio.v3 as iio

    kind = path.suffix.lower()
    how: dict[str, Any] = {"duration": 1000 / per_second, "loop": 0}
    if kind == ".mp4":
        how = {"plugin": "pyav", "codec": "libx264", "fps": per_second}
    data = iio.imwrite("<bytes>", images, extension=kind, **how)
    files.write_atomically(path, lambda file: file.write(data))
