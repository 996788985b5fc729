"""Do skills of a kind lie together? K nearest neighbours in z, with the labels of the demonstrations (evaluation only).

A piece is a stretch of one label. Base: the training split; queries: held-out demonstrations.
"""

from __future__ import annotations

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


def score_neighbours(seeds: list[Learned], pca: Pca, train: list[Demo], held_out: list[Demo], rounds: int = 50) -> dict:
    """All held-out pieces against all of the training split; and the thesis' protocol: 150 base and 50 query pieces,
    drawn `rounds` times. `untrained`: the same encoders with random weights; `pca`: 16 principal components of the raw
    piece."""
    import torch

    from intabs.model.networks import InteractionAbstractions

    untrained = []
    for k, method in enumerate(seeds):
        torch.manual_seed(k)
        model = InteractionAbstractions(method.config["model"], method.model.space)
        untrained.append(Learned("untrained", model))
    sides = []
    for demos in (train, held_out):
        samples = [sample(d) for d in demos]
        pieces = [label_pieces(d.extra["labels"]) for d in demos]
        codes = {
            name: [
                np.concatenate(
                    [
                        m.encode(m.inputs(s), [(a, b) for a, b, _ in p]).numpy()
                        for s, p in zip(samples, pieces, strict=True)
                        if p
                    ]
                )
                for m in methods
            ]
            for name, methods in (("z", seeds), ("untrained", untrained))
        }
        codes["pca"] = [
            np.stack([pca.encode(s.motion[a : b + 1]) for s, p in zip(samples, pieces, strict=True) for a, b, _ in p])
        ]
        sides.append((codes, np.array([label for p in pieces for _, _, label in p])))
    (base, base_labels), (query, query_labels) = sides
    majority = np.bincount(base_labels).argmax()

    def accuracy(name: str) -> tuple[float, np.ndarray]:
        predicted = [
            neighbours(b / b.std(0), base_labels, q / b.std(0)) for b, q in zip(base[name], query[name], strict=True)
        ]
        return float(np.mean([p == query_labels for p in predicted])), predicted[0]

    value, predicted = accuracy("z")
    rng = np.random.default_rng(0)
    thesis = []
    for _ in range(rounds):
        b = rng.permutation(len(base_labels))[:150]
        q = rng.permutation(len(query_labels))[:50]
        x, y = base["z"][0], query["z"][0]
        thesis.append((neighbours(x[b] / x.std(0), base_labels[b], y[q] / x.std(0)) == query_labels[q]).mean())
    return {
        "accuracy": value,
        "majority": float((query_labels == majority).mean()),
        "untrained": accuracy("untrained")[0],
        "pca": accuracy("pca")[0],
        "classes": len(np.unique(np.concatenate([base_labels, query_labels]))),
        "n": len(query_labels),
        "thesis_protocol": float(np.mean(thesis)),
        "confusion": confusion(query_labels, predicted, int(max(base_labels.max(), query_labels.max())) + 1).tolist(),
    }
