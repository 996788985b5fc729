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
from intabs.output import write_json
from intabs.play import END_REASONS
from intabs.skills.library import Frame, Library, weights_folder
from intabs.skills.planner import Planner, goals_of, seen_from, whole

ABLATIONS = ("", "objects", "z", "policy")
UNSEEN = 1_000_000  # seeds of rollouts start here; `intabs collect` counts up from 0
SETTLE_TICKS = 50
STRIP = 12  # pictures of a failure


@dataclass(frozen=True)
class Setting:
    task: str
    weights: str
    spread: float  # cm
    perception: str
    seed: int
    ablate: str
    format: str = ""  # of the weights, as the network runs them; empty: the manifest's
    plan: str = ""  # as Planner.for_task; "whole": the demonstration that began most like now; "goal": found
    nudge: bool = False  # the first grasp is made to fail
    source: str = ""  # plays this demonstration's skills
    film: str = ""  # folder for a strip of pictures of each failure


def wilson(successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927)."""
    if n == 0:
        return 0.0, 1.0
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, min(p, centre - half)), min(1.0, max(p, centre + half))  # with p in it, whatever rounding does


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
        world = _core.Rollout(str(paths.MODELS), setting.task, setting.weights, config, setting.format)
        planner = Planner(Path(setting.weights))
        _cache[key] = world, planner
    world, planner = _cache[key]
    seed = setting.seed + trial
    seen = seen_from(world.reset(seed, setting.spread))
    if setting.plan == "goal":
        plan = planner.find(goals_of(planner.library, setting.task, seen), seen)
    elif setting.plan == "whole" or setting.source:
        plan = whole(planner.library, setting.task, seen, setting.source)
    else:
        plan = planner.for_task(setting.task, seen)
    z, ticks, index = plan.arrays()
    if setting.ablate == "z":
        z = z[np.random.default_rng(seed).permutation(len(z))]
    film = max(1, int(ticks[:, 1].sum()) // STRIP) if setting.film else 0
    # What is to be shown of given skills is shown by them alone.
    others = not (setting.source or setting.plan == "whole" or setting.ablate == "z")
    result = world.run(z, ticks, index, SETTLE_TICKS, setting.ablate, setting.nudge, film, others)
    for trace in ("q", "gripper", "object_pose", "skills"):
        result.pop(trace)
    pictures = result.pop("pictures")
    result["displaced_cm"] = displaced_cm(planner.library, setting.task, seen)
    if pictures and not result["success"]:
        write_strip(Path(setting.film) / f"failed_{trial:04d}.png", pictures)
    if not result["success"] and result["end_reason"] in END_REASONS:
        result["reason"] = END_REASONS[result["end_reason"]]
    timing = {"search_s": plan.search_s, "verify_s": plan.verify_s} if plan.predicted is not None else {}
    return {"trial": trial, "seed": seed, "plan": plan.about, **timing, **result}


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
    plan: str = "",
    nudge: bool = False,
    progress: Callable[[int, str], None] = lambda done, text: None,
) -> dict:
    """Runs `trials` trials with seeds seed, seed + 1, ... plan, nudge: as in Setting. With `report` each result is
    kept in trials.jsonl, `resume` runs only those that are missing there; beside it figures.json, a strip of
    pictures of each failure, and success against displacement (displacement.png)."""
    if ablate not in ABLATIONS:
        raise UserError(f"--ablate {ablate}: known are objects, z, policy")
    weights = weights_folder(weights)
    with as_user_error(RuntimeError, ValueError):  # before any trial
        whole(Library.load(weights), task, None)
        _core.Rollout(str(paths.MODELS), task, str(weights))
    sha256 = json.loads((weights / "manifest.json").read_text())["sha256"]
    film = str(report) if report is not None else ""
    setting = Setting(task, str(weights), spread, perception, seed, ablate, plan=plan, nudge=nudge, film=film)
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
    figures = {
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
        "retried": sum(r["retries"] > 0 for r in done),
    }
    times = {k: [r[k] for r in done if k in r] for k in ("search_s", "verify_s")}
    figures |= {k: {"p50": float(np.median(v)), "max": max(v)} for k, v in times.items() if v}
    if report is not None:
        write_json(report / "figures.json", figures)
        plot_displacement(report / "displacement.png", task, done)
    return figures


def displaced_cm(library: Library, task: str, seen: Frame) -> float:
    """How far the objects lie from where they lay on average in the task's demonstrations: the farthest of them, cm."""
    away = 0.0
    for one in task.split("+"):
        first = [chain[0].frames[0] for chain in library.of_task(one)]
        for slot in range(len(seen.known)):
            places = [f.object_pose[slot, :3] for f in first if f.known[slot]]
            if places and seen.known[slot]:
                away = max(away, float(np.linalg.norm(seen.object_pose[slot, :3] - np.mean(places, 0))))
    return 100 * away


def write_strip(path: Path, pictures: list[np.ndarray]) -> None:
    """Side by side in two rows."""
    from PIL import Image

    half = (len(pictures) + 1) // 2
    black = np.zeros_like(pictures[0])
    rows = [
        np.concatenate([*row, *[black] * (half - len(row))], 1) for row in (pictures[:half], pictures[half:]) if row
    ]
    Image.fromarray(np.concatenate(rows)).save(path)


def plot_displacement(path: Path, task: str, done: list[dict]) -> None:
    """Rate of success and its 95 % interval in fifths of the trials, by displacement."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    order = np.argsort([r["displaced_cm"] for r in done])
    figure, ax = pyplot.subplots(figsize=(6, 4), constrained_layout=True)
    for part in np.array_split(order, min(5, len(order))):
        x = np.array([done[i]["displaced_cm"] for i in part])
        good = sum(done[i]["success"] for i in part)
        low, high = wilson(good, len(part))
        rate = good / len(part)
        ax.errorbar(
            x.mean(), rate, [[rate - low], [high - rate]], [[x.mean() - x.min()], [x.max() - x.mean()]], "o", color="C0"
        )
    for success, y in ((True, 1.04), (False, -0.04)):
        x = [r["displaced_cm"] for r in done if r["success"] == success]
        ax.plot(x, [y] * len(x), "|", color="C2" if success else "C3")
    ax.set(xlabel="displacement of the farthest object [cm]", ylabel="success", ylim=(-0.08, 1.08))
    ax.set_title(f"{task}: {sum(r['success'] for r in done)} of {len(done)}")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
