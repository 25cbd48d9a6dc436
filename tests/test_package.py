"""What is shipped: a wheel built from the sdist, complete, and nothing at the top but us."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Build the sdist, and the wheel from it, from a copy of the tracked files."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        target = source / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).exists() or (ROOT / name).is_symlink():
            shutil.copy2(ROOT / name, target, follow_symlinks=False)
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source],
        check=True,
        capture_output=True,
    )
    return out


def test_the_wheel_is_complete_and_installs_one_package(built):
    (wheel,) = built.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert tops == {"goalgan_bt", next(t for t in tops if t.endswith(".dist-info"))}
    ours = {str(p.relative_to(ROOT)) for p in (ROOT / "goalgan_bt").rglob("*.py")}
    ours |= {
        f"goalgan_bt/{p.relative_to(ROOT)}"
        for d in ("envs", "viz")
        for p in (ROOT / d).rglob("*.py")
    }
    ours |= {str(p.relative_to(ROOT)) for p in (ROOT / "goalgan_bt/study").glob("*.toml")}
    assert len(ours) > 100
    assert ours <= set(names) and "goalgan_bt/py.typed" in names
    assert "goalgan_bt/viz/export.html" in names
    demo = {str(p.relative_to(ROOT)) for p in (ROOT / "goalgan_bt/demo").rglob("*.npz")}
    assert demo and demo <= set(names)


def test_the_sdist_holds_what_the_wheel_needs(built):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "goalgan_bt/envs/maze.py"} <= names


def test_the_wheel_runs_from_another_directory(built, tmp_path):
    (wheel,) = built.glob("*.whl")
    target = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(target)
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(target)!r}); "
         "import goalgan_bt; print(goalgan_bt.__file__); sys.argv[1:] = ['--help-all']; "
         "import runpy; runpy.run_module('goalgan_bt.train', run_name='__main__')"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert str(target) in done.stdout and "--backtracking.trace-length" in done.stdout
