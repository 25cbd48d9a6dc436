"""The measurements of docs/reliability.md, small; and the document itself."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(script, *words):
    return subprocess.run(
        [sys.executable, ROOT / "benchmarks" / script, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=280,
    )


def test_killed_trainings_end_the_same(tmp_path):
    done = run("kills.py", "--kills", 8, "--seed", 1, "--json", tmp_path / "kills.json")
    assert done.returncode == 0, done.stderr
    counts = json.loads((tmp_path / "kills.json").read_text())
    assert counts == {
        "runs": 4,
        "kills": 8,
        "while_saving": 4,
        "unreadable": 0,
        "lost": 0,
        "different": 0,
    }


def test_damaged_inputs_work_or_end_in_the_clear_error(tmp_path):
    done = run("fuzz.py", "--cases", 600, "--seed", 7, "--json", tmp_path / "fuzz.json")
    assert done.returncode == 0, done.stderr
    counts = json.loads((tmp_path / "fuzz.json").read_text())
    assert sum(kind["cases"] for kind in counts.values()) >= 600
    assert all(kind["clear error"] + kind["fine"] == kind["cases"] for kind in counts.values())


def test_a_fault_in_a_reader_would_be_found(tmp_path, monkeypatch):
    """The fuzzer itself: it tells a traceback, a hang and two lines from the clear error."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    fuzz = pytest.importorskip("fuzz")
    monkeypatch.setattr(fuzz, "PATIENCE", 0.2)

    def case(kind):
        def fails(rng):
            if kind == "hang":
                while True:
                    pass
            raise {"clear": ValueError("one line"), "two": ValueError("a\nb")}.get(
                kind, KeyError(1)
            )

        return fails

    import signal

    before = signal.signal(signal.SIGALRM, fuzz.too_long)
    try:
        assert fuzz.one(case("clear"), None) == "clear error"
        assert fuzz.one(case("two"), None).startswith("more than one line")
        assert "KeyError" in fuzz.one(case("traceback"), None)
        assert "TimeoutError" in fuzz.one(case("hang"), None)
    finally:
        signal.signal(signal.SIGALRM, before)


def test_the_document_holds_the_counts(tmp_path):
    """Those of the files, none of them wrong."""
    text = (ROOT / "docs/reliability.md").read_text()
    for name, words in (("kills.json", "trainings killed"), ("fuzz.json", "all damaged inputs")):
        counts = json.loads((ROOT / "docs/runs" / name).read_text())
        (line,) = [line for line in text.splitlines() if words in line]
        cases = counts["kills"] if "kills" in counts else sum(n["cases"] for n in counts.values())
        assert f" {cases:,} |" in line and line.rstrip(" |*").endswith(" 0"), line


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_two_hundred_kills(tmp_path):
    done = subprocess.run([sys.executable, ROOT / "benchmarks/kills.py", "--kills", "200"])
    assert done.returncode == 0


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_hundred_thousand_damaged_inputs(tmp_path):
    done = subprocess.run([sys.executable, ROOT / "benchmarks/fuzz.py", "--cases", "100000"])
    assert done.returncode == 0
