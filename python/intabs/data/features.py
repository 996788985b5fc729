"""Demonstrations -> what the networks see. Features are made in C++, by the code that runs on the robot."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from intabs import _core
from intabs.data.demos import OBJECT_SLOTS, Demo


@dataclass
class Readings:
    """What the robot and perception said, tick by tick: the input of the state features."""

    joint_pos: np.ndarray  # (T, 6)
    gripper_closed: np.ndarray  # (T,) bool
    object_pose: np.ndarray  # (T, 4, 7)
    object_known: np.ndarray  # (T, 4) bool: seen at least once so far
    object_valid: np.ndarray  # (T, 4) bool

    def state(self, arm) -> np.ndarray:
        """(T, 59) float32, not normalised."""
        return _core.assemble_states(
            arm, self.joint_pos, self.gripper_closed, self.object_pose, self.object_known, self.object_valid
        )

    def map(self, f) -> Readings:
        return Readings(*(f(getattr(self, field.name)) for field in fields(self)))


@dataclass
class Trajectory:
    """One demonstration as arrays; T - 1 ticks, each with its action."""

    readings: Readings
    state: np.ndarray  # (T-1, 59) s = [s^r, s^e]
    agent_action: np.ndarray  # (T-1, 7) a^r
    environment_action: np.ndarray  # (T-1, 24) a^e


def trajectory(demo: Demo, arm) -> Trajectory:
    """Not normalised."""
    known = np.maximum.accumulate(demo.object_valid, axis=0)
    pose, valid = demo.object_pose, demo.object_valid
    missing = OBJECT_SLOTS - pose.shape[1]
    if missing:  # unused slots
        pose = np.pad(pose, ((0, 0), (0, missing), (0, 0)))
        valid = np.pad(valid, ((0, 0), (0, missing)))
        known = np.pad(known, ((0, 0), (0, missing)))
    readings = Readings(demo.joint_pos, demo.gripper > 0.5, pose, known, valid)
    motion = _core.object_motions(arm, readings.joint_pos, pose, known)
    readings = readings.map(lambda x: x[:-1])
    return Trajectory(readings, readings.state(arm), demo.actions[:-1].astype("f4"), motion)


@dataclass
class Normalizer:
    """y = (x - mean) / scale, clamped to +-limit. Dimensions that do not vary in training get scale 1."""

    state_mean: np.ndarray
    state_scale: np.ndarray
    agent_action_scale: np.ndarray
    environment_action_scale: np.ndarray
    limit: float = 5.0

    @staticmethod
    def fit(trajectories: list[Trajectory]) -> Normalizer:
        s = np.concatenate([t.state for t in trajectories])
        a = np.concatenate([t.agent_action for t in trajectories])
        e = np.concatenate([t.environment_action for t in trajectories])
        std = s.std(0)
        return Normalizer(
            s.mean(0).astype("f4"),
            np.where(std > 1e-4, std, 1).astype("f4"),
            # Actions are not centred: no action is no motion. The gripper is +-1 already.
            np.append(np.maximum(np.sqrt((a[:, :6] ** 2).mean(0)), 1e-4), 1.0).astype("f4"),
            # The motion of the objects shares one scale for positions and one for rotations.
            np.tile(np.repeat([max(_rms(e, 0), 1e-4), max(_rms(e, 3), 1e-3)], 3), OBJECT_SLOTS).astype("f4"),
        )

    def normalize_state(self, state: np.ndarray) -> np.ndarray:
        return _core.normalize(state, self.state_mean, self.state_scale, self.limit)

    def normalize(self, t: Trajectory) -> Trajectory:
        return Trajectory(
            t.readings,
            self.normalize_state(t.state),
            t.agent_action / self.agent_action_scale,
            np.clip(t.environment_action / self.environment_action_scale, -8, 8).astype("f4"),
        )

    def to_dict(self) -> dict:
        return {
            "state_mean": self.state_mean.tolist(),
            "state_scale": self.state_scale.tolist(),
            "agent_action_scale": self.agent_action_scale.tolist(),
            "environment_action_scale": self.environment_action_scale.tolist(),
            "limit": self.limit,
        }

    @staticmethod
    def from_dict(d: dict) -> Normalizer:
        return Normalizer(**{k: np.asarray(v, "f4") if isinstance(v, list) else v for k, v in d.items()})


def _rms(e: np.ndarray, first: int) -> float:
    e = e.reshape(len(e), -1, 6)[..., first : first + 3]
    return float(np.sqrt((e**2).mean()))
