"""Do skills of a kind lie together? K nearest neighbours in z, with the labels of the demonstrations (evaluation only).

A piece is a stretch of one label. Base: the training split; queries: held-out demonstrations.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intabs.data.demos import Demo
from intabs.evaluate.baselines import Pca
from intabs.evaluate.learned import Learned
from intabs.evaluate.metrics import sample

K = 5
SHORTEST = 4  # ticks


def label_pieces(labels: np.ndarray) -> list[tuple[int, int, int]]:
    """(first tick, tick after the last, label) of stretches that are long enough; ticks are those of actions: the last
    frame begins none."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(labels)) + 1, [len(labels)]])
    pairs = zip(edges[:-1], edges[1:], strict=True)
    out = [(int(a), int(min(b, len(labels) - 1)), int(labels[a])) for a, b in pairs]
    return [x for x in out if x[1] - x[0] >= SHORTEST]


def neighbours(base: np.ndarray, base_labels: np.ndarray, query: np.ndarray, k: int = K) -> np.ndarray:
    """Predicted labels of the queries: majority of the k nearest (Euclidean), ties to the nearer."""
    distance = ((query[:, None] - base[None]) ** 2).sum(-1)
    near = np.argsort(distance, axis=1, kind="stable")[:, :k]
    out = []
    for row in near:
        labels = base_labels[row]
        counts = np.bincount(labels)
        best = np.flatnonzero(counts == counts.max())
        out.append(next(x for x in labels if x in best))
    return np.array(out)


def confusion(true: np.ndarray, predicted: np.ndarray, classes: int) -> np.ndarray:
    """(classes, classes), rows: true."""
    table = np.zeros((classes, classes), int)
    np.add.at(table, (true, predicted), 1)
    return table


class Codes:
    """What each method says of pieces: z of every seed, of the same encoders with random weights, and 16 principal
    components of the raw pieces."""

    def __init__(self, seeds: list[Learned], pca: Pca):
        import torch

        from intabs.model.networks import InteractionAbstractions

        self.pca, self.encoders = pca, {"z": seeds, "untrained": []}
        for k, method in enumerate(seeds):
            torch.manual_seed(k)
            model = InteractionAbstractions(method.config["model"], method.model.space)
            self.encoders["untrained"].append(Learned("untrained", model))

    def of(self, demos: list[Demo], pieces: list[list[tuple[int, int, int]]]) -> dict[str, list[np.ndarray]]:
        """Name -> for each seed (n, 16)."""
        sides = [(sample(d), p) for d, p in zip(demos, pieces, strict=True) if p]
        out = {
            name: [
                np.concatenate([m.encode(m.inputs(s), [(a, b) for a, b, _ in p]).numpy() for s, p in sides])
                for m in methods
            ]
            for name, methods in self.encoders.items()
        }
        out["pca"] = [np.stack([self.pca.encode(s.motion[a : b + 1]) for s, p in sides for a, b, _ in p])]
        return out


def predicted(base: list[np.ndarray], labels: np.ndarray, query: list[np.ndarray]) -> list[np.ndarray]:
    """For each seed; numbers in deviations of the base."""
    return [neighbours(b / _deviation(b), labels, q / _deviation(b)) for b, q in zip(base, query, strict=True)]


def _deviation(x: np.ndarray) -> np.ndarray:
    return np.where(x.std(0) > 0, x.std(0), 1.0)  # what is always the same tells nothing


def score_compositions(codes: Codes, train: list[Demo], held_out: list[Demo]) -> dict | None:
    """Held-out demonstrations of tasks T1+T2: is the task that the pieces of single tasks vote for one of the two?
    chance: the share of pieces of these two. None without such demonstrations."""

    def taken(demos: list[Demo], joined: bool) -> tuple[list[Demo], list, np.ndarray]:
        some = [d for d in demos if ("+" in str(d.attrs.get("task", ""))) == joined and "task" in d.attrs]
        pieces = [label_pieces(d.extra["labels"]) for d in some]
        return some, pieces, np.array([str(d.attrs["task"]) for d, p in zip(some, pieces, strict=True) for _ in p])

    base, base_pieces, of = taken(train, False)
    query, query_pieces, wanted = taken(held_out, True)
    if not len(of) or not len(wanted):
        return None
    tasks, labels = np.unique(of, return_inverse=True)
    right = np.array([[t in w.split("+") for t in tasks] for w in wanted])
    known, asked = codes.of(base, base_pieces), codes.of(query, query_pieces)
    out = {
        name: float(np.mean([right[np.arange(len(p)), p].mean() for p in predicted(known[name], labels, asked[name])]))
        for name in known
    }
    chance = float((right @ np.bincount(labels) / len(labels)).mean())
    return {"accuracy": out["z"], "untrained": out["untrained"], "pca": out["pca"], "chance": chance, "n": len(wanted)}


def score_neighbours(codes: Codes, train: list[Demo], held_out: list[Demo], rounds: int = 50) -> dict:
    """All held-out pieces against all of the training split; and the thesis' protocol: 150 base and 50 query pieces,
    drawn `rounds` times. Of several seeds means; the thesis' protocol and the confusion are the first one's."""
    sides = []
    for demos in (train, held_out):
        pieces = [label_pieces(d.extra["labels"]) for d in demos]
        sides.append((codes.of(demos, pieces), np.array([label for p in pieces for _, _, label in p])))
    (base, base_labels), (query, query_labels) = sides
    majority = np.bincount(base_labels).argmax()
    found = {name: predicted(base[name], base_labels, query[name]) for name in base}
    accuracy = {name: float(np.mean([p == query_labels for p in every])) for name, every in found.items()}
    rng = np.random.default_rng(0)
    thesis = []
    for _ in range(rounds):
        b = rng.permutation(len(base_labels))[:150]
        q = rng.permutation(len(query_labels))[:50]
        x, y = (side["z"][0] / _deviation(base["z"][0]) for side in (base, query))
        thesis.append((neighbours(x[b], base_labels[b], y[q]) == query_labels[q]).mean())
    classes = int(max(base_labels.max(), query_labels.max())) + 1
    return {
        "accuracy": accuracy["z"],
        "majority": float((query_labels == majority).mean()),
        "untrained": accuracy["untrained"],
        "pca": accuracy["pca"],
        "classes": len(np.unique(np.concatenate([base_labels, query_labels]))),
        "n": len(query_labels),
        "thesis_protocol": float(np.mean(thesis)),
        "confusion": confusion(query_labels, found["z"][0], classes).tolist(),
    }


def picture(knn: dict, names: list[str], out: Path) -> None:
    """The confusion matrix, rows: true, in shares of the row."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    table = np.array(knn["confusion"])
    used = np.flatnonzero(table.sum(0) + table.sum(1))
    table = table[np.ix_(used, used)]
    words = [names[k] if k < len(names) else str(k) for k in used]
    figure, ax = pyplot.subplots(figsize=(2.5 + 0.4 * len(used),) * 2, constrained_layout=True)
    ax.imshow(table / np.maximum(table.sum(1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1)
    for i, j in np.argwhere(table):
        ax.text(j, i, table[i, j], ha="center", va="center", fontsize=8, color="white" if i == j else "black")
    ax.set_xticks(range(len(words)), words, rotation=90)
    ax.set_yticks(range(len(words)), [f"{w} ({n})" for w, n in zip(words, table.sum(1), strict=True)])
    ax.set_xlabel("5-NN says")
    ax.set_ylabel("label")
    ax.set_title(f"{knn['accuracy']:.3f} of {knn['n']} held-out pieces")
    figure.savefig(out, dpi=120)
    pyplot.close(figure)
