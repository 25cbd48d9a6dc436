"""`--track`: the real Weights & Biases, offline."""

import json
import struct
import time

import pytest
from conftest import TINY, call

from goalgan_bt.runs import tracking
from goalgan_bt.runs.metrics_csv import read_metrics

wandb_internal_pb2 = pytest.importorskip("wandb.proto.wandb_internal_pb2")


BLOCK, HEAD = 32_768, 7  # of LevelDB's log format: checksum 4, length 2, kind 1


def records(path):
    """The records of a file of Weights & Biases: LevelDB's log format after a head of 7 bytes."""
    data, at, parts = path.read_bytes(), HEAD, []
    while at + HEAD <= len(data):
        if BLOCK - at % BLOCK < HEAD:  # too little room for a record: the rest is zeros
            at += BLOCK - at % BLOCK
            continue
        length, kind = struct.unpack_from("<HB", data, at + 4)
        parts.append(data[at + HEAD : at + HEAD + length])
        at += HEAD + length
        if kind in (1, 4):  # whole, or the last part
            yield wandb_internal_pb2.Record.FromString(b"".join(parts))
            parts = []


def written(folder):
    """What it has written into a run folder: configuration and rows, in order."""
    config, rows = {}, []
    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        for record in records(path):
            config |= {i.key: json.loads(i.value_json) for i in record.run.config.update}
            if items := record.history.item:
                rows.append(
                    {i.key or "/".join(i.nested_key): json.loads(i.value_json) for i in items}
                )
    return config, rows


def test_the_metrics_of_a_run_and_of_what_goes_on_with_it(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    words = *TINY.split(), "--viz", "none", "--out", tmp_path
    assert call("train", *words, "--track").returncode == 0
    (folder,) = tmp_path.iterdir()
    more = "--iterations", 6, "--viz", "none", "--track"  # the folder does not decide it
    assert call("train", "--resume", folder, *more).returncode == 0
    config, rows = written(folder)
    deadline = time.monotonic() + 30  # W&B writes in a process of its own, which may be late
    while len(rows) < 6 and time.monotonic() < deadline:
        time.sleep(0.5)
        config, rows = written(folder)
    assert config["seed"] == 0 and config["env"] == "point_umaze"
    names, table = read_metrics(folder)
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5, 6]
    for told, kept in zip(rows, table, strict=True):
        for name in ("steps/train", "rollout/reward", "eval/coverage"):
            assert (name in told) == bool(kept[name])
            if name in told:
                assert told[name] == pytest.approx(float(kept[name]), rel=1e-5)
    assert "eval/coverage" in names


def test_without_it_a_run_does_not_begin(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "find_spec", lambda _: None)
    words = *TINY.split(), "--viz", "none", "--track", "--out", tmp_path / "runs"
    done = call("train", *words)
    assert done.returncode == 2 and "goalgan_bt[wandb]" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_what_it_refuses_is_told_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "nonsense")
    done = call("train", *TINY.split(), "--viz", "none", "--track", "--out", tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: --track: ")
    assert done.stderr.count("\n") == 1
