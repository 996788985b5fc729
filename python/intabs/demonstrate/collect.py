"""Records demonstrations as on a bench: the demonstrator moves the master arm, `intabs_record --mirror` makes the
puppet follow and writes down everything that is said, and the log becomes a demonstration (log.py).
"""

from __future__ import annotations

import contextlib
import random
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from intabs import bus, messages, paths
from intabs.data.demos import Demo, save_demos
from intabs.data.labels import KINDS
from intabs.demonstrate.log import SERVO, TICK_US, demo_from_log, objects_of
from intabs.demonstrate.tasks import DEMONSTRATORS, Job, Performance, require_task
from intabs.errors import UserError
from intabs.jobs import in_processes
from intabs.processes import Processes, shared_memory_name

SILENCE_S = 20.0
HOLD, TRACKING = 0, 1  # core/types.h ArmMode, ArmState


class _Master:
    """The master arm on the bus: a simulated one lives on the puppet's time and numbers what it says by the puppet's
    status it has seen."""

    def __init__(self, job: Job, link: bus.Bus):
        self.performance = Performance(job)
        self.link = link
        self.source = random.SystemRandom().getrandbits(62) + 1
        self.poses: dict[int, object] = {}  # by frame_seq
        self.waiting = None  # puppet's status, for the poses of its frame
        self.said = None  # the last status of ours
        self.success = False
        self.spoke, self.heard = time.monotonic(), False  # the puppet, by our clock

    def on_poses(self, m) -> None:
        self.poses = {m.frame_seq: m}
        self._try()

    def on_truth(self, m) -> None:
        self.success = bool(m.success)

    def on_status(self, s) -> None:
        self.spoke, self.heard = time.monotonic(), True
        if s.utime % TICK_US:
            return
        if self.said is not None and self.said.seq == s.seq:
            self.link.publish("MASTER_LITE6_STATUS", self.said)
            return
        self.waiting = s
        self._try()

    def _try(self) -> None:
        s = self.waiting
        if s is None or s.last_frame_seq not in self.poses:
            return
        self.waiting = None
        tick = self.performance.tick(s.q, s.q_commanded, *objects_of(self.poses[s.last_frame_seq]))
        m = messages.lite6_status_t()
        m.utime, m.seq, m.source = s.utime, s.seq, self.source
        m.last_frame_seq = s.last_frame_seq
        m.mode = HOLD if tick.action is None else SERVO
        m.state = TRACKING
        m.q, m.q_commanded = tick.q.tolist(), tick.q_meant.tolist()
        m.gripper_closed = tick.gripper_closed
        self.said = m
        self.link.publish("MASTER_LITE6_STATUS", m)


def record(job: Job, keep_log: Path | None = None, scratch: Path | None = None) -> Demo:
    """One demonstration on a plant of its own. attrs["success"] says what the plant says. keep_log: a file that shall
    have the LCM log. scratch: a folder for what goes again."""
    url, ring = bus.private_url(), shared_memory_name()
    link = bus.Bus(url)
    master = _Master(job, link)
    link.subscribe("LITE6_STATUS", master.on_status)
    link.subscribe("PLANT_TRUTH", master.on_truth)
    link.subscribe("OBJECT_POSES" if job.perception == "tags" else "PLANT_TRUTH", master.on_poses)
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        log = Path(folder) / "demonstration.lcmlog"
        with Processes(Path(folder)) as programs:
            programs.start(
                paths.program("intabs_record"), "--mirror", "--clock", "lockstep", "--lcm", url, "--out", log
            )
            cameras = "--cameras" if job.perception == "tags" else "--no-cameras"
            programs.start(
                paths.program("intabs_plant"), "--task", job.task, "--seed", job.seed, "--spread", job.spread,
                "--clock", "lockstep", "--lcm", url, "--ring", ring, cameras, "--models", paths.MODELS,
            )  # fmt: skip
            seeing = job.perception != "tags"
            while not master.performance.finished:
                link.handle(200)
                programs.check()
                if not seeing and master.heard:  # only now there are frames to look at
                    seeing = True
                    programs.start(
                        paths.program("intabs_perception"), "--lcm", url, "--ring", ring,
                        "--config", paths.MODELS / "config/perception.yaml",
                    )  # fmt: skip
                if time.monotonic() - master.spoke > SILENCE_S:
                    raise UserError(f"the plant said nothing for {SILENCE_S:.0f} s")
        if keep_log is not None:
            shutil.copy(log, keep_log)
        return demo_from_log(log, _attrs(job, master))


def _attrs(job: Job, master: _Master) -> dict:
    failure = master.performance.failure
    return {
        "task": job.task,
        "seed": job.seed,
        "spread_cm": job.spread,
        "perception": job.perception,
        "disturb": job.disturb,
        "detours": job.detours,
        "success": master.success and not failure,
        **({"failure": failure} if failure else {}),
        "recorded": f"scripted demonstrator at the master, intabs_record --mirror, object poses by {job.perception}",
    }


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


def _jobs(task: str, demos: int, perception: str, seed: int, spread: float, disturb: float, detours: float):
    """Twice as many as wanted, since some fail. Every fifth demonstration is straight: no disturbance, no change of
    mind; plans are made from those."""
    for i in range(2 * demos + 2):
        varied = i % 5 > 0
        yield Job(task, seed + i, spread, perception, disturb * varied, detours * varied)


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
    """Records until `demos` of every task succeeded; "all" are the five tasks. Failed tries are counted and left out.
    Whatever ends it early, the demonstrations recorded so far are kept."""
    tasks = list(DEMONSTRATORS) if task == "all" else [task]
    for name in tasks:
        require_task(name)
    bus.require_route()
    out = Path(out)
    _check_target(out)
    kept: list[Demo] = []
    figures: dict = {}
    # A worker that is ended leaves its folder behind; it goes with this one.
    scratch = tempfile.TemporaryDirectory(prefix="intabs_collect_", ignore_cleanup_errors=True)
    try:
        for name in tasks:
            count = figures[name] = {"demos": 0, "success": 0, "tried": 0}
            queue = _jobs(name, demos, perception, seed, spread, disturb, detours)
            with contextlib.closing(in_processes(partial(record, scratch=Path(scratch.name)), queue, jobs)) as recorded:
                for demo in recorded:
                    count["tried"] += 1
                    if demo.attrs["success"]:
                        count["success"] += 1
                        count["demos"] += 1
                        kept.append(demo)
                    progress(len(kept), f"{name}: {count['success']} of {count['tried']} succeeded")
                    if count["demos"] == demos:
                        break
            if count["demos"] < demos:
                raise UserError(f"{name}: only {count['demos']} of {count['tried']} demonstrations succeeded")
    except BaseException as e:
        if kept:
            _save(out, task, kept)
        if isinstance(e, (KeyboardInterrupt, UserError)):
            why = "interrupted" if isinstance(e, KeyboardInterrupt) else str(e)
            rest = f"{out} keeps the {len(kept)} demonstrations recorded so far" if kept else "nothing was recorded"
            raise UserError(f"{why}; {rest}") from None
        raise
    finally:
        scratch.cleanup()
    _save(out, task, kept)
    return {"demos": len(kept), "frames": sum(len(d) for d in kept), "tasks": figures}


def _save(out: Path, task: str, demos: list[Demo]) -> None:
    attrs = {"task": task, "rate_hz": 1e6 / TICK_US, "embodiment": "lite6", "label_names": list(KINDS)}
    save_demos(out, demos, attrs)
