"""Reads files of demonstrations without loading them: listing needs the index only, training reads windows.

with DemoFile("demos.hdf5", mask="train") as f:
    f.lengths, f.tasks             # of all demonstrations
    f.demo(3)                      # Demo
    f.arrays(3)                    # Arrays: agent, objects, validity of any embodiment
    f.sample(64, 16, rng)          # 64 windows of 16 frames, every start equally likely
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from intabs.data.demos import ENVIRONMENT_FIELDS, Arrays, Demo, agent_fields, plain
from intabs.errors import UserError

# More than one field of one demonstration ever has; a damaged header may claim any size.
MOST_BYTES = 1 << 31
# Attributes of the file that say nothing about a demonstration.
FILE_ONLY = ("total", "env_args", "layout", "format_version")
# h5py answers a damaged file with any of these.
BROKEN = (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, MemoryError, OverflowError)


@contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """What HDF5 throws at a damaged file becomes one line."""
    try:
        with np.errstate(all="ignore"):  # numbers that are none are `check`'s business
            yield
    except UserError:
        raise
    except BROKEN as e:
        raise UserError(f"{path}: damaged, or of another layout ({type(e).__name__}: {e})") from None


def is_demo(name: str) -> bool:
    return name.startswith("demo_") and name[5:].isascii() and name[5:].isdecimal()


def by_number(names) -> list[str]:
    return sorted(names, key=lambda n: int(n[5:]))


@dataclass
class Windows:
    """n windows of T frames each."""

    demo: np.ndarray  # (n,) index of the demonstration
    start: np.ndarray  # (n,) first frame
    agent: np.ndarray  # (n, T, A) float32
    objects: np.ndarray  # (n, T, S, 7) float32
    valid: np.ndarray  # (n, T, S) bool
    known: np.ndarray  # (n, T, S) bool: valid at least once since the demonstration began
    environment: np.ndarray  # (n, T, E) float32
    actions: np.ndarray  # (n, T, a) float32


class DemoFile:
    """Either layout. Raises UserError on what is not a file of demonstrations. May be sent to a worker process, which
    opens the file anew."""

    def __init__(self, path: Path | str, mask: str | None = None):
        self.path, self.mask = Path(path), mask
        self._open_demo: tuple[int, dict] = (-1, {})
        if not self.path.is_file():
            raise UserError(f"{path}: no such file; make one with `intabs collect --out {path}`")
        try:
            self.file = h5py.File(self.path, "r")
        except OSError as e:
            raise UserError(f"{path}: not an HDF5 file, or cut off ({e})") from None
        try:
            with reading(path):
                self._open()
        except BaseException:
            self.file.close()
            raise

    def _open(self) -> None:
        data = self.file.get("data")
        self.packed = isinstance(self.file.get("packed"), h5py.Group) and "index" in self.file
        if self.packed:
            index = self.file["index"]
            names = np.char.decode(index["name"][:]).tolist()
            offset, lengths, tasks = (index[k][:].astype("i8") for k in ("offset", "length", "task"))
            text = [plain(t) for t in index["tasks"][:]]
            self._datasets = {n: d for n, d in _datasets(self.file["packed"]).items()}
            frames = {len(d) for d in self._datasets.values()}
            odd = frames != {int(lengths.sum())} or (offset != np.cumsum(lengths) - lengths).any()
            if odd or len({len(names), len(offset), len(tasks)}) != 1 or (tasks >= len(text)).any():
                raise UserError(f"{self.path}: the index does not fit the data")
        else:
            if not isinstance(data, h5py.Group) or not any(is_demo(k) for k in data):
                raise UserError(f"{self.path}: holds no demonstration (no group data/demo_*)")
            names = by_number(k for k in data if is_demo(k))
        keep = np.arange(len(names))
        if self.mask is not None:
            if not isinstance(self.file.get(f"mask/{self.mask}"), h5py.Dataset):
                raise UserError(f"{self.path}: has no mask/{self.mask}")
            held = set(self.masks()[self.mask])
            keep = np.array([i for i, n in enumerate(names) if n in held], int)
        self.names: list[str] = [names[i] for i in keep]
        self.attrs = {k: plain(v) for k, v in data.attrs.items()} if isinstance(data, h5py.Group) else {}
        if self.packed:
            self.offsets, self.lengths = offset[keep], lengths[keep]
            self.tasks: list[str] = [text[t] for t in tasks[keep]]
            self._row = keep

    def masks(self) -> dict[str, list[str]]:
        out: dict[str, list[str]] = {}
        with reading(self.path):
            group = self.file.get("mask")
            for mask, dataset in group.items() if isinstance(group, h5py.Group) else ():
                if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or dataset.dtype.kind not in "SO":
                    raise UserError(f"{self.path}: mask/{mask} is no list of names")
                check_size(dataset)
                out[mask] = [str(plain(n)) for n in dataset[:]]
        return out

    def close(self) -> None:
        self.file.close()

    def __enter__(self) -> DemoFile:
        return self

    def __exit__(self, *_exc) -> None:
        self.close()

    def __getstate__(self) -> dict:
        return {"path": self.path, "mask": self.mask}

    def __setstate__(self, state: dict) -> None:
        self.__init__(**state)

    def __len__(self) -> int:
        return len(self.names)

    def __getattr__(self, name: str):
        # Of the layout with a group each these cost a visit to every group: only when asked for.
        if name in ("lengths", "tasks") and not self.__dict__.get("packed", True):
            with reading(self.path):
                if name == "lengths":
                    self.lengths = np.array([self.length(k) for k in range(len(self))], "i8")
                else:
                    self.tasks = [str(self.demo_attrs(k).get("task", "")) for k in range(len(self))]
            return self.__dict__[name]
        raise AttributeError(name)

    def length(self, k: int) -> int:
        """Frames; without a visit to all the others."""
        if self.packed:
            return int(self.lengths[k])
        group = self.group(k)
        actions = group.get("actions")
        if isinstance(actions, h5py.Dataset) and actions.ndim:
            return len(actions)
        return max((len(d) for d in _datasets(group).values() if d.ndim), default=0)

    def group(self, k: int) -> h5py.Group:
        """data/demo_k of the layout with a group each."""
        group = self.file["data"].get(self.names[k])
        if not isinstance(group, h5py.Group):
            raise UserError(f"{self.path}: data/{self.names[k]} is no group")
        return group

    def datasets(self, k: int) -> dict[str, h5py.Dataset]:
        """By name: obs/..., actions, ..."""
        if self.packed:
            return self._datasets
        if self._open_demo[0] != k:  # opening them is what costs: the last ones are kept
            self._open_demo = (k, _datasets(self.group(k)))
        return self._open_demo[1]

    def own_attrs(self, k: int) -> dict:
        """Of one demonstration, as stored with it."""
        if not self.packed:
            return {key: plain(v) for key, v in self.group(k).attrs.items()}
        attrs = json.loads(plain(self.file["index/attrs"][int(self._row[k])]))
        if not isinstance(attrs, dict):
            raise UserError(f"{self.path}: the attributes of {self.names[k]} are none")
        return attrs

    def demo_attrs(self, k: int) -> dict:
        """Of one demonstration; what it does not say, the file says."""
        return {key: v for key, v in self.attrs.items() if key not in FILE_ONLY} | self.own_attrs(k)

    def read(self, k: int, field: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Frames start..stop of one field."""
        dataset = self.datasets(k)[field]
        if self.packed:
            first, length = int(self.offsets[k]), int(self.lengths[k])
            return dataset[first + start : first + (length if stop is None else min(stop, length))]
        check_size(dataset)
        return dataset[start:stop]

    @cached_property
    def agent_fields(self) -> tuple[str, ...]:
        attrs = self.demo_attrs(0)
        return agent_fields(attrs, [n[4:] for n in self.datasets(0) if n.startswith("obs/")])

    def demo(self, k: int) -> Demo:
        with reading(self.path):
            where = f"{self.path}: data/{self.names[k]}"
            fields = {n: self.read(k, n) for n in self.datasets(k)}
            return demo_of(fields, self.demo_attrs(k), where)

    def arrays(self, k: int) -> Arrays:
        return self.demo(k).arrays(self.agent_fields)

    @cached_property
    def slots(self) -> list[int]:
        return object_slots(self.datasets(0))

    def windows(self, demo: np.ndarray, start: np.ndarray, length: int) -> Windows:
        """Reads these windows, nothing else of the file."""
        demo, start = np.asarray(demo), np.asarray(start)
        datasets = self.datasets(0)
        agent = [f"obs/{n}" for n in self.agent_fields]
        environment = [f"obs/{n}" for n in ENVIRONMENT_FIELDS if f"obs/{n}" in datasets]
        pose = [f"obs/object_{i}_pose" for i in self.slots]
        valid = [f"obs/object_{i}_valid" for i in self.slots]
        out: dict[str, np.ndarray] = {}
        with reading(self.path):
            for name in [*agent, *environment, *pose, "actions"]:
                if name not in datasets:
                    raise UserError(f"{self.path}: lacks {name}, which its attribute agent_fields names")
                out[name] = np.empty((len(demo), length, *datasets[name].shape[1:]), "f4")
            known = np.empty((len(demo), length, len(valid)), bool)
            flags = np.empty_like(known)
            # In the order of the file: neighbours share chunks.
            for i in np.lexsort((start, demo)):
                k, first = int(demo[i]), int(start[i])
                for name, array in out.items():
                    got = self.read(k, name, first, first + length)
                    if got.shape != array.shape[1:]:
                        raise UserError(f"{self.path}: {self.names[k]}/{name} is not as in the other demonstrations")
                    array[i] = got
                for s, name in enumerate(valid):
                    row = self.read(k, name, 0, first + length)[:, 0] > 0
                    flags[i, :, s] = row[first:]
                    known[i, :, s] = np.maximum.accumulate(row)[first:]
        n = len(demo)

        def flat(names: list[str]) -> np.ndarray:
            parts = [out[x].reshape(n, length, -1) for x in names]
            return np.concatenate(parts, axis=2) if parts else np.zeros((n, length, 0), "f4")

        objects = flat(pose).reshape(n, length, len(pose), 7)
        return Windows(demo, start, flat(agent), objects, flags, known, flat(environment), out["actions"])

    def sample(self, n: int, length: int, rng: np.random.Generator) -> Windows:
        """Every start of every demonstration that is long enough is equally likely."""
        starts = np.maximum(self.lengths - length + 1, 0)
        ends = np.cumsum(starts)
        if not len(ends) or not ends[-1]:
            raise UserError(f"{self.path}: no demonstration has {length} frames")
        pick = rng.integers(ends[-1], size=n)
        demo = np.searchsorted(ends, pick, side="right")
        return self.windows(demo, pick - (ends - starts)[demo], length)


def check_size(dataset: h5py.Dataset) -> None:
    if dataset.size * dataset.dtype.itemsize > MOST_BYTES:
        raise UserError(f"{dataset.name} claims {dataset.size * dataset.dtype.itemsize:.3g} bytes")


def _datasets(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """The datasets of a demonstration and of its obs, not deeper."""
    out = {}
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            out[name] = item
        elif name == "obs" and isinstance(item, h5py.Group):
            out |= {f"obs/{n}": d for n, d in item.items() if isinstance(d, h5py.Dataset)}
    return out


def object_slots(names) -> list[int]:
    """i of every obs/object_<i>_pose."""
    parts = [n.split("_") for n in names if n.startswith("obs/object_") and n.endswith("_pose")]
    return sorted(int(p[1]) for p in parts if len(p) == 3 and p[1].isascii() and p[1].isdecimal())


def demo_of(fields: dict[str, np.ndarray], attrs: dict, where: str) -> Demo:
    """Raises UserError if a field is missing or of the wrong shape."""

    def take(name: str, width: int | None, needed: bool = True) -> np.ndarray | None:
        if name not in fields:
            if needed:
                raise UserError(f"{where} lacks a field ({name}); `intabs data check` lists them all")
            return None
        value = fields.pop(name)
        shape = (length,) if width is None else (length, width or value.shape[-1] if value.ndim else 0)
        if value.shape != shape or value.dtype.kind not in "fiub":
            raise UserError(f"{where}/{name} is {value.shape} {value.dtype}, not {shape} numbers")
        return value

    fields = dict(fields)
    lite6 = attrs.get("embodiment") == "lite6"
    if "actions" not in fields or fields["actions"].ndim != 2:
        raise UserError(f"{where} lacks a field (actions, one row a frame); `intabs data check` lists them all")
    length = len(fields["actions"])
    time = take("obs/time", None).astype("f8")
    joint_pos = take("obs/robot_joint_pos", 6 if lite6 else 0, lite6)
    joint_vel = take("obs/robot_joint_vel", 6 if lite6 else 0, lite6)
    gripper = take("obs/robot_gripper", 1, True) if lite6 else None
    if not lite6 and fields.get("obs/robot_gripper", np.zeros(0)).shape == (length, 1):
        gripper = take("obs/robot_gripper", 1)
    actions = take("actions", 7 if lite6 else 0)
    slots = object_slots(fields)
    if slots != list(range(len(slots))):
        raise UserError(f"{where} lacks a field (an object below obs/object_{slots[-1]}_pose)")
    pose = [take(f"obs/object_{i}_pose", 7) for i in slots]
    valid = [take(f"obs/object_{i}_valid", 1)[:, 0] > 0 for i in slots]
    rest = {}
    for name, value in fields.items():
        if value.ndim == 0 or len(value) != length:
            raise UserError(f"{where}/{name} is {value.shape}: not one row a frame ({length})")
        rest[name] = value.astype("f8") if value.dtype.kind == "f" else value
    return Demo(
        time=time,
        joint_pos=None if joint_pos is None else joint_pos.astype("f8"),
        joint_vel=None if joint_vel is None else joint_vel.astype("f8"),
        gripper=None if gripper is None else gripper[:, 0].astype("f8"),
        object_pose=np.stack(pose, axis=1).astype("f8") if pose else np.zeros((length, 0, 7)),
        object_valid=np.stack(valid, axis=1) if valid else np.zeros((length, 0), bool),
        actions=actions.astype("f8"),
        attrs=attrs,
        obs={n[4:]: v for n, v in rest.items() if n.startswith("obs/")},
        extra={n: v for n, v in rest.items() if not n.startswith("obs/")},
    )


def inspect(path: Path | str) -> dict:
    """{demos, frames, rate_hz, embodiment, state, tasks, ...}: what a file holds."""
    with DemoFile(path) as f, reading(path):
        attrs = f.demo_attrs(0)
        rate = next((a[k] for a in (f.attrs, attrs) for k in ("rate_hz", "rate") if k in a), None)
        datasets = f.datasets(0)
        task = str(f.attrs.get("task", "unknown"))
        return {
            "demos": len(f),
            "frames": int(f.lengths.sum()),
            "rate_hz": _number(rate),
            "embodiment": str(attrs.get("embodiment", "unknown")),
            "state": {n[4:]: list(d.shape[1:]) for n, d in datasets.items() if n.startswith("obs/")},
            "tasks": dict(Counter(t or task for t in f.tasks)),
            "agent": {
                "fields": list(f.agent_fields),
                "width": sum(int(np.prod(datasets[f"obs/{n}"].shape[1:], dtype=int))
                             for n in f.agent_fields if f"obs/{n}" in datasets),
            },
            "object_slots": len(f.slots),
            "layout": "packed" if f.packed else "a group each",
            "masks": {m: len(n) for m, n in f.masks().items()},
        }  # fmt: skip


def _number(value) -> float | None:
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError):
        return None
