"""Records demonstrations: the demonstrator sits where intabs_control sits, hears the same messages and answers with the
same commands. What is written is what was heard on the bus.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs import _core, bus, messages, paths
from intabs.data.demos import OBJECT_SLOTS, Demo, save_demos
from intabs.demonstrate.pick_place import PickPlace
from intabs.errors import UserError
from intabs.jobs import in_processes
from intabs.processes import Processes, shared_memory_name

DEMONSTRATORS = {"pick_place": PickPlace}
POLICY_PERIOD_US = 40000
SETTLE_TICKS = 15  # the plant goes on holding after the last movement, so that success can show
MAX_TICKS = 1000
SILENCE_S = 20.0
SERVO, HOLD = 1, 0


@dataclass
class Job:
    task: str
    seed: int
    spread: float  # cm
    perception: str
    disturb: float  # scale of the disturbances the demonstrator has to correct
    detours: float  # probability of each change of mind


def _array(poses) -> tuple[np.ndarray, np.ndarray]:
    """OBJECT_POSES -> (S, 7) xyz wxyz, (S,) valid."""
    pose = np.concatenate([np.array(poses.p_WO), np.array(poses.q_WO)], axis=1)
    known = np.array(poses.id) >= 0
    valid = np.array(poses.valid, bool) if hasattr(poses, "valid") else known
    return pose, known & valid


class _Recorder:
    def __init__(self, job: Job, link: bus.Bus):
        rng = np.random.default_rng([job.seed, 7])
        arm = _core.ArmModel.lite6()
        self.demonstrator = DEMONSTRATORS[job.task](arm, _core.IkSolver(arm), rng, job.disturb, job.detours)
        self.link = link
        self.session = random.SystemRandom().getrandbits(62) + 1
        self.seq = 0
        self.poses: dict[int, object] = {}
        self.last_answer: tuple[int, object] | None = None
        self.ticks: list[tuple] = []
        self.settle: int | None = None
        self.finished = False
        self.success = False
        self.spoke = time.monotonic()
        self.waiting = None
        self.kept: np.ndarray | None = None
        self.gripper_closed = False

    def on_poses(self, m) -> None:
        self.poses = {m.frame_seq: m}
        self._try()

    def on_truth(self, m) -> None:
        self.success = bool(m.success)

    def on_status(self, s) -> None:
        self.spoke = time.monotonic()
        if s.utime % POLICY_PERIOD_US:
            return
        if self.last_answer is not None and self.last_answer[0] == s.seq:
            self.link.publish("LITE6_COMMAND", self.last_answer[1])
            return
        self.waiting = s
        self._try()

    def _try(self) -> None:
        s = self.waiting
        if s is None or s.last_frame_seq not in self.poses:
            return
        self.waiting = None
        pose, valid = _array(self.poses[s.last_frame_seq])
        q = np.array(s.q)
        command = messages.lite6_command_t()
        command.mode = HOLD
        command.q_target = list(s.q_commanded)
        command.gripper_closed = self.gripper_closed
        if self.settle is None:
            intent = self.demonstrator.step(q, pose, valid)
            if intent is not None:
                command.mode = SERVO
                command.q_target = intent.q_target.tolist()
                command.gripper_closed = self.gripper_closed = intent.gripper_closed
                self.ticks.append(
                    (s.utime * 1e-6, q, np.array(s.dq), float(s.gripper_closed), pose, valid, intent.action)
                )
                if intent.done or len(self.ticks) >= MAX_TICKS:
                    self.settle = 0
        else:
            self.settle += 1
            self.finished = self.settle >= SETTLE_TICKS
        self.seq += 1
        command.utime, command.seq, command.session, command.status_seq = s.utime, self.seq, self.session, s.seq
        command.dq_max = [2.14] * 6
        command.lifetime_us = 200000
        self.last_answer = (s.seq, command)
        self.link.publish("LITE6_COMMAND", command)


def record(job: Job) -> Demo:
    """One demonstration on a plant of its own. attrs["success"] says what the plant says."""
    url, ring = bus.private_url(), shared_memory_name()
    link = bus.Bus(url)
    recorder = _Recorder(job, link)
    link.subscribe("LITE6_STATUS", recorder.on_status)
    link.subscribe("PLANT_TRUTH", recorder.on_truth)
    if job.perception == "tags":
        link.subscribe("OBJECT_POSES", recorder.on_poses)
    else:
        link.subscribe("PLANT_TRUTH", recorder.on_poses)
    with tempfile.TemporaryDirectory() as logs, Processes(Path(logs)) as programs:
        cameras = "--cameras" if job.perception == "tags" else "--no-cameras"
        programs.start(
            paths.program("intabs_plant"), "--task", job.task, "--seed", job.seed, "--spread", job.spread,
            "--clock", "lockstep", "--lcm", url, "--ring", ring, cameras, "--models", paths.MODELS,
        )  # fmt: skip
        if job.perception == "tags":
            programs.start(
                paths.program("intabs_perception"), "--lcm", url, "--ring", ring,
                "--config", paths.MODELS / "config/perception.yaml",
            )  # fmt: skip
        while not recorder.finished:
            link.handle(200)
            programs.check()
            if time.monotonic() - recorder.spoke > SILENCE_S:
                raise UserError(f"the plant said nothing for {SILENCE_S:.0f} s")
    return _demo(job, recorder)


def _demo(job: Job, r: _Recorder) -> Demo:
    time_s, q, dq, gripper, pose, valid, action = (np.array(x) for x in zip(*r.ticks, strict=True))
    assert pose.shape[1] == OBJECT_SLOTS
    return Demo(
        time=time_s - time_s[0],
        joint_pos=q,
        joint_vel=dq,
        gripper=gripper,
        object_pose=pose,
        object_valid=valid,
        actions=action,
        attrs={
            "task": job.task,
            "seed": job.seed,
            "spread_cm": job.spread,
            "perception": job.perception,
            "disturb": job.disturb,
            "detours": job.detours,
            "success": r.success,
            "rate_hz": 1e6 / POLICY_PERIOD_US,
            "embodiment": "lite6",
            "recorded": f"scripted demonstrator over LITE6_STATUS and OBJECT_POSES ({job.perception})",
        },
    )


def _check_target(out: Path) -> None:
    """Before the work, not after it."""
    if out.is_dir():
        raise UserError(f"{out} is a folder: give the name of a file, e.g. {out / 'demos.hdf5'}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        probe = out.with_name(out.name + ".partial")
        probe.touch()
        probe.unlink()
    except OSError as e:
        raise UserError(f"cannot write {out}: {e.strerror}; give another --out") from None


def collect(
    task: str,
    demos: int,
    out: Path | str,
    perception: str = "tags",
    seed: int = 0,
    spread: float = 2.0,
    disturb: float = 1.0,
    detours: float = 0.3,
    jobs: int = 1,
    progress: Callable[[int, str], None] = lambda done, text: None,
) -> dict:
    """Records until `demos` of every task succeeded. Failed tries are counted and left out. Every fifth
    demonstration is straight: no disturbance, no change of mind; plans are made from those."""
    tasks = list(DEMONSTRATORS) if task == "all" else [task]
    unknown = [t for t in tasks if t not in DEMONSTRATORS]
    if unknown:
        raise UserError(f"unknown task '{unknown[0]}': known are {', '.join(DEMONSTRATORS)}")
    bus.require_route()
    kept: list[Demo] = []
    figures: dict = {}
    _check_target(Path(out))
    for name in tasks:
        good: list[Demo] = []
        tried = 0
        queue = (
            Job(name, seed + i, spread, perception, disturb * (i % 5 > 0), detours * (i % 5 > 0))
            for i in range(2 * demos + 2)
        )
        for demo in in_processes(record, queue, jobs):
            tried += 1
            if demo.attrs["success"]:
                good.append(demo)
            progress(len(kept) + len(good), f"{name}: {len(good)} of {tried} succeeded")
            if len(good) == demos:
                break
        if len(good) < demos:
            raise UserError(f"{name}: only {len(good)} of {tried} demonstrations succeeded")
        kept += good
        figures[name] = {"demos": len(good), "success": len(good), "tried": tried}
    save_demos(out, kept, {"task": task, "rate_hz": 1e6 / POLICY_PERIOD_US, "embodiment": "lite6"})
    return {"demos": len(kept), "frames": sum(len(d) for d in kept), "tasks": figures}
