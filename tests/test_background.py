"""What learns in the background: in order, with its metrics, and its errors come out."""

import threading
from contextlib import closing

import pytest

from goalgan_bt.runs.background import Background


def test_fits_run_in_order_on_another_thread_and_tell_their_metrics():
    ran, gate = [], threading.Event()

    def fit(name, value):
        gate.wait(10)
        ran.append((name, threading.current_thread() is threading.main_thread()))
        return {"loss": value}

    with closing(Background()) as background:
        background.wait("value")  # nothing was started: nothing to wait for
        background.start("value", fit, "value", 1.0)
        background.start("gan", fit, "gan", 2.0)
        assert ran == [] and background.metrics == {}
        gate.set()
        background.wait("gan")
        assert ran == [("value", False), ("gan", False)]
        assert background.metrics == {"gan/loss": 2.0}
        background.start("gan", fit, "gan", 3.0)
        background.wait("value", "gan")
        assert background.metrics == {"value/loss": 1.0, "gan/loss": 3.0}


def test_an_error_comes_out_where_it_is_waited_for():
    def fail():
        raise OSError("no memory left")

    with closing(Background()) as background:
        background.start("value", fail)
        with pytest.raises(OSError, match="no memory left"):
            background.wait("value")


def test_leaving_does_not_begin_what_has_not_begun():
    gate, begun = threading.Event(), []
    with pytest.raises(KeyboardInterrupt), closing(Background()) as background:
        background.start("value", lambda: gate.wait(10) and {})
        background.start("gan", lambda: begun.append(1) or {})
        threading.Timer(0.2, gate.set).start()
        raise KeyboardInterrupt
    assert begun == []
