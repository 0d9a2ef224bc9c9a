"""Work waits its turn, and nobody waits for it."""

import threading
import time

from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.session.state import JobQueue


@given(st.lists(st.sampled_from(["", "a", "b"]), max_size=30))
def test_work_is_done_in_order_and_of_a_key_the_last_in_a_row(keys):
    worker, gate, done, ended = JobQueue(), threading.Event(), [], threading.Event()
    worker.submit(lambda: done.extend([] if gate.wait(30) else ["late"]))
    for i, key in enumerate(keys):
        worker.submit(lambda i=i: done.append(i), key)
    worker.submit(ended.set)
    gate.set()
    assert ended.wait(30)
    assert done == [i for i, key in enumerate(keys) if not key or keys[i + 1 : i + 2] != [key]]


def test_what_waits_is_forgotten_and_nothing_is_taken_in_the_end():
    for forget, expected in (("clear", [True, 3]), ("close", [True])):
        worker, begun, gate, done = JobQueue(), threading.Event(), threading.Event(), []

        def first(begun: threading.Event = begun, gate: threading.Event = gate, done: list[int] = done) -> None:
            begun.set()
            done.append(gate.wait(30))

        worker.submit(first)
        assert begun.wait(30)
        worker.submit(lambda done=done: done.append(2))
        getattr(worker, forget)()
        worker.submit(lambda done=done: done.append(3))
        gate.set()
        while worker._running:
            time.sleep(0.001)
        assert done == expected, forget
