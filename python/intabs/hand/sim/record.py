"""Simulated performances -> demonstrations of the embodiment `human`, through the filters of perception."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs import _core
from intabs.data.demos import Demo, DemoWriter
from intabs.data.labels import KINDS, LEFT_FINGER, RIGHT_FINGER, Truth, label
from intabs.errors import UserError
from intabs.hand.sim import scripts, sensors, skeleton
from intabs.hand.track import HandTrack, track_hand
from intabs.jobs import in_processes

GRAIN = 2.0**-14  # m: coordinates are rounded to it, which halves the file
USED = ("measured", "filled")


@dataclass(frozen=True)
class Job:
    task: str
    seed: int
    spread: float
    method: str = "robust"


@dataclass
class Recorded:
    demo: Demo
    track: HandTrack
    truth: np.ndarray  # (T, 21, 3)

    @property
    def error(self) -> np.ndarray:
        """Distances of the kept points to the true joints [m]."""
        return np.linalg.norm(self.track.points - self.truth, axis=2)[self.track.valid]


def record(job: Job) -> Recorded:
    run = scripts.perform(job.task, job.seed, job.spread)
    rng = np.random.default_rng([job.seed, 13])
    time = scripts.PERIOD * np.arange(len(run))
    uv = sensors.key_points(run, rng)
    track = track_hand(
        time, uv, sensors.depth_pictures(run, uv, rng), sensors.K, sensors.CAMERA.array(), method=job.method
    )
    points = np.round(_held(track.points, track.valid) / GRAIN) * GRAIN
    pose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(run), scripts.SLOTS, 1))
    valid = np.zeros((len(run), scripts.SLOTS), bool)
    for slot, name in enumerate(run.names):
        if name:
            seen, there = sensors.tag_poses(run, name, rng)
            filled, state, _ = _core.fill_gaps(time, seen, there)
            valid[:, slot] = state > 0
            pose[:, slot] = _held(filled, valid[:, slot])
    keypoints = points.reshape(len(run), -1)
    demo = Demo(
        time=time,
        joint_pos=None,
        joint_vel=None,
        gripper=None,
        object_pose=pose,
        object_valid=valid,
        actions=np.diff(keypoints, axis=0, append=keypoints[-1:]),
        obs={"hand_keypoints": keypoints, "hand_valid": track.valid},
        extra={"labels": labels(run)},
        attrs={
            "task": job.task,
            "seed": job.seed,
            "spread_cm": job.spread,
            "success": scripts.done(run),
            "object_names": run.names,
            "recorded": "simulated hand; colour and depth camera, filters of perception; objects by dummy tags",
        },
    )
    return Recorded(demo, track, run.joints())


def _held(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(T, n, d) or (T, d): where nothing is valid, what was last (at the start: what comes first; never: zero)."""
    out = value.copy()
    flat, known = (out[:, None], valid[:, None]) if valid.ndim == 1 else (out, valid)
    for i in range(flat.shape[1]):
        rows = np.flatnonzero(known[:, i])
        if len(rows):
            last = np.maximum.accumulate(np.where(known[:, i], np.arange(len(flat)), -1))
            flat[:, i] = flat[np.where(last < 0, rows[0], last), i]
    return out


IDS = {"block": 0, "goal": 1, "drawer": 2, "lid": 3, "cup": 4, "bowl": 5, "spoon": 6}
TOUCH = 0.015  # m, from the grip point to the object
CLOSED = 0.45  # closure
BEADS, FLOW, TIPPED = 30, 40, np.radians(80)  # beads flow out of a cup that is tipped over so far, so many a second


def labels(run: scripts.Performance) -> np.ndarray:
    """As of the plant's demonstrations: from where hand and objects were, not from the script."""
    closed = np.array(run.closure) > CLOSED
    grip = np.stack(
        [X.p + X.R.apply(skeleton.grip_point(c, run.scale)) for X, c in zip(run.wrist, run.closure, strict=True)]
    )
    ids = np.array([IDS.get(name, -1) for name in run.names])
    pose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(run), scripts.SLOTS, 1))
    touches = np.zeros((len(run), scripts.SLOTS), np.uint8)
    beads = np.zeros((len(run), scripts.SLOTS))
    for slot, name in enumerate(run.names):
        if not name:
            continue
        pose[:, slot] = run.object_pose(name)
        near = np.array([_distance(o[name], name, p) < TOUCH for o, p in zip(run.objects, grip, strict=True)])
        touches[near & closed, slot] = LEFT_FINGER | RIGHT_FINGER
        if name == "cup":
            upright = np.array([o[name].R.apply([0, 0, 1])[2] for o in run.objects])
            out = np.cumsum(np.arccos(np.clip(upright, -1, 1)) > TIPPED) * FLOW * scripts.PERIOD
            beads[:, slot] = np.maximum(BEADS - out, 0)
    return label(grip, closed, Truth(ids, pose, touches, beads))


def _distance(X: scripts.Pose, name: str, p: np.ndarray) -> float:
    """From p to the nearest box of the object [m], 0 inside."""
    q = X.R.inv().apply(p - X.p)
    boxes = scripts.SHAPES[name]
    return min((np.linalg.norm(np.maximum(np.abs(q - c) - half, 0)) for half, c in boxes), default=np.inf)


def tasks_of(task: str) -> list[str]:
    known = [*scripts.TASKS, *scripts.COMPOSITIONS]
    if task == "all":
        return known
    if task not in known:
        raise UserError(f"unknown task '{task}': known are {', '.join(known)}, all")
    return [task]


def collect(
    task: str,
    demos: int,
    out: Path,
    seed: int = 0,
    spread: float = 2.0,
    method: str = "robust",
    jobs: int = 1,
    progress: Callable[[int, str], None] = lambda done, text: None,
) -> dict:
    """`demos` demonstrations of each task into `out`; the figures."""
    queue = [Job(name, seed + i, spread, method) for name in tasks_of(task) for i in range(demos)]
    attrs = {
        "task": task,
        "rate_hz": 1 / scripts.PERIOD,
        "embodiment": "human",
        "camera": json.dumps({"intrinsics": sensors.K.tolist(), "X_WC": sensors.CAMERA.array().tolist()}),
        "hand_method": method,
        "label_names": list(KINDS),
    }
    errors, states, per_task, frames = [], np.zeros(len(_core.hand_states), int), {}, 0
    with DemoWriter(out, attrs) as writer:
        for done, (job, recorded) in enumerate(zip(queue, _recorded(queue, jobs), strict=True), 1):
            writer.add(recorded.demo)
            frames += len(recorded.demo)
            errors.append(recorded.error)
            states += np.bincount(recorded.track.state.ravel(), minlength=len(states))
            count = per_task.setdefault(job.task, {"demos": 0, "success": 0})
            count["demos"] += 1
            count["success"] += bool(recorded.demo.attrs["success"])
            progress(done, job.task)
    error = 1e3 * np.concatenate(errors)
    points = dict(zip(_core.hand_states, states.tolist(), strict=True))
    return {
        "demos": len(queue),
        "frames": frames,
        "tasks": per_task,
        "points": points,
        "kept": sum(points[name] for name in USED) / states.sum(),
        "error_mm": {
            "p50": float(np.median(error)), "p95": float(np.quantile(error, 0.95)), "max": float(error.max()),
            "over_60": float((error > 60).mean()),
        },
    }  # fmt: skip


def _recorded(queue: list[Job], jobs: int) -> Iterator[Recorded]:
    return map(record, queue) if jobs == 1 else in_processes(record, queue, jobs)
