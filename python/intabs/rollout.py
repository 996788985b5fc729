"""Closed-loop success of shipped or trained weights in the plant, in process, in lockstep."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from intabs import _core, paths
from intabs.errors import UserError, as_user_error
from intabs.jobs import in_processes
from intabs.play import END_REASONS, load_plan

ABLATIONS = ("", "objects", "z", "policy")
UNSEEN = 1_000_000  # seeds of rollouts start here; `intabs collect` counts up from 0
SETTLE_TICKS = 50


@dataclass(frozen=True)
class Setting:
    task: str
    weights: str
    spread: float  # cm
    perception: str
    seed: int
    ablate: str
    format: str = ""  # of the weights, as the network runs them; empty: the manifest's


def wilson(successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927)."""
    if n == 0:
        return 0.0, 1.0
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def _whole_lines(path: Path) -> list[dict]:
    lines = []
    for line in path.read_text().splitlines():
        try:
            lines.append(json.loads(line))
        except ValueError:
            break
    return lines


_cache: dict = {}


def run_trial(job: tuple[Setting, int]) -> dict:
    with as_user_error(RuntimeError, ValueError, TypeError):
        return _run_trial(*job)


def _run_trial(setting: Setting, trial: int) -> dict:
    key = (setting.task, setting.weights, setting.perception, setting.format)
    if key not in _cache:
        _cache.clear()
        config = str(paths.MODELS / "config/perception.yaml") if setting.perception == "tags" else ""
        _cache[key] = _core.Rollout(str(paths.MODELS), setting.task, setting.weights, config, setting.format)
    skills = load_plan(setting.task, Path(setting.weights))
    z = np.array([s["z"] for s in skills], "f4")
    ticks = [int(s["max_ticks"]) for s in skills]
    seed = setting.seed + trial
    if setting.ablate == "z":
        z = z[np.random.default_rng(seed).permutation(len(z))]
    result = _cache[key].run(seed, setting.spread, z, ticks, SETTLE_TICKS, setting.ablate)
    for trace in ("q", "gripper", "object_pose"):
        result.pop(trace)
    if not result["success"] and result["end_reason"] in END_REASONS:
        result["reason"] = END_REASONS[result["end_reason"]]
    return {"trial": trial, "seed": seed, **result}


def rollout(
    task: str,
    trials: int,
    spread: float = 2.0,
    weights: Path | str = "lite6",
    perception: str = "truth",
    seed: int = UNSEEN,
    jobs: int = 1,
    ablate: str = "",
    report: Path | None = None,
    resume: bool = False,
    progress: Callable[[int, str], None] = lambda done, text: None,
) -> dict:
    """Runs `trials` trials with seeds seed, seed + 1, ...; with `report` each result is kept in trials.jsonl, and
    `resume` runs only those that are missing there."""
    if ablate not in ABLATIONS:
        raise UserError(f"--ablate {ablate}: known are objects, z, policy")
    shipped = paths.MODELS / "weights" / weights
    weights = shipped if shipped.is_dir() else Path(weights)
    with as_user_error(RuntimeError, ValueError):  # before any trial
        load_plan(task, weights)
        _core.Rollout(str(paths.MODELS), task, str(weights))
    sha256 = json.loads((weights / "manifest.json").read_text())["sha256"]
    setting = Setting(task, str(weights), spread, perception, seed, ablate)
    results: dict[int, dict] = {}
    log = None
    if report is not None:
        report.mkdir(parents=True, exist_ok=True)
        path = report / "trials.jsonl"
        header = {"setting": asdict(setting), "sha256": sha256}
        if resume and path.exists():
            lines = _whole_lines(path)
            if not lines or lines[0] != header:
                raise UserError(f"{path}: was made with other settings; give another --report, or leave out --resume")
            results = {r["trial"]: r for r in lines[1:] if r["trial"] < trials}
        elif path.exists():
            raise UserError(f"{path} is there already: add --resume, or give another --report")
        # Written anew: the last line of an interrupted run may be cut.
        log = path.open("w")
        for line in (header, *results.values()):
            print(json.dumps(line), file=log, flush=True)
    missing = ((setting, i) for i in range(trials) if i not in results)
    for r in in_processes(run_trial, missing, jobs):
        results[r["trial"]] = r
        if log is not None:
            print(json.dumps(r), file=log, flush=True)
        good = sum(x["success"] for x in results.values())
        progress(len(results), f"{good} of {len(results)} succeeded")
    if log is not None:
        log.close()
    done = [results[i] for i in range(trials)]
    successes = sum(r["success"] for r in done)
    return {
        "task": task,
        "trials": trials,
        "success": successes,
        "rate": successes / trials if trials else 0.0,
        "ci95": list(wilson(successes, trials)),
        "failures": dict(Counter(r["reason"] for r in done if not r["success"])),
        "spread_cm": spread,
        "perception": perception,
        "seed": seed,
        "ablate": ablate,
    }
