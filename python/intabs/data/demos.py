"""Demonstrations in HDF5, in robomimic's layout, so that its own tools open them. README.md of this folder has the
fields of every embodiment and the packed layout of large files; these are those of the Lite 6:

data/demo_k/obs/robot_joint_pos   (T, 6)  rad, measured
data/demo_k/obs/robot_joint_vel   (T, 6)  rad/s
data/demo_k/obs/robot_gripper     (T, 1)  1 closed, 0 open (commanded; the gripper has no sensor)
data/demo_k/obs/object_<i>_pose   (T, 7)  p_WO [m], q_WO (w, x, y, z); slot i
data/demo_k/obs/object_<i>_valid  (T, 1)  1 where perception vouches for the pose
data/demo_k/obs/time              (T,)    s
data/demo_k/actions               (T, 7)  step of the joint targets the demonstrator meant [rad a tick], gripper +-1
mask/{train,valid}                names of demonstrations
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from intabs.errors import UserError

OBJECT_SLOTS = 4  # of the Lite 6's state; files may hold any number
FORMAT_VERSION = 1
# Above this many demonstrations a group each is slow to open (about 1 ms a dataset) and the packed layout is used.
PACKED_ABOVE = 2000

# What makes up the agent's state s^r, unless the file's attribute `agent_fields` says otherwise.
AGENT_FIELDS = {"lite6": ("robot_joint_pos", "robot_gripper"), "human": ("hand_keypoints",)}
# Observations of the environment beside the poses: articulated objects, states without a known meaning.
ENVIRONMENT_FIELDS = ("object_joint_pos", "environment_state")


@dataclass
class Demo:
    """One demonstration; arrays as in the module's docstring, objects stacked by slot. An embodiment without joints or
    without a gripper has None there and its own fields in `obs`."""

    time: np.ndarray  # (T,)
    joint_pos: np.ndarray | None  # (T, n)
    joint_vel: np.ndarray | None  # (T, n)
    gripper: np.ndarray | None  # (T,)
    object_pose: np.ndarray  # (T, S, 7)
    object_valid: np.ndarray  # (T, S)
    actions: np.ndarray  # (T, a)
    attrs: dict = field(default_factory=dict)  # task, seed, success, ...
    obs: dict[str, np.ndarray] = field(default_factory=dict)  # further observations by name, (T, ...)
    extra: dict[str, np.ndarray] = field(default_factory=dict)  # beside obs: labels, states, source_actions, (T, ...)

    def __len__(self) -> int:
        return len(self.time)

    def observations(self) -> dict[str, np.ndarray]:
        """As in the file, by name."""
        fields = dict(self.obs)
        if self.joint_pos is not None:
            fields["robot_joint_pos"] = self.joint_pos
        if self.joint_vel is not None:
            fields["robot_joint_vel"] = self.joint_vel
        if self.gripper is not None:
            fields["robot_gripper"] = self.gripper[:, None]
        for i in range(self.object_pose.shape[1]):
            fields[f"object_{i}_pose"] = self.object_pose[:, i]
            fields[f"object_{i}_valid"] = self.object_valid[:, i, None]
        fields["time"] = self.time
        return fields

    def arrays(self, fields: Iterable[str] | None = None) -> Arrays:
        """What training reads, whatever the embodiment. `fields`: the agent's (see `agent_fields`)."""
        obs = self.observations()
        if fields is None:
            fields = agent_fields(self.attrs, obs)
        length = len(self)
        return Arrays(
            agent=_columns(obs, fields, length),
            objects=self.object_pose,
            valid=self.object_valid.astype(bool),
            environment=_columns(obs, ENVIRONMENT_FIELDS, length),
            time=self.time,
            actions=self.actions,
        )


@dataclass
class Arrays:
    """One demonstration for training, any embodiment."""

    agent: np.ndarray  # (T, A) s^r
    objects: np.ndarray  # (T, S, 7) poses in W, xyz and wxyz
    valid: np.ndarray  # (T, S) bool
    environment: np.ndarray  # (T, E) what else belongs to s^e: joints of articulated objects
    time: np.ndarray  # (T,) s
    actions: np.ndarray  # (T, a)


def _columns(obs: dict[str, np.ndarray], names: Iterable[str], length: int) -> np.ndarray:
    parts = [np.asarray(obs[n], "f8").reshape(length, -1) for n in names if n in obs]
    return np.concatenate(parts, axis=1) if parts else np.zeros((length, 0))


def name_list(value: object) -> list[str]:
    """An attribute that lists names, however it is stored: JSON or an array; [] if it is none."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except json.JSONDecodeError:
            return []
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.ndim == 1 else []
    if not isinstance(value, (list, tuple)):
        return []
    return [v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in value]


def agent_fields(attrs: dict, present: Iterable[str]) -> tuple[str, ...]:
    """The observations that make up s^r, in order."""
    named = name_list(attrs.get("agent_fields"))
    if named:
        return tuple(named)
    known = AGENT_FIELDS.get(str(attrs.get("embodiment", "")))
    return known or tuple(n for n in ("robot_joint_pos", "robot_gripper") if n in present)


def stored(value):
    """An attribute as HDF5 takes it: lists and dictionaries as JSON."""
    return json.dumps(value) if isinstance(value, (dict, list, tuple)) else value


def plain(value):
    """An attribute as Python has it."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


class DemoWriter:
    """Writes beside the target and renames at the end: an interrupted run never leaves a file that looks whole.

    with DemoWriter(path, attrs) as writer:
        writer.add(demo)

    `attrs`, of the file, may change until the end. packed: the layout of large files.
    """

    def __init__(self, path: Path | str, attrs: dict, valid_share: float = 0.1, packed: bool = False):
        self.path, self.attrs, self.valid_share = Path(path), attrs, valid_share
        self.masks: dict[str, list[str]] | None = None  # instead of valid_share
        self.names: list[str] = []
        self.frames = 0
        if self.path.is_dir():
            raise UserError(f"{path} is a folder: give the name of a file, e.g. {self.path / 'demos.hdf5'}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._partial = self.path.with_name(self.path.name + ".partial")
            self.file = h5py.File(self._partial, "w", libver="latest" if packed else "earliest")
        except OSError as e:
            raise UserError(f"cannot write {path}: {e.strerror or e}") from None
        self._data = self.file.create_group("data")
        self.packed = packed
        self._pack = _Packer(self.file) if packed else None

    def __enter__(self) -> DemoWriter:
        return self

    def __exit__(self, kind, *_exc) -> None:
        try:
            if kind is None:
                self._finish()
                self.file.close()
                # The contents are on the disk before the name is.
                with open(self._partial, "rb+") as f:
                    os.fsync(f.fileno())
                os.replace(self._partial, self.path)
        finally:
            if self.file:
                self.file.close()
            self._partial.unlink(missing_ok=True)

    def add(self, demo: Demo, name: str | None = None) -> None:
        name = name or f"demo_{len(self.names)}"
        if self._pack is not None:
            self._pack.add(demo, name)
        else:
            _write_demo(self._data, name, demo)
        self.copied(name, len(demo))

    def copied(self, name: str, frames: int) -> None:
        """Counts a demonstration that somebody wrote into `file` directly."""
        self.names.append(name)
        self.frames += frames

    def _finish(self) -> None:
        if not self.names:
            raise UserError(f"{self.path}: no demonstration to write")
        data = self._data
        data.attrs["total"] = self.frames
        data.attrs["format_version"] = FORMAT_VERSION
        # robomimic's readers want this attribute to be there.
        env = {"env_name": str(self.attrs.get("task", "")), "env_type": -1, "env_kwargs": {}}
        data.attrs["env_args"] = json.dumps(env)
        for key, value in self.attrs.items():
            data.attrs[key] = stored(value)
        if self._pack is not None:
            self._pack.finish()
            data.attrs["layout"] = "packed"
        masks = self.masks if self.masks is not None else held_out(self.names, self.valid_share)
        for mask, names in masks.items():
            self.file.create_dataset(f"mask/{mask}", data=np.array(names, dtype="S"))


def held_out(names: list[str], share: float) -> dict[str, list[str]]:
    """Masks train and valid: whole demonstrations, evenly spread over the file."""
    n_valid = int(round(share * len(names)))
    held = np.zeros(len(names), bool)
    if n_valid:
        held[np.linspace(0, len(names) - 1, n_valid).round().astype(int)] = True
    array = np.array(names)
    return {"train": array[~held].tolist(), "valid": array[held].tolist()}


def save_demos(path: Path | str, demos: list[Demo], attrs: dict, valid_share: float = 0.1) -> None:
    with DemoWriter(path, attrs, valid_share, packed=len(demos) > PACKED_ABOVE) as writer:
        for demo in demos:
            writer.add(demo)


def file_type(name: str, array: np.ndarray) -> str:
    """The type an array is kept in: single precision, time in double, flags and pictures in bytes."""
    if name in ("obs/time", "states"):
        return "f8"
    if name.endswith("_valid") or array.dtype == bool:
        return "u1"
    return "f4" if array.dtype.kind == "f" else array.dtype.str


def _write_demo(data: h5py.Group, name: str, demo: Demo) -> None:
    g = data.create_group(name)

    def put(key: str, value: np.ndarray) -> None:
        value = np.asarray(value)
        small = value.ndim < 2 or value.size == 0
        how = {} if small else {"compression": "gzip", "shuffle": True}
        g.create_dataset(key, data=value.astype(file_type(key, value)), **how)

    g.create_group("obs")
    for key, value in demo.observations().items():
        put(f"obs/{key}", value)
    put("actions", demo.actions)
    for key, value in demo.extra.items():
        put(key, value)
    for key, value in (demo.attrs | {"num_samples": len(demo)}).items():
        g.attrs[key] = stored(value)


class _Packer:
    """packed/...: the fields of all demonstrations one after the other; index/...: where each begins."""

    CHUNK = 1024  # frames
    BUFFER = 32768  # frames: fields are written in long runs, not a demonstration at a time

    def __init__(self, file: h5py.File):
        self.file = file
        self.packed: dict[str, h5py.Dataset] = {}
        self.buffer: dict[str, list[np.ndarray]] = {}
        self.buffered = self.frames = 0
        self.offset: list[int] = []
        self.length: list[int] = []
        self.name: list[str] = []
        self.task: list[str] = []
        self.attrs: list[str] = []

    def add(self, demo: Demo, name: str) -> None:
        fields = {f"obs/{k}": np.asarray(v) for k, v in demo.observations().items()}
        fields["actions"] = np.asarray(demo.actions)
        fields |= {k: np.asarray(v) for k, v in demo.extra.items()}
        if not self.buffer:
            for key, value in fields.items():
                self.packed[key] = self.file.create_dataset(
                    f"packed/{key}", (0, *value.shape[1:]), file_type(key, value),
                    maxshape=(None, *value.shape[1:]), chunks=(self.CHUNK, *value.shape[1:]),
                )  # fmt: skip
                self.buffer[key] = []
        if fields.keys() != self.buffer.keys() or any(
            v.shape != (len(demo), *self.packed[k].shape[1:]) for k, v in fields.items()
        ):
            odd = sorted(fields.keys() ^ self.buffer.keys()) or ["shapes"]
            raise UserError(f"{name} differs from the others in {odd[0]}: a packed file holds one kind of field")
        for key, value in fields.items():
            self.buffer[key].append(value)
        self.offset.append(self.frames)
        self.length.append(len(demo))
        self.name.append(name)
        self.task.append(str(demo.attrs.get("task", "")))
        self.attrs.append(json.dumps({k: plain(v) for k, v in demo.attrs.items()}))
        self.frames += len(demo)
        self.buffered += len(demo)
        if self.buffered >= self.BUFFER:
            self._flush()

    def _flush(self) -> None:
        for key, parts in self.buffer.items():
            if parts:
                dataset = self.packed[key]
                dataset.resize(self.frames, axis=0)
                dataset[self.frames - self.buffered :] = np.concatenate(parts)
                parts.clear()
        self.buffered = 0

    def finish(self) -> None:
        self._flush()
        tasks, task = np.unique(self.task, return_inverse=True)
        text = h5py.string_dtype()
        index = self.file.create_group("index")
        index.create_dataset("offset", data=np.array(self.offset, "i8"))
        index.create_dataset("length", data=np.array(self.length, "i4"))
        index.create_dataset("name", data=np.array(self.name, "S"))
        index.create_dataset("task", data=task.astype("i4"))
        index.create_dataset("tasks", data=tasks.astype(object), dtype=text)
        index.create_dataset("attrs", data=np.array(self.attrs, object), dtype=text)


def load_demos(path: Path | str, mask: str | None = None) -> tuple[list[Demo], dict]:
    """All demonstrations, or those of `mask` (train, valid). Raises UserError on a file that is not ours. For files
    that do not fit into memory: reader.DemoFile."""
    from intabs.data.reader import DemoFile

    with DemoFile(path, mask) as f:
        return [f.demo(k) for k in range(len(f))], f.attrs
