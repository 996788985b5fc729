"""Checkpoint -> models/weights/NAME: weights.safetensors, manifest.json with golden vectors, skills.json.

The C++ side loads what was written before the export counts as done, and must give the golden outputs.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from intabs import _core
from intabs.data.demos import OBJECT_SLOTS, Demo, load_demos
from intabs.data.reader import DemoFile
from intabs.errors import UserError
from intabs.evaluate.learned import Learned
from intabs.evaluate.metrics import fixed_cuts, sample
from intabs.model.networks import InteractionAbstractions, phase, phase_basis
from intabs.model.space import Space, state_of
from intabs.replay.replay import in_replay
from intabs.rollout import UNSEEN, Setting, run_trial
from intabs.skills.library import entries
from intabs.skills.practice import AFAR, note, tried, write
from intabs.train.cutting import load_cutter
from intabs.train.trainer import LOG, RESULT, file_hash, load_model, load_named

SCHEMA = 1
STORED = {16: torch.float16, 32: torch.float32}
SEGMENT = 14  # ticks of a skill on which the formats are compared
GOLDEN_TICKS = 40
SAME_START = 0.05  # rad
TOLERANCE = 1e-5


def load_weights(folder: Path | str) -> tuple[InteractionAbstractions, dict]:
    """The model of an exported folder, and its manifest."""
    from safetensors.torch import load_file

    folder = Path(folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    if "space" not in manifest["training"]:
        raise UserError(f"{folder}: was exported by an older version; export its run again")
    space = Space.from_config(manifest["training"]["space"], _core.ArmModel.lite6())
    space.load_normalizer(manifest["normalizer"])
    model = InteractionAbstractions(manifest["training"]["config"]["model"], space)
    model.load_tensors(load_file(str(folder / "weights.safetensors")))
    return model.eval(), manifest


def encode_demo(model: InteractionAbstractions, demo: Demo, cuts: list[int]) -> np.ndarray:
    """The skills of a demonstration between these ticks: (n, 16) means of z."""
    learned = Learned("intabs", model)
    return learned.encode(learned.inputs(sample(demo)), list(zip(cuts, cuts[1:], strict=False))).numpy()


def library_of(model, demos: list[Demo], names: list[str], cuts: list[list[int]]) -> dict:
    """skills.json: every skill of these demonstrations, cut at these ticks (skills/library.py)."""
    skills = []
    for demo, name, at in zip(demos, names, cuts, strict=True):
        known = np.maximum.accumulate(demo.object_valid.astype(bool), axis=0)
        missing = OBJECT_SLOTS - known.shape[1]
        known = np.pad(known, ((0, 0), (0, missing)))
        pose = np.pad(demo.object_pose, ((0, 0), (0, missing), (0, 0)))
        z, of = encode_demo(model, demo, at), (demo.joint_pos, demo.gripper > 0.5, pose, known)
        skills += entries(str(demo.attrs["task"]), name, z, at, *of)
    return {"skills": skills, "practice": []}


def variants(data: dict, recorded: dict[str, Demo]) -> list[tuple[str, str, Demo]]:
    """(name, recording, replay): of the replays that a run learned from, for each recording and each other way to do it
    (from another side of a round object, from a start far away: replay/replay.py) the one most like it. data: of the
    checkpoint."""
    path = data.get("replays_path", "")
    if not path:
        return []
    if not Path(path).exists() or file_hash(path) != data["replays_sha256"]:
        raise UserError(f"{path}: not the replays of the training; skills are cut from those that go another way")
    best: dict[tuple[str, float, int], tuple[tuple[bool, float, float], Demo]] = {}
    with DemoFile(path) as f:
        for k in range(len(f)):
            attrs = f.own_attrs(k)
            way = str(attrs["source"]), float(attrs.get("side", 0)), int(attrs.get("slow", 0))
            if way[1:] == (0, 0) or way[0] not in recorded:
                continue
            replay = f.demo(k)
            elsewhere = np.abs(replay.joint_pos[0] - recorded[way[0]].joint_pos[0]).max() > SAME_START
            rank = bool(elsewhere) and not way[2], abs(float(attrs.get("pitch", 0))), float(attrs["spread_cm"])
            if way not in best or rank < best[way][0]:
                best[way] = rank, replay
    out = []
    for (source, side, slow), (_, demo) in sorted(best.items(), key=lambda x: x[0]):
        how = f" {math.degrees(side):+.0f} deg" * bool(side) + AFAR * bool(slow)
        out.append((source + how, source, demo))
    return out


def export(
    run: Path | str,
    out: Path | str,
    trials: int = 20,
    practice: int = 0,
    jobs: int = 1,
    progress: Callable[[float, str], None] = lambda share, text: None,
    bits: int = 32,
) -> dict:
    """Returns {sha256, tensors, max_abs_error, formats}. `trials`: closed-loop runs of each weight format;
    `practice`: of each demonstration's skills, for the library to know which do their task; 0: none.
    `bits`: 16 rounds the weights to half precision, in half the space; all that follows is theirs.
    Raises UserError if C++ and torch disagree by more than 1e-5. In `out` nothing changes until all is done."""
    model, checkpoint = load_model(run)
    data = checkpoint["data"]
    if not Path(data["path"]).exists() or file_hash(data["path"]) != data["sha256"]:
        raise UserError(
            f"{data['path']}: not the demonstrations that {run} was trained on; its skills are cut from them"
        )
    if model.space.arm is None:
        raise UserError(f"{run}: was not trained on the Lite 6; only its weights run in C++")
    if model.space.layout != _core.STATE_LAYOUT:
        raise UserError(
            f"{run}: sees objects as {model.space.layout}; C++ knows {_core.STATE_LAYOUT} (model.objects=gripper, "
            "model.rotation=columns)"
        )
    if bits not in STORED:
        raise UserError(f"--bits {bits}: write 16 or 32")
    if bits == 16:
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(parameter.half())
    out = Path(out).resolve()
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file; name a folder")
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        figures = _write(model, checkpoint, partial, trials, practice, jobs, progress, STORED[bits])
        for name in (LOG, RESULT):
            if (Path(run) / name).exists():
                shutil.copy(Path(run) / name, partial / name)
        out.mkdir(exist_ok=True)
        for file in sorted(partial.iterdir()):
            os.replace(file, out / file.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return figures


def _write(
    model: InteractionAbstractions, checkpoint: dict, out: Path, trials, practice, jobs, progress, stored: torch.dtype
) -> dict:
    from safetensors.torch import save_file

    tensors = {
        f"{net}.{name}": value.to(stored)
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

    manifest = {
        "schema_version": SCHEMA,
        "sha256": sha256,
        "networks": {net: module.spec for net, module in model.networks().items()},
        "state_layout": _core.STATE_LAYOUT,
        "normalizer": model.space.normalizer(),
        "policy_period_us": 40000,
        "training": {
            "data_sha256": checkpoint["data"]["sha256"],
            "replays_sha256": checkpoint["data"]["replays_sha256"],
            "replays": checkpoint["data"]["replays"],
            "config": checkpoint["config"],
            "space": checkpoint["space"],
            "seed": checkpoint["seed"],
            "steps": checkpoint["step"],
            "code_version": checkpoint["code_version"],
        },
    }
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1))

    demos, names = load_named(checkpoint["data"]["path"], "train")
    config, cutter = checkpoint["config"], load_cutter(model, checkpoint.get("cutter"))
    cuts = [c.tolist() for c in Learned("intabs", model, config, cutter).cuts(demos, demos)]
    for name, source, demo in variants(checkpoint["data"], dict(zip(names, demos, strict=True))):
        cuts.append(in_replay(np.array(cuts[names.index(source)]), demo.attrs).tolist())
        names.append(name)
        demos.append(demo)
    even = [fixed_cuts(len(d), SEGMENT + 1) for d in demos]
    chains = [(str(d.attrs["task"]), n) for d, n in zip(demos, names, strict=True)]
    won = []
    for kind in (even, cuts) if practice else ():
        write(out / "skills.json", library_of(model, demos, names, kind))
        won.append(tried(out, chains, range(practice), jobs, progress))
    if practice:  # skills of a fixed length where they do better
        cuts = [e if won[0][n] > won[1][n] else c for n, c, e in zip(chains, cuts, even, strict=True)]
    write(out / "skills.json", library_of(model, demos, names, cuts))
    if practice:
        note(out, {c: max(w[c] for w in won) for c in chains}, practice, jobs, progress)

    error = verify(out)
    if not error <= TOLERANCE:
        raise UserError(f"the C++ network differs from torch by {error:.2e}, more than {TOLERANCE:.0e}")
    held_out, _ = load_demos(checkpoint["data"]["path"], "valid")
    formats = format_report(out, model, held_out or demos, trials)
    return {"sha256": sha256, "tensors": len(tensors), "max_abs_error": error, "formats": formats}


FORMATS = ("fp32", "16", "8")


def format_report(out: Path, model, demos: list[Demo], trials: int) -> dict:
    """What each weight format costs: largest and root mean square difference of the joint steps from torch [rad a tick]
    on these demonstrations, segment by segment, and closed-loop success in the plant (truth, spread 2 cm)."""
    segments = []
    for demo in demos:
        cuts = fixed_cuts(len(demo), SEGMENT + 1)
        z = torch.from_numpy(encode_demo(model, demo, cuts))
        with torch.no_grad():
            features, _ = model.space.features(state_of(demo)[0])
            for i, (a, b) in enumerate(zip(cuts, cuts[1:], strict=False)):
                at = phase_basis(phase(torch.arange(b - a), torch.tensor(b - a)))
                segments.append(model.policy_input(features[a:b], z[i].expand(b - a, -1), at))
    report = {}
    for form in FORMATS:
        pi = _core.Network.load(str(out), "pi", format=form)
        differences = []
        for x in segments:
            with torch.no_grad():
                want = model.pi(x[None])["agent"][0].numpy()
            pi.reset()
            got = np.stack([pi.step(row)["agent"] for row in x.numpy()])
            differences.append((got - want)[:, :6] * model.space.command_scale[:6].numpy())
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
