"""A run to look at from Python, above all in a notebook: its figures, its page, its numbers.

run = goalgan_bt.open_run(trained.folder)
run.plot()
run.show()
"""

import base64
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.metrics_csv import Metrics
from goalgan_bt.viz.page_process import PageProcess
from goalgan_bt.viz.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Frame:
    """A page inside of a page, which notebooks show.

    Attributes:
        source: its address, or the page itself as `data:...`.
    """

    def __init__(self, source: str, height: int, page: PageProcess | None = None) -> None:
        self.source, self._height, self._page = source, height, page

    def _repr_html_(self) -> str:
        size = f'width="100%" height="{self._height}" style="border:0"'
        return f'<iframe src="{self.source}" {size}></iframe>'

    def close(self) -> None:
        """End the page, if it is live; otherwise it ends with Python."""
        if self._page is not None:
            self._page.close()


class OpenRun:
    """A run to look at.

    Args:
        folder: the run folder, of a run that goes on or has ended.

    Attributes:
        metrics: what it has measured so far, (n,) each by name, NaN where nothing was measured.

    Raises:
        RunError: if the folder is no run.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        Run(self.folder)

    @property
    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """Columns of `metrics.csv` by name, (n,) each; NaN where there is no number."""
        table = Metrics(self.folder / "metrics.csv")
        table.refresh()
        return {name: table.column(name) for name in table.names}

    def plot(self, maps: int = 4, at: tuple[int, ...] = (), width: float | None = None) -> "Figure":
        """Coverage over the maze and over training, as `python -m goalgan_bt.plot` draws it.

        Args:
            maps: coverage maps, spread over training.
            at: or the iterations whose maps to draw.
            width: in millimetres, for print.

        Raises:
            UsageError: for a number of maps or a width that make no sense.
            RunError: if matplotlib is missing (extra `plots`), or there is nothing to draw yet.
        """
        try:
            from goalgan_bt.viz import pictures
        except ImportError:
            raise RunError('plots need matplotlib: pip install "goalgan_bt[plots]"') from None
        if not 1 <= maps <= 50 or not (width is None or 60 <= width <= 1000):
            raise UsageError("plot draws 1 to 50 maps, and figures for print 60 to 1000 mm wide")
        with pictures.for_print(width is not None):
            return pictures.overview([self.folder], maps, tuple(np.atleast_1d(at).tolist()), width)

    def show(self, height: int = 640, port: int = 8080) -> Frame:
        """The page over the run, live, for a notebook on this machine. Ends with Python.

        Args:
            height: in pixels.
            port: where it shall listen; the next free one, if it is busy.

        Raises:
            RunError: if there is no page within a minute.
        """
        page = PageProcess("127.0.0.1", port)
        page.open(self.folder)
        address = page.wait(60)
        if address is None:
            page.close()
            raise RunError("the page has not started: python -m goalgan_bt.viz says why")
        return Frame(address, height, page)

    def embed(self, height: int = 640) -> Frame:
        """The page over the run as it is now, inside of the notebook: it needs no server, and is
        there for whoever reads the notebook later. Some megabytes.

        Args:
            height: in pixels.

        Raises:
            RunError: if the run holds no report yet.
        """
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "run.html"
            words = [
                sys.executable,
                "-m",
                "goalgan_bt.viz",
                str(self.folder),
                "--export",
                str(path),
            ]
            done = subprocess.run(words, capture_output=True, text=True)
            if done.returncode:
                raise RunError(done.stderr.strip().removeprefix("error: "))
            page = base64.b64encode(path.read_bytes()).decode()
        return Frame(f"data:text/html;base64,{page}", height)


def open_run(folder: Path | str) -> OpenRun:
    """A run to look at (see `OpenRun`).

    Raises:
        RunError: if the folder is no run.
    """
    return OpenRun(folder)
