"""numpy archives, an episode a file: --agent KEY (T, n) joints, --object KEY (T, 7) or (T, S, 7) poses, time (T,).
A name AGENT_OBJECT_VERBn (MyoHand_cup_pour1.npz) gives embodiment, object and task."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from intabs.data.demos import Demo
from intabs.data.importers import Options, Recording, files_under, finite_matrix, joints_in_radians, poses, velocities
from intabs.data.resample import steps_of
from intabs.errors import UserError

NAME = re.compile(r"([A-Za-z0-9]+)_([A-Za-z0-9]+)_([A-Za-z]+)\d*")


def read(source: Path, options: Options) -> Recording:
    files = files_under(source, (".npz",), "npz")
    first = _arrays(files[0])
    if options.agent is None:
        raise UserError(f"{files[0]} holds {', '.join(first)}: say which is the agent (--agent KEY --object KEY)")
    agents = {_named(p)[0] for p in files}
    options.say(f"units of the joints: {options.units}; poses m, xyz then quaternion {options.quaternion} (--quat)")
    if options.time not in first:
        if options.source_rate_hz is None:
            raise UserError(f"{files[0]} has no array '{options.time}': name it (--time) or give --source-rate HZ")
        options.say(f"time: from the rate, {options.source_rate_hz:g} Hz")
    left = sorted(set(first) - {options.agent, options.object, options.time})
    if left:
        options.say(f"left out: {', '.join(left)}")
    embodiment = agents.pop() if len(agents) == 1 else "unknown"
    attrs = {"embodiment": embodiment, "agent_fields": ["robot_joint_pos"], "joint_units": options.units}
    width = sum(int(np.prod(first[k].shape[1:], dtype=int)) for k in (options.agent, options.object) if k in first)
    return Recording(_demos(files, options), len(files), attrs, width)


def _named(path: Path) -> tuple[str, str, str]:
    """Embodiment, object, task."""
    match = NAME.fullmatch(path.stem)
    return (match[1].lower(), match[2], match[3]) if match else ("unknown", "object", path.stem)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {k: archive[k] for k in archive.files}
    except Exception as e:  # zipfile, zlib, numpy's header and its tokenizer: a damaged file fails anywhere
        raise UserError(f"{path}: not an npz of arrays, or damaged ({e})") from None


def _demos(files: list[Path], options: Options) -> Iterator[Demo]:
    for path in files:
        arrays = _arrays(path)
        for key in (options.agent, options.object):
            if key is not None and key not in arrays:
                raise UserError(f"{path} has no array '{key}': it holds {', '.join(arrays)}")
        joint = finite_matrix(arrays[options.agent], f"{path}: {options.agent}")
        joint = joints_in_radians(joint, options, f"{path}: {options.agent}")
        length = len(joint)
        embodiment, thing, task = _named(path)
        pose = np.zeros((length, 0, 7))
        if options.object is not None:
            value = arrays[options.object]
            where = f"{path}: {options.object}"
            if len(value.reshape(len(value), -1)) != length or value.size % (7 * length):
                raise UserError(f"{where} is {value.shape}: not (T, 7) or (T, S, 7) with the agent's {length} frames")
            value = finite_matrix(value.reshape(length, -1), where)
            pose = poses(value.reshape(length, -1, 7), options.quaternion, where)
        if options.time in arrays:
            time = finite_matrix(arrays[options.time].reshape(-1, 1), f"{path}: {options.time}")[:, 0]
            if len(time) != length or (np.diff(time) <= 0).any():
                raise UserError(f"{path}: {options.time} is not {length} times that advance")
            time = time - time[0]
        else:
            if options.source_rate_hz is None:
                raise UserError(f"{path} has no array '{options.time}': give --source-rate HZ")
            time = np.arange(length) / options.source_rate_hz
        slots = pose.shape[1]
        yield Demo(
            time=time,
            joint_pos=joint,
            joint_vel=velocities(joint, time),
            gripper=None,
            object_pose=pose,
            object_valid=np.ones((length, slots), bool),
            actions=steps_of(joint, None),
            attrs={
                "task": task,
                "source": path.name,
                "object_names": [thing] if slots == 1 else [f"{thing}_{i}" for i in range(slots)],
            },
        )
