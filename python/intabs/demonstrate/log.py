"""An LCM log (intabs_record, lcm-logger) -> a demonstration: the one way from what was on the bus to what is learned.

A tick is 40 ms. States are the puppet's measured joints and what perception said of the objects; the action is the step
from the puppet's last target to where the master is now. A simulated master tells in its status what was meant
(q_commanded, without the knocks the hand gets) and while it demonstrates (mode 1); a master guided by hand is taken as
measured, from where it begins to move to where it comes to rest.

Where perception did not see an object it foretold its pose, causally; who looks back knows better: short gaps are
filled from both sides, long ones are invalid, and `filled` says where.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

import lcm
import numpy as np

from intabs import _core, messages
from intabs.data import labels
from intabs.data.demos import Demo
from intabs.errors import UserError

TICK_US = 40000
DRIVER_TICK_US = 4000
SERVO = 1  # core/types.h ArmMode
FILLED = 2  # perception/gaps.h SampleState
STILL = 0.02  # rad: a master guided by hand moves when it is further than this from where it was
MARGIN_TICKS = 5  # kept before and after its motion


def read_log(path: Path | str, master: str = "MASTER_", prefix: str = "") -> dict[str, list]:
    """{channel: decoded messages in the order of arrival}; the master's under MASTER_LITE6_STATUS. A log that was cut
    off gives what is whole. What does not decode is left out."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; record one with intabs_record --mirror --out {path}")
    types = {prefix + name: (name, t) for name, t in messages.CHANNELS.items()}
    types[master + "LITE6_STATUS"] = ("MASTER_LITE6_STATUS", messages.lite6_status_t)
    heard: dict[str, list] = {}
    try:
        for event in lcm.EventLog(str(path), "r"):
            name, message_type = types.get(event.channel, (None, None))
            if name is None:
                continue
            try:
                heard.setdefault(name, []).append(message_type.decode(event.data))
            except (ValueError, struct.error):
                continue
    except OSError:
        pass
    if not heard:
        raise UserError(f"{path}: not an LCM log, or nothing of the arm's in it")
    return heard


def demo_from_log(path: Path | str, attrs: dict | None = None, master: str = "MASTER_", prefix: str = "") -> Demo:
    """Object poses are those of OBJECT_POSES; where nobody perceived, PLANT_TRUTH's."""
    path = Path(path)
    heard = read_log(path, master, prefix)
    for channel, cure in (
        ("LITE6_STATUS", "was the puppet on the bus? --prefix names its channels"),
        ("MASTER_LITE6_STATUS", "was the master on the bus? --master names its channels"),
        ("LITE6_COMMAND", "record with --mirror"),
    ):
        if channel not in heard:
            raise UserError(f"{path}: has no {channel}: {cure}")
    poses = heard.get("OBJECT_POSES") or heard.get("PLANT_TRUTH")
    if not poses:
        raise UserError(f"{path}: has no OBJECT_POSES: was intabs_perception running?")
    # Nobody's monotonic clock keeps to the grid; simulation time does.
    lockstep = all(s.utime % DRIVER_TICK_US == 0 for s in heard["LITE6_STATUS"])
    ticks = _lockstep_ticks(heard, poses) if lockstep else _wall_ticks(heard, poses)
    ticks = _from_first_poses(_demonstrated(ticks))
    if len(ticks) < 2:
        raise UserError(f"{path}: the master demonstrates nothing")
    demo = _demo(ticks, attrs or {})
    if lockstep and "PLANT_TRUTH" in heard:
        add_labels(demo, [t.status for t, _ in ticks], heard["PLANT_TRUTH"])
    return demo


def add_labels(demo: Demo, statuses: list, truths: list) -> None:
    """What happens between gripper and objects (data/labels.py), where the plant says at every tick what it knows."""
    known = {t.frame_seq: t for t in truths}
    truths = [known.get(s.last_frame_seq) for s in statuses]
    if any(t is None for t in truths):
        return
    arm = _core.ArmModel.lite6()
    tip = np.array([arm.tip(q)[:3] for q in demo.joint_pos])
    truth = labels.Truth(
        ids=np.array(truths[0].id),
        pose=np.array([objects_of(t)[0] for t in truths]),
        touches=np.array([list(t.touches) for t in truths], np.uint8),
        beads_in=np.array([t.beads_in for t in truths]),
    )
    demo.extra["labels"] = labels.label(tip, demo.gripper, truth)


class Tick:
    """What held at one policy tick. poses may be absent: not seen."""

    def __init__(self, utime: int, status, master, poses, target):
        self.utime, self.status, self.master, self.poses = utime, status, master, poses
        self.target = np.array(target)  # what the puppet was told at this tick


def _first(items: list, key: Callable) -> dict:
    """By key; what was sent again does not count."""
    found: dict = {}
    for item in items:
        found.setdefault(key(item), item)
    return found


def _lockstep_ticks(heard: dict, poses: list) -> list[Tick]:
    """Everything is tied by numbers: the frame to the status, the master's status and the command likewise."""
    statuses = _first([s for s in heard["LITE6_STATUS"] if s.utime % TICK_US == 0], lambda s: s.seq)
    masters = _first(heard["MASTER_LITE6_STATUS"], lambda m: m.seq)
    commands = _first(heard["LITE6_COMMAND"], lambda c: c.status_seq)
    frames = _first(poses, lambda p: p.frame_seq)
    ticks = []
    for seq, s in sorted(statuses.items()):
        if seq in masters and seq in commands:
            command = commands[seq]
            target = command.q_target if command.mode == SERVO else s.q_commanded
            ticks.append(Tick(s.utime, s, masters[seq], frames.get(s.last_frame_seq), target))
    return ticks


def _wall_ticks(heard: dict, poses: list) -> list[Tick]:
    """Of each channel the newest that was there at the tick."""

    def sampler(items: list, utime: Callable) -> Callable:
        items = sorted(items, key=utime)
        times = [utime(i) for i in items]

        def at(t: int):
            k = bisect_right(times, t)
            return items[k - 1] if k else None

        return at

    status = sampler(heard["LITE6_STATUS"], lambda s: s.utime)
    master = sampler(heard["MASTER_LITE6_STATUS"], lambda m: m.utime)
    frame = sampler(poses, lambda p: getattr(p, "exposure_utime", p.utime))
    begin = max(heard[c][0].utime for c in ("LITE6_STATUS", "MASTER_LITE6_STATUS", "LITE6_COMMAND"))
    end = min(heard[c][-1].utime for c in ("LITE6_STATUS", "MASTER_LITE6_STATUS", "LITE6_COMMAND"))
    ticks = []
    for t in range(begin, end + 1, TICK_US):
        # The mirror tells the puppet where the master is. Its commands come a moment after the master's statuses: to
        # take the newest of both would count a step twice now and then.
        m = master(t)
        ticks.append(Tick(t, status(t), m, frame(t), m.q))
    return ticks


def _demonstrated(ticks: list[Tick]) -> list[tuple[Tick, np.ndarray]]:
    """The ticks of the demonstration, each with its action."""
    scripted = any(t.master.mode == SERVO for t in ticks)
    meant = [np.array(t.master.q_commanded if scripted else t.master.q) for t in ticks]
    if scripted:
        keep = [i for i, t in enumerate(ticks) if t.master.mode == SERVO]
    else:
        q = np.array(meant)
        moved = np.flatnonzero(np.abs(q - q[0]).max(1) > STILL) if len(q) else []
        rests = np.flatnonzero(np.abs(q - q[-1]).max(1) > STILL) if len(q) else []
        if not len(moved):
            return []
        keep = list(range(max(moved[0] - MARGIN_TICKS, 0), min(rests[-1] + MARGIN_TICKS + 1, len(ticks))))
    out = []
    for i in keep:
        before = ticks[i - 1].target if i else np.array(ticks[i].status.q_commanded)
        action = np.append(meant[i] - before, 1.0 if ticks[i].master.gripper_closed else -1.0)
        out.append((ticks[i], action))
    return out


def objects_of(poses) -> tuple[np.ndarray, np.ndarray]:
    """OBJECT_POSES or PLANT_TRUTH -> (S, 7) xyz wxyz, (S,) valid."""
    pose = np.concatenate([np.array(poses.p_WO), np.array(poses.q_WO)], axis=1)
    known = np.array(poses.id) >= 0
    valid = np.array(poses.valid, bool) if hasattr(poses, "valid") else known
    return pose, known & valid


def _from_first_poses(ticks: list) -> list:
    seen = (i for i, (t, _) in enumerate(ticks) if t.poses is not None)
    return ticks[next(seen, len(ticks)) :]


def _demo(ticks: list[tuple[Tick, np.ndarray]], attrs: dict) -> Demo:
    pose, measured = [], []
    before = None
    for t, _ in ticks:
        p, valid = objects_of(t.poses) if t.poses is not None else (pose[-1], np.zeros_like(measured[-1]))
        seen = np.array(t.poses.age) == 0 if hasattr(t.poses, "age") else True
        pose.append(p)
        measured.append(valid & seen & (t.poses is not before))
        before = t.poses
    statuses = [t.status for t, _ in ticks]
    time_us = np.array([t.utime for t, _ in ticks])
    time = (time_us - time_us[0]) * 1e-6
    pose, state = fill_gaps(time, np.array(pose), np.array(measured))
    return Demo(
        time=time,
        joint_pos=np.array([s.q for s in statuses]),
        joint_vel=np.array([s.dq for s in statuses]),
        gripper=np.array([float(s.gripper_closed) for s in statuses]),
        object_pose=pose,
        object_valid=state > 0,
        actions=np.array([a for _, a in ticks]),
        attrs={"rate_hz": 1e6 / TICK_US, "embodiment": "lite6", **attrs},
        extra={"filled": state == FILLED},
    )


def fill_gaps(time: np.ndarray, pose: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaps of up to 0.5 s between measurements, from both sides (perception/gaps.h); in longer ones, before the first
    and after the last measurement poses stay as they are and count as invalid. time (T,) s; pose (T, S, 7); measured
    (T, S). Returns the poses and (T, S) 0 invalid, 1 measured, 2 filled."""
    pose = pose.copy()
    state = np.zeros(measured.shape, np.uint8)
    for i in np.flatnonzero(measured.any(0)):
        pose[:, i], state[:, i], _ = _core.fill_gaps(time, pose[:, i], measured[:, i])
    return pose, state
