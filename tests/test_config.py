import json
import re
from dataclasses import asdict

import pytest

from goalgan_bt import envs
from goalgan_bt.learners import maze_config, table
from goalgan_bt.runs.command_line import whole_numbers
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.run_folder import write_settings


@pytest.mark.parametrize("name", envs.NAMES)
def test_every_environment_has_a_preset_that_can_be_run(name):
    cfg = maze_config.preset(name)
    table.check(cfg)
    assert cfg.env == name
    assert cfg.backtracking.trace_length == (50 if name.startswith("ant") else 20)


@pytest.mark.parametrize("env", ["point_umaze", "ant_umaze"])
def test_the_command_line_overrides_the_preset(env):
    flags = ["--backtracking.trace-length", "7", f"--env={env}", "--trpo.max-kl", "0.5"]
    cfg = table.from_command_line(flags)
    assert (cfg.env, cfg.backtracking.trace_length, cfg.trpo.max_kl) == (env, 7, 0.5)
    assert cfg.total_steps == maze_config.preset(env).total_steps


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env", "ant_nowhere"], "unknown environment 'ant_nowhere': "),
        (["--total-steps", "-5"], "--total-steps must be greater than 0, not -5"),
        (["--trpo.max-kl", "0"], "--trpo.max-kl must be greater than 0"),
        (["--discount", "1.5"], "--discount must be between 0 and 1"),
        (["--backtracking.trace-length", "-1"], "--backtracking.trace-length must be 0 or more"),
        (["--backtracking.trace-length", "1000000000"], "trace_length times traces must be"),
        (["--goals.r-min", "0.9"], "--goals.r-min must be less"),
        (["--no-such-flag", "1"], "no-such-flag"),
        (["--seed", "three"], "--seed cannot be 'three'; --help-all tells what it takes"),
        (
            ["--total-steps", "1.5e0"],
            "--total-steps cannot be '1.5e0'; --help-all tells what it takes",
        ),
        (["--dim", "3"], "--dim goes with point_nd: ant_umaze has two dimensions"),
        (["--resume", "nowhere"], "nowhere is no run"),
        (["--policy.final-std", "0"], "--policy.final-std must be greater than 0"),
        (["--policy.final-std", "0.01"], "must not be less than --policy.min-std"),
        (["--policy.hidden", "8", "-5"], "--policy.hidden"),
        (["--backtracking.min-transitions", "0"], "greater than 0"),
        (["--backtracking.buffer", "10"], "--backtracking.min-transitions must not be more"),
        (["--seed", "99999999999999999999999"], "--seed must be a sane number"),
        (["--rollout.num-envs", "1000000000"], "--rollout.num-envs must be between 1 and 100000"),
        (["--threads", "100000000"], "--threads must be at most"),
        (["--trpo.max-kl", "inf"], "--trpo.max-kl must be finite"),
        (["--goals.neighbours", "0"], "greater than 0"),
        (["--horizon", "7", "--action-repeat", "3"], "multiple of --action-repeat"),
        (["--env", "point_nd", "--map", "x.txt"], "point_nd has no walls"),
        (["--env", "point_nd", "--physics", "warp"], "point_nd is no MuJoCo model"),
        (["--physics", "bullet"], "bullet"),
        (["--device", "cuda"], "--device is mujoco-warp's"),
    ],
)
def test_bad_flags_are_one_clear_line(flags, message):
    with pytest.raises((UsageError, RunError)) as error:
        table.from_command_line(flags)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_settings_survive_the_run_folder(tmp_path):
    cfg = table.from_command_line(
        ["--env", "point_umaze", "--policy.hidden", "8", "9", "--out", "x"]
    )
    write_settings(tmp_path, asdict(cfg))
    assert table.load(tmp_path) == cfg


def test_resume_starts_from_the_runs_settings(tmp_path):
    cfg = table.from_command_line(["--env", "point_spiral", "--seed", "3"])
    write_settings(tmp_path, asdict(cfg))
    cfg = table.from_command_line(["--resume", str(tmp_path), "--iterations", "9"])
    assert (cfg.env, cfg.seed, cfg.iterations) == ("point_spiral", 3, 9)
    with pytest.raises(UsageError, match="--env of a run cannot change"):
        table.from_command_line(["--resume", str(tmp_path), "--env", "ant_umaze"])
    with pytest.raises(UsageError, match="--env of a run cannot change"):
        table.from_command_line(["--resume", str(tmp_path), "--env", "hopper"])


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"nonsense": 1}',
        '{"trpo": 3}',
        '{"env": "moon"}',
        '{"discount": "x"}',
        '{"seed": 1.5}',
    ],
)
def test_damaged_settings_are_refused(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises((UsageError, RunError)) as error:
        table.load(tmp_path)
    assert "\n" not in str(error.value)


def test_help_explains_every_setting(capsys):
    with pytest.raises(SystemExit) as stop:
        table.from_command_line(["--help-all"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "--backtracking.trace-length" in text and "--rollout.chain" in text
    settings = json.loads(json.dumps(asdict(maze_config.ANT), default=str))
    for name, value in settings.items():
        flags = value if isinstance(value, dict) else {"": None}
        for flag in flags:
            assert "--" + ".".join(filter(None, [name, flag])).replace("_", "-") in text


def test_large_numbers_may_be_written_with_an_exponent():
    cfg = table.from_command_line(["--env", "point_umaze", "--total-steps", "1e6", "--seed=2e1"])
    assert cfg.total_steps == 1_000_000 and cfg.seed == 20
    words = "--env point_umaze --trpo.max-kl 1e-2 --total-steps 2.5E+6"
    cfg = table.from_command_line(words.split())
    assert cfg.trpo.max_kl == 0.01 and cfg.total_steps == 2_500_000
    assert whole_numbers(["1e6", "--out", "a", "1e3", "--x", "1.55e1"]) == [
        "1e6",
        "--out",
        "a",
        "1e3",
        "--x",
        "1.55e1",
    ]


@pytest.mark.parametrize(
    ("env", "meant"),
    [
        ("umaze", "did you mean point_umaze or ant_umaze?"),
        ("hoper", "did you mean hopper?"),
        ("four_rooms_99999", "four_rooms_N (N from 7 to 51)"),
    ],
)
def test_an_unknown_environment_is_told_what_may_be_meant(env, meant):
    with pytest.raises(UsageError, match=re.escape(meant)):
        table.from_command_line(["--env", env])


def test_a_folder_of_runs_names_one_of_them(trained):
    with pytest.raises(RunError, match=f"it holds 1 runs, of which {trained} is the last"):
        table.load(trained.parent)
