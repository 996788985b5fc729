"""Franka kitchen: a pickle of the relay play data (observations, actions of one episode), a folder of such, or D4RL's
HDF5 (episodes one after the other, cut at terminals and timeouts). The first 30 numbers of an observation are 9 joints
of the robot (7 of the arm, 2 fingers) and 21 of the kitchen, whose last 7 are the kettle's pose (xyz, wxyz).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from intabs.data import unpickle
from intabs.data.demos import Demo
from intabs.data.importers import Options, Recording, files_under, finite_matrix, poses, velocities
from intabs.data.reader import check_size, reading
from intabs.data.resample import steps_of
from intabs.errors import UserError

RATE_HZ = 12.5  # of the parser of the relay data; no file says it
OBJECT_JOINTS = [
    "knob_1", "burner_1", "knob_2", "burner_2", "knob_3", "burner_3", "knob_4", "burner_4", "light_switch", "light",
    "slide_cabinet", "left_hinge", "right_hinge", "microwave",
]  # fmt: skip


def read(source: Path, options: Options) -> Recording:
    files = files_under(source, (".pkl", ".pickle", ".hdf5", ".h5"), "recording of the kitchen")
    # The names and lengths first: a folder of pickles is read one by one.
    spans = [(path, span) for path in files for span in _spans(path)]
    rate = options.source_rate_hz or RATE_HZ
    options.say("units: rad, m; the kettle's pose in the kitchen's frame, quaternion wxyz")
    options.say(f"time: from the rate, {rate:g} Hz: no file says it (--source-rate)")
    options.say("goals and the 30 numbers behind the joints are left out")
    attrs = {"embodiment": "franka", "task": "kitchen",
             "agent_fields": ["robot_joint_pos", "robot_finger_pos"]}  # fmt: skip
    width = _arrays(*spans[0])[0].shape[1]
    return Recording(_demos(spans, rate), len(spans), attrs, width)


def _spans(path: Path) -> list[slice]:
    """Episodes of a file."""
    if path.suffix in (".pkl", ".pickle"):
        return [slice(None)]
    with _open(path) as f, reading(path):
        for key in ("observations", "actions"):
            if not isinstance(f.get(key), h5py.Dataset) or f[key].ndim != 2:
                raise UserError(f"{path}: has no dataset {key} (T, n): not D4RL's layout")
        length = len(f["observations"])
        ends = np.zeros(length, bool)
        for key in ("terminals", "timeouts"):
            if key in f:
                check_size(f[key])
                flags = np.asarray(f[key][...]).reshape(-1)
                if len(flags) != length:
                    raise UserError(f"{path}: {key} has {len(flags)} values, observations {length}")
                ends |= flags.astype(bool)
        ends[-1:] = True
    stop = np.flatnonzero(ends) + 1
    start = np.concatenate([[0], stop[:-1]])
    return [slice(int(a), int(b)) for a, b in zip(start, stop, strict=True) if b - a >= 2]


def _open(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError as e:
        raise UserError(f"{path}: not an HDF5 file, or cut off ({e})") from None


def _arrays(path: Path, span: slice) -> tuple[np.ndarray, np.ndarray]:
    if path.suffix in (".pkl", ".pickle"):
        value = unpickle.load(path)
        if not isinstance(value, dict) or not {"observations", "actions"} <= value.keys():
            raise UserError(f"{path}: not of the kitchen: it wants a dictionary with observations and actions")
        o, a = np.asarray(value["observations"]), np.asarray(value["actions"])
    else:
        with _open(path) as f, reading(path):
            o, a = f["observations"][span], f["actions"][span]
    o, a = finite_matrix(o, f"{path}: observations"), finite_matrix(a, f"{path}: actions", 9)
    if o.shape[1] not in (30, 59, 60) or len(a) != len(o):
        raise UserError(f"{path}: observations {o.shape}, actions {a.shape}: not 30 or 60 numbers a frame")
    return o, a


def _demos(spans: list[tuple[Path, slice]], rate: float) -> Iterator[Demo]:
    for path, span in spans:
        o, a = _arrays(path, span)
        time = np.arange(len(o)) / rate
        kettle = poses(o[:, None, 23:30], "wxyz", f"{path}: kettle")
        yield Demo(
            time=time,
            joint_pos=o[:, :7],
            joint_vel=velocities(o[:, :7], time),
            gripper=None,
            object_pose=kettle,
            object_valid=np.ones((len(o), 1), bool),
            actions=steps_of(o[:, :9], None),
            attrs={
                "task": "kitchen",
                "source": path.name if span.start is None else f"{path.name}:{span.start}",
                "object_names": ["kettle"],
                "object_joint_names": OBJECT_JOINTS,
            },
            obs={"robot_finger_pos": o[:, 7:9], "object_joint_pos": o[:, 9:23]},
            extra={"source_actions": a},
        )
