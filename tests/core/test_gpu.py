"""What is done for a GPU before it is wanted."""

from __future__ import annotations

import threading

from normlift_ns.core.gpu import wake


def test_a_gpu_that_cannot_start_is_told_of_where_it_is_wanted(monkeypatch):
    told = []
    monkeypatch.setattr(threading, "excepthook", told.append)
    before = set(threading.enumerate())
    wake("cuda:99")
    for thread in set(threading.enumerate()) - before:
        thread.join()
    assert told == []
