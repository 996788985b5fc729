"""Other people's demonstrations -> ours. One module a format, each with

    read(source: Path, options: Options) -> Recording

`options.say` takes what the user has to know: units, frames, order of quaternions, rate, what is left out."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intabs.data.check import find_faults
from intabs.data.demos import PACKED_ABOVE, Demo, DemoWriter
from intabs.data.reader import inspect
from intabs.data.resample import heal_signs, resample, wxyz
from intabs.errors import UserError

KINDS = {
    "robosuite": "robosuite",
    "robomimic": "robomimic",
    "roboturk": "robosuite",
    "kitchen": "kitchen",
    "lerobot": "lerobot",
    "lite6-csv": "lite6_csv",
    "npz": "npz",
}


MOST = 1e30  # no measured number is larger


@dataclass
class Options:
    say: Callable[[str], None] = print
    rate_hz: float | None = None  # of the result
    source_rate_hz: float | None = None  # where the files do not say it
    units: str = "rad"  # of the joints, where the files do not say it: rad, deg, none
    quaternion: str = "wxyz"  # of object poses, where the files do not say it
    agent: str | None = None  # npz: keys
    object: str | None = None
    time: str = "time"


@dataclass
class Recording:
    demos: Iterable[Demo]  # may be read while they are written
    count: int
    attrs: dict  # of the file
    width: int  # of the source's state
    masks: dict[str, list[str]] | None = field(default=None)  # by names demo_k in the order of `demos`


def import_demos(
    kind: str, source: Path, out: Path, options: Options, progress: Callable[[int, int], None] = lambda k, n: None
) -> dict:
    """Returns the figures of `inspect`, and {width, notes, faults}."""
    if kind not in KINDS:
        raise UserError(f"unknown kind '{kind}': known are {', '.join(KINDS)}")
    if not source.exists():
        raise UserError(f"{source}: no such file or folder")
    notes: list[str] = []
    tell, options.say = options.say, lambda text: (notes.append(text), tell(text))
    recording = importlib.import_module(f"intabs.data.importers.{KINDS[kind]}").read(source, options)
    attrs = recording.attrs | {"recorded": f"imported from {kind}"}
    rates, healed, wide = [], 0, 0.0
    with DemoWriter(out, attrs, packed=recording.count > PACKED_ABOVE) as writer:
        for k, demo in enumerate(recording.demos):
            for i in range(demo.object_pose.shape[1]):
                demo.object_pose[:, i, 3:], n = heal_signs(demo.object_pose[:, i, 3:])
                healed += n
            rates.append(rate_of(demo.time))
            demo.attrs.setdefault("rate_hz", rates[-1])
            if options.rate_hz is not None:
                try:
                    demo = resample(demo, options.rate_hz)
                except UserError as e:
                    raise UserError(f"{source}: demonstration {k} ({demo.attrs.get('source', '')}): {e}") from None
            wide = max(wide, float(np.abs(demo.actions).max(initial=0)))
            writer.add(demo)
            progress(k + 1, recording.count)
        if not rates:
            raise UserError(f"{source}: holds no demonstration")
        if options.rate_hz is not None:
            attrs["rate_hz"] = float(options.rate_hz)
            tell_rate(options, rates)
        else:
            if max(rates) > 1.15 * min(rates):
                raise UserError(
                    f"{source}: rates from {min(rates):.1f} to {max(rates):.1f} Hz in one folder: give --rate, or"
                    " import them one by one"
                )
            attrs.setdefault("rate_hz", float(np.median(rates)))
            options.say(f"rate: {attrs['rate_hz']:.4g} Hz, as recorded (the median step in time)")
        writer.masks = recording.masks
    if healed:
        options.say(f"orientations: {healed} changes of sign healed (q and -q are the same rotation)")
    if wide > 1:
        options.say(f"actions reach {wide:.3g}: robomimic wants them within 1 and will say so")
    faults = find_faults(out)
    options.say(f"check: {len(faults)} faults (`intabs data check {out}`)" if faults else "check: no faults")
    return inspect(out) | {"width": recording.width, "notes": notes, "faults": faults}


def tell_rate(options: Options, rates: list[float]) -> None:
    low, high = min(rates), max(rates)
    was = f"{np.median(rates):.4g}" if high < 1.01 * low else f"{low:.4g}-{high:.4g}"
    how = "low-passed at 0.4 of the new rate, " if options.rate_hz < 1.2 * high else ""
    options.say(
        f"rate: resampled from {was} to {options.rate_hz:g} Hz: {how}positions by splines, rotations on the sphere,"
        " switches by the last value, actions by the path they add up to; states and source_actions left out"
    )


def rate_of(time: np.ndarray) -> float:
    step = np.diff(time)
    if not len(step) or not np.isfinite(step).all() or (median := float(np.median(step))) <= 0:
        raise UserError("the time of a demonstration does not advance")
    rate = 1 / median
    # 0.0333 s in single precision is 30 Hz.
    return float(round(rate)) if abs(rate - round(rate)) < 1e-3 * rate else float(f"{rate:.5g}")


def joints_in_radians(joint: np.ndarray, options: Options, where: str) -> np.ndarray:
    """Checks what cannot be radians."""
    if options.units == "deg":
        return np.radians(joint)
    most = float(np.abs(joint[np.isfinite(joint)]).max(initial=0))
    if options.units == "rad" and most > 4 * np.pi:
        raise UserError(f"{where}: joints reach {most:.4g}, no radians: give --units deg, or none to keep them as is")
    return joint


def poses(value: np.ndarray, order: str, where: str) -> np.ndarray:
    """(T, S, 7) xyz + quaternion in `order` -> xyz + wxyz, checked."""
    value = np.array(value, float)
    if order == "xyzw":
        value[..., 3:] = wxyz(value[..., 3:])
    norm = np.linalg.norm(value[..., 3:], axis=-1)
    off = float(np.abs(norm - 1).max(initial=0))
    if not off < 0.1:
        raise UserError(f"{where}: the last 4 numbers of a pose are no unit quaternion (norm off by {off:.3g})")
    value[..., 3:] /= norm[..., None]
    return value


def velocities(joint: np.ndarray, time: np.ndarray) -> np.ndarray:
    return np.gradient(joint, time, axis=0) if len(time) > 2 else np.zeros_like(joint)


def files_under(source: Path, suffixes: tuple[str, ...], what: str) -> list[Path]:
    """`source` itself or all files of a folder, in the order of their names, numbers by value."""
    if source.is_file():
        return [source]
    found = [p for p in source.rglob("*") if p.is_file() and p.suffix.lower() in suffixes]
    if not found:
        raise UserError(f"{source}: holds no {what} ({', '.join('*' + s for s in suffixes)})")
    return sorted(found, key=lambda p: _numbers_by_value(str(p)))


def _numbers_by_value(text: str) -> list:
    import re

    return [(0, int(t), "") if t.isdigit() else (1, 0, t) for t in re.split(r"([0-9]+)", text)]


def finite_matrix(value, where: str, columns: int | None = None) -> np.ndarray:
    """(T, n) of numbers, or one line saying what is wrong."""
    value = np.asarray(value)
    if value.dtype.kind not in "fiub" or value.ndim != 2 or len(value) < 2 or columns not in (None, value.shape[1]):
        want = f"(T, {columns if columns is not None else 'n'})"
        raise UserError(f"{where} is {value.shape} {value.dtype}, not {want} numbers with two frames or more")
    bad = ~(np.abs(value.astype(float)) < MOST)
    if bad.any():
        raise UserError(f"{where}: frame {int(np.argwhere(bad)[0][0])} is not finite")
    return value.astype(float)


def iterate(items: Iterable, make: Callable[[int, object], Demo]) -> Iterator[Demo]:
    for k, item in enumerate(items):
        yield make(k, item)
