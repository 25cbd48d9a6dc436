"""What a page gives to a browser as a file: one report as a table, the run as a page of its own."""

import subprocess
import sys
import tempfile
from pathlib import Path

import viser

from goalgan_bt.viz.run import Frame, success


def as_csv(frame: Frame) -> bytes:
    """Test goals and their success as a table."""
    rate, measured = success(frame)
    names = [f"goal_{i}" for i in range(frame["test_goals"].shape[1])]
    lines = [",".join([*names, "success", "measured"])]
    for goal, value in zip(frame["test_goals"], rate, strict=True):
        lines.append(",".join([*(f"{x:.4f}" for x in goal), f"{value:.4f}", str(int(measured))]))
    return ("\n".join(lines) + "\n").encode()


class Export:
    """A run on its way to a browser as one HTML page, made by a process of its own.

    Args:
        folder: the run folder.
        client: whose browser gets the page.
    """

    def __init__(self, folder: Path, client: viser.ClientHandle) -> None:
        self._name, self._client = f"{folder.name}.html", client
        self._directory = tempfile.TemporaryDirectory()
        self._path = Path(self._directory.name) / "page.html"
        words = [sys.executable, "-m", "goalgan_bt.viz", str(folder.resolve())]
        self._process = subprocess.Popen(
            [*words, "--export", str(self._path), "--with-parent"],  # it ends with this process
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        self._note = client.add_notification("One moment", "The page is being made.", loading=True)

    def done(self) -> bool:
        """Whether it has come to an end; sends the page, or says why there is none."""
        if self._process.poll() is None:
            return False
        self._note.remove()
        with self._directory:
            if self._process.returncode == 0:
                self._client.send_file_download(
                    self._name, self._path.read_bytes(), save_immediately=True
                )
            else:
                assert self._process.stderr is not None
                reason = self._process.stderr.read().decode(errors="replace")[-300:]
                self._client.add_notification("There is no page", reason, color="red")
        return True

    def cancel(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()
        self._directory.cleanup()
