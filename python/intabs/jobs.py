"""Work in processes of its own: a few at a time, in order, and a process that dies is said, not waited for."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from intabs.errors import UserError


def in_processes(work: Callable, items: Iterable, jobs: int) -> Iterator:
    """Results of work(item) in the order of the items; at most 2 x jobs items are ahead. Leaving early drops the rest.

    spawn: neither LCM's thread nor OpenGL survives a fork.
    """
    items = iter(items)
    waiting: deque = deque()
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))
    try:
        while True:
            while len(waiting) < 2 * jobs:
                try:
                    waiting.append(pool.submit(work, next(items)))
                except StopIteration:
                    break
            if not waiting:
                return
            yield waiting.popleft().result()
    except BrokenProcessPool:
        raise UserError("a worker process died (out of memory?): try fewer --jobs") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
