"""Folders of colour pictures with depth pictures beside them.

NAME_o.jpg (or .png), NAME_depth.png (uint16, mm), NAME_intrinsics.txt or intrinsics.txt (fx fy cx cy). A NAME of digits
is the time in us. Without such names: every picture of the folder, by name, without depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs.errors import UserError

PICTURES = {".jpg", ".jpeg", ".png", ".bmp"}
PERIOD_US = 33_333  # where names say nothing of time


@dataclass
class Shot:
    name: str
    time_us: int
    picture: Path
    depth: Path | None

    def rgb(self) -> np.ndarray:
        return _open(self.picture, "RGB")

    def depth_mm(self) -> np.ndarray | None:
        """(H, W) uint16."""
        return None if self.depth is None else _open(self.depth, "depth")


def _open(path: Path, kind: str) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path) as image:
            if kind == "RGB":
                return np.asarray(image.convert("RGB"))
            if image.mode not in ("I;16", "I", "L"):
                raise UserError(f"{path}: depth must be a picture of 16 bits, this is {image.mode}")
            return np.ascontiguousarray(np.asarray(image).astype(np.uint16))
    except OSError as e:
        raise UserError(f"{path}: cannot be read as a picture ({e})") from None


def shots(folder: Path) -> list[Shot]:
    """In the order of time. Raises UserError for a folder without pictures."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give a folder of pictures, or KIND:WHERE (ring, v4l2, video, ...)")
    pictures = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES and not p.stem.endswith("_depth"))
    coloured = [p for p in pictures if p.stem.endswith("_o")]
    if not pictures:
        raise UserError(f"{folder}: no pictures in it ({', '.join(sorted(PICTURES))})")
    found = []
    for number, picture in enumerate(coloured or pictures):
        name = picture.stem.removesuffix("_o")
        depth = folder / f"{name}_depth.png"
        stamped = name.isascii() and name.isdigit()
        found.append(
            Shot(name, int(name) if stamped else number * PERIOD_US, picture, depth if depth.exists() else None)
        )
    found.sort(key=lambda s: s.time_us)
    if any(b.time_us <= a.time_us for a, b in zip(found, found[1:], strict=False)):
        raise UserError(f"{folder}: two pictures of the same time (names are microseconds)")
    return found


def intrinsics(folder: Path, file: Path | None = None) -> np.ndarray:
    """fx fy cx cy of `file`, or of the one in the folder."""
    if file is None:
        candidates = sorted(folder.glob("*intrinsics.txt"))
        if not candidates:
            raise UserError(
                f"{folder}: no *intrinsics.txt (fx fy cx cy) for the depth pictures: give --intrinsics FILE"
            )
        file = candidates[0]
    try:
        values = np.array(file.read_text().split(), "f8")
    except (OSError, ValueError) as e:
        raise UserError(f"{file}: cannot be read as fx fy cx cy ({e})") from None
    if values.shape != (4,) or not (np.isfinite(values).all() and (values[:2] > 0).all()):
        raise UserError(f"{file}: must hold four numbers, fx fy cx cy")
    return values


def joints(folder: Path, shot: Shot) -> np.ndarray | None:
    """Labelled joints NAME_Joint.obj, (21, 3) m in C, in MediaPipe's order (found by projecting); None without."""
    file = folder / f"{shot.name}_Joint.obj"
    if not file.exists():
        return None
    rows = [line.split()[1:4] for line in file.read_text().splitlines() if line.startswith("v ")]
    return np.array(rows, "f8") / 1e3


def depths(found: list[Shot], background_mm: int = 0) -> Iterator[np.ndarray | None]:
    """background_mm: puts a wall so far behind the hand's median where the picture has nothing."""
    for shot in found:
        z = shot.depth_mm()
        if z is not None and background_mm and (z > 0).any():
            z = np.where(z == 0, np.uint16(np.median(z[z > 0]) + background_mm), z)
        yield z
