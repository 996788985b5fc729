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
from intabs.jobs import in_processes
from intabs.model.networks import InteractionAbstractions, phase, phase_basis
from intabs.model.space import Space, state_of
from intabs.replay.replay import in_replay
from intabs.rollout import UNSEEN, Setting, run_trial
from intabs.skills.library import Library, entries
from intabs.train.cutting import load_cutter
from intabs.train.trainer import file_hash, load_model, load_named

SCHEMA = 1
STORED = {16: torch.float16, 32: torch.float32}
SEGMENT = 14  # ticks of a skill on which the formats are compared
GOLDEN_TICKS = 40
PRACTICE_CM, PRACTICE_SEED = (3.0, 8.0), 500_000  # by turns: far away demonstrations differ in how well they do
SURE = 3
SAME_START = 0.05  # rad
AFAR = " from afar"  # of a demonstration whose start is far away, where no practice begins
MORE = 2  # times as many tries where it is not clear which demonstration does best
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


def write_library(out: Path, library: dict) -> None:
    (out / "skills.json").write_text(json.dumps(library, separators=(",", ":")))


def practise(
    out: Path, library: dict, tries: range, jobs: int, progress, only: list[tuple[str, str]] | None = None
) -> list[float]:
    """How often the skills of each demonstration do their task in the plant: truth, objects within PRACTICE_CM by
    turns, seeds of its own; as `worth` has it. only: of these (task, demonstration)."""
    write_library(out, library)
    chains = list(Library.load(out).chains)
    only = [c for c in only or chains if not c[1].endswith(AFAR)]
    work = [(Setting(task, str(out), PRACTICE_CM[i % 2], "truth", PRACTICE_SEED, "", source=source), i)
            for task, source in sorted(only) for i in tries]  # fmt: skip
    won = dict.fromkeys(chains, 0.0)
    for done, ((setting, _), result) in enumerate(zip(work, in_processes(run_trial, work, jobs), strict=True)):
        won[setting.task, setting.source] += worth(result)
        progress(done / len(work), f"{setting.task}: {setting.source}")
    for task, source in chains:  # as good as from near
        won[task, source] = won.get((task, source.removesuffix(AFAR)), 0)
    return list(won.values())


def worth(result: dict) -> float:
    """Of a trial, 0 .. 1: what was done only on being tried again tells less for a demonstration's skills."""
    return result["success"] / (1 + result["retries"])


def unsure(chains: list[tuple[str, str]], won: list[float], tries: int) -> list[tuple[str, str]]:
    """Where not even SURE demonstrations of a task always did it, the best ones: few tries hardly tell them apart."""
    out = []
    for task in dict.fromkeys(t for t, _ in chains):
        own = {c: w for c, w in zip(chains, won, strict=True) if c[0] == task}
        best = max(own.values())
        if sum(w == tries for w in own.values()) < min(SURE, len(own)):
            out += [c for c, w in own.items() if w >= max(best - 1, 1)]
    return out


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
    if practice:
        tries = range(practice)
        rates = [practise(out, library_of(model, demos, names, c), tries, jobs, progress) for c in (even, cuts)]
        # Skills of a fixed length where they do better.
        cuts = [e if a > b else c for a, b, c, e in zip(*rates, cuts, even, strict=True)]
    library = library_of(model, demos, names, cuts)
    if practice:
        chains = [(str(d.attrs["task"]), n) for d, n in zip(demos, names, strict=True)]
        won = [max(x) for x in zip(*rates, strict=True)]
        more = unsure(chains, won, practice)
        again = practise(out, library, range(practice, MORE * practice), jobs, progress, more) if more else won
        library["practice"] = [
            {"task": c[0], "source": c[1], "trials": (MORE if c in more else 1) * practice,
             "success": round(w + (a if c in more else 0), 3)}
            for c, w, a in zip(chains, won, again, strict=True)
        ]  # fmt: skip
    write_library(out, library)

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
