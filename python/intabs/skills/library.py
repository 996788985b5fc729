"""The skill library beside the weights, skills.json: every skill of every training demonstration, encoded.

Written by `intabs export` (train/export.py), read here and by cpp/intabs/skills/skill_library.h. No torch.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intabs import paths
from intabs.errors import UserError

SLOTS = 4
TURN_LENGTH = 0.1  # m/rad, as kTurnLength of skills/skill_player.h
RESTS = 0.008  # m: an object that came less far in a skill rested
EFFECT = 0.05  # m, as kEffect there
MAX_SKILL_TICKS = 15000
LOOSE = 0.07  # so much shorter or longer than recorded eta may make a skill (cpp/intabs/skills/README.md)


@dataclass(frozen=True)
class Frame:
    """One tick of the recording."""

    q: np.ndarray  # (6,) [rad]
    gripper_closed: bool
    object_pose: np.ndarray  # (4, 7) p_WO [m], q_WO wxyz; zeros where unknown
    known: np.ndarray  # (4,) bool


@dataclass(frozen=True)
class Skill:
    index: int
    task: str
    source: str  # demonstration
    number: int  # of that demonstration's skills
    ticks: int  # how long it lasted
    min_ticks: int
    max_ticks: int
    z: np.ndarray  # (16,)
    moved: (
        np.ndarray
    )  # (4,) how far each object had come at most, from where it last rested: |dp| + TURN_LENGTH angle [m]
    frames: tuple[Frame, ...]  # its first, middle and last tick

    @property
    def effect(self) -> str:
        """In words."""
        a, b = self.frames[0], self.frames[-1]
        parts = []
        for slot in np.flatnonzero(a.known & b.known):
            step = 100 * np.linalg.norm(b.object_pose[slot, :3] - a.object_pose[slot, :3])
            turn = math.degrees((rotation(a.object_pose[slot]).inv() * rotation(b.object_pose[slot])).magnitude())
            if 0.01 * step + TURN_LENGTH * math.radians(turn) > RESTS:
                parts.append(f"object {slot}: {step:.0f} cm, {turn:.0f} deg")
        if a.gripper_closed != b.gripper_closed:
            parts.append("gripper " + ("closes" if b.gripper_closed else "opens"))
        return "; ".join(parts) or "moves nothing"

    def as_plan(self) -> dict:
        return {
            "z": self.z.tolist(), "min_ticks": self.min_ticks, "max_ticks": self.max_ticks,
            "library_index": self.index,
        }  # fmt: skip


def rotation(pose: np.ndarray) -> Rotation:
    """Of a pose (7,) or poses (..., 7)."""
    return Rotation.from_quat(np.roll(pose[..., 3:], -1, -1))


class Library:
    """Skills in the file's order; `chains`: those of each demonstration, in time; `practice`: how often each chain
    (task, demonstration) did its task in practice, 0 .. 1 (1 where nobody tried)."""

    def __init__(self, skills: list[Skill], practice: dict[tuple[str, str], float]):
        self.skills, self.practice = skills, practice

    @staticmethod
    def load(weights: Path) -> Library:
        path = weights / "skills.json"
        if not weights.is_dir():
            raise UserError(f"{weights}: no such weights; train and export them, or check out the repository whole")
        if not path.is_file():
            raise UserError(f"{path}: is missing; export the weights again")
        try:
            d = json.loads(path.read_text())
            practice = {(c["task"], c["source"]): c["success"] / c["trials"] for c in d["practice"]}
            return Library([_skill(i, entry) for i, entry in enumerate(d["skills"])], practice)
        except (ValueError, KeyError, TypeError, IndexError, OverflowError, ZeroDivisionError) as e:
            raise UserError(
                f"{path}: not a skill library ({type(e).__name__}: {e}); export the weights again"
            ) from None

    @cached_property
    def chains(self) -> dict[tuple[str, str], list[Skill]]:
        """(task, demonstration) -> its skills."""
        out: dict[tuple[str, str], list[Skill]] = {}
        for s in self.skills:
            out.setdefault((s.task, s.source), []).append(s)
        return {k: sorted(v, key=lambda s: s.number) for k, v in out.items()}

    def rate(self, chain: list[Skill]) -> float:
        return self.practice.get((chain[0].task, chain[0].source), 1.0)

    @property
    def tasks(self) -> list[str]:
        return sorted({s.task for s in self.skills})

    def of_task(self, task: str) -> list[list[Skill]]:
        """Its chains. Raises UserError with the known tasks."""
        found = [chain for (t, _), chain in self.chains.items() if t == task]
        if not found:
            raise UserError(f"unknown task '{task}': known are {', '.join(self.tasks) or 'none'}")
        return found


def weights_folder(name: Path | str) -> Path:
    """A name in models/weights, or a folder."""
    shipped = paths.MODELS / "weights" / name
    return shipped if shipped.is_dir() else Path(name)


def latent_sizes(weights: Path) -> dict[str, int]:
    """How many of z's numbers each encoder says, in z's order: {"agent": 8, "environment": 8}."""
    path = weights / "manifest.json"
    try:
        networks = json.loads(path.read_text())["networks"]
        return {n.removeprefix("q_"): net["heads"]["mean"] for n, net in networks.items() if n.startswith("q_")}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as e:
        raise UserError(f"{path}: not a manifest ({type(e).__name__}: {e}); export the weights again") from None


def _skill(index: int, d: dict) -> Skill:
    z, moved = np.array(d["z"], "f4"), np.array(d["moved"], "f4")
    if z.shape != (16,) or not np.isfinite(z).all() or moved.shape != (SLOTS,):
        raise ValueError(f"skill {index}: z must be 16 finite numbers, moved {SLOTS}")
    if not 1 <= d["min_ticks"] <= d["max_ticks"] <= MAX_SKILL_TICKS:
        raise ValueError(f"skill {index}: needs 1 <= min_ticks <= max_ticks <= {MAX_SKILL_TICKS}")
    frames = tuple(_frame(f) for f in d["frames"])
    if len(frames) != 3:
        raise ValueError(f"skill {index}: needs three frames")
    return Skill(
        index, d["task"], d["source"], d["number"], d["ticks"], d["min_ticks"], d["max_ticks"], z, moved, frames
    )


def _frame(d: dict) -> Frame:
    pose, known = np.zeros((SLOTS, 7)), np.zeros(SLOTS, bool)
    pose[:, 3] = 1
    for slot, x in d["objects"].items():
        pose[int(slot)], known[int(slot)] = x, True
    return Frame(np.array(d["q"], float), bool(d["gripper_closed"]), pose, known)


def entries(task: str, source: str, z: np.ndarray, cuts: list[int], q, gripper, object_pose, known) -> list[dict]:
    """For the file: the skills of a demonstration, z (n, 16), which begin at cuts[:-1]; the last ends at cuts[-1].
    q (T, 6), gripper (T,), object_pose (T, 4, 7), known (T, 4)."""
    out, rest = [], np.zeros(SLOTS, int)
    for number, (a, b) in enumerate(zip(cuts, cuts[1:], strict=False)):
        moved, rested = np.zeros(SLOTS), np.ones(SLOTS, bool)
        for slot in np.flatnonzero(known[a]):
            before = out and _came(object_pose[cuts[number - 1] : a + 1, slot]) > RESTS
            rested[slot] = not before
            if rested[slot]:
                rest[slot] = a
            moved[slot] = _came(object_pose[rest[slot] : b + 1, slot])
        out.append(_entry(task, source, number, z[number], a, b, moved, rested, q, gripper, object_pose, known))
    return out


def _came(pose: np.ndarray) -> float:
    """How far poses (n, 7) came from the first."""
    R = rotation(pose)
    return float((np.linalg.norm(pose[:, :3] - pose[0, :3], axis=1) + TURN_LENGTH * (R[0].inv() * R).magnitude()).max())


def _entry(task, source, number, z, a, b, moved, rested, q, gripper, object_pose, known) -> dict:
    n = b - a
    shortest = max(1, round((1 - LOOSE) * n))

    def frame(t: int) -> dict:
        objects = {str(i): [round(float(v), 4) for v in object_pose[t, i]] for i in np.flatnonzero(known[t])}
        return {"q": [round(float(v), 4) for v in q[t]], "gripper_closed": bool(gripper[t]), "objects": objects}

    return {
        "task": task, "source": source, "number": number, "ticks": n, "min_ticks": shortest,
        "max_ticks": 2 * n - shortest, "z": [round(float(v), 5) for v in z],
        "rested": rested.tolist(), "moved": [round(float(v), 4) for v in moved],
        "frames": [frame(t) for t in (a, a + n // 2, b)],
    }  # fmt: skip


def drawing(skill: Skill) -> str:
    """SVG: arm and objects at the skill's start, middle and end, from the side and from above; a scale of 10 cm."""
    from intabs import _core

    arm, size, views = _core.ArmModel.lite6(), 240, (("side", 0, 2), ("above", 0, 1))
    lines = [arm.places(f.q) for f in skill.frames]
    objects = [f.object_pose[f.known, :3] for f in skill.frames]
    seen = np.concatenate([*lines, *objects])
    colours = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728")
    title = f"skill {skill.index}: {skill.task}, {skill.source} {skill.number}: {skill.effect}"
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size * 3} {size * 2 + 20}" font-family="sans-serif" '
        f'font-size="11"><text x="4" y="13">{title}</text>'
    ]
    for row, (view, u, v) in enumerate(views):
        low = seen[:, [u, v]].min(0) - 0.03
        scale = size / max(float((seen[:, [u, v]].max(0) + 0.03 - low).max()), 1e-6)
        for k, (line, frame) in enumerate(zip(lines, skill.frames, strict=True)):

            def at(p, k=k, row=row, u=u, v=v, low=low, scale=scale):
                return (
                    f"{k * size + (p[u] - low[0]) * scale:.1f}",
                    f"{20 + (row + 1) * size - (p[v] - low[1]) * scale:.1f}",
                )

            points = " ".join(",".join(at(p)) for p in line)
            out.append(f'<polyline points="{points}" fill="none" stroke="#444" stroke-width="3"/>')
            for slot in np.flatnonzero(frame.known):
                x, y = at(frame.object_pose[slot])
                out.append(
                    f'<circle cx="{x}" cy="{y}" r="6" fill="{colours[slot]}"><title>object {slot}</title></circle>'
                )
            out.append(
                f'<text x="{k * size + 4}" y="{20 + row * size + 14}">{("start", "middle", "end")[k]}, {view}</text>'
            )
        bar = 0.1 * scale
        out.append(f'<path d="M{3 * size - bar - 6:.1f} {16 + (row + 1) * size}h{bar:.1f}" stroke="#000"/>')
    return "\n".join([*out, "</svg>\n"])
