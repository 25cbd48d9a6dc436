"""A run in a notebook: a real kernel runs the example."""

import base64
import html
import re
import urllib.request
from pathlib import Path

import nbclient
import nbformat
import numpy as np
import pytest

import goalgan_bt

EXAMPLE = Path(__file__).parents[1] / "examples/notebook.ipynb"


@pytest.mark.timeout(280)
def test_the_example_runs_from_its_first_to_its_last_cell(tmp_path):
    book = nbformat.read(EXAMPLE, as_version=4)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    code[0].source = code[0].source.replace("total_steps=400_000", "total_steps=60_000, threads=1")
    assert "60_000" in code[0].source
    code[-2].source = code[-2].source.replace("height=640", "height=640, port=0") + (
        "\nimport urllib.request\nprint(urllib.request.urlopen(page.source).status)\npage"
    )
    nbclient.NotebookClient(book, timeout=200, resources={"metadata": {"path": tmp_path}}).execute()
    trained, plotted, numbers, page, _ = (cell.outputs for cell in code)
    assert "coverage" in str(trained)
    assert any("image/png" in output.get("data", {}) for output in plotted)
    assert "array" in str(numbers)
    shown = next(o["data"]["text/html"] for o in page if "text/html" in o.get("data", {}))
    assert re.search(r'<iframe src="http://127\.0\.0\.1:\d+" width="100%" height="640"', shown)
    assert any("200" in output.get("text", "") for output in page)


def test_a_page_in_a_notebook_ends_when_it_is_closed(trained):
    page = goalgan_bt.open_run(trained).show(port=0)
    with urllib.request.urlopen(page.source, timeout=20) as answer:
        assert answer.status == 200
    page.close()
    with pytest.raises(OSError):
        urllib.request.urlopen(page.source, timeout=5)


def test_what_is_embedded_is_the_exported_page(trained):
    frame = goalgan_bt.open_run(trained).embed(300)
    head = "data:text/html;base64,"
    assert frame.source.startswith(head) and 'height="300"' in frame._repr_html_()
    page = base64.b64decode(frame.source.removeprefix(head)).decode()
    assert trained.name in html.unescape(page) and "Iteration 4" in page


def test_its_numbers_are_those_of_the_table(trained):
    metrics = goalgan_bt.open_run(trained).metrics
    assert metrics["iteration"].tolist() == [1, 2, 3, 4]
    assert np.isfinite(metrics["eval/coverage"][-1])


def test_what_is_no_run_says_so(tmp_path, folder):
    with pytest.raises(goalgan_bt.RunError, match="is no run"):
        goalgan_bt.open_run(tmp_path)
    for frame in (folder / "frames").iterdir():
        frame.unlink()
    with pytest.raises(goalgan_bt.RunError, match="no report yet"):
        goalgan_bt.open_run(folder).embed()
