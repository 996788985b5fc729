"""robomimic's HDF5: data/demo_k/{obs/*, actions, states}, `model_file` (XML) as attribute. The states say where the
objects are; a file without them (low-dimensional, stripped) is read by the names of its observations, whose
quaternions are xyzw.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from intabs.data.demos import Demo, plain
from intabs.data.importers import Options, Recording, finite_matrix, poses, velocities
from intabs.data.importers.robosuite import demo_of_states, robot_of
from intabs.data.reader import by_number, check_size, is_demo, reading
from intabs.data.resample import steps_of
from intabs.errors import UserError

RATE_HZ = 20.0  # robosuite's, where env_args does not say it
# Tasks whose observation `object` begins with the pose of the one object.
ONE_OBJECT = ("Lift", "PickPlaceCan", "NutAssemblySquare")


def read(source: Path, options: Options) -> Recording:
    if source.is_dir():
        inside = [p for p in sorted(source.rglob("*")) if p.suffix in (".hdf5", ".h5")]
        if len(inside) != 1:
            raise UserError(f"{source}: a folder with {len(inside)} HDF5 files: name one")
        source = inside[0]
    try:
        f = h5py.File(source, "r")
    except OSError as e:
        raise UserError(f"{source}: not an HDF5 file, or cut off ({e})") from None
    with f, reading(source):
        data = f.get("data")
        names = by_number(n for n in data if is_demo(n)) if isinstance(data, h5py.Group) else []
        if not names:
            raise UserError(f"{source}: holds no demonstration (no group data/demo_*)")
        env = _env(data)
        robot = robot_of(f)
        order = {n: f"demo_{k}" for k, n in enumerate(names)}
        masks = {}
        for mask, members in f.get("mask", {}).items():
            masks[mask] = [order[n] for n in (str(plain(m)) for m in members[...]) if n in order]
        first = data[names[0]]
        by_states = "states" in first and "<mujoco" in str(plain(first.attrs.get("model_file", "")))
        width = first["states"].shape[1] if by_states else sum(
            int(np.prod(d.shape[1:], dtype=int)) for d in first.get("obs", {}).values() if d.ndim == 2
        )  # fmt: skip
        pictures = [n for n, d in first.get("obs", {}).items() if getattr(d, "ndim", 0) == 4]
    options.say("units: rad, m, s; poses in the simulation's world")
    rate = options.source_rate_hz or float(env.get("env_kwargs", {}).get("control_freq", RATE_HZ))
    if by_states:
        options.say("objects and joints: from the states and the model's XML (quaternions wxyz)")
    else:
        options.say("no states with a model: read by the names of the observations (quaternions xyzw, turned to wxyz)")
        options.say(f"time: from the rate, {rate:g} Hz")
    if pictures:
        options.say(f"pictures left out: {', '.join(pictures)}")
    attrs = {"embodiment": robot, "task": str(env.get("env_name", "unknown")),
             "agent_fields": ["robot_joint_pos", "robot_gripper"]}  # fmt: skip
    demos = _demos(source, names, by_states, str(env.get("env_name", "")), rate)
    return Recording(demos, len(names), attrs, int(width), masks or None)


def _env(data: h5py.Group) -> dict:
    try:
        env = json.loads(str(plain(data.attrs.get("env_args", "{}"))))
    except json.JSONDecodeError:
        env = {}
    env = env if isinstance(env, dict) else {}
    if not isinstance(env.get("env_kwargs", {}), dict):
        env["env_kwargs"] = {}
    return env


def _demos(source: Path, names: list[str], by_states: bool, env: str, rate: float) -> Iterator[Demo]:
    with h5py.File(source, "r") as f, reading(source):
        for name in names:
            group = f["data"][name]
            where = f"{source}: {name}"
            attrs = {"task": env, "source": f"{source.name}:{name}"}
            if "actions" not in group:
                raise UserError(f"{where}: has no actions")
            wanted = {n: d for n, d in group.items() if n in ("states", "actions")}
            wanted |= {f"obs/{n}": d for n, d in group.get("obs", {}).items() if d.ndim == 2}
            for d in wanted.values():
                check_size(d)
            fields = {n: finite_matrix(d[...], f"{where}/{n}") for n, d in wanted.items()}
            if by_states:
                xml = str(plain(group.attrs.get("model_file", "")))
                yield demo_of_states({k: fields[k] for k in ("states", "actions")}, xml, where, attrs)
            else:
                yield _demo_of_observations(fields, env, rate, where, attrs)


def _demo_of_observations(fields: dict, env: str, rate: float, where: str, attrs: dict) -> Demo:
    obs = {n[4:]: v for n, v in fields.items() if n.startswith("obs/")}
    joint = obs.get("robot0_joint_pos")
    if joint is None:
        raise UserError(f"{where}: has neither states with a model nor obs/robot0_joint_pos: nothing says the joints")
    actions = fields["actions"]
    odd = [n for n, v in obs.items() if len(v) != len(joint)]
    if len(actions) != len(joint) or odd:
        raise UserError(f"{where}: {(odd or ['actions'])[0]} is not as long as obs/robot0_joint_pos ({len(joint)})")
    time = np.arange(len(joint)) / rate
    gripper = (actions[:, -1] > 0).astype(float)
    more = {}
    for ours, theirs in (("robot_finger_pos", "robot0_gripper_qpos"), ("robot_eef_pos", "robot0_eef_pos")):
        if theirs in obs:
            more[ours] = obs[theirs]
    if "robot0_eef_quat" in obs:
        more["robot_eef_quat"] = np.roll(obs["robot0_eef_quat"], 1, axis=1)
    pose = np.zeros((len(joint), 0, 7))
    thing = obs.get("object", obs.get("object-state"))
    if thing is not None and thing.shape[1] >= 7 and env.split("_")[0] in ONE_OBJECT:
        pose = poses(thing[:, None, :7], "xyzw", f"{where}/obs/object")
        attrs = attrs | {"object_names": ["object"]}
    elif thing is not None:
        more["environment_state"] = thing
    if np.ptp(gripper) == 0:
        attrs = attrs | {"gripper": "constant in the source"}
    return Demo(
        time=time,
        joint_pos=joint,
        joint_vel=obs.get("robot0_joint_vel", velocities(joint, time)),
        gripper=gripper,
        object_pose=pose,
        object_valid=np.ones(pose.shape[:2], bool),
        actions=steps_of(joint, gripper),
        attrs=attrs,
        obs=more,
        extra={"source_actions": actions},
    )
