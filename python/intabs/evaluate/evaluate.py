"""Every method on the same held-out demonstrations: `intabs evaluate`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs import _core, paths
from intabs.data.demos import Demo, load_demos
from intabs.data.features import Normalizer, Trajectory, trajectory
from intabs.errors import UserError
from intabs.evaluate.baselines import Mean, Pca, Still
from intabs.evaluate.learned import Learned
from intabs.evaluate.metrics import Motion, Scaling, errors, fixed_cuts
from intabs.model.kinematics import rotation

METHODS = ("intabs", "pca", "still", "mean")
FIGURES = ("all", "balanced", "joints", "position", "orientation")


@dataclass
class Sample:
    motion: Motion
    trajectory: Trajectory

    def piece(self, a: int, b: int) -> Sample:
        """Ticks a to b, both of them in."""
        t = self.trajectory
        cut = Trajectory(t.readings.map(lambda x: x[a:b]), t.state[a:b], t.agent_action[a:b], t.environment_action[a:b])
        return Sample(self.motion[a : b + 1], cut)


def sample(demo: Demo, arm) -> Sample:
    arrays = demo.arrays()
    gripper = np.where(arrays.agent[:, 6:7] > 0.5, 1.0, -1.0)
    motion = Motion(
        np.concatenate([arrays.agent[:, :6], gripper], 1),
        arrays.objects[..., :3],
        rotation(arrays.objects[..., 3:]),
        arrays.environment,
        arrays.valid,
    )
    return Sample(motion, trajectory(demo, arm))


def load_learned(source: Path, arm) -> tuple[Learned, int, str]:
    """A run of `intabs train` or a folder of weights: the method, its typical length of a segment, hash of its data."""
    import torch

    from intabs.model.networks import InteractionAbstractions
    from intabs.train.trainer import load_model

    if (source / "checkpoint.pt").exists():
        model, normalizer, checkpoint = load_model(source)
        config, sha256 = checkpoint["config"], checkpoint["data"]["sha256"]
    elif (source / "manifest.json").exists():
        from safetensors.torch import load_file

        manifest = json.loads((source / "manifest.json").read_text())
        config, sha256 = manifest["training"]["config"], manifest["training"]["data_sha256"]
        model = InteractionAbstractions(config["model"])
        model.load_tensors(load_file(str(source / "weights.safetensors")))
        normalizer = Normalizer.from_dict(manifest["normalizer"])
    else:
        raise UserError(f"{source}: neither a run of `intabs train` (checkpoint.pt) nor a folder of weights")
    torch.set_num_threads(1)
    segment = int(round(sum(config["objective"]["segment"]) / 2)) + 1  # ticks, both ends in
    return Learned("intabs", model, normalizer, arm), segment, sha256


def evaluate(
    sources: list[Path],
    data: Path,
    methods: list[str],
    unit: str,
    progress: Callable[[int, str], None] = lambda done, text: None,
) -> dict:
    """Several sources are several seeds of one method. {methods: {name: {all, balanced, joints, position, orientation,
    sd, n}}, seeds}: means over held-out demonstrations, or over all their segments; sd over seeds, of `all`."""
    unknown = [m for m in methods if m not in METHODS]
    if unknown:
        raise UserError(f"--methods {unknown[0]}: known are {', '.join(METHODS)}")
    arm = _core.ArmModel.lite6()
    sources = [s if s.exists() else paths.MODELS / "weights" / s for s in sources]
    learned = [load_learned(s, arm) for s in sources]
    segment = learned[0][1]
    train = [sample(d, arm).motion for d in load_demos(data, "train")[0]]
    held_out = [sample(d, arm) for d in load_demos(data, "valid")[0]]
    if not held_out:
        raise UserError(f"{data}: holds nothing out (mask/valid is empty); `intabs data split` makes one")
    scaling = Scaling.fit(train)
    pieces = []
    for s in held_out:
        cuts = fixed_cuts(len(s.motion), segment)
        if unit == "whole":
            pieces.append((s, cuts))
        else:
            pieces += [(s.piece(a, b), [0, b - a]) for a, b in zip(cuts, cuts[1:], strict=False)]
    make = {
        "still": lambda: [Still()],
        "mean": lambda: [Mean(train, scaling, segment)],
        "pca": lambda: [Pca(train, scaling, segment)],
        "intabs": lambda: [x[0] for x in learned],
    }
    figures: dict = {}
    done = 0
    for name in methods:
        seeds = []
        for method in make[name]():
            rows = []
            for s, cuts in pieces:
                extra = (s.trajectory,) if isinstance(method, Learned) else ()
                rows.append(errors(method.reconstruct(s.motion, cuts, *extra), s.motion, scaling))
                done += 1
                progress(done, name)
            seeds.append({k: float(np.mean([r[k] for r in rows])) for k in FIGURES})
        figures[name] = {k: float(np.mean([s[k] for s in seeds])) for k in FIGURES}
        figures[name]["sd"] = float(np.std([s["all"] for s in seeds], ddof=1)) if len(seeds) > 1 else 0.0
        figures[name]["n"] = len(pieces)
    return {"methods": figures, "unit": unit, "segment": segment, "seeds": len(sources)}
