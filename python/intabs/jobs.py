"""Work in processes of its own: a few at a time, in order, and a process that dies is said, not waited for."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from intabs.errors import UserError


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """What is started inside never hears it: on a terminal it comes to every process, and the first one decides."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def in_processes(work: Callable, items: Iterable, jobs: int) -> Iterator:
    """Results of work(item) in the order of the items; at most 2 x jobs items are ahead. Leaving early drops the rest.

    spawn: neither LCM's thread nor OpenGL survives a fork.
    """
    items = iter(items)
    waiting: deque = deque()
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))
    before = set(multiprocessing.active_children())
    try:
        while True:
            while len(waiting) < 2 * jobs:
                try:
                    item = next(items)
                except StopIteration:
                    break
                with _deaf_to_ctrl_c():  # the first one starts the workers
                    waiting.append(pool.submit(work, item))
            if not waiting:
                return
            yield waiting.popleft().result()
    except BrokenProcessPool:
        raise UserError("a worker process died (out of memory?): try fewer --jobs") from None
    except (KeyboardInterrupt, GeneratorExit):
        for worker in set(multiprocessing.active_children()) - before:
            worker.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
