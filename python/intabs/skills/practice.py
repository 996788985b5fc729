"""Practice: the skills of each demonstration tried in the plant by themselves, so that plans are made of those that do
their task there. Truth, seeds of its own. No torch.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

from intabs.jobs import in_processes
from intabs.rollout import Setting, run_trial
from intabs.skills.library import Library

Chain = tuple[str, str]  # task, demonstration
Progress = Callable[[float, str], None]

CM, SEED = (3.0, 8.0), 500_000  # by turns: far away demonstrations differ in how well they do
SURE = 3
MORE = 2  # times as many tries where it is not clear which demonstration does best
AFAR = " from afar"  # of a demonstration whose start is far away, where no practice begins: as good as from near


def practise(weights: Path, tries: int, jobs: int, progress: Progress) -> None:
    """Notes in the library of these weights how often the skills of each demonstration do their task."""
    chains = list(Library.load(weights).chains)
    note(weights, tried(weights, chains, range(tries), jobs, progress), tries, jobs, progress)


def tried(weights: Path, chains: list[Chain], tries: range, jobs: int, progress: Progress) -> dict[Chain, float]:
    """How often each of them did its task, as `worth` has it."""
    work = [
        (Setting(task, str(weights), CM[i % len(CM)], "truth", SEED, "", source=source), i)
        for task, source in sorted(chains)
        for i in tries
        if not source.endswith(AFAR)
    ]
    won = dict.fromkeys(chains, 0.0)
    for done, ((setting, _), result) in enumerate(zip(work, in_processes(run_trial, work, jobs), strict=True)):
        won[setting.task, setting.source] += worth(result)
        progress((done + 1) / len(work), f"{setting.task}: {setting.source}")
    return won | {(task, s): won.get((task, s.removesuffix(AFAR)), 0.0) for task, s in chains}


def note(weights: Path, won: dict[Chain, float], tries: int, jobs: int, progress: Progress) -> None:
    """Goes on from what `tried` found for the whole library: more tries where they are needed."""
    more = unsure(won, tries)
    again = tried(weights, more, range(tries, MORE * tries), jobs, progress) if more else {}
    path = weights / "skills.json"
    library = json.loads(path.read_text())
    library["practice"] = [
        {"task": c[0], "source": c[1], "trials": (MORE if c in again else 1) * tries,
         "success": round(w + again.get(c, 0.0), 3)}
        for c, w in won.items()
    ]  # fmt: skip
    write(path, library)


def write(path: Path, library: dict) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(library, separators=(",", ":")))
    os.replace(partial, path)


def worth(result: dict) -> float:
    """Of a trial, 0 .. 1: what was done only on being tried again tells less for a demonstration's skills."""
    return result["success"] / (1 + result["retries"])


def unsure(won: dict[Chain, float], tries: int) -> list[Chain]:
    """Where not even SURE demonstrations of a task always did it, the best ones: few tries hardly tell them apart."""
    out = []
    for task in dict.fromkeys(t for t, _ in won):
        own = {c: w for c, w in won.items() if c[0] == task}
        best = max(own.values())
        if sum(w == tries for w in own.values()) < min(SURE, len(own)):
            out += [c for c, w in own.items() if w >= max(best - 1, 1)]
    return out
