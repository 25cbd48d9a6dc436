"""What learns beside the main thread: in order, with its metrics, and its errors come out."""

import threading

import pytest

from goalgan_bt.beside import Beside


def test_fits_run_in_order_on_another_thread_and_tell_their_metrics():
    ran, gate = [], threading.Event()

    def fit(name, value):
        gate.wait(10)
        ran.append((name, threading.current_thread() is threading.main_thread()))
        return {"loss": value}

    with Beside() as beside:
        beside.wait("value")  # nothing was started: nothing to wait for
        beside.start("value", fit, "value", 1.0)
        beside.start("gan", fit, "gan", 2.0)
        assert ran == [] and beside.metrics == {}
        gate.set()
        beside.wait("gan")
        assert ran == [("value", False), ("gan", False)]
        assert beside.metrics == {"gan/loss": 2.0}
        beside.start("gan", fit, "gan", 3.0)
        beside.wait("value", "gan")
        assert beside.metrics == {"value/loss": 1.0, "gan/loss": 3.0}


def test_an_error_comes_out_where_it_is_waited_for():
    def fail():
        raise OSError("no memory left")

    with Beside() as beside:
        beside.start("value", fail)
        with pytest.raises(OSError, match="no memory left"):
            beside.wait("value")


def test_leaving_does_not_begin_what_has_not_begun():
    gate, begun = threading.Event(), []
    with pytest.raises(KeyboardInterrupt), Beside() as beside:
        beside.start("value", lambda: gate.wait(10) and {})
        beside.start("gan", lambda: begun.append(1) or {})
        threading.Timer(0.2, gate.set).start()
        raise KeyboardInterrupt
    assert begun == []
