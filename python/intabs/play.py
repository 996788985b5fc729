"""Plays a plan for a task with the C++ programs, watches, and scores. Python starts, watches and stops them; between
camera and arm there is none of it.
"""

from __future__ import annotations

import json
import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs import _core, bus, messages, paths
from intabs.errors import UserError, as_user_error
from intabs.processes import Processes, free_ports, shared_memory_name, terminated_like_interrupted
from intabs.skills.library import Frame, Library, weights_folder
from intabs.skills.planner import Plan, Planner, missing, whole

WEIGHTS = "lite6"
CAMERAS = ("left", "right")  # of the plant that perception sees
SETTLE_S = 2.0  # after the plan's end: so long may success take to show
TICK_S = 0.04  # policy
TRIES = 4.0  # so many times the plan's longest duration may a run last: kMaxRetries of skills/skill_player.h, and once

# skills/skill_player.h EndReason
RUNNING, FINISHED, NO_EFFECT = 1, 2, 7
END_REASONS = {
    3: "the plan was aborted",
    4: "perception went silent",
    5: "a reading or the policy's output was not finite",
    6: "the driver refused to go on (fault, stop, or another session)",
    NO_EFFECT: "an object did not move as in the demonstration, however often it was tried",
}
FAULTED = 6
# core/types.h Fault
FAULTS = {
    1: "commands stopped coming",
    2: "ESTOP",
    3: "the arm's readings stopped coming",
    4: "the connection to the arm is lost",
    5: "the arm reports an error",
    6: "its loop stood still in mid-motion",
}


@dataclass
class Options:
    task: str = "pick_place"  # or several, joined by +: one after the other, in the world of that name
    perception: str = "tags"
    clock: str = "lockstep"
    arm: str = "plant"  # or "lite6": the driver, and a fake controller with the plant behind it; clock "wall" alone
    seed: int = 0
    spread: float = 2.0  # cm
    out: Path = Path("out/demo")
    viewer: bool = False
    plan: Callable[[Planner, Frame], Plan] | None = None  # None: Planner.for_task
    by_goals: bool = False  # success is that the plan's goals are reached, not the world's task
    weights: str = WEIGHTS


class _Run:
    """What is heard during one run. All decisions use the plant's clock, so in lockstep they fall the same way each
    time however late a message comes to us."""

    def __init__(self, plan_id: int, lockstep: bool, by_time: bool):
        """by_time: frames are known by their exposure, as nobody tells perception the plant's count of them."""
        self.plan_id, self.lockstep, self.by_time = plan_id, lockstep, by_time
        self.spoke = time.monotonic()  # the plant, by our clock
        self.truth: dict[int, messages.plant_truth_t] = {}  # by frame
        self.poses: dict[int, messages.object_poses_t] = {}  # by frame
        self.skill: messages.skill_status_t | None = None
        self.skill_utimes: list[int] = []
        self.finished_us: int | None = None
        self.end_reason = 0
        self.fps = 0.0

    def on_truth(self, m) -> None:
        self.spoke = time.monotonic()
        self.truth[m.utime if self.by_time else m.frame_seq] = m

    def on_poses(self, m) -> None:
        self.poses[m.exposure_utime if self.by_time else m.frame_seq] = m

    def on_skill(self, m) -> None:
        if m.plan_id != self.plan_id or m.end_reason < RUNNING:
            return
        # The plan is acknowledged before its first tick; only simulated time has a tick at 0.
        ticked = m.utime > 0 or self.lockstep
        if ticked and (self.skill is None or m.utime > self.skill.utime):
            self.skill_utimes.append(m.utime)
            self.skill = m
        if m.end_reason != RUNNING and self.finished_us is None:
            self.finished_us, self.end_reason = m.utime, m.end_reason

    def on_perception(self, m) -> None:
        if m.n:
            self.fps = min(m.fps[: m.n])

    def first_frame(self, status: messages.lite6_status_t, truth: bool) -> Frame | None:
        """What is seen first: in lockstep the same whenever we hear of it."""
        heard = self.truth if truth else self.poses
        if not heard:
            return None
        m = heard[min(heard)]
        pose = np.concatenate([np.array(m.p_WO), np.array(m.q_WO)], 1)
        known = np.array(m.id) >= 0 if truth else (np.array(m.id) >= 0) & np.array(m.valid, bool)
        pose[~known] = (0, 0, 0, 1, 0, 0, 0)
        return Frame(np.array(status.q), bool(status.gripper_closed), pose, known)

    def sees(self) -> bool:
        """Perception keeps up: its newest poses are at most .2 s behind the plant."""
        newest = max((p.exposure_utime for p in self.poses.values()), default=None)
        return newest is not None and max(t.utime for t in self.truth.values()) - newest < 200_000

    @property
    def start_us(self) -> int:
        return self.skill_utimes[0]

    def end(self, limit_s: float) -> tuple[int, bool] | None:
        """(time on the plant's clock, success), or None while it goes on. Told only when the plant has gone past that
        time: then all messages up to it are in."""
        if self.skill is None or not self.truth:
            return None
        end = self._end(self.start_us + int(limit_s * 1e6))
        return end if end and max(t.utime for t in self.truth.values()) > end[0] else None

    def _end(self, limit_us: int) -> tuple[int, bool] | None:
        if self.finished_us is None:
            return limit_us, False
        if self.end_reason not in (FINISHED, NO_EFFECT):  # what the player missed may be there all the same
            return self.finished_us, False
        for utime, success in sorted((t.utime, t.success) for t in self.truth.values() if t.utime >= self.finished_us):
            if success:
                return utime, True
            if utime >= self.finished_us + SETTLE_S * 1e6:
                return utime, False
        return None

    def subgoals(self, end_us: int) -> int:
        """Bits of the sub-goals that were reached at some time."""
        bits = 0
        for t in self.truth.values():
            if t.utime <= end_us:
                bits |= t.subgoals
        return bits

    def paths(self, end_us: int) -> np.ndarray:
        """Of the objects (F, 4, 7), as they were, from before the plan began on: never empty."""
        heard = [self.truth[k] for k in sorted(self.truth) if self.truth[k].utime <= max(end_us, self.start_us)]
        return np.array([np.concatenate([m.p_WO, m.q_WO], 1) for m in heard])

    def object_errors_mm(self, end_us: int) -> list[float]:
        """Distance of each valid pose from the truth of the same frame."""
        errors = []
        for frame, poses in self.poses.items():
            truth = self.truth.get(frame)
            if truth is None or not self.start_us <= truth.utime <= end_us:
                continue
            for slot in range(len(poses.id)):
                if poses.valid[slot] and poses.id[slot] >= 0:
                    errors.append(1e3 * math.dist(poses.p_WO[slot], truth.p_WO[slot]))
        return errors


def play(options: Options, report: Callable[[float, str], None]) -> tuple[dict, str]:
    """One run. Returns its figures (as in summary.json) and, if the task failed, why. Raises UserError if something
    broke. `report(share, text)` is called while it runs."""
    weights = weights_folder(options.weights)
    whole(Library.load(weights), options.task, None)  # an unknown task is told before anything starts
    with as_user_error(RuntimeError, ValueError):
        subgoals = _core.World(str(paths.MODELS), options.task).subgoal_names
    worlds = ("fake_lite6", "lite6") if options.arm == "lite6" else ("plant",)
    programs = {name: paths.program(f"intabs_{name}") for name in (*worlds, "perception", "control")}
    bus.require_route()
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    figures = {name: out / "logs" / f"{name}.json" for name in programs}
    for stale in (*figures.values(), out / "summary.json", out / "video.mp4", out / "strip.png"):
        stale.unlink(missing_ok=True)

    url, ring = bus.private_url(), shared_memory_name()
    run = _Run(random.SystemRandom().getrandbits(62) + 1, options.clock == "lockstep", options.arm == "lite6")
    # By the wall clock the arm holds while perception is behind.
    with terminated_like_interrupted(), Processes(out / "logs") as processes:
        listener = bus.Bus(url)
        listener.subscribe("PLANT_TRUTH", run.on_truth)
        listener.subscribe("OBJECT_POSES", run.on_poses)
        listener.subscribe("SKILL_STATUS", run.on_skill)
        listener.subscribe("PERCEPTION_STATUS", run.on_perception)

        def wait_for(what: Callable[[], bool], patience_s: float, silence: str, again=lambda: None) -> None:
            until = time.monotonic() + patience_s
            while not what():
                processes.check()
                if time.monotonic() > until:
                    raise UserError(f"{silence} within {patience_s:.0f} s; what it said is in {out / 'logs'}")
                again()
                listener.handle(100)

        report(0.0, "starting")
        ports = free_ports(5)
        processes.start(
            programs[worlds[0]],
            *("--lcm", url, "--models", paths.MODELS, "--task", options.task, "--seed", options.seed),
            *("--spread", options.spread, "--ring", ring, "--cameras"),
            *("--video", out / "video.mp4", "--strip", out / "strip.png", "--json", figures[worlds[0]]),
            *(["--viewer"] if options.viewer else []),
            *(
                ("--plant", "--port", ports, "--report-port-base", ports + 1)
                if options.arm == "lite6"
                else ("--clock", options.clock)
            ),
        )
        wait_for(lambda: run.truth, 30, f"intabs_{worlds[0]} said nothing")
        if options.arm == "lite6":
            processes.start(
                programs["lite6"],
                *("--lcm", url, "--host", "127.0.0.1", "--port", ports, "--report-port", ports + 1),
                *("--flight", out / "logs", "--json", figures["lite6"]),
            )
        if options.perception == "tags":
            processes.start(
                programs["perception"],
                *("--lcm", url, "--config", paths.MODELS / "config" / "perception.yaml"),
                # A real arm's driver knows nothing of frames: then cameras are looked at as they come.
                *(
                    (w for camera in CAMERAS for w in ("--source", f"{camera}=ring:{ring}"))
                    if options.arm == "lite6"
                    else ("--ring", ring)
                ),
                *("--json", figures["perception"]),
            )
        processes.start(
            programs["control"],
            *("--lcm", url, "--weights", weights, "--perception", options.perception),
            *("--clock", options.clock, "--json", figures["control"]),
        )
        if options.perception == "tags":
            wait_for(run.sees, 20, "intabs_perception sent no fresh poses")
        seen = run.first_frame(_first_status(url, processes), options.perception == "truth")
        planner = Planner(weights)
        plan = options.plan(planner, seen) if options.plan else planner.for_task(options.task, seen)
        report(0.0, plan.about)
        if plan.predicted is not None:  # told before anything moves
            print(plan.expected(seen), flush=True)
        parts = messages.plan_parts(run.plan_id, plan.as_messages())
        longest_s = sum(s.max_ticks for s in plan.skills) * TICK_S
        # By the wall clock the arm holds while perception is behind.
        limit_s = TRIES * longest_s + (5.0 if options.clock == "lockstep" else 60.0)

        def send_plan() -> None:
            for part in parts:
                listener.publish("SKILL_PLAN", part)

        wait_for(lambda: run.skill, 20, "intabs_control did not take the plan", again=send_plan)

        while (end := run.end(limit_s)) is None:
            processes.check()
            if not listener.handle(100) and time.monotonic() - run.spoke > 15:
                raise UserError(f"intabs_{worlds[0]} fell silent; what it said is in {out / 'logs'}")
            report(*_standing(run))
        fault = _first_status(url, processes).fault if run.end_reason == FAULTED and options.clock == "wall" else 0
        codes = processes.stop(patience_s=60)
    for name, code in codes.items():
        if code != 0:
            raise UserError(f"{name} did not end cleanly (exit code {code}): {processes.last_line(name)}")

    end_us, success = end
    left = missing(plan.goals, run.paths(end_us)) if plan.goals else None
    if options.by_goals:
        success = run.end_reason in (FINISHED, NO_EFFECT) and int(left[1]) == len(plan.goals)
    summary = _summary(options, run, end_us, success, {n: _figures(f) for n, f in figures.items()}, subgoals)
    if fault:
        summary["fault"] = fault
    summary["plan"] = {"about": plan.about, "skills": [s.index for s in plan.skills], "retries": run.skill.retries}
    if plan.predicted is not None:
        summary["plan"] |= {"predicted": plan.predicted.tolist(), "search_s": plan.search_s, "verify_s": plan.verify_s}
    if left is not None:
        summary["plan"]["ended_from_goal_m"] = left[0]
    why = "" if success else _why(run, summary, end_us)
    if options.by_goals and run.end_reason == FINISHED and not success:
        why = f"the objects ended {1000 * left[0]:.0f} mm from the goal"
    return summary, why


def _first_status(url: str, processes: Processes) -> messages.lite6_status_t:
    """Heard on a connection of its own: at 250 Hz nobody here wants to hear the others."""
    heard: list = []
    ear = bus.Bus(url)
    ear.subscribe("LITE6_STATUS", heard.append)
    until = time.monotonic() + 20
    while not heard:
        processes.check()
        if time.monotonic() > until:
            raise UserError("no LITE6_STATUS within 20 s")
        ear.handle(100)
    return heard[0]


def _standing(run: _Run) -> tuple[float, str]:
    skill = run.skill
    share = (skill.skill_index + skill.progress) / max(skill.n_skills, 1)
    at_s = (skill.utime - run.start_us) * 1e-6
    return share, f"skill {skill.skill_index + 1} of {skill.n_skills}, {at_s:.1f} s"


def _figures(path: Path) -> dict:
    return json.loads(path.read_text()) if path.exists() else {}


def _percentile(values: list[float], share: float) -> float | None:
    """Nearest rank; None without values."""
    if not values:
        return None
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def _summary(
    options: Options, run: _Run, end_us: int, success: bool, figures: dict[str, dict], subgoals: list[str]
) -> dict:
    bits = run.subgoals(end_us)
    errors = run.object_errors_mm(end_us)
    ticks = [u for u in run.skill_utimes if u <= end_us]
    control = figures["control"].get("control", {})
    perception = figures["perception"]
    return {
        "task": options.task,
        "seed": options.seed,
        "spread": options.spread,
        "perception_source": options.perception,
        "clock": options.clock,
        "success": success,
        "subtasks": [{"name": name, "success": bool(bits >> i & 1)} for i, name in enumerate(subgoals)],
        "duration_s": round((end_us - run.start_us) * 1e-6, 3),
        "control": {
            "rate_hz": round(1e6 * (len(ticks) - 1) / (ticks[-1] - ticks[0]), 3) if len(ticks) > 1 else None,
            "ticks": len(ticks),
            "overruns": control.get("overruns"),
            "latency_us": control.get("latency_us"),
        },
        "policy": figures["control"].get("policy", {}),
        "perception": {
            "frames": sum(run.start_us <= p.exposure_utime <= end_us for p in run.poses.values()),
            "fps": round(run.fps, 2),
            "detect_ms": perception.get("detect_ms", {"p50": None}),
            "object_error_mm": {
                key: None if value is None else round(value, 3)
                for key, value in (("p50", _percentile(errors, 0.5)), ("p95", _percentile(errors, 0.95)))
            },
        },
    }


def _why(run: _Run, summary: dict, end_us: int) -> str:
    missed = [s["name"] for s in summary["subtasks"] if not s["success"]]
    reason = END_REASONS.get(run.end_reason)
    if fault := FAULTS.get(summary.get("fault")):
        reason = f"the driver stopped: {fault}"
    if reason is None:
        reason = "not " + ", ".join(missed) if missed else "the goal state did not last"
    return f"{reason} (after {summary['duration_s']:.1f} s)"
