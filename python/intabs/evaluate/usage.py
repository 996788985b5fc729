"""What of z the learned skills use (evaluation only)."""

from __future__ import annotations

import numpy as np

from intabs.data.demos import Demo
from intabs.evaluate.learned import Learned
from intabs.evaluate.metrics import sample

ACTIVE = 0.01  # variance of z's mean over skills: a dimension below it says nothing (Burda et al., IWAE, 2016, 5.1)


def score_usage(method: Learned, train: list[Demo], demos: list[Demo]) -> dict:
    """Of the skills between learned boundaries: {skills, demonstrations, ticks: median length, active: [of each
    encoder's part of z], of: [sizes]}."""
    cuts = method.cuts(train, demos)
    pieces = [[(int(a), int(b)) for a, b in zip(c, c[1:], strict=False) if b > a] for c in cuts]
    z = np.concatenate([method.encode(method.inputs(sample(d)), p).numpy() for d, p in zip(demos, pieces, strict=True)])
    sizes = [q.spec["heads"]["mean"] for q in method.model.encoders.values()]
    parts = np.split(z, np.cumsum(sizes)[:-1], axis=1)
    return {
        "skills": len(z),
        "demonstrations": len(demos),
        "ticks": float(np.median([b - a for p in pieces for a, b in p])),
        "active": [int((part.var(0) > ACTIVE).sum()) for part in parts],
        "of": sizes,
    }
