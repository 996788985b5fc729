"""Driver against fake controller for minutes, a moving session, faults by the clock; prints what came of it as JSON.

python tests/process/lite6_soak.py --minutes 10 --busy 2 [--quiet-controller]    (figures: cpp/intabs/lite6/README.md)
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from lite6_bench import ALIGNING, FAULT, HOME, TRACKING, Lite6Bench

LIMITS = {"speed": 2.14, "acceleration": 20.0, "jerk": 500.0}
TICK_S = 0.004


def path(t: float) -> list[float]:
    q = [0.5 * math.sin(1.1 * t), 0.15 * math.sin(0.7 * t), 0.15 * math.sin(0.9 * t), 0.3 * math.sin(t), 0, math.sin(t)]
    return [a + b for a, b in zip(HOME, q, strict=True)]


class Watch:
    """Limits of the reference over ticks that followed each other, jerk while it tracks alone: stops may break it."""

    def __init__(self):
        self.kept = []  # the last three
        self.worst = dict.fromkeys(LIMITS, 0.0)
        self.beyond = dict.fromkeys(LIMITS, 0)
        self.states, self.faults = Counter(), Counter()
        self.heard = self.lost = 0
        self.state = None

    def look(self, statuses: list) -> None:
        for s in statuses:
            if s.state != self.state:
                self.states[s.state] += 1
                self.faults[s.fault] += s.state == FAULT
            self.state = s.state
        self.heard += len(statuses)
        rows = [*self.kept, *statuses]
        self.kept = rows[-3:]
        if len(rows) < 4:
            return
        q = np.array([s.q_commanded for s in rows])
        seq, state = (np.array([getattr(s, name) for s in rows]) for name in ("seq", "state"))
        self.lost += int((np.diff(seq[len(rows) - len(statuses) - (len(rows) > len(statuses)) :]) - 1).sum())
        # A new start from the measured pose, after a RESET, is no motion.
        joined = (np.diff(seq) == 1) & ~((state[:-1] == FAULT) & (state[1:] != FAULT))
        moves = np.isin(state, (TRACKING, ALIGNING))
        for order, name in enumerate(LIMITS, 1):
            value = np.abs(np.diff(q, order, axis=0)).max(axis=1) / TICK_S**order
            new = np.arange(len(value)) + order >= len(rows) - len(statuses)
            whole = np.all([joined[k : k + len(value)] for k in range(order)], axis=0)
            if name == "jerk":
                whole &= np.all([moves[k : k + len(value)] for k in range(order + 1)], axis=0)
            value = value[whole & new]
            self.worst[name] = max(self.worst[name], value.max(initial=0.0))
            self.beyond[name] += int((value > LIMITS[name] * (1 + 1e-6) + 1e-6).sum())


def first_in_line(pid: int, priority: int) -> None:
    """A real controller never waits for a CPU of ours."""
    try:
        os.sched_setscheduler(pid, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        print("not allowed to schedule the fake controller in real time: it will stall as the machine does")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--busy", type=int, default=0, help="so many processes that do nothing but compute")
    parser.add_argument("--quiet-controller", action="store_true", help="no injected faults")
    args = parser.parse_args()
    faults = () if args.quiet_controller else ("--delay-every", 20, "--corrupt-every", 31, "--drop-every", 61)
    with tempfile.TemporaryDirectory() as folder, Lite6Bench(Path(folder), *faults) as bench:
        first_in_line(bench.fake.process.pid, 70)
        first_in_line(0, 50)
        for n in range(args.busy):
            bench.processes.start(sys.executable, "-c", "while True: pass", name=f"busy {n}")
        bench.driver()
        session = bench.session(path=path)
        watch, began, resets, told = Watch(), time.monotonic(), 0, time.monotonic()
        bench.until(lambda: bench.state == TRACKING, "it tracks")
        while time.monotonic() - began < 60 * args.minutes:
            bench.listen(0.5)
            watch.look(bench.statuses[1:])
            del bench.statuses[:-1]
            if bench.state == FAULT:
                bench.reset(session.id)
                resets += 1
            if time.monotonic() - told > 30:
                told = time.monotonic()
                print(f"{told - began:.0f} s: {watch.heard} statuses, faults {dict(watch.faults)}", flush=True)
        state = bench.fake.state
        bench.processes.running["intabs_lite6"].send_signal(signal.SIGINT)
        code = bench.processes.running["intabs_lite6"].wait(20)
        driver = json.loads((bench.folder / "lite6.json").read_text())["lite6"]
        print(
            json.dumps(
                {
                    "exit": code,
                    "statuses": watch.heard,
                    "statuses_not_heard": watch.lost,
                    "beyond_limits": watch.beyond,
                    "worst": {k: round(v, 6) for k, v in watch.worst.items()},
                    "episodes_by_state": dict(watch.states),
                    "faults": dict(watch.faults),
                    "resets": resets,
                    "driver": driver,
                    "controller": state,
                },
                indent=2,
            )
        )


if __name__ == "__main__":
    main()
