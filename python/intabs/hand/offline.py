"""A folder of pictures -> key points, and with depth filtered points in space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs.errors import UserError
from intabs.hand import frames as files
from intabs.hand.estimator import POINTS, MediaPipeHands
from intabs.hand.track import track_hand


@dataclass
class Options:
    method: str = "robust"
    independent: bool = False
    background_mm: int = 0
    intrinsics: Path | None = None
    frames: int = 0  # 0: all


def process_folder(
    folder: Path, out: Path | None, options: Options, progress: Callable[[float, str], None] = lambda *_: None
) -> dict:
    """Writes `out` (npz) and returns the figures. Raises UserError or ValueError, one line."""
    found = files.shots(folder)
    if options.frames:
        found = found[: options.frames]
    deep = any(s.depth for s in found)
    camera = files.intrinsics(folder, options.intrinsics) if deep else None
    time = np.array([s.time_us for s in found]) / 1e6
    uv, score, ms = np.full((len(found), POINTS, 2), np.nan), np.zeros(len(found)), []
    with MediaPipeHands(options.independent) as hands:
        for k, shot in enumerate(found):
            if hand := hands.find(shot.rgb()):
                uv[k], score[k] = hand.uv, hand.score
                ms.append(hand.ms)
            progress((k + 1) / len(found), shot.name)
    figures = {"frames": len(found), "found": int((score > 0).sum()), "ms": {"p50": _median(ms)}}
    arrays = {"time": time, "uv": uv, "score": score}
    if deep:
        track = track_hand(time, uv, files.depths(found, options.background_mm), camera, method=options.method)
        arrays |= {"points": track.points, "state": track.state, "intrinsics": camera}
        figures |= {"method": options.method, "points": track.counts(), "kept": float(track.valid.mean())}
        labels = [files.joints(folder, s) for s in found]
        known = [i for i, joints in enumerate(labels) if joints is not None]
        if known:
            error = np.linalg.norm(track.points[known] - np.array([labels[i] for i in known]), axis=2)
            error = 1e3 * error[track.valid[known]]
            figures["error_mm"] = {
                "n": int(error.size),
                "p50": _median(error),
                "p90": float(np.quantile(error, 0.9)) if error.size else None,
                "max": float(error.max()) if error.size else None,
            }
    if out is not None:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            with open(out, "wb") as f:
                np.savez_compressed(f, **arrays)
        except OSError as e:
            raise UserError(f"cannot write {out}: {e.strerror or e}") from None
    return figures


def _median(values) -> float:
    return float(np.median(values)) if len(values) else 0.0


def describe(figures: dict) -> str:
    lines = [f"a hand in {figures['found']} of {figures['frames']} pictures, {figures['ms']['p50']:.0f} ms each"]
    if "points" in figures:
        counts = ", ".join(f"{n} {name}" for name, n in figures["points"].items() if n)
        lines.append(f"points: {counts}; kept {100 * figures['kept']:.0f} %")
    if "error_mm" in figures:
        e = figures["error_mm"]
        if e["n"]:
            lines.append(f"to the labelled joints: median {e['p50']:.1f} mm, p90 {e['p90']:.1f}, max {e['max']:.1f}")
    return "\n".join(lines)
