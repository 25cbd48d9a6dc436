"""The house: what may import what, how long a function may be, how fast the door opens."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parents[1]
FILES = [path for folder in ("goalgan_bt", "envs", "viz") for path in (ROOT / folder).rglob("*.py")]


def functions():
    """Every function of the package: where it stands, and its lines."""
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = node.end_lineno - node.lineno + 1
                yield f"{path.relative_to(ROOT)}:{node.name}", lines


def test_folders_import_downwards_and_no_files_in_a_circle(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert lint_imports(no_cache=True) == EXIT_STATUS_SUCCESS


def test_functions_are_short_and_the_loop_fits_on_a_page():
    lengths = dict(functions())
    assert len(lengths) > 400
    assert lengths["goalgan_bt/learners/maze.py:train"] <= 60
    assert {name: n for name, n in lengths.items() if n > 80} == {}


def test_folders_are_two_levels_deep_at_most():
    assert {len(path.relative_to(ROOT / "goalgan_bt").parts) for path in FILES
            if path.is_relative_to(ROOT / "goalgan_bt")} == {1, 2}  # fmt: skip


def python(code):
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_is_nothing_and_recall_needs_no_mujoco():
    loaded = "import sys, goalgan_bt; print('torch' in sys.modules, 'numpy' in sys.modules)"
    assert python(loaded) == "False False"
    recall = "import sys; from goalgan_bt import recall_traces; print('mujoco' in sys.modules)"
    assert python(recall) == "False"
    ask = "import sys; from goalgan_bt import GoalCurriculum; print('mujoco' in sys.modules)"
    assert python(ask) == "False"


@pytest.mark.parametrize("module", ["train", "study", "plot", "viz"])
def test_help_waits_for_neither_torch_nor_mujoco(module):
    code = f"""
import runpy, sys
sys.argv = ["x", "--help"]
try:
    runpy.run_module("goalgan_bt.{module}", run_name="__main__")
except SystemExit as stop:
    assert not stop.code
print("torch" in sys.modules, "mujoco" in sys.modules, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.strip() == "False False" and "--help" in done.stdout


def test_every_file_stands_in_the_tree_that_readers_are_shown():
    tree = (ROOT / "docs/tree.md").read_text() + (ROOT / "README.md").read_text()
    missing = [path.name for path in FILES if path.name != "__init__.py" and path.name not in tree]
    assert missing == []
