"""Demonstrations in HDF5, in robomimic's layout, so that its own tools open them.

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
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from intabs.errors import UserError

OBJECT_SLOTS = 4
FORMAT_VERSION = 1


@dataclass
class Demo:
    """One demonstration; arrays as in the module's docstring, objects stacked by slot."""

    time: np.ndarray  # (T,)
    joint_pos: np.ndarray  # (T, 6)
    joint_vel: np.ndarray  # (T, 6)
    gripper: np.ndarray  # (T,)
    object_pose: np.ndarray  # (T, S, 7)
    object_valid: np.ndarray  # (T, S)
    actions: np.ndarray  # (T, 7)
    attrs: dict = field(default_factory=dict)  # task, seed, success, ...

    def __len__(self) -> int:
        return len(self.time)


def save_demos(path: Path | str, demos: list[Demo], attrs: dict, valid_share: float = 0.1) -> None:
    """Writes beside the target and renames at the end: an interrupted run never leaves a file that looks whole."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with h5py.File(partial, "w") as f:
        data = f.create_group("data")
        for k, demo in enumerate(demos):
            _write_demo(data, f"demo_{k}", demo)
        data.attrs["total"] = sum(len(d) for d in demos)
        data.attrs["format_version"] = FORMAT_VERSION
        # robomimic's readers want this attribute to be there.
        data.attrs["env_args"] = json.dumps({"env_name": attrs.get("task", ""), "env_type": -1, "env_kwargs": {}})
        for key, value in attrs.items():
            data.attrs[key] = value
        names = np.array([f"demo_{k}" for k in range(len(demos))], dtype="S")
        # Hold out whole demonstrations, evenly spread over the file.
        n_valid = int(round(valid_share * len(demos)))
        held = np.zeros(len(demos), bool)
        if n_valid:
            held[np.linspace(0, len(demos) - 1, n_valid).round().astype(int)] = True
        f.create_dataset("mask/train", data=names[~held])
        f.create_dataset("mask/valid", data=names[held])
    os.replace(partial, path)


def _write_demo(data: h5py.Group, name: str, demo: Demo) -> None:
    g = data.create_group(name)
    obs = g.create_group("obs")

    def put(key: str, value: np.ndarray, dtype: str = "f4") -> None:
        obs.create_dataset(key, data=value.astype(dtype), compression="gzip", shuffle=True)

    put("robot_joint_pos", demo.joint_pos)
    put("robot_joint_vel", demo.joint_vel)
    put("robot_gripper", demo.gripper[:, None])
    for i in range(demo.object_pose.shape[1]):
        put(f"object_{i}_pose", demo.object_pose[:, i])
        put(f"object_{i}_valid", demo.object_valid[:, i, None], "u1")
    obs.create_dataset("time", data=demo.time.astype("f8"))
    g.create_dataset("actions", data=demo.actions.astype("f4"), compression="gzip", shuffle=True)
    g.attrs["num_samples"] = len(demo)
    for key, value in demo.attrs.items():
        g.attrs[key] = value


def _plain(value):
    return value.item() if isinstance(value, np.generic) else value


def load_demos(path: Path | str, mask: str | None = None) -> tuple[list[Demo], dict]:
    """All demonstrations, or those of `mask` (train, valid). Raises UserError on a file that is not ours."""
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file; make one with `intabs collect --out {path}`")
    try:
        f = h5py.File(path, "r")
    except OSError as e:
        raise UserError(f"{path}: not an HDF5 file, or cut off ({e})") from None
    with f:
        if "data" not in f or not any(k.startswith("demo_") for k in f["data"]):
            raise UserError(f"{path}: has no group data/demo_*; `intabs data info` says what a file holds")
        data = f["data"]
        names = sorted((k for k in data if k.startswith("demo_")), key=lambda s: int(s.split("_")[1]))
        if mask is not None:
            if f"mask/{mask}" not in f:
                raise UserError(f"{path}: has no mask/{mask}")
            keep = {n.decode() for n in f[f"mask/{mask}"][:]}
            names = [n for n in names if n in keep]
        demos = []
        for name in names:
            try:
                demos.append(_read_demo(data[name]))
            except KeyError as e:
                raise UserError(f"{path}: data/{name} lacks a field ({e.args[0]})") from None
        attrs = {k: _plain(v) for k, v in data.attrs.items()}
    return demos, attrs


def _read_demo(g: h5py.Group) -> Demo:
    obs = g["obs"]
    slots = sorted(int(k.split("_")[1]) for k in obs if k.startswith("object_") and k.endswith("_pose"))
    return Demo(
        time=obs["time"][:],
        joint_pos=obs["robot_joint_pos"][:].astype("f8"),
        joint_vel=obs["robot_joint_vel"][:].astype("f8"),
        gripper=obs["robot_gripper"][:, 0].astype("f8"),
        object_pose=np.stack([obs[f"object_{i}_pose"][:].astype("f8") for i in slots], axis=1),
        object_valid=np.stack([obs[f"object_{i}_valid"][:, 0] > 0 for i in slots], axis=1),
        actions=g["actions"][:].astype("f8"),
        attrs={k: _plain(v) for k, v in g.attrs.items()},
    )
