"""Perturbed replays of recorded demonstrations: the same motion, tick by tick, relative to objects that lie elsewhere,
tried in the plant. From a recording alone: its commands and what was seen; nothing of the demonstrator's script.

The tip's commanded path X(t) becomes D(t) X(t). D moves along with what the motion is about: not at all at the start,
then with the object that will be moved (its displacement D_i), then, as it comes near another object, with that one's
(D_j). Inverse kinematics gives the new commands. To what is round, a bowl, things may come from another side: if asked
for, some replays turn the way there and back about its axis. After Mandlekar et al., MimicGen (2023), with references
that go over into each other instead of cut pieces. Where the arm cannot come to the object as recorded, the hand takes
it steeper or flatter, turned about the axis along which the fingers close.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from intabs import _core, paths
from intabs.data.demos import OBJECT_SLOTS, Demo, DemoWriter
from intabs.errors import UserError
from intabs.jobs import in_processes
from intabs.skills.library import TURN_LENGTH, rotation
from intabs.skills.planner import too_near

REACHED = 0.9  # of to_mover: the way to the object is over
NEAR_GRASP = 0.08  # m, tip from the place where the object begins to move: there D is D_i
NEAR_GOAL = 0.03  # m, moved object from where it comes nearest to the other one, from above: there D is D_j, and what
# is lowered into it then goes with it
SMOOTH = 4.0  # ticks, of D's weights
MOVED = 0.015  # m or
TURNED = 0.15  # rad: an object that moved in a demonstration
LEAD = 1.0  # ticks, of the command before the arm
RETURN = 0.12  # of a disturbance, a tick, that the recorded commands take back
MIN_SPREAD = 1.0  # cm
REPLAY_SEEDS = 300000  # of the plant; evaluation uses others
MAX_STEP = 0.08  # rad a tick (2 rad/s): a path that is faster is not tried
AT_ENDS = 0.2  # share of the replays that start where another demonstration ended,
AT_GRASP = 0.15  # where the gripper closed, so far beside it: a grasp that was missed is tried again from there,
BESIDE_RAD = 0.03
NEAR_HOME = 0.15  # so far from home (standard deviations, each joint); the others at home
START_RAD = 0.15
SLOW = 40  # ticks more on the way to the object where a start is too far for the recording's pace
DRIVE_STEP = 0.03  # rad a tick, on the way to such a start
KNOCKED = 0.015  # m (a turn counts TURN_LENGTH a radian): an object that moves so far as the hand is put beside it
ROUND = {("pour", 1)}  # task, slot: objects that things may come to from any side,
ANOTHER_SIDE = 1.1  # rad: about their axis by so much,
SIDES = (-1, 0, 0, 0, 0, 1)  # this way or that, if asked for: most as recorded, or the cup is grasped less well
NEAR_ROUND = 0.13  # m, moved object from the round one: there it has come round
PITCHES = (0.0, 0.2, -0.2, 0.4, -0.4)  # rad: the hand steeper or flatter; the first that the arm can do


@dataclass
class Outline:
    """What a demonstration's motion is about, tick by tick."""

    q_target: np.ndarray  # (T, 6) commanded
    gripper: np.ndarray  # (T,) bool commanded
    mover: int  # slot of the object that is moved
    other: int  # slot of what it is brought to; -1: nothing
    to_mover: np.ndarray  # (T,) 0 .. 1
    to_other: np.ndarray  # (T,) 0 .. 1
    at_other: np.ndarray  # (T,) 0 .. 1, and back
    approach: int  # ticks of the recording's way to the object


def outline(demo: Demo, arm) -> Outline | None:
    """None if nothing was moved."""
    # The measured path, ahead by the servo's lag. Recorded actions leave out the demonstrator's disturbances, so that
    # their sum is not where the arm was.
    t = np.arange(len(demo))
    target = np.stack([np.interp(t + LEAD, t, x) for x in demo.joint_pos.T], 1)
    tip = np.array([arm.tip(q)[:3] for q in target])
    p = demo.object_pose[..., :3]
    seen = [i for i in range(p.shape[1]) if demo.object_valid[:, i].any()]
    far, turned = np.zeros(p.shape[1]), np.zeros(p.shape[1])
    for i in seen:
        ok = demo.object_valid[:, i].astype(bool)
        far[i] = np.linalg.norm(p[ok, i] - p[ok, i][0], axis=1).max()
        R = Rotation.from_quat(np.roll(demo.object_pose[ok, i, 3:], -1, -1))
        turned[i] = (R[0].inv() * R).magnitude().max()
    moved = [i for i in seen if far[i] > MOVED or turned[i] > TURNED]
    if not moved:
        return None
    mover = max(moved, key=lambda i: far[i] + 0.1 * turned[i])
    ok = demo.object_valid[:, mover].astype(bool)
    path = p[:, mover].copy()
    for k in range(3):
        path[:, k] = np.interp(np.arange(len(p)), np.flatnonzero(ok), path[ok, k])
    R = Rotation.from_quat(np.roll(demo.object_pose[ok, mover, 3:], -1, -1))
    angle = np.interp(np.arange(len(p)), np.flatnonzero(ok), (R[0].inv() * R).magnitude())
    began = int(np.argmax((np.linalg.norm(path - path[0], axis=1) > 0.3 * MOVED) | (angle > 0.3 * TURNED)))
    to_mover = _progress(np.linalg.norm(tip - tip[began], axis=1), NEAR_GRASP)
    to_mover[began:] = 1
    others = [j for j in seen if j != mover]
    other, to_other, at_other = -1, np.zeros(len(p)), np.zeros(len(p))
    if others and far[mover] > 3 * MOVED:
        distance = np.array([np.linalg.norm(path - p[:, j].mean(0), axis=1) for j in others])
        k = int(np.argmin(distance[:, began:].min(1)))
        other = others[k]
        level = np.linalg.norm(path[:, :2] - p[:, other, :2].mean(0), axis=1)
        to_other = _progress(level, level[began:].min() + NEAR_GOAL)
        to_other[:began] = 0
        at_other = _progress(distance[k], NEAR_ROUND, back=True)
    return Outline(target, demo.actions[:, 6] > 0, mover, other, to_mover, to_other, at_other,
                   max(1, int(np.argmax(to_mover >= REACHED))))  # fmt: skip


def _progress(distance: np.ndarray, near: float, back: bool = False) -> np.ndarray:
    """0 at the first distance, 1 from `near` on; never back unless asked for, smoothed."""
    start = max(distance[0], near + 1e-3)
    w = np.clip((start - distance) / (start - min(near, 0.8 * start)), 0, 1)
    w = w if back else np.maximum.accumulate(w)
    w = w * w * (3 - 2 * w)
    return np.clip(gaussian_filter1d(w, SMOOTH), 0, 1)


def slowed(about: Outline, ticks: int) -> Outline:
    """The way to the object lasts so many ticks more."""
    end, n = about.approach, len(about.gripper)
    t = np.concatenate([np.arange(end + ticks) * end / (end + ticks), np.arange(end, n)])

    def along(x: np.ndarray) -> np.ndarray:
        if x.dtype == bool:
            return x[np.round(t).astype(int)]
        return np.stack([np.interp(t, np.arange(n), c) for c in x.reshape(n, -1).T], -1).reshape(len(t), *x.shape[1:])

    arrays = {k: along(v) for k, v in vars(about).items() if isinstance(v, np.ndarray)}
    return replace(about, **arrays)


def in_replay(ticks: np.ndarray, attrs: dict) -> np.ndarray:
    """Where ticks of a recording are in a replay of it with these attributes."""
    slow, end = int(attrs.get("slow", 0)), int(attrs.get("approach", 1))
    return np.where(ticks < end, np.round(ticks * (end + slow) / end), ticks + slow).astype(int)


def started_at(start: np.ndarray, path: np.ndarray, about: Outline, shares: tuple[float, ...]) -> np.ndarray | None:
    """Joint targets (T, 6) that begin at `start`, or at the first of these shares of the way to it that MAX_STEP
    allows, and join `path` on the way to the object that will be moved; None if it allows none."""
    end = int(np.argmax(about.to_mover >= REACHED))
    x = np.clip(np.arange(len(path)) / max(end, 1), 0, 1)
    # Speed goes up and down in a fifth of the time each.
    done = np.where(x < 0.2, x * x / 0.32, np.where(x > 0.8, 1 - (1 - x) ** 2 / 0.32, (x - 0.1) / 0.8))
    offset = (1 - done)[:, None] * (start - path[0])
    for share in shares:
        moved = path + share * offset
        if np.abs(np.diff(moved, axis=0)).max() <= MAX_STEP:
            return moved
    return None


def displacement(old: np.ndarray, new: np.ndarray) -> tuple[np.ndarray, float]:
    """Of an object's pose (7,) in the table's plane: where its place goes, p -> p_new + Rz(yaw)(p - p_old)."""
    R = Rotation.from_quat(np.roll(new[3:], -1)) * Rotation.from_quat(np.roll(old[3:], -1)).inv()
    return new[:3] - old[:3], float(R.as_rotvec()[2])


class Replayer:
    """Replays in one task's world. Not for several threads."""

    def __init__(self, task: str):
        self.session = _core.Session(str(paths.MODELS), task, "")
        self.arm = _core.ArmModel.lite6()
        self.ik = _core.IkSolver(self.arm)

    def commands(
        self, demo: Demo, about: Outline, new: np.ndarray, side: float = 0.0, pitch: float = 0.0
    ) -> np.ndarray | None:
        """Joint targets (T, 6) for objects at `new` (S, 7); None if they cannot be reached smoothly. side: angle about
        the axis of what the moved object is brought to, from which it comes instead [rad]. pitch: of the hand about
        the fingers' closing axis, its y axis, from the grasp on [rad]."""
        first = {
            i: demo.object_pose[np.argmax(demo.object_valid[:, i]), i] for i in (about.mover, about.other) if i >= 0
        }
        moves = {i: displacement(first[i], new[i]) for i in first}
        out, q = [], about.q_target[0]
        for t, target in enumerate(about.q_target):
            X = np.asarray(self.arm.tip(target))
            p, R = X[:3], Rotation.from_quat(np.roll(X[3:], -1))
            w, v = about.to_mover[t], about.to_other[t]
            shift, yaw = np.zeros(3), 0.0
            for i, weight in ((about.mover, w * (1 - v)), (about.other, v)):
                if i < 0:
                    continue
                step, angle = moves[i]
                turned = Rotation.from_rotvec([0, 0, angle]).apply(p - first[i][:3])
                shift = shift + weight * (first[i][:3] + step + turned - p)
                yaw += weight * angle
            turn, p = Rotation.from_rotvec([0, 0, yaw]) * R * Rotation.from_rotvec([0, w * pitch, 0]), p + shift
            if side:
                round_it, axis = Rotation.from_rotvec([0, 0, side * about.at_other[t]]), new[about.other, :3]
                turn, p = round_it * turn, axis + round_it.apply(p - axis)
            pose = np.concatenate([p, np.roll(turn.as_quat(), 1)])
            answer = self.ik.solve(pose, q)
            if not answer.ok:
                return None
            if t and np.abs(answer.q - q).max() > MAX_STEP:
                return None
            q = np.asarray(answer.q)
            out.append(q)
        return np.stack(out)

    def way(self, demo: Demo, about: Outline, new: np.ndarray, side: float) -> tuple[np.ndarray, float] | str:
        """(commands, pitch), of PITCHES the first that does; why if none does."""
        why = "out of reach" + ", from another side" * bool(side)
        for pitch in PITCHES:
            path = self.commands(demo, about, new, side, pitch)
            if path is None:
                continue
            if not too_near(path):
                return path, pitch
            why = "the arm would come too near to itself or the table"
        return why

    def replay(
        self,
        demo: Demo,
        about: Outline,
        seed: int,
        spread_cm: float,
        disturb: float,
        start: np.ndarray | None = None,
        side: float = 0.0,
        at_grasp: bool = False,
    ) -> Demo | str:
        """One try with the objects where the plant puts them for this seed; the reason if it failed.

        disturb: standard deviation [rad] of pushes the commands get now and then and take back (Laskey et al., DART,
        2017); what is recorded as the action takes back, it does not push. start: joints (6,) [rad] to begin at; None:
        the recording's. at_grasp: counted from where the gripper closes. The way there is not recorded. side: as for
        commands."""
        session = self.session
        session.reset(seed, spread_cm)
        rng = np.random.default_rng(seed)
        pose = session.observe()["object_pose"]
        way = self.way(demo, about, pose, side)
        if isinstance(way, str):
            return way
        path, pitch = way
        slow = 0
        if at_grasp:
            there = path[: int(np.argmax(about.gripper)) + 1]
            start = there[-1] + start
            if not (self.along(there) and self.drive(start)):
                return "start out of reach"
            old, new = pose[about.mover], session.observe()["object_pose"]  # what was touched lies elsewhere
            turned = (rotation(old).inv() * rotation(new[about.mover])).magnitude()
            if np.linalg.norm(new[about.mover, :3] - old[:3]) + TURN_LENGTH * turned > KNOCKED:
                return "knocked away as the hand was put beside it"
            path = self.commands(demo, about, new, side, pitch)
            if path is None:
                return "out of reach where it was knocked to"
        if start is not None:
            far = started_at(start, path, about, (1.0,))
            if far is None:
                slow, about = SLOW, slowed(about, SLOW)
                path = self.commands(demo, about, session.observe()["object_pose"], side, pitch)
                far = started_at(start, path, about, (1.0, 0.75, 0.5, 0.25, 0.0)) if path is not None else None
            if far is None or not self.drive(far[0]):
                return "start out of reach"
            path = far
        rows, pushed, target = [], np.zeros(6), path[0].copy()
        for t, wanted in enumerate(path):
            o = session.observe()
            before = target
            pushed = pushed * (1 - RETURN)
            meant = wanted + pushed
            action = np.append(meant - before, 1.0 if about.gripper[t] else -1.0)
            if disturb and rng.random() < 0.05:
                pushed = pushed + disturb * rng.normal(size=6)
            target = wanted + pushed
            rows.append((o["utime"] * 1e-6, o["q"], o["dq"], o["gripper_closed"], o["object_pose"], o["object_valid"],
                         action))  # fmt: skip
            if session.command(target, bool(about.gripper[t])) != 0:
                return "the driver refused"
        for _ in range(15):
            if session.command(target, bool(about.gripper[-1])) != 0:
                break
        if not session.success:
            return session.failure_reason.split(" [")[0]
        how = {"seed": seed, "spread_cm": spread_cm, "side": side, "pitch": pitch, "slow": slow}
        how["approach"] = about.approach
        return Demo(*(np.array(x) for x in zip(*rows, strict=True)), how)

    def along(self, way: np.ndarray) -> bool:
        """By these targets (n, 6), the gripper open; whether the driver let it."""
        return all(self.session.command(target, False) == 0 for target in way)

    def drive(self, to: np.ndarray) -> bool:
        """Joint by joint in step, to rest there; whether the driver let it."""
        o = self.session.observe()
        q, gripper = np.asarray(o["q_commanded"]), bool(o["gripper_closed"])
        steps = int(np.ceil(np.abs(to - q).max() / DRIVE_STEP)) + 1
        way = [q + (to - q) * (k + 1) / steps for k in range(steps)] + [to] * 10
        return all(self.session.command(target, gripper) == 0 for target in way)


def pad_slots(demo: Demo) -> Demo:
    missing = OBJECT_SLOTS - demo.object_pose.shape[1]
    if missing:
        demo.object_pose = np.pad(demo.object_pose, ((0, 0), (0, missing), (0, 0)))
        demo.object_valid = np.pad(demo.object_valid, ((0, 0), (0, missing)))
    return demo


@dataclass
class Try:
    source: str  # name of the recorded demonstration
    demo: Demo
    seed: int
    spread_cm: float
    disturb: float
    start: np.ndarray | None
    at_grasp: bool
    side: float


_replayers: dict[str, Replayer] = {}


def attempt(one: Try) -> tuple[Try, Demo | str]:
    """In a worker process, which keeps its worlds."""
    task = one.demo.attrs["task"]
    if task not in _replayers:
        _replayers[task] = Replayer(task)
    about = outline(one.demo, _replayers[task].arm)
    if about is None:
        return one, "nothing is moved in the recording"
    side = one.side if (task, about.other) in ROUND else 0.0
    return one, _replayers[task].replay(
        one.demo, about, one.seed, one.spread_cm, one.disturb, one.start, side, one.at_grasp
    )


def make(
    data: Path,
    out: Path,
    number: int,
    spread_cm: float,
    disturb: float,
    seed: int,
    jobs: int,
    progress,
    sides: bool = False,
    of: dict[str, int] | None = None,
) -> dict:
    """Replays of the training split's demonstrations: `number` that succeeded, as many of each task as of others
    but those of which `of` says how many.
    sides: a third of the tries come to what is ROUND from another side.
    {demos, frames, tries, tasks: {task: {demos, tries, failures: {reason: n}}}}."""
    from intabs.data.reader import DemoFile

    with DemoFile(data, "train") as f:
        recorded = [(f.names[k], pad_slots(f.demo(k))) for k in range(len(f))]
        attrs = {k: f.attrs[k] for k in ("embodiment", "rate_hz", "env_args") if k in f.attrs}
    by_task: dict[str, list] = {}
    for name, demo in recorded:
        by_task.setdefault(str(demo.attrs["task"]), []).append((name, demo))
    of = of or {}
    if unknown := set(of) - set(by_task):
        raise UserError(f"--of {min(unknown)}: {data} has {', '.join(sorted(by_task))}")
    others = [task for task in sorted(by_task) if task not in of]
    rest = number - sum(of.values())
    if rest < 0 or (rest and not others):
        raise UserError(f"--number {number}: --of says {sum(of.values())} replays")
    wanted = of | {task: rest // len(others) + (i < rest % len(others)) for i, task in enumerate(others)}
    figures = {task: {"demos": 0, "tries": 0, "failures": Counter()} for task in wanted}
    frames = done = 0
    ends = np.array([demo.joint_pos[-1] for _, demo in recorded])

    def start(demo: Demo, rng: np.random.Generator) -> tuple[np.ndarray | None, bool]:
        kind, end, push = rng.random(), ends[rng.integers(len(ends))], rng.normal(size=6)
        if kind < AT_ENDS:
            return end, False
        if kind < AT_ENDS + AT_GRASP:
            return BESIDE_RAD * push, True
        return (demo.joint_pos[0] + START_RAD * push if kind < AT_ENDS + AT_GRASP + NEAR_HOME else None), False

    def tries():
        # A source that cannot be replayed must not keep this going for ever.
        for task in sorted(by_task):
            rng = np.random.default_rng([seed, len(task), *task.encode()])
            sided = np.random.default_rng([seed, 1, *task.encode()])
            for k in range(6 * wanted[task]):
                if figures[task]["demos"] >= wanted[task]:
                    break
                name, demo = by_task[task][k % len(by_task[task])]
                spread = max(MIN_SPREAD, spread_cm * float(np.cbrt(rng.random())))  # far away there is more room
                side = ANOTHER_SIDE * float(sided.choice(SIDES)) if sides else 0.0
                yield Try(name, demo, REPLAY_SEEDS + seed + k, spread, disturb, *start(demo, rng), side)

    with (
        DemoWriter(out, {**attrs, "task": "all", "replays_of": data.name}, 0.0) as writer,
        contextlib.closing(in_processes(attempt, tries(), jobs)) as results,
    ):
        for one, got in results:
            task = one.demo.attrs["task"]
            figures[task]["tries"] += 1
            if isinstance(got, str):
                figures[task]["failures"][got] += 1
            elif figures[task]["demos"] < wanted[task]:
                got.attrs |= {"task": task, "source": one.source, "success": True, "embodiment": "lite6"}
                writer.add(got)
                figures[task]["demos"] += 1
                frames += len(got)
                done += 1
            progress(done, f"{task}: {figures[task]['demos']} of {figures[task]['tries']} tries")
    for f in figures.values():
        f["failures"] = dict(f["failures"])
    return {
        "demos": done,
        "frames": frames,
        "tries": sum(f["tries"] for f in figures.values()),
        "tasks": figures,
    }
