"""How well learned boundaries meet changes of the labels (evaluation only)."""

from __future__ import annotations

import numpy as np

from intabs.data.demos import Demo
from intabs.evaluate.learned import Learned

TOLERANCE = 3  # frames


def matched(found: np.ndarray, true: np.ndarray, tolerance: int = TOLERANCE) -> int:
    """How many boundaries were found: each counts once, within `tolerance` frames."""
    free, hits = list(true), 0
    for x in found:
        near = [y for y in free if abs(x - y) <= tolerance]
        if near:
            free.remove(min(near, key=lambda y: abs(x - y)))
            hits += 1
    return hits


def precision_recall_f1(found: list[np.ndarray], true: list[np.ndarray], tolerance: int = TOLERANCE):
    """Pooled over demonstrations: (precision, recall, f1)."""
    hits = sum(matched(a, b, tolerance) for a, b in zip(found, true, strict=True))
    p, r = hits / max(1, sum(map(len, found))), hits / max(1, sum(map(len, true)))
    return p, r, 2 * p * r / max(p + r, 1e-9)


def label_changes(demo: Demo) -> np.ndarray:
    return np.flatnonzero(np.diff(demo.extra["labels"])) + 1


def mean_times(train: list[Demo], demo: Demo) -> np.ndarray:
    """Boundaries where those of the task's training demonstrations are on average, in shares of the duration: as many
    as their median, the k-th at the mean of the k-th in rank."""
    times = [label_changes(d) / len(d) for d in train if d.attrs.get("task") == demo.attrs.get("task")]
    times = [t for t in times if len(t)]
    if not times:
        return np.zeros(0)
    rank = (np.arange(int(np.median([len(t) for t in times]))) + 0.5) / np.median([len(t) for t in times])
    return np.mean([np.quantile(t, rank) for t in times], 0) * len(demo)


def score_boundaries(method: Learned, train: list[Demo], held_out: list[Demo]) -> dict:
    """precision, recall, f1 of the learned cuts of held-out demonstrations; f1 of the best fixed length (chosen on the
    training split) and of the mean times of the training split's labels."""
    found = [cuts[1:-1] for cuts in method.cuts(train, held_out)]
    true = [label_changes(d) for d in held_out]
    precision, recall, f1 = precision_recall_f1(found, true)

    def fixed(demos: list[Demo], length: int) -> float:
        cuts = [np.arange(length, len(d), length) for d in demos]
        return precision_recall_f1(cuts, [label_changes(d) for d in demos])[2]

    best = max(range(4, 61), key=lambda n: fixed(train, n))
    return {
        "precision": precision,
        "recall": recall,
        "f1": f1,
        "fixed_cut_f1": fixed(held_out, best),
        "mean_time_f1": precision_recall_f1([mean_times(train, d) for d in held_out], true)[2],
    }
