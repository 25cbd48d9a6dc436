"""Every command of the README and of docs/ works, and every link leads somewhere."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import call, run_module

from goalgan_bt.learners import table
from goalgan_bt.learners.maze_config import MazeConfig
from goalgan_bt.study import plan
from goalgan_bt.viz import __main__ as viz

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SETUP = (
    "python3 -m venv",
    ".venv/bin/pip",
    "pip install",
    "printf",
    "head=",
    "export ",
    "uv pip",
    "sed -i",
    "pip-licenses",
    "cyclonedx-py",
)  # and no command of ours
SMALL = (
    "--iterations 1 --rollout.num-envs 8 --rollout.steps 5 --coverage.rollouts 1 --gan.steps 2 "
    "--gan.pretrain-steps 2 --horizon 20 --threads 1"
)


def commands():
    """Every command in fenced blocks and in the text, as it stands there."""
    found = {}
    for page in PAGES:
        text = page.read_text()
        for block in re.findall(r"```sh\n(.*?)```", text, re.S):
            for line in block.replace("\\\n", " ").split("\n"):
                if line := re.sub(r"(^|\s)#.*", "", line).strip():
                    found[" ".join(line.split())] = page.name
        for inline in re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.S)):
            if re.match(r"(python|torchrun|pytest) ", inline):
                found[inline] = page.name
    return {
        c: page for c, page in found.items() if not c.startswith(SETUP) and page != "commands.md"
    }


def of(module):
    """The arguments of each documented command of a module, but for ranks and clusters."""
    start = rf"(?:\.venv/bin/)?python -m goalgan_bt\.{module}(?:$| )"
    return sorted({re.sub(start, "", c) for c in commands() if re.match(start, c)})


def filled(words, folder):
    """With a run in the place of RUN, and a seed in that of S."""
    words = words.replace("[RUN ...]", "").replace("RUN", str(folder))
    words = re.sub(r"^runs\b", str(folder.parent), words)  # a folder of runs
    return shlex.split(re.sub(r"\bS\b", "3", words))


def put_files_of_the_page(folder):
    """What docs/custom_env.md lets its reader write."""
    text = (ROOT / "docs/custom_env.md").read_text()
    robot, _, tasks = re.findall(r"```python\n(.*?)```", text, re.S)
    (field,) = re.findall(r"```\n(#.*?)```", text, re.S)
    assert robot == (ROOT / "examples/quadruped.py").read_text()
    assert field == (ROOT / "examples/field.txt").read_text()
    for name, content in {"quadruped.py": robot, "my_tasks.py": tasks, "field.txt": field}.items():
        (folder / name).write_text(content)


@pytest.mark.parametrize("words", of("train"))
def test_every_documented_training_runs(words, tmp_path, folder, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_maze.txt").write_text("#####\n#...#\n###.#\n#S..#\n#####\n")
    if own := re.search(r"--env (\w+):\w+", words):
        put_files_of_the_page(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        if own[1] == "quadruped":
            pytest.importorskip("dm_control")
    argv = filled(words, folder)
    if {"--help", "--help-all"} & set(argv):
        assert call("train", *argv).returncode == 0
        return
    cfg = table.from_command_line(argv)
    if "warp" in argv or not isinstance(cfg, MazeConfig | table.four_rooms.FourRoomsConfig):
        pytest.importorskip("sb3_contrib" if "warp" not in argv else "mujoco_warp")
        return  # trained in test_warp.py and test_locomotion.py; here its flags were understood
    small = ["--total-steps", "500"] if "four_rooms" in words else shlex.split(SMALL)
    if "--resume" in argv:
        small = ["--iterations", "5"]
    done = call("train", *argv, *small, "--viz", "none")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("words", of("study"))
def test_every_documented_study_is_there(words):
    named = shlex.split(words)
    if named[0] not in ("NAME", "NAME_OR_FILE"):
        assert plan.load(named[0]).name == named[0]


@pytest.mark.parametrize("words", [w for w in of("plot") if w])
def test_every_documented_plot_is_drawn(words, folder, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "x.png"
    words = re.sub(r"--at( \d+)+", "--at 1 2 3 4", words)  # the run is a short one
    assert call("plot", *filled(words, folder), "--out", out).returncode == 0 and out.exists()


@pytest.mark.parametrize("words", [w for w in of("evaluate") if w])
def test_every_documented_evaluation_is_made(words, folder):
    done = call("evaluate", *filled(words, folder), "--episodes", "8")
    assert done.returncode == 0 and "in 8 episodes" in done.stdout, done.stderr


@pytest.mark.parametrize("words", [w for w in of("export") if w])
def test_every_documented_policy_is_exported(words, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    pytest.importorskip("minari" if "--minari" in words else "onnxscript")
    small = ["--episodes", "4"] if "--minari" in words else []
    done = call("export", *filled(words, folder), *small)
    assert done.returncode == 0 and "MB)" in done.stdout, done.stderr


@pytest.mark.parametrize("words", [w for w in of("share") if w])
def test_every_documented_folder_is_shared(words, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pytest.importorskip("huggingface_hub")
    done = call("share", *filled(words, folder))
    assert done.returncode == 0 and "MB)" in done.stdout, done.stderr


@pytest.mark.parametrize("words", [w for w in of("record") if w])
def test_every_documented_film_is_made(words, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pytest.importorskip("av")
    done = run_module("record", *filled(words, folder), "--size", "64")
    if "pictures need OpenGL" in done.stderr:
        pytest.skip("no EGL here")
    assert done.returncode == 0 and "MB)" in done.stdout, done.stderr


@pytest.mark.parametrize("words", [w for w in of("viz") if w])
def test_every_documented_page_is_understood(words, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cfg = viz.from_command_line(filled(words, folder))
    assert cfg.runs[0] == folder
    if cfg.export is not None:
        assert call("viz", *filled(words, folder)).returncode == 0 and cfg.export.exists()


def test_every_command_is_run_or_listed_with_its_last_result():
    listed = (ROOT / "docs/commands.md").read_text()
    for command, page in commands().items():
        words = command.split()
        script = next((w for w in words if w.endswith(".py")), None)
        module = next((w for w in words if w.startswith("goalgan_bt.")), None)
        named = script or module or " ".join(words[:3]) if words[0] != "pytest" else command
        known = f"{named}" in listed or words[0] == ".venv/bin/python"
        assert known, f"{page}: {command}"
        if script:
            assert (ROOT / script).exists(), f"{page}: {command}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_the_readme_is_short_and_its_lines_too():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 180
    assert [line for line in lines if len(line) > 120 and not line.startswith("|")] == []


def git(*words, cwd):
    given = ["git", "-c", "user.name=x", "-c", "user.email=x", *words]
    return subprocess.run(given, cwd=cwd, check=True, capture_output=True, text=True).stdout.strip()


def test_a_revision_is_the_same_as_itself_and_not_as_one_that_learns_otherwise(tmp_path):
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    copy = tmp_path / "copy"
    git("clone", "-q", str(ROOT), str(copy), cwd=tmp_path)
    settings = copy / "goalgan_bt/learners/four_rooms.py"
    changed = settings.read_text().replace("rate * (gradient -", "0.5 * rate * (gradient -")
    assert changed != settings.read_text()
    same = [sys.executable, "benchmarks/same.py", "HEAD", "--only", "rooms_actor_critic"]
    done = subprocess.run(same, cwd=copy, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    settings.write_text(changed)
    done = subprocess.run(same, cwd=copy, capture_output=True, text=True)
    assert done.returncode == 1 and "rooms_actor_critic: row" in done.stdout
