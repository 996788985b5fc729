"""Every method on the same held-out demonstrations: `intabs evaluate`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from intabs import paths
from intabs.data.demos import load_demos
from intabs.errors import UserError
from intabs.evaluate.baselines import Mean, Pca, Still
from intabs.evaluate.boundaries import score_boundaries
from intabs.evaluate.hdmp import FaithfulHdmp, Hdmp
from intabs.evaluate.knn import Codes, score_compositions, score_neighbours
from intabs.evaluate.learned import Learned
from intabs.evaluate.metrics import Motion, Scaling, errors, fixed_cuts, sample, seen_from_tip
from intabs.evaluate.usage import score_usage

KINDS = {"split": "intabs", "joint": "tvi", "agent": "tvi-agent"}
METHODS = ("intabs", "tvi", "tvi-agent", "pca", "hdmp", "hdmp-faithful", "still", "mean")
FIGURES = ("all", "balanced", "joints", "position", "orientation")
FROM_TIP = ("all_from_tip", "position_from_tip", "orientation_from_tip")  # of the Lite 6, objects seen from its gripper


def load_learned(source: Path) -> Learned:
    """A run of `intabs train` or a folder of weights."""
    from intabs.train.cutting import load_cutter
    from intabs.train.trainer import load_model

    if (source / "checkpoint.pt").exists():
        model, about = load_model(source)
        cutter = load_cutter(model, about.get("cutter"))
        steps, replays, sha256 = about["step"], about["data"]["replays"], about["data"]["sha256"]
    elif (source / "manifest.json").exists():
        from intabs.train.export import load_weights

        model, manifest = load_weights(source)
        about, cutter = manifest["training"], None
        steps, replays, sha256 = about["steps"], about.get("replays", 0), about["data_sha256"]
    else:
        raise UserError(f"{source}: neither a run of `intabs train` (checkpoint.pt) nor a folder of weights")
    torch.set_num_threads(1)
    learned = Learned(KINDS[model.kind], model, about["config"], cutter)
    learned.steps, learned.replays, learned.data_sha256 = steps, replays, sha256
    return learned


def find_sources(sources: list[Path]) -> list[Path]:
    """Names of shipped weights stand for their folders; beside weights, the baselines' come along."""
    out = []
    for source in sources:
        folder = source if source.exists() else paths.MODELS / "weights" / source
        if not folder.exists():
            raise UserError(f"{source}: no run of `intabs train` and no folder in models/weights")
        folder = folder.resolve()
        beside = (folder.with_name(f"{folder.name}-{kind}") for kind in ("tvi", "tvi-agent"))
        out += [folder, *(f for f in beside if (f / "manifest.json").exists())]
    return list(dict.fromkeys(out))


def evaluate(
    sources: list[Path],
    data: Path,
    methods: list[str] | None,
    unit: str,
    segment: int = 15,
    progress: Callable[[int, str], None] = lambda done, text: None,
) -> dict:
    """Several sources of a kind are several seeds of one method; methods None: all that there are.

    {methods: {name: {all, balanced, joints, position, orientation, sd, n}}, training: {name: [{parameters, steps,
    replays, data_sha256}]}, data_sha256, usage, knn, boundaries, ratios, seeds}:
    means over held-out demonstrations, or over all their segments; sd over seeds, of `all`; for the Lite 6 also
    FROM_TIP.
    ratios: of the first method's figures to the others', with 95 % intervals (bootstrap over held-out demonstrations,
    paired; None of a single one). usage and boundaries are the first seed's.
    """
    from intabs.train.trainer import file_hash

    unknown = [m for m in methods or () if m not in METHODS]
    if unknown:
        raise UserError(f"--methods {unknown[0]}: known are {', '.join(METHODS)}")
    learned: dict[str, list[Learned]] = {}
    for source in find_sources(sources):
        method = load_learned(source)
        learned.setdefault(method.name, []).append(method)
    train_demos, held_out_demos = load_demos(data, "train")[0], load_demos(data, "valid")[0]
    if not held_out_demos:
        raise UserError(f"{data}: holds nothing out (mask/valid is empty); `intabs data split` makes one")
    train = [sample(d).motion for d in train_demos]
    held_out = [sample(d) for d in held_out_demos]
    scaling = Scaling.fit(train)
    arm = next(iter(learned.values()))[0].model.space.arm
    from_tip = Scaling.fit([seen_from_tip(m, arm) for m in train]) if arm is not None else None

    def score(got: Motion, want: Motion) -> dict[str, float]:
        out = errors(got, want, scaling)
        if from_tip is not None:
            e = errors(seen_from_tip(got, arm), seen_from_tip(want, arm), from_tip)
            out |= {k: e[k.removesuffix("_from_tip")] for k in FROM_TIP}
        return out

    pieces = []
    for i, s in enumerate(held_out):
        cuts = fixed_cuts(len(s.motion), segment)
        if unit == "whole":
            pieces.append((i, s, cuts))
        else:
            pieces += [(i, s.piece(a, b), [0, b - a]) for a, b in zip(cuts, cuts[1:], strict=False)]
    make = {
        "still": lambda: [Still()],
        "mean": lambda: [Mean(train, scaling, segment)],
        "pca": lambda: [Pca(train, scaling, segment)],
        "hdmp-faithful": lambda: [FaithfulHdmp()],
        "hdmp": lambda: [Hdmp()],
        **{name: lambda found=found: found for name, found in learned.items()},
    }
    others = (m for m in METHODS if m not in KINDS.values() and (m != "hdmp" or Hdmp.installed()))
    names = methods or [*learned, *others]
    missing = [m for m in names if m not in make]
    if missing:
        raise UserError(f"--methods {missing[0]}: no run of that kind is given; have {', '.join(learned)}")
    rows: dict[str, list[list[dict]]] = {}  # method -> seeds -> pieces
    done = 0
    for name in names:
        rows[name] = []
        for method in make[name]():
            seed = []
            for _, s, cuts in pieces:
                seed.append(score(method.reconstruct(s, cuts), s.motion))
                done += 1
                progress(done, name)
            rows[name].append(seed)
    figures = {}
    for name, seeds in rows.items():
        figures[name] = {k: float(np.mean([r[k] for seed in seeds for r in seed])) for k in seeds[0][0]}
        means = [np.mean([r["all"] for r in seed]) for seed in seeds]
        figures[name] |= {"sd": float(np.std(means, ddof=1)) if len(means) > 1 else 0.0, "n": len(pieces)}
    out = {
        "methods": figures,
        "unit": unit,
        "segment": segment,
        "seeds": max(len(x) for x in learned.values()),
        "training": {name: [m.training for m in learned[name]] for name in names if name in learned},
        "data_sha256": file_hash(data),
        "ratios": ratios(rows, [i for i, _, _ in pieces]),
    }
    main = learned.get("intabs") or next(iter(learned.values()))
    if main[0].cuts_itself:
        out["usage"] = score_usage(main[0], train_demos, held_out_demos)
    if all("labels" in d.extra for d in train_demos + held_out_demos):
        codes = Codes(main, Pca(train, scaling, segment))
        out["knn"] = score_neighbours(codes, train_demos, held_out_demos)
        if compositions := score_compositions(codes, train_demos, held_out_demos):
            out["compositions"] = compositions
        if main[0].cuts_itself:
            out["boundaries"] = score_boundaries(main[0], train_demos, held_out_demos)
    return out


def ratios(rows: dict[str, list[list[dict]]], demo: list[int], draws: int = 2000) -> dict:
    """Of the first method to each other one: {method: {figure: [ratio, low, high]}}."""
    first, *others = rows
    demo = np.array(demo)
    groups = [np.flatnonzero(demo == i) for i in np.unique(demo)]
    rng = np.random.default_rng(0)
    picks = [np.concatenate([groups[i] for i in rng.integers(len(groups), size=len(groups))]) for _ in range(draws)]
    values = {name: {k: np.mean([[r[k] for r in seed] for seed in rows[name]], 0) for k in FIGURES} for name in rows}
    out = {}
    for name in others:
        out[name] = {}
        for k in FIGURES:
            a, b = values[first][k], values[name][k]
            drawn = [a[p].mean() / max(b[p].mean(), 1e-12) for p in picks]
            interval = np.quantile(drawn, [0.025, 0.975]).tolist() if len(groups) > 1 else [None, None]
            out[name][k] = [float(a.mean() / max(b.mean(), 1e-12)), *interval]
    return out


def with_interval(figure: list) -> str:
    """Of `ratios`: "0.92 (0.86-0.96)"."""
    ratio, low, high = figure
    return f"{ratio:.2f}" + ("" if low is None else f" ({low:.2f}-{high:.2f})")
