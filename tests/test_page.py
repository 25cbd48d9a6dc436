"""The page in a real browser: Debian's Chromium, headless, software rendering."""

import contextlib
import io
import re
import shutil
import subprocess
import time

import numpy as np
import pytest
from conftest import call, serve, started
from PIL import Image

from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.viz.export import export
from goalgan_bt.viz.run import Run, success
from goalgan_bt.viz.scene import tile_image

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian's package chromium)"),
    pytest.mark.timeout(280),
]
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Drawing in software on busy cores takes long, which is no reason to stop it.
FLAGS += ["--disable-gpu-watchdog", "--disable-gpu-process-crash-limit"]
FLAGS += ["--disable-domain-blocking-for-3d-apis", "--disable-dev-shm-usage"]
TRAIN = "--env point_umaze --threads 1 --viz none --coverage.every 100000 --goals.episodes 200"
PATIENCE = 90_000  # milliseconds: other work may hold the cores
CAPTION = re.compile(r"^Iteration \d")


def draws(browser):
    """Whether the browser has WebGL, whatever the page."""
    page = browser.new_page()
    context = page.evaluate_handle("document.createElement('canvas').getContext('webgl2')")
    there = context.evaluate("(context) => context !== null && !context.isContextLost()")
    page.close()
    return there


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as p:
        for _ in range(3):  # its graphics process may fail to start on busy cores
            browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            if draws(browser):
                break
            browser.close()
        else:
            pytest.skip("this Chromium has no WebGL here")
        yield browser
        browser.close()


@contextlib.contextmanager
def training(*flags, out):
    """Training in the background, and its run folder."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with started("train", *TRAIN.split(), *flags, cwd=out, **pipes) as process:
        yield out / process.stdout.readline().removeprefix("run folder: ").strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished run."""
    out = tmp_path_factory.mktemp("page")
    words = *TRAIN.split(), "--total-steps", 200_000, "--out", out
    assert call("train", *words).returncode == 0
    (folder,) = out.iterdir()
    return folder


def opened(browser, address):
    # Few pixels: there is no graphics card, and the cores are needed.
    page = browser.new_page(viewport={"width": 900, "height": 600}, device_scale_factor=0.4)
    page.set_default_timeout(PATIENCE)
    page.on("console", lambda message: print("browser:", message.text))  # seen where a test fails
    page.goto(address)
    page.get_by_text("Follow live").wait_for()
    page.get_by_text(CAPTION).wait_for()
    page.get_by_text("Layers", exact=True).click()
    page.get_by_label("Coverage map").wait_for()
    return page


@pytest.fixture(scope="module")
def served(browser, folder):
    """A page over the finished run."""
    process, address = serve(folder)
    page = opened(browser, address)
    yield page
    page.close()
    process.stdin.close()
    process.wait(timeout=20)


@pytest.fixture
def page(served, folder):
    """The same as it was at first, whatever was done to it."""
    served.get_by_role("tab", name="Time").click()
    for name in ("Follow live", "Coverage map"):
        served.get_by_label(name).set_checked(True)
    served.get_by_text(last(folder)).wait_for()
    return served


def last(folder):
    """How the caption of the last report begins."""
    return re.compile(f"^Iteration {int(frame_paths(folder)[-1].stem):,} ")


def layer(page, name):
    """A layer as the browser holds it: viser's scene tree."""
    node = f"window.__viserSceneTree.getState()['/run0/{name}/node']"
    wait_for(page, lambda: page.evaluate(f"Boolean({node})"))
    return page.evaluate(
        f"(({{message, effectiveVisibility}}) => ({{visible: effectiveVisibility,"
        f" data: Array.from(message.props._data ?? [])}}))({node})"
    )


def report_shown(page, folder):
    """The number of the report whose coverage map is in the browser, pixel by pixel."""
    data, maze = bytes(layer(page, "coverage")["data"]), Run(folder).maze
    shown = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
    for path in reversed(frame_paths(folder)):
        frame = read_frame(path)
        if np.array_equal(shown, tile_image(maze, frame["test_goals"], success(frame)[0])):
            return int(path.stem)
    return 0


def colourful(page):
    """The share of the scene, as it is drawn, that is no shade of grey."""
    page.wait_for_timeout(200)
    scene = {"x": 0, "y": 150, "width": 560, "height": 450}  # without panel and notices
    image = Image.open(io.BytesIO(page.screenshot(clip=scene, timeout=60_000))).convert("RGB")
    return float((np.ptp(np.asarray(image).astype(int), axis=2) > 50).mean())


def happens(page, condition, seconds):
    end = time.monotonic() + seconds
    while not (there := condition()) and time.monotonic() < end:
        page.wait_for_timeout(100)
    return bool(there)


def wait_for(page, condition, seconds=90):
    if happens(page, condition, seconds):
        return
    rate = pictures_per_second(page)
    if rate < 1:  # with a good page, too: other work holds the cores, and there is no GPU
        pytest.skip(f"the browser draws {rate} pictures per second here and now")
    raise AssertionError(f"it did not happen in time, at {rate} pictures per second")


def pictures_per_second(page, seconds=5):
    """How fast the browser draws at the moment."""
    drawn = page.evaluate(
        """(end) => new Promise((done) => {
            let n = 0;
            const draw = () => { n += 1; requestAnimationFrame(draw); };
            draw();
            setTimeout(() => done(n - 1), end);
        })""",
        1000 * seconds,
    )
    return drawn / seconds


def report(page, number):
    """Type a number into the box beside the time slider."""
    box = page.locator("input[type=text], input[type=number]").first
    box.fill(str(number))
    box.press("Enter")


def test_the_slider_moves_the_map_back(page, folder):
    first, *_, latest = (int(path.stem) for path in frame_paths(folder))
    wait_for(page, lambda: report_shown(page, folder) == latest)
    report(page, 0)
    page.get_by_text(re.compile("^Iteration 1 ")).wait_for()
    wait_for(page, lambda: report_shown(page, folder) == first)


def test_layers_go_and_come_and_are_drawn(page):
    wait_for(page, lambda: colourful(page) > 0.1)
    whole = colourful(page)
    switch = page.get_by_label("Coverage map")
    switch.click()
    wait_for(page, lambda: not layer(page, "coverage")["visible"])
    wait_for(page, lambda: colourful(page) < 0.6 * whole)
    switch.click()
    wait_for(page, lambda: layer(page, "coverage")["visible"])
    wait_for(page, lambda: colourful(page) > 0.8 * whole)


def test_a_click_on_the_floor_is_tried(page, folder):
    page.get_by_role("tab", name="Try").click()
    outcome, asked = page.get_by_text("Policy of iteration"), page.get_by_text("This tile is")
    for x, y in ((340, 400), (300, 390), (380, 385), (280, 410)):
        page.mouse.click(x, y, delay=300)  # pressed for some pictures, as by a person
        if happens(page, asked.count, seconds=20):
            break
    wait_for(page, lambda: asked.count() and "after" in outcome.inner_text())
    told = re.search(
        r"Goal \((-?\d\.\d), (-?\d\.\d)\): (not reached|reached|fell) after \d\.\d s",
        outcome.inner_text(),
    )
    assert told and Run(folder).maze.is_free(np.array([[float(told[1]), float(told[2])]])).all()


def test_an_exported_page_plays_without_a_network(browser, folder, tmp_path):
    export(Run(folder), tmp_path / "run.html")
    context = browser.new_context(offline=True, device_scale_factor=0.4)
    context.set_default_timeout(PATIENCE)
    page, asked = context.new_page(), []
    page.on("request", lambda request: asked.append(request.url))
    page.goto((tmp_path / "run.html").as_uri())
    caption = page.locator("#caption")
    caption.get_by_text(CAPTION).wait_for()
    first = caption.inner_text()
    assert all(box["width"] < 20 for box in boxes(page, "#legend svg"))  # signs, not pictures
    assert all(box["width"] > 150 for box in boxes(page, "figure svg"))
    wait_for(page, lambda: caption.inner_text() != first)  # it plays
    page.evaluate("seek(0)")  # what a click on a curve does
    wait_for(page, lambda: caption.inner_text().startswith("Iteration 1 "))
    page.evaluate("seek(run.reports.at(-1).time)")
    wait_for(page, lambda: caption.inner_text().startswith("The last policy goes to"))
    assert not [url for url in asked if not url.startswith(("file:", "data:", "blob:", "about:"))]
    context.close()


def boxes(page, selector):
    """Where elements are on a page."""
    found = page.locator(selector)
    assert found.count()
    return [found.nth(i).bounding_box() for i in range(found.count())]


def test_it_shows_learning_and_outlives_the_trainer(browser, tmp_path):
    with training("--total-steps", "100000000", out=tmp_path) as folder:
        viewer, address = serve(folder)
        page = opened(browser, address)
        wait_for(page, lambda: report_shown(page, folder) > 0)
        first = report_shown(page, folder)
        wait_for(page, lambda: report_shown(page, folder) > first)
    page.get_by_text(last(folder)).wait_for()  # the trainer was killed
    seen = page.get_by_text(CAPTION).inner_text()
    with training("--resume", str(folder), out=tmp_path):
        wait_for(page, lambda: page.get_by_text(CAPTION).inner_text() != seen)
    page.close()
    viewer.stdin.close()
    viewer.wait(timeout=20)
