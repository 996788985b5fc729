"""Demonstrations in the in-process twin of plant and perception: no programs, no LCM, the same states bit for bit
(tests/process/test_record.py holds the two together). For success rates; what is learned is recorded by collect.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from intabs import _core, paths
from intabs.demonstrate.tasks import Job, Performance, require_task
from intabs.errors import UserError
from intabs.jobs import in_processes
from intabs.output import Progress
from intabs.rollout import wilson


@dataclass
class Trial:
    job: Job
    success: bool
    reason: str  # of failure
    state_hash: int
    seconds: float  # simulated
    q: np.ndarray  # (T, 6) measured, at the ticks of the demonstration
    object_pose: np.ndarray  # (T, S, 7) as seen
    actions: np.ndarray  # (T, 7)


_sessions: dict = {}


def perform(job: Job) -> Trial:
    key = (job.task, job.perception)
    if key not in _sessions:
        config = str(paths.MODELS / "config/perception.yaml") if job.perception == "tags" else ""
        _sessions[key] = _core.Session(str(paths.MODELS), job.task, config)
    session = _sessions[key]
    session.reset(job.seed, job.spread)
    performance = Performance(job)
    rows = []
    while not performance.finished:
        o = session.observe()
        tick = performance.tick(o["q"], o["q_commanded"], o["object_pose"], o["object_valid"])
        if tick.action is not None:
            rows.append((o["q"], o["object_pose"], tick.action))
        session.command(tick.q, tick.gripper_closed)
    success = session.success and not performance.failure
    q, pose, actions = (np.array(x) for x in zip(*rows, strict=True)) if rows else (np.zeros((0, 0)),) * 3
    return Trial(
        job,
        success,
        "" if success else performance.failure or session.failure_reason,
        session.state_hash,
        session.observe()["utime"] * 1e-6,
        q,
        pose,
        actions,
    )


def success_rate(jobs: Iterable[Job], workers: int = 1, progress: Callable[[int, str], None] = lambda *_: None) -> dict:
    """{trials, success, ci95 (Wilson), failures: {reason: n}, failed_seeds}."""
    good, failures, failed = 0, Counter(), []
    done = 0
    with contextlib.closing(in_processes(perform, jobs, workers)) as trials:
        for trial in trials:
            done += 1
            good += trial.success
            if not trial.success:
                failures[trial.reason.split(" [")[0]] += 1
                failed.append(trial.job.seed)
            progress(done, f"{good} of {done} succeeded")
    return {
        "trials": done,
        "success": good,
        "ci95": [round(x, 3) for x in wilson(good, done)],
        "failures": dict(failures),
        "failed_seeds": failed,
    }


def main() -> None:
    """python -m intabs.demonstrate.in_process TASK --trials N: how often the demonstrator succeeds."""
    parser = argparse.ArgumentParser(prog="python -m intabs.demonstrate.in_process", description=main.__doc__)
    parser.add_argument("task")
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--spread", type=float, default=5.0, help="cm")
    parser.add_argument("--perception", choices=("truth", "tags"), default="truth")
    parser.add_argument("--seed", type=int, default=20000, help="of the first trial; 5000 to 9999 were tuned on")
    parser.add_argument("--jobs", type=int, default=1, help="trials at a time")
    o = parser.parse_args()
    try:
        require_task(o.task)
        jobs = (Job(o.task, o.seed + i, o.spread, o.perception) for i in range(o.trials))
        with Progress(o.task, o.trials) as progress:
            figures = success_rate(jobs, o.jobs, progress.update)
    except UserError as e:
        raise SystemExit(f"{parser.prog}: {e}") from None
    print(json.dumps({"task": o.task, "spread_cm": o.spread, "perception": o.perception, "seed": o.seed, **figures}))


if __name__ == "__main__":
    main()
