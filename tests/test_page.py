"""The page in a real browser: Debian's Chromium, headless, software rendering."""

import io
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from conftest import serve
from PIL import Image

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian's package chromium)"),
    pytest.mark.timeout(280),
]
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TRAIN = (
    "--env point_umaze --threads 1 --report-every 1 --viz none --coverage.every 100000 "
    "--goals.episodes 200"
)
CAPTION = re.compile(r"^Iteration \d")
RED, BLUE = 0, 2  # channels of a pixel


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def train(*flags, out):
    """Training in the background, and its run folder."""
    process = subprocess.Popen(
        [sys.executable, "-m", "goalgan_bt.train", *TRAIN.split(), *flags],
        cwd=out,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return process, out / process.stdout.readline().removeprefix("run folder: ").strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished run."""
    process, folder = train("--total-steps", "300000", out=tmp_path_factory.mktemp("page"))
    process.communicate(timeout=120)
    return folder


def opened(browser, address):
    page = browser.new_page(viewport={"width": 900, "height": 600})
    page.goto(address)
    page.get_by_text("Follow live").wait_for(timeout=60_000)
    page.get_by_text(CAPTION).wait_for(timeout=60_000)
    return page


@pytest.fixture
def page(browser, folder):
    process, address = serve(folder)
    page = opened(browser, address)
    yield page
    page.close()
    process.stdin.close()
    process.wait(timeout=20)


def pixels(page, channel):
    """How many pixels of the scene are clearly RED or BLUE; viser dims a scene on slow machines."""
    page.wait_for_timeout(700)  # the software renderer takes its time
    scene = {"x": 0, "y": 150, "width": 560, "height": 450}  # without panel and notices
    image = Image.open(io.BytesIO(page.screenshot(clip=scene))).convert("RGB")
    rgb = np.asarray(image).astype(int)
    others = np.delete(rgb, channel, axis=2).max(axis=2)
    return int((rgb[..., channel] - others > 50).sum())


def wait_for(page, condition, seconds=60):
    for _ in range(2 * seconds):
        if condition():
            return
        page.wait_for_timeout(500)
    raise AssertionError("it did not happen in time")


def report(page, number):
    """Type a number into the box beside the time slider."""
    box = page.locator("input[type=text], input[type=number]").first
    box.fill(str(number))
    box.press("Enter")


def test_the_map_is_painted_and_the_slider_goes_back(page):
    wait_for(page, lambda: min(pixels(page, RED), pixels(page, BLUE)) > 500)
    late_blue = pixels(page, BLUE)
    report(page, 0)
    page.get_by_text(re.compile("^Iteration 1 ")).wait_for(timeout=20_000)
    wait_for(page, lambda: pixels(page, BLUE) < 0.8 * late_blue)


def test_layers_go_and_come(page):
    wait_for(page, lambda: pixels(page, RED) > 500)
    painted = pixels(page, RED)
    switch = page.get_by_label("Coverage map")
    switch.click()
    wait_for(page, lambda: pixels(page, RED) < 0.4 * painted)
    switch.click()
    wait_for(page, lambda: pixels(page, RED) > 0.6 * painted)


def test_a_click_on_the_floor_is_tried(page):
    page.get_by_role("tab", name="Try").click()
    page.get_by_text("No goal set yet").wait_for(timeout=20_000)
    for x, y in ((340, 400), (300, 390), (380, 385), (280, 410)):
        page.mouse.click(x, y)
        page.wait_for_timeout(1500)
        if page.get_by_text("Policy of iteration").count():
            break
    outcome = page.get_by_text("Policy of iteration")
    wait_for(page, lambda: "after" in outcome.inner_text())
    assert any(word in outcome.inner_text() for word in ("reached", "fell"))


def test_it_shows_learning_and_outlives_the_trainer(browser, tmp_path):
    process, folder = train("--total-steps", "100000000", out=tmp_path)
    while not list((folder / "frames").glob("*.npz")):
        assert process.poll() is None
        signal.sigtimedwait([], 0.2)
    viewer, address = serve(folder)
    page = opened(browser, address)
    for layer in ("Body", "Goals", "Recall traces"):
        page.get_by_label(layer, exact=True).click()
    first = pixels(page, BLUE)
    wait_for(page, lambda: pixels(page, BLUE) > first + 300, seconds=90)

    process.kill()
    process.wait(timeout=20)
    page.wait_for_timeout(2000)
    seen = page.get_by_text(CAPTION).inner_text()
    resumed, _ = train("--resume", str(folder), out=tmp_path)
    wait_for(page, lambda: page.get_by_text(CAPTION).inner_text() != seen)
    resumed.kill()
    resumed.wait(timeout=20)
    viewer.stdin.close()
    viewer.wait(timeout=20)
    page.close()
