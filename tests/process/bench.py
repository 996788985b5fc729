"""Starts, hears and stops the real programs for a test, on an LCM group of their own."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from intabs import bus, messages, paths, play
from intabs.processes import Processes, shared_memory_name
from intabs.skills.library import Library
from intabs.skills.planner import whole

IDLE, TRACKING, SLOWING, HOLDING, FAULT, STOPPED = range(6)  # core/types.h ArmState
STALE_COMMAND = 1  # Fault
WEIGHTS = paths.MODELS / "weights" / play.WEIGHTS
TASK = "pick_place"


def need_programs() -> None:
    """Skips the module where it cannot run."""
    missing = [n for n in ("plant", "perception", "control") if not (paths.BIN / f"intabs_{n}").exists()]
    if missing:
        pytest.skip(f"not built in {paths.BIN}: {', '.join(missing)}", allow_module_level=True)
    if not (WEIGHTS / "skills.json").exists():
        pytest.skip(f"{WEIGHTS} has no skill library: train and export first", allow_module_level=True)
    if fault := bus.route_fault():
        pytest.skip(f"no multicast route ({fault}): {bus.ROUTE_CURE}", allow_module_level=True)


def ends(program: str, *args: object, patience_s: float = 60) -> tuple[int, list[str]]:
    """Runs a program that should end on its own: exit code and what it wrote to stderr."""
    done = subprocess.run([paths.program(program), *map(str, args)], capture_output=True, text=True, timeout=patience_s)
    return done.returncode, done.stderr.splitlines()


class Bench:
    """The programs of one run and everything they said."""

    def __init__(self, folder: Path, clock: str = "wall", perception: str = "tags", seed: int = 1, spread: float = 0):
        self.clock, self.perception_source = clock, perception
        self.seed, self.spread = seed, spread
        self.url, self.ring = bus.private_url(), shared_memory_name()
        self.folder = folder
        self.processes = Processes(folder)
        self.bus = bus.Bus(self.url)
        self.heard: dict[str, list] = {}
        for channel in messages.CHANNELS:
            self.heard[channel] = []
            self.bus.subscribe(channel, self.heard[channel].append)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_exc) -> None:
        self.processes.stop()

    def plant(self, name: str = "intabs_plant") -> subprocess.Popen:
        cameras = "--cameras" if self.perception_source == "tags" else "--no-cameras"
        return self.processes.start(
            paths.program("intabs_plant"),
            *("--lcm", self.url, "--models", paths.MODELS, "--task", TASK, "--seed", self.seed),
            *("--spread", self.spread, "--clock", self.clock, "--ring", self.ring, cameras),
            *("--json", self.folder / "plant.json"),
            name=name,
        )

    def perception(self, name: str = "intabs_perception") -> subprocess.Popen:
        config = paths.MODELS / "config" / "perception.yaml"
        return self.processes.start(
            paths.program("intabs_perception"),
            *("--lcm", self.url, "--ring", self.ring, "--config", config, "--json", self.folder / "perception.json"),
            name=name,
        )

    def control(self, name: str = "intabs_control") -> subprocess.Popen:
        return self.processes.start(
            paths.program("intabs_control"),
            *("--lcm", self.url, "--weights", WEIGHTS, "--perception", self.perception_source, "--clock", self.clock),
            *("--json", self.folder / "control.json"),
            name=name,
        )

    def start_all(self) -> None:
        self.plant()
        self.until(lambda: self.heard["PLANT_TRUTH"], "the plant speaks")
        if self.perception_source == "tags":
            self.perception()
            self.until(self.perception_keeps_up, "perception keeps up")
        self.control()

    def perception_keeps_up(self) -> bool:
        poses, truth = self.heard["OBJECT_POSES"], self.heard["PLANT_TRUTH"]
        return bool(poses) and truth[-1].utime - poses[-1].exposure_utime < 200_000

    def play(self, plan_id: int = 1) -> None:
        """Sends the plan until control has taken it."""
        parts = messages.plan_parts(plan_id, whole(Library.load(WEIGHTS), TASK, None).as_messages())

        def taken() -> bool:
            for part in parts:
                self.bus.publish("SKILL_PLAN", part)
            return bool(self.heard["SKILL_STATUS"]) and self.heard["SKILL_STATUS"][-1].plan_id == plan_id

        self.until(taken, "control takes the plan")

    def until(self, what, name: str, patience_s: float = 30) -> None:
        end = time.monotonic() + patience_s
        while not what():
            assert time.monotonic() < end, f"waited {patience_s} s in vain: {name}; {self.last_lines()}"
            self.bus.handle(100)

    def listen(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.bus.handle(max(1, int(1000 * left)))

    def last_lines(self) -> str:
        return json.dumps({name: self.processes.last_line(name) for name in self.processes.running})

    @property
    def status(self) -> messages.lite6_status_t:
        return self.heard["LITE6_STATUS"][-1]

    def states_since(self, index: int) -> list[int]:
        """The states gone through, repetitions left out."""
        states = [s.state for s in self.heard["LITE6_STATUS"][index:]]
        return [s for i, s in enumerate(states) if i == 0 or s != states[i - 1]]
