"""HDF5 of robosuite's collector and of RoboTurk: data/demo_k/states = time, qpos, qvel of a MuJoCo model whose XML lies
in models/ beside the file. Panda files carry `actions`, whose last number closes the gripper at +1 and opens it at -1;
Sawyer's (RoboTurk) `joint_velocities` and `gripper_actuations`: 0 closes, -1 opens.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from intabs.data import mujoco_model
from intabs.data.demos import Demo, plain
from intabs.data.importers import Options, Recording, files_under, finite_matrix, poses
from intabs.data.reader import by_number, check_size, is_demo, reading
from intabs.data.resample import steps_of
from intabs.errors import UserError

ARM = re.compile(r"(robot\d+_)?((left|right)_)?j(oint)?_?\d+")
FINGER = re.compile(r"finger|gripper")


def read(source: Path, options: Options) -> Recording:
    files = files_under(source, (".hdf5", ".h5"), "HDF5 file")
    found, robots, widths = [], {}, []
    for path in files:
        with _open(path) as f, reading(path):
            for name in by_number(n for n in f["data"] if is_demo(n)):
                found.append((path, name))
                widths.append(int(f[f"data/{name}/states"].shape[1]))
            robots[robot_of(f)] = path
    if len(robots) > 1:
        raise UserError(f"{source}: recordings of {' and '.join(sorted(robots))}: import them one by one")
    if not found:
        raise UserError(f"{source}: holds no demonstration (no data/demo_* with states)")
    options.say("units: rad, m, rad/s, s as MuJoCo has them; poses in the simulation's world; quaternions wxyz")
    options.say("joint order: from the model's XML; the agent is the arm's joints and the gripper's command")
    attrs = {"embodiment": next(iter(robots)), "agent_fields": ["robot_joint_pos", "robot_gripper"]}
    return Recording(_demos(found), len(found), attrs, max(widths))


def _open(path: Path) -> h5py.File:
    try:
        f = h5py.File(path, "r")
    except OSError as e:
        raise UserError(f"{path}: not an HDF5 file, or cut off ({e})") from None
    data = f.get("data")
    if not isinstance(data, h5py.Group) or not any(
        is_demo(n) and isinstance(g, h5py.Group) and getattr(g.get("states"), "ndim", 0) == 2 for n, g in data.items()
    ):
        f.close()
        raise UserError(f"{path}: not of robosuite's collector (no data/demo_* with states)")
    return f


def robot_of(f: h5py.File) -> str:
    attrs = f["data"].attrs
    text = " ".join(str(plain(attrs[k])) for k in ("env", "env_info", "env_args") if k in attrs)
    for robot in ("Panda", "Sawyer", "Baxter", "IIWA", "Jaco", "Kinova3", "UR5e"):
        if robot.lower() in text.lower():
            return robot.lower()
    return "unknown"


def _demos(found: list[tuple[Path, str]]) -> Iterator[Demo]:
    for path, name in found:
        with _open(path) as f, reading(path):
            group = f["data"][name]
            where = f"{path}: {name}"
            model_file = str(plain(group.attrs.get("model_file", "")))
            if "<mujoco" in model_file:
                xml = model_file
            else:
                beside = path.parent / "models" / Path(model_file).name
                if not beside.is_file():
                    raise UserError(f"{where}: its model {beside} is missing: it holds the order of the joints")
                xml = beside.read_text(errors="replace")
            fields = {}
            for key in ("states", "actions", "joint_velocities", "gripper_actuations"):
                if key in group:
                    check_size(group[key])
                    fields[key] = finite_matrix(group[key][...], f"{where}/{key}")
            attrs = {"task": str(plain(f["data"].attrs.get("env", path.parent.name))), "source": _name(path, name)}
        yield demo_of_states(fields, xml, where, attrs)


def _name(path: Path, name: str) -> str:
    return f"{path.parent.name}/{path.name}:{name}"


def demo_of_states(fields: dict[str, np.ndarray], xml: str, where: str, attrs: dict) -> Demo:
    states = fields["states"]
    model = mujoco_model.parse(xml, f"{where}, its model")
    if states.shape[1] != 1 + model.nq + model.nv:
        raise UserError(f"{where}: states are {states.shape[1]} wide, its model wants {1 + model.nq + model.nv}")
    for key, value in fields.items():
        if len(value) != len(states):
            raise UserError(f"{where}: {key} has {len(value)} frames, states {len(states)}")
    time, qpos, qvel = states[:, 0], states[:, 1 : 1 + model.nq], states[:, 1 + model.nq :]
    scalar = [j for j in model.joints if j.kind in ("hinge", "slide")]
    arm = [j for j in scalar if ARM.fullmatch(j.name)]
    if not arm:
        raise UserError(f"{where}: no joint of its model is named like an arm's (joint1, right_j0, ...)")
    root = next(b for b in arm[0].bodies if b)
    finger = [j for j in scalar if j not in arm and FINGER.search(j.name)]
    # Sawyer turns its head in the middle of the arm's joints.
    other = [j for j in scalar if j not in arm and j not in finger and root in j.bodies]
    thing = [j for j in scalar if j not in arm and j not in finger and j not in other]
    free = [j for j in model.joints if j.kind == "free"]
    pose = [poses(qpos[:, j.qpos : j.qpos + 7], "wxyz", f"{where}, {j.body}") for j in free]
    gripper = None
    if "gripper_actuations" in fields:
        gripper = (fields["gripper_actuations"][:, -1] > -0.5).astype(float)
    elif "actions" in fields:
        gripper = (fields["actions"][:, -1] > 0).astype(float)
    joint_pos = qpos[:, [j.qpos for j in arm]]
    obs = {}
    for key, joints in (("robot_finger_pos", finger), ("robot_other_pos", other), ("object_joint_pos", thing)):
        if joints:
            obs[key] = qpos[:, [j.qpos for j in joints]]
    extra = {"states": states}
    if "actions" in fields:
        extra["source_actions"] = fields["actions"]
    elif "joint_velocities" in fields and "gripper_actuations" in fields:
        extra["source_actions"] = np.concatenate([fields["joint_velocities"], fields["gripper_actuations"]], axis=1)
    attrs = attrs | {
        "joint_names": [j.name for j in arm],
        "object_names": [j.body for j in free],
        "object_joint_names": [j.name for j in thing],
    }
    if gripper is not None and np.ptp(gripper) == 0:
        attrs["gripper"] = "constant in the source"
    return Demo(
        time=time,
        joint_pos=joint_pos,
        joint_vel=qvel[:, [j.qvel for j in arm]],
        gripper=gripper,
        object_pose=np.stack(pose, axis=1) if pose else np.zeros((len(time), 0, 7)),
        object_valid=np.ones((len(time), len(pose)), bool),
        actions=steps_of(joint_pos, gripper),
        attrs=attrs,
        obs=obs,
        extra=extra,
    )
