"""What a person sees while it trains: one live table, or one plain line per report."""

import contextlib
import sys
import time

from rich.console import Console
from rich.live import Live
from rich.table import Table

from goalgan_bt.runs.torchrun import speaks

ROWS = (  # label, column of metrics.csv, format, unit
    ("iteration", "iteration", "{:,.0f}", ""),
    ("training steps", "steps/train", "{:,.0f}", ""),
    ("labelling steps", "steps/label", "{:,.0f}", ""),
    ("evaluation steps", "steps/eval", "{:,.0f}", ""),
    ("training steps/s", "time/fps", "{:,.0f}", ""),
    ("time simulating", "time/simulation_share", "{:.0%}", ""),
    ("time learning", "time/learning_share", "{:.0%}", ""),
    ("coverage", "eval/coverage", "{:.3f}", "stochastic policy"),
    ("coverage", "eval/coverage_deterministic", "{:.3f}", "deterministic policy"),
    ("return", "eval/return", "{:,.1f}", "deterministic policy"),
    ("coverage", "curriculum/estimated_coverage", "{:.3f}", "estimated, free of charge"),
    ("intermediate goals", "curriculum/intermediate", "{:.0%}", ""),
    ("policy KL", "trpo/kl", "{:.4f}", "nats"),
    ("imitation loss", "imitation/loss", "{:.3f}", "nats"),
)


class Terminal:
    """Shows reports.

    Args:
        title: of the live table.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._seen: dict[str, float] = {}
        console = Console()
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def close(self) -> None:
        """Leave the terminal as it is now."""
        if self._live is not None:
            self._live.stop()

    def report(self, row: dict[str, float], left: float) -> None:
        """Show a row of metrics and the estimated time left, seconds."""
        self._seen.update({name: value for name, value in row.items() if value == value})
        if self._live is not None:
            self._live.start()  # with the first report: a rank that reports nothing shows nothing
            self._live.update(self._table(left), refresh=True)
            return
        parts = [f"{time.strftime('%H:%M:%S')} it {row['iteration']:.0f}"]
        for name, column, form in (
            ("steps", "steps/train", "{:,.0f}"),
            ("label", "steps/label", "{:,.0f}"),
            ("eval", "steps/eval", "{:,.0f}"),
            ("fps", "time/fps", "{:,.0f}"),
            ("sim", "time/simulation_share", "{:.0%}"),
            ("coverage", "eval/coverage", "{:.3f}"),
            ("deterministic", "eval/coverage_deterministic", "{:.3f}"),
            ("return", "eval/return", "{:,.1f}"),
            ("estimated", "curriculum/estimated_coverage", "{:.3f}"),
            ("intermediate", "curriculum/intermediate", "{:.0%}"),
            ("kl", "trpo/kl", "{:.3f}"),
            ("imitation", "imitation/loss", "{:.2f}"),
        ):
            value = row.get(column, float("nan"))
            if value == value:
                parts.append(f"{name} {form.format(value)}")
        print("  ".join([*parts, f"left {_duration(left)}"]), flush=True)

    def _table(self, left: float) -> Table:
        table = Table(title=self._title, show_header=False, min_width=52)
        for label, column, form, note in ROWS:
            if column in self._seen:
                table.add_row(label, form.format(self._seen[column]), note)
        table.add_row("time left", _duration(left), "Ctrl-C stops and keeps a checkpoint")
        return table


def say(text: str) -> None:
    """One line for the person at the terminal or the log."""
    print(text, flush=True)


def complain(text: str, kind: str = "error") -> None:
    """One line on standard error, if anybody listens there. Of several processes on a machine that
    torchrun started, the first speaks."""
    if not speaks() and not text.startswith("rank "):
        return
    with contextlib.suppress(OSError):
        print(f"{kind}: {text}", file=sys.stderr, flush=True)


def _duration(seconds: float) -> str:
    if seconds != seconds or seconds == float("inf"):
        return "?"
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes}m{seconds:02d}s" if minutes else f"{seconds}s"
