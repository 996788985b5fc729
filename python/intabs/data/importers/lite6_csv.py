"""Lite 6 guided by hand, a csv an episode: timestamp (s or ms), x y z [mm], roll pitch yaw [deg], joint1..6 [deg], and
in some a gripper bit: 1 open, 0 closed (the arm reaches with 1, turns it to 0 at the cup, carries and pours with 0,
sets down and turns it to 1). A column `scale` without a meaning is left out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.data.demos import Demo
from intabs.data.importers import Options, Recording, files_under, velocities
from intabs.data.resample import heal_signs, steps_of, wxyz
from intabs.errors import UserError

JOINTS = [f"joint{i}" for i in range(1, 7)]
TCP = ["x", "y", "z", "roll", "pitch", "yaw"]
# No recorder of an arm is slower than this [s] or as fast as one a millisecond: how ms are told from s.
SLOWEST_STEP = 0.5
FAR_OFF = 100.0  # mm in one step
REACH = 0.8  # m, of the tool's point from the base
JOINT_LIMIT = 2 * np.pi + 0.1


def read(source: Path, options: Options) -> Recording:
    files = files_under(source, (".csv",), "csv")
    width = len(_columns(files[0])[0])
    units = sorted({_read(path)[1] for path in files})
    stray = sum(_read(path)[2] for path in files)
    if stray:
        options.say(f"TCP: {stray} frame{'s' if stray > 1 else ''} far off both neighbours, filled from the one before")
    options.say(f"units: joints deg -> rad, TCP mm -> m, roll pitch yaw deg -> quaternion wxyz, time {'/'.join(units)}")
    options.say("frames: TCP (with the tool set in the controller) in the arm's base; no objects in this format")
    options.say("gripper: the bit is 1 where it is open (seen from what the arm does; the files do not say it)")
    options.say("joint velocities: differences of the positions; actions: steps to the next frame")
    attrs = {"embodiment": "lite6", "task": source.stem if source.is_file() else source.name}
    return Recording(_demos(files), len(files), attrs, width)


def _columns(path: Path) -> tuple[list[str], list[str]]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise UserError(f"{path}: not text ({e})") from None
    names = [n.strip() for n in lines[0].split(",")] if lines else []
    missing = [n for n in ["timestamp", *TCP, *JOINTS] if n not in names]
    if missing:
        raise UserError(f"{path}: has no column {missing[0]}: its first line must name timestamp, x..yaw, joint1..6")
    return names, [line for line in lines[1:] if line.strip()]


def _read(path: Path) -> tuple[dict[str, np.ndarray], str, int]:
    """Columns in SI, the unit of the time, and the number of rows with a torn TCP."""
    names, lines = _columns(path)
    rows = []
    for i, line in enumerate(lines):
        cells = line.split(",")
        try:
            rows.append([float(c) for c in cells])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != len(names) or not np.isfinite(rows[-1]).all():
            raise UserError(f"{path}: line {i + 2} is not {len(names)} numbers")
    if len(rows) < 2:
        raise UserError(f"{path}: holds fewer than two frames")
    table = dict(zip(names, np.array(rows).T, strict=True))
    step = float(np.median(np.diff(table["timestamp"])))
    in_ms = step > SLOWEST_STEP
    if in_ms:
        table["timestamp"] = table["timestamp"] * 1e-3
    torn = _torn(np.stack([table[n] for n in TCP[:3]], axis=1))
    for name in TCP:
        table[name][torn] = table[name][np.flatnonzero(torn) - 1]
    for name in JOINTS + TCP[3:]:
        table[name] = np.radians(table[name])
    for name in TCP[:3]:
        table[name] = table[name] * 1e-3
    far = float(np.sqrt(sum(table[n] ** 2 for n in TCP[:3])).max())
    wide = max(float(np.abs(table[n]).max()) for n in JOINTS)
    if far > 2 * REACH or wide > JOINT_LIMIT:
        raise UserError(f"{path}: TCP {far:.3g} m away or joints of {wide:.3g} rad: not mm and deg of a Lite 6")
    # An arm that works is not closer than this: it would be metres taken for mm, radians for degrees.
    if far < 0.02 and wide < 0.11:
        raise UserError(f"{path}: TCP {far:.3g} m away, joints below {wide:.3g} rad: not in mm and deg")
    return table, "ms" if in_ms else "s", int(torn.sum())


def _torn(tcp: np.ndarray) -> np.ndarray:
    """(T,) bool of (T, 3) mm: single rows far from both neighbours, which are close to each other. The recorder read
    the pose while it was being written; the joints of such a row are sound."""
    torn = np.zeros(len(tcp), bool)
    step = np.linalg.norm(np.diff(tcp, axis=0), axis=1)
    over = np.linalg.norm(tcp[2:] - tcp[:-2], axis=1)
    torn[1:-1] = (step[:-1] > FAR_OFF) & (step[1:] > FAR_OFF) & (over < 0.2 * step[:-1])
    return torn


def _demos(files: list[Path]) -> Iterator[Demo]:
    for path in files:
        table, _, _ = _read(path)
        time = table["timestamp"] - table["timestamp"][0]
        if (np.diff(time) <= 0).any():
            raise UserError(f"{path}: time does not advance after line {int(np.argmax(np.diff(time) <= 0)) + 2}")
        joint = np.stack([table[n] for n in JOINTS], axis=1)
        bit = table.get("gripper")
        if bit is not None and not np.isin(bit, (0, 1)).all():
            raise UserError(f"{path}: column gripper holds other values than 0 and 1")
        gripper = np.zeros(len(time)) if bit is None else 1 - bit
        rpy = np.stack([table[n] for n in TCP[3:]], axis=1)
        attrs = {"source": f"{path.parent.name}/{path.name}", "task": path.parent.name}
        if bit is None:
            attrs["gripper"] = "not recorded"
        elif np.ptp(bit) == 0:
            attrs["gripper"] = "constant in the source"
        yield Demo(
            time=time,
            joint_pos=joint,
            joint_vel=velocities(joint, time),
            gripper=gripper,
            object_pose=np.zeros((len(time), 0, 7)),
            object_valid=np.zeros((len(time), 0), bool),
            actions=steps_of(joint, gripper),
            attrs=attrs,
            obs={
                "robot_eef_pos": np.stack([table[n] for n in TCP[:3]], axis=1),
                # The controller turns about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll).
                "robot_eef_quat": heal_signs(wxyz(Rotation.from_euler("xyz", rpy).as_quat()))[0],
            },
        )
