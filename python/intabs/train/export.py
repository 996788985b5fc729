"""Checkpoint -> models/weights/NAME: weights.safetensors, manifest.json with golden vectors, plans/<task>.json.

The C++ side loads what was written before the export counts as done, and must give the golden outputs.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import torch

from intabs import _core
from intabs.data.demos import Demo, load_demos
from intabs.data.features import trajectory
from intabs.errors import UserError
from intabs.model.networks import InteractionAbstractions
from intabs.rollout import UNSEEN, Setting, run_trial
from intabs.train.trainer import default_arm, load_model

SCHEMA = 1
GOLDEN_TICKS = 40
TOLERANCE = 1e-5


def encode_demo(model: InteractionAbstractions, normalizer, demo: Demo, cut: int) -> np.ndarray:
    """The skills of a demonstration by a fixed cut: (n, 16) means of z. A rest of over half a cut is a skill too."""
    t = normalizer.normalize(trajectory(demo, default_arm()))
    length = len(t.state)
    starts = list(range(0, length - cut // 2, cut))
    rows = []
    with torch.no_grad():
        for a in starts:
            b = min(a + cut, length)
            mean, _ = model.encode(
                *(
                    torch.from_numpy(np.ascontiguousarray(x[None, a:b], "f4"))
                    for x in (t.state, t.agent_action, t.environment_action)
                )
            )
            rows.append(mean[0].numpy())
    return np.stack(rows)


def typical_demo(demos: list[Demo]) -> int:
    """The demonstration whose objects start nearest to the average place, among straight ones of average length."""
    first = np.array([d.object_pose[np.argmax(d.object_valid.all(1)), :, :3].ravel() for d in demos])
    lengths = np.array([len(d) for d in demos])
    calm = np.array([d.attrs.get("disturb", 0.0) == 0 and d.attrs.get("detours", 0.0) == 0 for d in demos])
    usual = np.median(lengths[calm]) if calm.any() else np.median(lengths)
    near_length = np.abs(lengths - usual) <= 0.15 * usual
    distance = np.linalg.norm(first - first.mean(0), axis=1)
    return int(np.argmin(distance + 10.0 * ~near_length + 100.0 * ~calm))


def make_plan(model, normalizer, demo: Demo, cut: int, source: str) -> dict:
    z = encode_demo(model, normalizer, demo, cut)
    return {
        "task": demo.attrs["task"],
        "source_demo": source,
        "skills": [{"z": [float(v) for v in row], "min_ticks": cut, "max_ticks": cut} for row in z],
    }


def export(run: Path | str, out: Path | str, trials: int = 20) -> dict:
    """Returns {sha256, tensors, max_abs_error, formats}. `trials`: closed-loop runs of each weight format, 0: none.
    Raises UserError if C++ and torch disagree by more than 1e-5."""
    from safetensors.torch import save_file

    model, normalizer, checkpoint = load_model(run)
    out = Path(out)
    (out / "plans").mkdir(parents=True, exist_ok=True)
    tensors = {
        f"{net}.{name}": value.float()
        for net, module in model.networks().items()
        for name, value in module.tensors().items()
    }
    weights = out / "weights.safetensors"
    save_file(tensors, str(weights))
    sha256 = hashlib.sha256(weights.read_bytes()).hexdigest()

    golden = {}
    rng = np.random.default_rng(0)
    for net, module in model.networks().items():
        x = rng.normal(size=(GOLDEN_TICKS, module.spec["input"])).astype("f4")
        with torch.no_grad():
            y = module(torch.from_numpy(x)[None])
        golden[net] = {
            "input": x.tolist(),
            "heads": {k: v[0].numpy().tolist() for k, v in y.items()},
        }
    (out / "golden.json").write_text(json.dumps(golden))

    cut = int(round(sum(checkpoint["config"]["objective"]["segment"]) / 2))
    manifest = {
        "schema_version": SCHEMA,
        "sha256": sha256,
        "networks": {net: module.spec for net, module in model.networks().items()},
        "state_layout": _core.STATE_LAYOUT,
        "normalizer": normalizer.to_dict(),
        "policy_period_us": 40000,
        "training": {
            "data_sha256": checkpoint["data"]["sha256"],
            "config": checkpoint["config"],
            "seed": checkpoint["seed"],
            "steps": checkpoint["step"],
            "code_version": checkpoint["code_version"],
        },
    }
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1))

    demos, _ = load_demos(checkpoint["data"]["path"], "train")
    for task in sorted({d.attrs["task"] for d in demos}):
        of_task = [d for d in demos if d.attrs["task"] == task]
        k = typical_demo(of_task)
        plan = make_plan(model, normalizer, of_task[k], cut, f"seed {of_task[k].attrs.get('seed')}")
        (out / "plans" / f"{task}.json").write_text(json.dumps(plan, indent=1))

    error = verify(out)
    if not error <= TOLERANCE:
        raise UserError(f"{out}: the C++ network differs from torch by {error:.2e}, more than {TOLERANCE:.0e}")
    held_out, _ = load_demos(checkpoint["data"]["path"], "valid")
    formats = format_report(out, model, normalizer, held_out or demos, cut, trials)
    return {"sha256": sha256, "tensors": len(tensors), "max_abs_error": error, "formats": formats}


FORMATS = ("fp32", "16", "8")


def format_report(out: Path, model, normalizer, demos: list[Demo], cut: int, trials: int) -> dict:
    """What each weight format costs: largest and root mean square difference of the joint steps from torch [rad a tick]
    on these demonstrations, segment by segment, and closed-loop success in the plant (truth, spread 2 cm)."""
    segments = []
    for demo in demos:
        t = normalizer.normalize(trajectory(demo, default_arm()))
        z = encode_demo(model, normalizer, demo, cut)
        segments += [(t.state[k * cut : (k + 1) * cut], z[k]) for k in range(len(z))]
    report = {}
    for form in FORMATS:
        pi = _core.Network.load(str(out), "pi", format=form)
        differences = []
        for state, z in segments:
            x = np.concatenate([state, np.tile(z, (len(state), 1))], axis=1)
            with torch.no_grad():
                want = model.act(torch.from_numpy(state)[None], torch.from_numpy(z)[None])[0][0].numpy()
            pi.reset()
            got = np.stack([pi.step(row)["agent"] for row in x])
            differences.append((got - want)[:, :6] * normalizer.agent_action_scale[:6])
        d = np.concatenate(differences)
        report[form] = {"max_rad": float(np.abs(d).max()), "rms_rad": float(np.sqrt((d**2).mean()))}
        if trials:
            report[form]["closed_loop"] = {"trials": trials, "success": {}}
            for task in sorted({d.attrs["task"] for d in demos}):
                jobs = [(Setting(task, str(out), 2.0, "truth", UNSEEN, "", form), i) for i in range(trials)]
                report[form]["closed_loop"]["success"][task] = sum(run_trial(job)["success"] for job in jobs)
    return report


def verify(weights: Path | str) -> float:
    """Loads the weights in C++ and replays the golden inputs; largest absolute difference."""
    weights = Path(weights)
    golden = json.loads((weights / "golden.json").read_text())
    worst = 0.0
    for net, g in golden.items():
        network = _core.Network.load(str(weights), net)
        x = np.asarray(g["input"], "f4")
        for head, want in g["heads"].items():
            want = np.asarray(want, "f4")
            if want.ndim == 1:  # an encoder: one value a sequence
                got = network.encode_final(x)[head]
            else:
                network.reset()
                got = np.stack([network.step(row)[head] for row in x])
            worst = max(worst, float(np.abs(got - want).max()))
    return worst
