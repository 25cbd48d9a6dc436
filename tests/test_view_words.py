"""What a page says and shows of runs of every kind: words, the tour, several runs, four rooms,
locomotion, boxes without walls."""

import json
import re
import shutil
import time
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import TINY, call

from goalgan_bt.envs import maze as mazes
from goalgan_bt.envs.four_rooms import FourRooms
from goalgan_bt.learners import four_rooms, locomotion, table
from goalgan_bt.learners.maze import train
from goalgan_bt.runs import run_folder
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import Metrics
from goalgan_bt.runs.policies import MOST, forget_after, keep_policy, kept_policies, kept_policy
from goalgan_bt.viz import palette
from goalgan_bt.viz.captions import covers, doing, practised
from goalgan_bt.viz.download import as_csv
from goalgan_bt.viz.layers import GOALS, OF_KIND, legend
from goalgan_bt.viz.player import Player
from goalgan_bt.viz.run import Run, visits
from goalgan_bt.viz.tour import TOUR
from goalgan_bt.viz.view import View


def opened(*folders):
    return View([Run(folder) for folder in folders], port=0)


def node(view, name):
    return view.server.scene.get_handle_by_name(name)


def bodies_of(view):
    """Where the bodies are in the scene."""
    scene = view.server.scene
    assert node(view, "/bodies") is not None, sorted(scene._handle_from_node_name)
    return [np.asarray(node(view, "/bodies").position[:2])]


# Words.


def test_the_way_from_the_start_is_counted_along_the_corridors():
    maze = mazes.layout("umaze")  # start at the lower left, the end is the upper left
    places = np.array([[0.0, 0.0], [0.9, -0.9], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 2.0]])
    assert maze.way_from_start(places)[:5].tolist() == [0, 0, 4, 8, 12]
    assert np.isnan(maze.way_from_start(places)[5])  # a wall


def test_what_is_practised_by_hand(folder):
    run = Run(folder)
    frame = dict(read_frame(folder / "frames/000004.npz"))
    frame["goals"] = np.array([[4.0, 0.0]] * 5 + [[4.0, 4.0]] * 5 + [[0.0, 0.0]] * 10)
    frame["label"] = np.array([0] * 10 + [1] * 10)  # what is too easy does not count
    told = practised(run, frame)
    assert told.startswith("Now it practises 4 to 8 m from the start (the farthest place of")
    assert "is 12 m away" in told
    success = run.metrics.column("rollout/success")[-1]
    assert f"{success:.0%} of its attempts succeed" in told and "walls" not in told
    frame["goals"][10:15] = 0.0, 2.0
    assert "25% of the goals lie in walls" in practised(run, frame)
    frame["goals"][:] = 0.0, 2.0
    assert "no body can reach" in practised(run, frame)


def test_one_figure_of_coverage_is_told_and_the_other_with_its_date(tmp_path):
    def told(*rows):
        head = "iteration,steps/train,eval/coverage,curriculum/estimated_coverage"
        (tmp_path / "metrics.csv").write_text("\n".join([head, *rows]) + "\n")
        metrics = Metrics(tmp_path / "metrics.csv")
        metrics.refresh()
        return covers(metrics, "maze")

    assert told("1,1000000,,") == ""
    assert told("1,1000000,0.5,0.4") == "It reaches **50%** of the maze."
    assert told("1,1000000,,0.4") == "It reaches about **40%** of the maze (its own estimate)."
    later = told("1,1000000,0.5,0.4", "2,2000000,,0.6")
    assert later.startswith("It reaches about **60%** of the maze (its own estimate; measured at")
    assert later.endswith("1.00M steps: 50%).")


def test_a_run_that_goes_on_and_one_that_has_ended_say_so(folder):
    covered = Run(folder).metrics.column("eval/coverage")[-1]
    told = doing(Run(folder))
    assert told.startswith("A body has learned") and f"**{covered:.0%}** of the maze" in told
    (folder / "ended.txt").unlink()
    told = doing(Run(folder))
    assert told.startswith("A body learns to reach every place") and "Now it practises" in told
    for path in frame_paths(folder):
        path.unlink()
    assert "It has just begun" in doing(Run(folder))


def test_every_sign_of_the_scene_is_in_the_legend():
    shown = legend("goals")
    for goal in palette.GOALS.values():
        assert goal.text in shown and palette.css(goal.fill) in shown
    for words in ("never", "always reached", "start", "goal of the body", "its trail"):
        assert words in shown
    assert "as recalled" in shown and "recall trace" in shown and "remembered" in shown
    assert "most visited" in legend("rooms") and legend("running") == ""


# The tour.


def test_the_tour_shows_what_it_speaks_of_and_puts_all_back(folder):
    view = opened(folder)
    panel = view.panel
    view._ask("layer", ("paths", True))
    panel._boxes["paths"].value = True
    assert len(TOUR) == 5 and all(set(stop.layers) <= set(GOALS) for stop in TOUR)
    for number, stop in enumerate(TOUR, 1):
        panel._next_stop()
        view.tick(time.monotonic())
        assert f"**{number} of 5: {stop.title}.**" in panel._told.content and panel._told.visible
        for layer in GOALS:
            assert node(view, f"/run0/{layer}").visible == (layer in stop.layers), layer
    panel._next_stop()
    view.tick(time.monotonic())
    assert not panel._told.visible and "again" in panel._next.label
    for name, layer in GOALS.items():
        assert node(view, f"/run0/{name}").visible == (layer.shown or name == "paths")
    panel._next_stop()
    assert "**1 of 5" in panel._told.content
    panel._end_tour()
    assert not panel._told.visible
    view.close()


def test_keys_move_through_the_reports(folder):
    view = opened(folder)
    commands = view.server.gui._command_handle_from_uuid.values()
    keys = {command.hotkey for command in commands}
    assert {"space", "pageup", "pagedown", "home", "T", "H"} <= keys
    view.panel._key_pressed("step", -1, None)
    view.tick(time.monotonic())
    assert view._shown == 2 and not view.panel.follow.value and view.panel.slider.value == 2
    view.panel._key_pressed("step", -(10**9), None)
    view.tick(time.monotonic())
    assert view._shown == 0
    view.panel._toggle_play()
    assert view.panel.play.value
    view.close()


# Several runs.


def test_several_runs_stand_in_a_grid_with_names_in_the_colours_of_their_curves(trained, tmp_path):
    copies = []
    for seed in range(5):
        copy = shutil.copytree(trained, tmp_path / f"run{seed}")
        settings = json.loads((copy / "config.json").read_text()) | {"seed": seed}
        (copy / "config.json").write_text(json.dumps(settings))
        copies.append(copy)
    view = opened(*copies)
    places = np.array([node(view, f"/run{i}").position[:2] for i in range(5)])
    assert len(set(places[:3, 1])) == 1 and len(set(places[3:, 1])) == 1  # three above, two below
    assert (np.diff(places[:3, 0]) > 8).all() and (places[3:, 1] < places[0, 1] - 8).all()
    curve = view.panel.curves._handles[0]
    for i in range(5):
        assert node(view, f"/run{i}/name/text").text == f"point_umaze recall_traces s{i}"
        red, green, blue = node(view, f"/run{i}/name/strip").color
        assert (
            f"#{red:02x}{green:02x}{blue:02x}" == palette.RUNS[i] == curve.series[1 + i]["stroke"]
        )
    assert len(view.panel.curves._handles) > 5  # not of coverage alone
    view.close()


def test_a_click_on_one_of_several_runs_chooses_it_and_is_tried_there(trained, folder):
    view = opened(trained, folder)
    there = np.array(view._offsets[1])
    view._ask("goal", there + np.array([0.2, 0.0]))
    now = time.monotonic()
    view.tick(now)
    assert view._chosen == 1 and view.panel._run.value.startswith("2: ")
    view._play_body(now + 1e-3)
    (centre,) = bodies_of(view)
    assert centre == pytest.approx(there, abs=0.1)
    assert "Goal (0.2, 0.0)" in view.panel.outcome.content
    assert len(node(view, "/run1/body/goal").points) > 10
    view._ask("choose", 0)
    view.tick(now)
    assert view._chosen == 0 and len(node(view, "/run1/body/goal").points) == 1
    view._ask("choose", "no such run")
    view.tick(now)
    assert view._chosen == 0 and not view._trouble
    view.close()


def test_two_runs_of_one_name_can_be_told_apart(trained, tmp_path):
    other = shutil.copytree(trained, tmp_path / trained.name)
    view = opened(trained, other)
    assert len(set(view.panel._run.options)) == 2
    view._ask("choose", 1)
    view.tick(time.monotonic())
    assert view._chosen == 1
    view.close()


def test_another_run_is_chosen_in_the_past_that_is_on_show(trained, folder):
    view = opened(trained, folder)
    view.panel.follow.value = False
    view._ask("slider", 0)
    view._ask("choose", 1)
    view.tick(time.monotonic())
    assert view.stage.report == view._reports[1] and view.stage.report < 4
    assert f"Iteration {view.stage.report} " in view.panel.caption.content
    assert view.runs[1].task_and_method() in view.panel.caption.content.replace("&#95;", "_")
    view.close()


def test_the_table_is_that_of_the_report_on_show(trained, folder):
    (folder / "frames/000001.npz").unlink()
    (folder / "frames/000002.npz").unlink()
    sent = []
    view = opened(trained, folder)
    client = SimpleNamespace(send_file_download=lambda name, data: sent.append(data))
    view._ask("choose", 1)
    view.panel.follow.value = False
    view._ask("slider", 2)
    view._ask("csv", client)
    view.tick(time.monotonic())
    assert sent == [as_csv(read_frame(folder / f"frames/{view._reports[1]:06d}.npz"))]
    view.close()


def test_a_refusal_can_be_read_while_the_body_plays(folder):
    view = opened(folder)
    now = time.monotonic()
    view._play_body(now)
    view._ask("goal", np.array([0.0, 2.0]))  # a wall
    view._serve_all(now + 0.1)
    view._play_body(now + 0.2)
    assert "free place" in view.panel.outcome.content
    view._play_body(now + 10)
    assert "Policy of iteration" in view.panel.outcome.content
    view.close()


def test_the_headline_knows_that_a_run_has_ended_or_gone(folder):
    (folder / "ended.txt").unlink()
    view = opened(folder)
    assert "body learns" in view.panel.doing.content
    (folder / "ended.txt").write_text("interrupted")
    view._look()
    assert "has learned" in view.panel.doing.content
    shutil.rmtree(folder)
    view._look()
    assert "Click on" not in view.panel.doing.content
    view.close()


def test_runs_of_several_kinds_share_a_page(trained, rooms):
    view = opened(trained, rooms)
    boxes = {name: box.label for name, box in view.panel._boxes.items()}
    assert boxes["coverage"] == "Coverage map / Visits" and boxes["goals"] == "Goals"
    assert view.panel.caption.content.startswith(
        view.runs[0].task_and_method().replace("_", "&#95;")
    )
    for plot, handle in zip(view.panel.curves._plots, view.panel.curves._handles, strict=True):
        assert len(handle.series) == 2 + len(view.panel.curves._levels(plot))  # x, and one run
    view.close()


def test_too_many_runs_are_one_line(trained, tmp_path):
    for i in range(17):
        (tmp_path / str(i)).mkdir()
        shutil.copy(trained / "config.json", tmp_path / str(i))
    done = call("viz", tmp_path)
    assert done.returncode == 2 and "at most 16 runs, and there are 17" in done.stderr


# Policies that are kept.


def state_of(iteration):
    parts = {"policy": {}, "places": {}, "gan": {"much": 1}}
    return {"learner": parts, "run": {"iteration": iteration}, "collector": 1}


def test_kept_policies_are_thinned_and_the_one_before_is_found(tmp_path):
    for iteration in range(10, 10 * (MOST + 2), 10):
        keep_policy(state_of(iteration), tmp_path)
    kept = [int(path.stem) for path in kept_policies(tmp_path)]
    assert kept == [10, *range(30, 10 * (MOST + 2), 10)]  # the first and the last stay
    assert kept_policy(tmp_path, 29).stem == "000010" and kept_policy(tmp_path, 50).stem == "000050"
    assert kept_policy(tmp_path, 3).stem == "000010" and kept_policy(tmp_path, None) is None
    forget_after(tmp_path, 50)
    assert [int(path.stem) for path in kept_policies(tmp_path)] == [10, 30, 40, 50]


def test_kept_policies_stay_spread_over_a_long_run(tmp_path):
    for iteration in range(1, 301):
        keep_policy(state_of(iteration), tmp_path)
    kept = [int(path.stem) for path in kept_policies(tmp_path)]
    assert len(kept) == MOST and kept[0] == 1 and kept[-1] == 300
    assert max(np.diff(kept)) <= 4 * 300 / MOST


def test_policies_are_not_written_or_removed_through_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/000009.pt").write_bytes(b"mine")
    (tmp_path / "policies").symlink_to(tmp_path / "elsewhere")
    keep_policy(state_of(5), tmp_path)
    forget_after(tmp_path, 0)
    assert [p.name for p in (tmp_path / "elsewhere").iterdir()] == ["000009.pt"]
    assert kept_policies(tmp_path) == []


def test_a_damaged_kept_policy_is_passed_over(folder):
    first, *_, last = kept_policies(folder)
    player = Player(folder)
    first.write_bytes(b"nothing")
    assert player.take(int(first.stem)) and player.iteration == 4  # that of the checkpoint
    assert player.take(int(last.stem)) and player.iteration == int(last.stem)


# Four rooms.


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """A finished run in four rooms."""
    out = tmp_path_factory.mktemp("rooms")
    words = "--env", "four_rooms_9", "--total-steps", 30_000, "--viz", "none", "--out", out
    assert call("train", *words).returncode == 0
    return next(out.iterdir())


def test_four_rooms_are_drawn_as_they_are(rooms):
    run, world = Run(rooms), FourRooms(9)
    assert run.kind == "rooms" and run.maze.rows == world.rows
    frame = run.frame(run.iterations[-1])
    cells = frame["test_goals"]
    assert len(cells) == run.maze.free.sum() and run.maze.is_free(cells).all()
    assert {tuple(x) for x in cells} == {tuple(x) for x in run.maze.cell_centres()}
    assert frame["goals"].tolist() == [[6, -6]] and [0, 0] in cells.tolist()
    assert run.metrics.column("train/states")[-1] == (frame["visits"] > 0).sum()


def test_the_arrows_of_four_rooms_go_where_the_policy_goes():
    """By hand: of a policy that always goes right, and of one that does not care."""
    world = FourRooms(7)
    learner = four_rooms.ActorCritic(*world.next_state.shape)
    assert np.abs(four_rooms.frame(world, learner, np.zeros(1))["policy"]).max() < 1e-12
    learner.logits[:, 1] = 50.0
    picture = four_rooms.frame(world, learner, np.zeros(len(world.cells), dtype=int))
    assert np.allclose(picture["policy"], [1, 0])
    for state, place in enumerate(picture["test_goals"]):
        after = picture["test_goals"][world.next_state[state, 1]]
        assert (after - place).tolist() in ([1, 0], [0, 0])
    learner.logits[:, 0] = 100.0
    policy = four_rooms.frame(world, learner, np.zeros(1))["policy"]
    assert np.allclose(policy, [0, 1])  # up is up


def test_visits_are_shown_on_a_scale_of_logarithms():
    times = {"test_goals": np.zeros((4, 2)), "visits": np.array([0, 1, 9, 99])}
    wanted = np.log([1, 2, 10, 100]) / np.log(100)
    assert visits(times) == pytest.approx(wanted)
    assert visits(times | {"visits": np.zeros(4)}).tolist() == [0, 0, 0, 0]
    assert visits({"test_goals": np.zeros((4, 2))}).tolist() == [0, 0, 0, 0]


def test_four_rooms_have_a_page_a_plot_and_an_export(rooms, tmp_path):
    view = opened(rooms)
    for _ in range(3):
        view.tick(time.monotonic())
        view._play_body(time.monotonic())
    assert not view._trouble and "cells visited" in view.panel.caption.content
    assert "four rooms" in view.panel.doing.content
    assert len(node(view, "/run0/policy/node").points) > 10
    view._ask("goal", np.array([0.2, 0.0]))
    view.tick(time.monotonic())
    assert not view._trouble
    view.close()
    assert call("plot", rooms, "--out", tmp_path / "rooms.png").returncode == 0
    done = call("viz", rooms, "--export", tmp_path / "rooms.html")
    assert done.returncode == 0, done.stderr


# Locomotion.


def test_the_policy_of_locomotion_is_there_while_it_learns(tmp_path):
    """So that the page needs no checkpoint, which holds all that SAC has seen."""
    pytest.importorskip("sb3_contrib")
    from goalgan_bt.viz.walker import Walker

    words = ["--env", "hopper", "--method", "sac", "--viz", "none", "--total-steps", "250"]
    cfg = table.from_command_line([*words, "--episodes", "1", "--out", str(tmp_path)])
    folder = run_folder.new_run(tmp_path, "hopper", 0, asdict(cfg))
    asked = []

    class Early:  # stops after the second measurement
        @property
        def requested(self):
            asked.append((folder / "policy.pt").exists())
            return len(Run(folder).metrics) >= 2

    locomotion.train(cfg, folder, Early())
    assert asked[0] is False and asked[-1] is True and (folder / "checkpoint.pt").exists()
    (folder / "checkpoint.pt").unlink()
    assert Walker(folder).take(None)


@pytest.mark.parametrize("method", ["trpo", "sac"])
def test_locomotion_has_a_page_whose_body_walks(tmp_path, method):
    pytest.importorskip("sb3_contrib")
    words = ["--env", "hopper", "--method", method, "--viz", "none", "--out", str(tmp_path)]
    words += ["--total-steps", "1200" if method == "sac" else "4096", "--episodes", "1"]
    cfg = table.from_command_line(words)
    folder = run_folder.new_run(tmp_path, "hopper", 0, asdict(cfg))
    locomotion.train(cfg, folder)
    view = opened(folder)
    now = time.monotonic()
    view._play_body(now)
    assert "An episode of the newest policy" in view.panel.outcome.content
    attempt = view.stage._attempt
    assert attempt.states.shape[1:] == (1, 6) and len(attempt.states) > 5
    far = attempt.states[-1, 0, 0] - attempt.states[0, 0, 0]
    view._play_body(now + attempt.seconds + 0.5)
    assert re.search(r"return \*\*-?\d", view.panel.outcome.content)
    assert view.stage._bodies.middle[0] == pytest.approx(attempt.states[-1, 0, 0], abs=1e-6)
    assert abs(node(view, "/run0/ground").position[0] + far % 1.0) < 1.0
    titles = [plot.title for plot in view.panel.curves._plots]
    assert titles[0] == "Return of an episode" and not view._trouble
    view.close()


def test_a_walker_plays_what_the_agent_learned(tmp_path):
    """The return of its episode is that of the agent's own evaluation on the same first state."""
    pytest.importorskip("sb3_contrib")
    from goalgan_bt.viz.walker import LONGEST, Walker

    words = ["--env", "hopper", "--viz", "none", "--total-steps", "8192", "--episodes", "1"]
    cfg = table.from_command_line([*words, "--out", str(tmp_path)])
    folder = run_folder.new_run(tmp_path, "hopper", 0, asdict(cfg))
    locomotion.train(cfg, folder)
    walker = Walker(folder)
    assert walker.take(None)
    attempt = walker.attempt(walker.some_goal())
    agent, test_env = locomotion.make(cfg)
    saved = __import__("torch").load(folder / "policy.pt", weights_only=True)
    agent.policy.load_state_dict(saved["policy"])
    test_env.obs_rms.mean, test_env.obs_rms.var = saved["mean"].numpy(), saved["var"].numpy()
    test_env.venv.seed(0)
    observation, total = test_env.reset(), 0.0
    for _ in range(LONGEST):
        action, _ = agent.predict(observation, deterministic=True)
        observation, reward, done, _ = test_env.step(action)
        total += float(reward[0])
        if done[0]:
            break
    assert walker.returned == pytest.approx(total, rel=1e-6)
    assert attempt.fell[0] == done[0]


# Boxes without walls.


def test_a_box_has_axes_that_say_which_dimensions_are_seen(tmp_path):
    run_folder.write_meta(tmp_path, None)
    train(
        table.from_command_line(TINY.replace("point_umaze", "point_nd --dim 4").split()), tmp_path
    )
    view = opened(tmp_path)
    assert node(view, "/run0/axis0").text == "dimension 1 of 4, m"
    assert node(view, "/run0/axis1").text == "dimension 2 of 4, m"
    assert node(view, "/run0/floor") is None  # nothing that cuts the dots
    assert "of this box" in view.panel.doing.content or "this box" in view.panel.doing.content
    view.close()


def test_layers_of_each_kind_have_words():
    for layers in OF_KIND.values():
        for layer in layers.values():
            assert layer.label and layer.hint.endswith(".")
