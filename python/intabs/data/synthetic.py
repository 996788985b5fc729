"""Demonstrations that mean nothing, as many as wanted: what reading, checking and sampling large files is measured on.

python -m intabs.data.synthetic OUT.hdf5 --demos 100000
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from intabs.data.demos import PACKED_ABOVE, Demo, DemoWriter
from intabs.data.resample import steps_of
from intabs.output import Progress

RATE_HZ = 25.0
OBJECTS = 3


def demo(rng: np.random.Generator, frames: int) -> Demo:
    """Smooth, with a grasp, objects that stand and are carried: `check` finds nothing wrong with it."""
    time = np.arange(frames) / RATE_HZ
    u = np.linspace(0, np.pi, frames)
    amplitude, phase = rng.uniform(0.05, 0.4, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6))
    waves = np.sin(np.arange(1, 4)[:, None, None] * u[:, None] + phase[:, None]) * amplitude[:, None]
    joint = waves.sum(axis=0) + rng.uniform(-0.5, 0.5, 6)
    first, last = np.sort(rng.integers(frames // 10, frames - frames // 10, 2))
    gripper = np.zeros(frames)
    gripper[first : last + 5] = 1
    pose = np.zeros((frames, OBJECTS, 7))
    pose[:, :, :2] = rng.uniform(-0.3, 0.3, (OBJECTS, 2))
    pose[:, 0, :3] += 0.1 * (1 - np.cos(u))[:, None] * rng.uniform(-1, 1, 3)
    yaw = rng.uniform(-0.7, 0.7, OBJECTS) + np.linspace(0, 0.3, frames)[:, None] * (np.arange(OBJECTS) == 0)
    pose[:, :, 3], pose[:, :, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    return Demo(
        time=time,
        joint_pos=joint,
        joint_vel=np.gradient(joint, 1 / RATE_HZ, axis=0),
        gripper=gripper,
        object_pose=pose,
        object_valid=np.ones((frames, OBJECTS), bool),
        actions=steps_of(joint, gripper),
    )


def write(path: Path, demos: int, frames: int = 300, seed: int = 0, packed: bool | None = None) -> None:
    rng = np.random.default_rng(seed)
    attrs = {"embodiment": "lite6", "rate_hz": RATE_HZ, "recorded": "synthetic"}
    packed = demos > PACKED_ABOVE if packed is None else packed
    with Progress("write", total=demos) as bar, DemoWriter(path, attrs, packed=packed) as writer:
        for k in range(demos):
            d = demo(rng, frames)
            d.attrs = {"task": f"synthetic_{k % 5}", "seed": k}
            writer.add(d)
            bar.update(k + 1, f"{k + 1} of {demos}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--demos", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--groups", action="store_true", help="a group each, as for small files")
    a = parser.parse_args()
    write(a.out, a.demos, a.frames, a.seed, False if a.groups else None)
