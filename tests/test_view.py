"""The page: what it reads, what it draws, what people can do to it."""

import gzip
import json
import shutil
import socket
import time
import urllib.request

import msgspec
import numpy as np
import pytest
import viser
import websockets.sync.client
import zstandard
from conftest import TINY, call, run_module, serve
from viser import _messages

from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners import table
from goalgan_bt.learners.maze import train
from goalgan_bt.runs import run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import read_frame
from goalgan_bt.runs.metrics_csv import Metrics
from goalgan_bt.runs.policies import kept_policies
from goalgan_bt.runs.run_writer import RunWriter
from goalgan_bt.study.published import published
from goalgan_bt.viz.captions import settings_table, state
from goalgan_bt.viz.curves import joined, thinned
from goalgan_bt.viz.download import as_csv
from goalgan_bt.viz.player import Player
from goalgan_bt.viz.run import Run, success
from goalgan_bt.viz.scene import ARROW, arrows, segments, tile_image
from goalgan_bt.viz.view import View, report_at


@pytest.fixture
def view(folder):
    view = View([Run(folder)], port=0)
    yield view
    view.close()


def node(view, name):
    return view.server.scene.get_handle_by_name(name)


# What it reads.


def test_a_run_is_read_whole(folder):
    run = Run(folder)
    assert run.iterations == [1, 2, 3, 4] and len(run.metrics) == 4
    assert run.env == "point_umaze" and run.maze.free.sum() == 7
    assert run.ended() == "complete" and not run.gone
    rate, measured = success(run.frame(4))
    assert rate.shape == (112,) and measured
    assert np.isclose(rate.mean(), run.metrics.column("eval/coverage")[-1], atol=1e-5)


def test_news_is_seen_and_only_news(folder):
    run = Run(folder)
    assert not run.refresh()
    shutil.copy(folder / "frames/000004.npz", folder / "frames/000009.npz")
    assert run.refresh() and run.iterations[-1] == 9
    with (folder / "metrics.csv").open("a") as file:
        file.write("5,")  # a line that is being written
    assert run.refresh() and len(run.metrics) == 4
    assert not run.refresh()


def test_metrics_are_read_as_they_grow_break_off_and_are_replaced(tmp_path):
    path = tmp_path / "metrics.csv"
    metrics = Metrics(path)
    assert not metrics.refresh() and len(metrics) == 0 and np.isnan(metrics.last("a"))
    path.write_text("iteration,a\n1,0.5\n2,")
    assert metrics.refresh() and len(metrics) == 1
    with path.open("a") as file:
        file.write("\n3,7,7\nx,1\n4,2\n")
    assert metrics.refresh() and len(metrics) == 3  # neither the row too long nor the one without
    assert np.array_equal(metrics.column("a"), [0.5, np.nan, 2.0], equal_nan=True)
    assert metrics.at(4, "a") == 2 and np.isnan(metrics.at(3, "a")) and metrics.last("a") == 2
    (tmp_path / "new").write_text("iteration,b\n1,9\n")
    (tmp_path / "new").replace(path)
    assert metrics.refresh() and metrics.column("b").tolist() == [9.0]
    assert np.isnan(metrics.column("a")).all()
    path.write_text("iteration,c\n1,10\n2,20\n2,21\n3,30\n")  # the same file, another table
    assert metrics.refresh() and metrics.at(2, "c") == 21 and metrics.at(3, "c") == 30
    assert len(metrics) == 4
    path.unlink()
    assert not metrics.refresh() and len(metrics) == 4


def test_a_frame_that_is_written_anew_is_read_anew(folder):
    run = Run(folder)
    assert run.frame(2)["goals"].shape != (1, 2)
    few = {"goals": np.zeros((1, 2)), "test_goals": np.zeros((3, 2)), "coverage": np.zeros(3)}
    RunWriter(folder, 4).frame(2, **few)
    assert run.frame(2)["goals"].shape == (1, 2)


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 nothing", None])
def test_a_damaged_frame_is_no_frame(folder, damage):
    path = folder / "frames/000003.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    assert Run(folder).frame(3) is None
    rng = np.random.default_rng(0)
    run = Run(folder)
    for _ in range(200):
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        run.frame(3)  # whatever it gives, it does not raise


def test_a_folder_that_vanishes_leaves_what_was_seen(folder):
    run = Run(folder)
    frame = run.frame(4)
    shutil.rmtree(folder)
    assert not run.refresh() and run.gone
    assert run.frame(4) is frame and run.frame(1) is None and len(run.metrics) == 4


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(RunError, match="is no run"):
        Run(tmp_path)


def test_ten_thousand_frames_are_listed_fast_and_not_all_kept(folder):
    source = folder / "frames/000004.npz"
    for i in range(5, 10_001):
        (folder / f"frames/{i:06d}.npz").hardlink_to(source)
    run = Run(folder)
    assert len(run.iterations) == 10_000
    begin = time.perf_counter()
    run.refresh()
    assert time.perf_counter() - begin < 1.0
    for i in range(1, 200):
        run.frame(i)
    assert len(run._frames) <= 64


# What it draws.


def test_each_tile_lies_where_it_is_on_the_map():
    """The one mastered tile is where it belongs: x to the right, y up, in any order of tiles."""
    maze = mazes.layout("umaze")
    tiles = maze.tiles()
    order = np.random.default_rng(0).permutation(len(tiles))
    for mastered in (0, 17, 60, 111):
        rate = np.zeros(len(tiles))
        rate[mastered] = 1.0
        image = tile_image(maze, tiles[order], rate[order]).astype(int)
        rows, columns = np.nonzero((image[..., 0] > 200) & (image[..., 3] > 0))
        height, width = image.shape[:2]
        x = maze.low[0] + (columns.mean() + 0.5) / width * (maze.high - maze.low)[0]
        y = maze.high[1] - (rows.mean() + 0.5) / height * (maze.high - maze.low)[1]
        assert np.allclose((x, y), tiles[mastered], atol=0.05)
        assert len(rows) == 15 * 15  # one tile and no more
    painted = image[..., 3] > 0
    assert painted.sum() == 112 * 15 * 15  # no wall


def test_segments_leave_out_gaps():
    lines = np.array([[[0.0, 0]], [[1, 0]], [[np.nan, 0]], [[3, 0]], [[4, 0]]])
    points, step = segments(lines)
    assert points[:, :, 0].tolist() == [[0, 1], [3, 4]] and step.tolist() == [0, 3]


def test_curves_are_thinned_to_their_ends_and_joined_over_gaps():
    assert thinned(10_000)[[0, -1]].tolist() == [0, 9_999] and len(thinned(10_000)) == 400
    nan = np.nan
    filled = joined(np.arange(5.0), np.array([nan, 1, nan, 3, nan]))
    assert np.array_equal(filled, [nan, 1, 2, 3, nan], equal_nan=True)


def test_the_last_report_is_on_show_and_follows_the_run(view, folder):
    assert "Iteration 4" in view.panel.caption.content and "measured" in view.panel.caption.content
    before = node(view, "/run0/coverage/node").image.copy()
    RunWriter(folder, 4)
    frame = dict(read_frame(folder / "frames/000004.npz"))
    frame["coverage"] = 1 - frame["coverage"]
    RunWriter(folder, 4).frame(6, **frame)
    view._last_look = 0.0
    view.tick(time.monotonic())
    assert "Iteration 6" in view.panel.caption.content
    assert not np.array_equal(before, node(view, "/run0/coverage/node").image)


def test_going_back_shows_the_past_until_one_follows_again(view, folder):
    view.panel.follow.value = False
    view._ask("slider", 0)
    view.tick(time.monotonic())
    assert "Iteration 1 " in view.panel.caption.content
    shutil.copy(folder / "frames/000004.npz", folder / "frames/000009.npz")
    view._look()
    assert "Iteration 1 " in view.panel.caption.content
    view.panel.follow.value = True
    view._look()
    assert "Iteration 9" in view.panel.caption.content


def test_playing_goes_through_all_reports(view):
    view.panel.play.value, view.panel.speed.value = True, 20
    seen, end = set(), time.monotonic() + 5
    while time.monotonic() < end and len(seen) < 4:
        view.tick(time.monotonic())
        seen.add(view._shown)
    assert seen == {0, 1, 2, 3}


def test_layers_are_shown_and_hidden(view):
    assert not node(view, "/run0/paths").visible
    view._ask("layer", ("paths", True))
    view._ask("layer", ("goals", False))
    view.tick(time.monotonic())
    assert node(view, "/run0/paths").visible and not node(view, "/run0/goals").visible


def test_frames_of_an_older_version_are_drawn_as_far_as_they_go(folder):
    frame = read_frame(folder / "frames/000004.npz")
    few = {k: frame[k] for k in ("goals", "coverage", "test_goals")}
    RunWriter(folder, 4).frame(5, **few)
    RunWriter(folder, 5).frame(6, coverage=np.zeros(3))
    RunWriter(folder, 6).frame(7, **{**few, "coverage": np.full(112, np.nan)})
    view = View([Run(folder)], port=0)
    for index in range(7):
        view._show(index)
    view.close()


def test_the_page_outlives_its_folder(view, folder):
    shutil.rmtree(folder)
    view._look()
    view._ask("goal", [0.0, 0.0])
    view.tick(time.monotonic())
    assert "is gone" in view.panel.status.content


def test_several_runs_stand_side_by_side(trained, folder):
    for i in (2, 3, 4):
        (folder / f"frames/{i:06d}.npz").unlink()  # the first is behind the second
    view = View([Run(folder), Run(trained)], port=0)
    assert node(view, "/run1").position[0] > node(view, "/run0").position[0] + 6
    assert view.panel.slider.max == 3 and "s0: Iteration 1 " in view.panel.caption.content
    pictures = [node(view, f"/run{i}/coverage/node").image.copy() for i in range(2)]
    assert not np.array_equal(*pictures)
    view.panel.follow.value = False
    view._ask("slider", 0)
    view.tick(time.monotonic())
    assert np.array_equal(node(view, "/run0/coverage/node").image, pictures[0])
    assert not np.array_equal(node(view, "/run1/coverage/node").image, pictures[1])
    view.close()
    assert report_at(Run(trained), 0) == 1 and report_at(Run(trained), np.inf) == 4


def test_what_stands_in_a_folder_is_shown_as_text(folder):
    evil = folder.rename(folder.parent / "a<img src=x>![i](b)|**c**`")
    (evil / "ended.txt").write_text("<script>x</script>\n\n# big")
    settings = json.loads((evil / "config.json").read_text()) | {"<b>": "![i](<c>)"}
    (evil / "config.json").write_text(json.dumps(settings))
    run = Run(evil)
    view = View([run], port=0)
    for text in (view.panel.status.content, settings_table(run.settings)):
        assert not set("<>![]`#") & set(text.replace("&#", ""))
    assert "c&#42;&#42;" in view.panel.status.content
    view.close()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("frames/000004.npz", "no archive"),
        ("frames/²².npz", "not a number"),
        ("metrics.csv", 'iteration,steps/train\n1,"' + 200_000 * "x"),
        ("metrics.csv", "a,b\n1,2\n"),
        ("checkpoint.pt", "half"),
        ("ended.txt", "\udcff"),
    ],
)
def test_no_file_ends_the_page(folder, file, text):
    (folder / file).write_text(text, errors="surrogatepass")
    view = View([Run(folder)], port=0)
    view._ask("csv", None)
    view._ask("all", None)
    for _ in range(3):
        view.tick(time.monotonic())
    assert "Iteration" in view.panel.caption.content and not view._trouble
    view.close()


def test_trouble_is_told_once_and_does_not_end_the_page(view, monkeypatch, capsys):
    def fail(_):
        raise RuntimeError("what nobody thought of")

    monkeypatch.setattr(view, "_look_again", fail)
    for _ in range(5):
        view.tick(time.monotonic())
    assert capsys.readouterr().err.count("what nobody thought of") == 1


def test_a_run_without_walls_is_shown(tmp_path):
    words = TINY.replace("point_umaze", "point_nd --dim 4").split()
    run_folder.write_meta(tmp_path, None)
    train(table.from_command_line(words), tmp_path)
    view = View([Run(tmp_path)], port=0)
    view._ask("all", None)
    view.tick(time.monotonic())
    assert "All tiles" in view.panel.outcome.content and not view._trouble
    view.close()


def test_the_body_walks_in_the_maze_that_was_recorded(folder):
    """Not in the map's file, which may have changed or be elsewhere."""
    settings = json.loads((folder / "config.json").read_text()) | {"map": "nowhere/my.txt"}
    (folder / "config.json").write_text(json.dumps(settings))
    player = Player(folder)
    assert player.take_newest() and player.env.maze == Run(folder).maze
    assert published(settings) == () and len(published(settings | {"map": None})) == 2


# What people can do to it.


def test_a_click_leads_to_an_attempt_with_an_outcome(view):
    view._ask("goal", np.array([0.2, 0.0]))  # within reach from the first moment
    view.tick(time.monotonic())
    end = time.monotonic() + 30
    while "reached** after" not in view.panel.outcome.content and time.monotonic() < end:
        view._play_body(time.monotonic())
    assert "Goal (0.2, 0.0): **reached** after" in view.panel.outcome.content


def test_ring_trail_and_verdict_stay_until_the_next_wish(view):
    view._ask("goal", np.array([0.2, 0.0]))
    now = time.monotonic()
    view.tick(now)
    attempt = view.stage._attempt
    view._play_body(now + attempt.seconds + 3600)
    assert view.stage._attempt is attempt and "**reached** after" in view.panel.outcome.content
    trail = node(view, "/run0/body/trail").points
    assert len(trail) == attempt.ends[0] and trail[0, 0, :2] == pytest.approx(0)
    assert (
        np.linalg.norm(node(view, "/run0/body/goal").points[..., :2] - [0.2, 0], axis=-1)
    ).max() < 0.31
    view._ask("release", None)
    view.tick(now)
    view._play_body(now)
    assert view.stage._attempt is not attempt and not view.stage.asked


def test_a_click_tells_what_is_known_of_the_place(view, folder):
    frame = read_frame(folder / "frames/000004.npz")
    tile = int(np.linalg.norm(frame["test_goals"] - [0.2, 0.1], axis=1).argmin())
    frame["goals"][:] = 3.9
    frame["goals"][7] = 0.2, 0.2
    frame["label"][7] = 1
    frame["coverage"][tile] = 0.37
    RunWriter(folder, 4).frame(4, **frame)
    view._look()
    view._ask("goal", np.array([0.2, 0.1]))
    view.tick(time.monotonic())
    told = view.panel.outcome.content
    assert "This tile is reached in **37%** (measured)" in told
    assert "The goal beside it is too easy" in told


def test_tried_tiles_are_coloured_as_they_end(view):
    view._ask("all", None)
    now = time.monotonic()
    view.tick(now)
    attempt = view.stage._attempt
    picture = lambda: node(view, "/run0/tried/node").image  # noqa: E731
    first = attempt.ends.min() * attempt.dt
    view._play_body(view.stage._began + first - 0.5 * attempt.dt)
    assert not picture()[..., 3].any()
    view._play_body(view.stage._began + attempt.seconds + 1)
    maze, goals = view.runs[0].maze, attempt.goals
    assert np.array_equal(picture(), tile_image(maze, goals, attempt.reached.astype(float)))


def test_the_body_is_that_of_the_report_on_show(view, folder):
    kept = [int(path.stem) for path in kept_policies(folder)]
    assert kept[-1] == 4 and len(kept) >= 2
    view._show(kept[0] - 1)
    assert view.stage.ready(time.monotonic()) and view.stage._player.iteration == kept[0]
    view._show(3)
    assert view.stage.ready(time.monotonic()) and view.stage._player.iteration == 4


def test_the_status_says_when_coverage_was_measured(folder):
    coverage = Run(folder).metrics.column("eval/coverage")[-1]
    steps = Run(folder).metrics.column("steps/train")[-1]
    assert f"coverage {coverage:.2f} at {steps / 1e6:.2f}M" in state(Run(folder))


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_page_is_called_by_its_run(view, encoding):
    address = f"http://127.0.0.1:{view.server.get_port()}/"
    request = urllib.request.Request(address, headers={"Accept-Encoding": encoding})
    with urllib.request.urlopen(request, timeout=10) as answer:
        assert answer.headers["Content-Encoding"] == encoding
        body = answer.read()
    page = gzip.decompress(body) if encoding == "gzip" else body
    assert f"<title>{view.runs[0].name}</title>" in page.decode()


def test_arrows_by_hand():
    there, along = np.array([[1.0, 2.0]]), np.array([[0.0, 1.0]])
    shaft, one, other = arrows(there, along)
    assert shaft[:, :2] == pytest.approx(np.array([[1, 2 - ARROW / 2], [1, 2 + ARROW / 2]]))
    for barb, side in ((one, -1), (other, 1)):
        assert barb[1] == pytest.approx(shaft[1])  # at the tip, and back from there
        assert np.sign(barb[0, 0] - 1) == side and shaft[0, 1] < barb[0, 1] < shaft[1, 1]
    assert arrows(there[:0], along[:0]).shape == (0, 2, 3)


def test_arrows_lead_to_the_goal_that_was_set_and_to_none_of_many(view, monkeypatch):
    drawn = []
    monkeypatch.setattr(view._scenes[0], "draw_ways", lambda *field: drawn.append(field))
    view._ask("goal", np.array([0.2, 0.0]))
    view.tick(time.monotonic())
    places, directions = drawn[-1]
    assert len(places) == len(view.stage._player.env.test_goals())
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1)
    near = np.linalg.norm(places - [0.2, 0.0], axis=1) < 0.4
    cosines = (directions * ([0.2, 0.0] - places)).sum(axis=1)[near]
    assert near.any() and (cosines > 0).all()
    view._ask("all", None)
    view.tick(time.monotonic())
    assert len(drawn[-1][0]) == 0


def test_without_a_heading_there_are_no_arrows(folder):
    player = Player(folder)
    player.env.heading = None
    assert len(player.ways(np.array([[0.2, 0.0]]))[0]) == 0


def test_how_an_attempt_ended_is_told_however_late(view):
    view._ask("goal", np.array([0.2, 0.0]))
    now = time.monotonic()
    view.tick(now)
    view._play_body(now)
    assert "on its way" in view.panel.outcome.content
    view._play_body(now + view.stage._attempt.seconds + 25)  # a busy machine, or nobody looked
    assert "Goal (0.2, 0.0): **reached** after" in view.panel.outcome.content


def test_what_takes_seconds_to_compute_is_shown_from_its_beginning(view, monkeypatch):
    assert view.stage.ready(time.monotonic())
    player = view.stage._player
    attempt = player.attempt

    def slow(goals):
        time.sleep(0.5)
        return attempt(goals)

    monkeypatch.setattr(player, "attempt", slow)
    view._ask("goal", np.array([0.2, 0.0]))
    now = time.monotonic()
    view.tick(now)
    assert "on its way, 0.0 s" in view.panel.outcome.content
    assert view.stage._began - now >= 0.5


def test_a_click_into_a_wall_is_answered(view):
    view._ask("goal", np.array([0.0, 2.0]))
    view.tick(time.monotonic())
    assert "free place" in view.panel.outcome.content


def test_without_a_policy_it_says_so(folder):
    (folder / "checkpoint.pt").unlink()
    view = View([Run(folder)], port=0)
    view._ask("all", None)
    view.tick(time.monotonic())
    assert "no policy to play" in view.panel.outcome.content
    view.close()


def test_the_body_acts_with_the_noise_that_was_recorded(folder):
    player = Player(folder)
    assert player.take_newest()
    policy = player._policy
    std = float(policy.bounded_log_std().detach().exp().mean())
    assert np.isclose(std, Run(folder).metrics.column("rollout/std")[-1], rtol=1e-4)


def test_csv_has_a_line_per_tile(folder):
    lines = as_csv(read_frame(folder / "frames/000004.npz")).decode().splitlines()
    assert lines[0] == "goal_0,goal_1,success,measured" and len(lines) == 113
    assert all(line.endswith(",1") for line in lines[1:])


def connected(view, origin=None):
    """A websocket to a page's server, as a browser opens it."""
    return websockets.sync.client.connect(
        f"ws://127.0.0.1:{view.server.get_port()}",
        subprotocols=[f"viser-v{viser.__version__}"],
        origin=origin,
        max_size=None,
    )


CAMERA = (1.0, 0, 0, 0), (0.0, 0, 5), 1.0, 0.1, 100.0, 600, 800, (0.0, 0, 0), (0.0, 1, 0)
LOOK = _messages.ViewerCameraMessage(*CAMERA)  # who has a camera is a client


def send(browser, message):
    browser.send(msgspec.msgpack.encode(message.as_serializable_dict()))


def unpacked(data):
    """The messages in a packet of viser's, still msgpack: two lengths, then zstd."""
    length = int.from_bytes(data[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(data[16 : 16 + length])


def wait(seconds, condition, step):
    """Do a step over and over until there is what one waits for."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        step()
        time.sleep(0.02)


def test_the_run_is_sent_as_one_page(view, folder):
    with connected(view) as browser:
        send(browser, LOOK)
        wait(10, view.server.get_clients, lambda: None)
        (client,) = view.server.get_clients().values()
        view._ask("page", client)
        view.tick(time.monotonic())
        assert view._export is not None
        wait(60, lambda: view._export is None, lambda: view.tick(time.monotonic()))
        received = b""
        while b"FileTransferStartDownload" not in received:
            received = unpacked(browser.recv(timeout=20))
    assert f"{folder.name}.html".encode() in received


@pytest.mark.parametrize("origin", ["https://evil.example", "http://localhost:1", "null"])
def test_a_page_of_another_site_is_not_let_in(view, origin):
    with pytest.raises(websockets.exceptions.InvalidStatus, match="403"), connected(view, origin):
        pass


def test_a_foreign_name_that_points_here_is_not_let_in(view):
    with socket.create_connection(("127.0.0.1", view.server.get_port()), timeout=10) as line:
        line.sendall(b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n")
        assert b" 403 " in line.recv(1000).splitlines()[0]


def test_nonsense_from_a_browser_changes_no_file_and_ends_nothing(view, folder):
    """Someone sends nonsense to every control there is."""
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    controls = list(view.server.gui._gui_input_handle_from_uuid)
    assert len(controls) >= 13
    nonsense = ("../../etc/passwd", "__import__('os').remove('x')", -(10**9), None, [1], {"a": 1})
    own = f"http://127.0.0.1:{view.server.get_port()}"
    with connected(view, own) as browser:
        send(browser, LOOK)
        for uuid in controls:
            for value in nonsense:
                send(browser, _messages.GuiUpdateMessage(uuid, {"value": value}))
        wait(10, lambda: view._requests.qsize() > 10, lambda: None)
        for _ in range(50):
            view.tick(time.monotonic())
            time.sleep(0.01)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    view.panel.follow.value = True
    view._look()
    assert "Iteration 4" in view.panel.caption.content


def test_many_wishes_are_one_attempt(view, monkeypatch):
    begun = []
    monkeypatch.setattr(view.stage, "ask", lambda place, now: begun.append(place))
    for _ in range(50):
        view._ask("all", None)
    view._ask("goal", np.array([0.2, 0.0]))
    view.tick(time.monotonic())
    assert [place.tolist() for place in begun] == [[0.2, 0.0]]


# The command.


@pytest.mark.parametrize(
    ("run", "arguments", "message"),
    [
        (call, [], "python -m goalgan_bt.viz RUN"),
        (call, ["nowhere"], "error: nowhere is no run"),
        (call, ["nowhere", "--port", "99999"], "--port must be between 0 and 65535"),
        (run_module, ["nowhere", "--frobnicate"], "--help"),
    ],
)
def test_bad_input_ends_in_one_line_and_code_2(run, arguments, message):
    done = run("viz", *arguments)
    assert done.returncode == 2 and message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_it_listens_here_only_and_ends_with_its_parent(folder):
    process, address = serve(folder)
    assert address.startswith("http://127.0.0.1:")
    process.stdin.close()
    assert process.wait(timeout=20) == 0
