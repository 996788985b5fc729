"""A scripted demonstrator: the stand-in for the person who shows the task.

It sees what perception sees (OBJECT_POSES, LITE6_STATUS) and answers with joint targets, 25 Hz. Like a person it
varies speed, way-points and grasp, pauses, is disturbed and corrects, and changes its mind: it may look at the goal
first, rise again before grasping, put the block back, or lift it off the goal once more. Without the last, the state
alone would tell what comes next, and skills would have nothing to say. Nothing of it is in the learned policy's path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

TICK_S = 0.04
BLOCK, GOAL = 0, 1
# Tip of the gripper in the block's frame when it holds the handle: on the handle's axis, above the block's centre [m].
GRASP_HEIGHT = 0.034
BLOCK_HALF = 0.022


@dataclass
class Intent:
    """What the demonstrator does at one tick."""

    q_target: np.ndarray  # (6,) rad: what is sent
    gripper_closed: bool
    action: np.ndarray  # (7,) what was meant: step of the target without the disturbance, gripper +-1
    done: bool = False


@dataclass
class _Leg:
    """One movement of the tip: where to, how long, what the gripper does, how still it must be before the next."""

    name: str
    duration: float  # s
    closed: bool
    tolerance: float  # m
    kick: float  # m, size of disturbances
    goal: object  # callable(demonstrator) -> (p_WG, Rotation R_WG)
    arch: np.ndarray | None = None  # m, detour in the middle


def _minimum_jerk(x: float) -> float:
    """Flash and Hogan 1985."""
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x)


def _as_pose(pose7: np.ndarray) -> tuple[np.ndarray, Rotation]:
    return np.array(pose7[:3]), Rotation.from_quat(np.roll(pose7[3:], -1))


class PickPlace:
    """Takes the block by its handle, carries it to the goal, lets go.

    ik: intabs._core.IkSolver; arm: intabs._core.ArmModel; rng: numpy Generator, the whole source of variation.
    """

    needs = (BLOCK, GOAL)  # slots that must be valid before it starts

    def __init__(self, arm, ik, rng: np.random.Generator, disturb: float = 1.0, detours: float = 0.0):
        """disturb scales the disturbances, detours is the probability of each change of mind."""
        self.arm, self.ik, self.rng = arm, ik, rng
        self.disturb, self.detours = disturb, detours
        self.tempo = rng.uniform(0.85, 1.2)
        self.legs: list[_Leg] | None = None
        self.leg = 0
        self.elapsed = 0.0
        self.pause = 0.0
        self.offset = np.zeros(3)  # of the tip from its reference [m]
        self.twist = 0.0  # about the vertical [rad]
        self.correction = rng.uniform(0.14, 0.25)  # share of the offset taken back a tick
        self.objects = None

    # --- way-points -------------------------------------------------------------------------------------------
    def _grasp(self) -> tuple[np.ndarray, Rotation]:
        p_WO, R_WO = _as_pose(self.objects[BLOCK])
        return p_WO + R_WO.apply([self.grasp_x, 0, GRASP_HEIGHT + self.grasp_z]), self._down(R_WO)

    def _down(self, R_WO: Rotation) -> Rotation:
        """Gripper pointing down, fingers closing on the handle's faces, turned with the object's yaw."""
        yaw = np.arctan2(*R_WO.as_matrix()[[1, 0], 0])
        return Rotation.from_euler("z", yaw + self.grasp_yaw) * Rotation.from_euler("x", np.pi)

    def _above_block(self):
        p, R = self._grasp()
        return p + [0, 0, self.hover], R

    def _lifted(self):
        p, R = self.held_at
        return p + [0, 0, self.lift], R

    def _put_back(self):
        return self.held_at

    def _above_goal(self):
        p, R = self._place_empty()
        return p + [0, 0, self.hover], R

    def _place_empty(self):
        p_goal, R_goal = _as_pose(self.objects[GOAL])
        return p_goal + [0, 0, BLOCK_HALF + GRASP_HEIGHT], self._down(R_goal)

    def _retreat(self, height: float):
        p, R = self.reference
        return p + [0, 0, height], R

    def _place(self, height: float):
        """Where the tip must be for the block, as it lies in the gripper now, to stand on the goal."""
        p_goal, R_goal = _as_pose(self.objects[GOAL])
        R_block = Rotation.from_euler("z", np.arctan2(*R_goal.as_matrix()[[1, 0], 0]))
        p_GO, R_GO = self.block_in_tip
        R_WG = self._down(R_block)
        # Only the yaw of the grasp is undone: the tip stays vertical.
        del R_GO
        p_block = p_goal + [0, 0, BLOCK_HALF + height]
        return p_block - R_WG.apply(p_GO), R_WG

    def _start(self, q: np.ndarray, objects: np.ndarray) -> None:
        rng = self.rng
        self.objects = objects.copy()
        self.hover = rng.uniform(0.045, 0.075)
        self.lift = rng.uniform(0.05, 0.085)
        self.grasp_x = rng.uniform(-0.005, 0.005)
        self.grasp_z = rng.uniform(-0.002, 0.003)
        self.grasp_yaw = rng.uniform(-0.05, 0.05)
        carry_height = rng.uniform(0.045, 0.075)
        retreat = rng.uniform(0.05, 0.08)
        arch = np.append(rng.normal(0, 0.008, 2), rng.uniform(0, 0.015))
        t = self.tempo
        slow, fine = 0.006, 0.003  # m, disturbances while moving freely, and close to things

        def legs(*names: str) -> list[_Leg]:
            return [
                {
                    "reach": lambda: _Leg("reach", 1.5 * t, False, 0.006, slow, lambda d: d._above_block(), arch * 0.5),
                    "look": lambda: _Leg("look", 1.5 * t, False, 0.008, slow, lambda d: d._above_goal(), arch * 0.5),
                    "descend": lambda: _Leg("descend", 0.9 * t, False, 0.0012, fine, lambda d: d._grasp()),
                    "rise": lambda: _Leg("rise", 0.7 * t, False, 0.006, fine, lambda d: d._above_block()),
                    "grasp": lambda: _Leg("grasp", 0.36, True, 0.01, 0.0, lambda d: d.reference),
                    "lift": lambda: _Leg("lift", 0.8 * t, True, 0.008, 0.004, lambda d: d._lifted()),
                    "return": lambda: _Leg("return", 0.9 * t, True, 0.002, fine, lambda d: d._put_back()),
                    "carry": lambda: _Leg("carry", 1.5 * t, True, 0.006, slow, lambda d: d._place(carry_height), arch),
                    "lower": lambda: _Leg("lower", 1.0 * t, True, 0.002, fine, lambda d: d._place(0.001)),
                    "release": lambda: _Leg("release", 0.32, False, 0.01, 0.0, lambda d: d.reference),
                    "retreat": lambda: _Leg("retreat", 0.9 * t, False, 0.008, fine, lambda d: d._retreat(retreat)),
                    "rest": lambda: _Leg("rest", 0.4, False, 0.01, 0.0, lambda d: d.reference),
                }[name]()
                for name in names
            ]

        def fancy() -> bool:
            return rng.random() < self.detours

        self.legs = []
        if fancy():
            self.legs += legs("look")
        self.legs += legs("reach")
        if fancy():
            self.legs += legs("descend", "rise")
        if fancy():
            self.legs += legs("descend", "grasp", "lift", "return", "release", "rise")
        self.legs += legs("descend", "grasp", "lift")
        if fancy():
            self.legs += legs("return", "lift")
        self.legs += legs("carry")
        if fancy():
            self.legs += legs("lower", "carry")
        if fancy():
            self.legs += legs("lower", "release", "retreat", "reach", "descend", "grasp", "lift", "carry")
        self.legs += legs("lower", "release", "retreat", "rest")
        p, R = _as_pose(self.arm.tip(q))
        self.reference = (p, R)
        self.q_target = np.array(q)
        self._begin_leg()

    def _begin_leg(self) -> None:
        leg = self.legs[self.leg]
        self.elapsed = 0.0
        self.leg_from = self.reference
        self.leg_to = leg.goal(self)
        self.leg_slerp = Slerp([0, 1], Rotation.concatenate([self.leg_from[1], self.leg_to[1]]))
        if self.rng.random() < 0.12:
            self.pause = self.rng.uniform(0.08, 0.3)

    def _reference_at(self, elapsed: float) -> tuple[np.ndarray, Rotation]:
        leg = self.legs[self.leg]
        x = elapsed / leg.duration
        s = _minimum_jerk(x)
        p = (1 - s) * self.leg_from[0] + s * self.leg_to[0]
        if leg.arch is not None and x < 1:
            p = p + leg.arch * np.sin(np.pi * s) ** 2
        return p, self.leg_slerp(s)

    # --- one tick -----------------------------------------------------------------------------------------------
    def step(self, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> Intent | None:
        """q (6,) measured; objects (S, 7) xyz wxyz in W; valid (S,). None while it can't start (objects not seen)."""
        if self.legs is None:
            if not all(valid[i] for i in self.needs):
                return None
            self._start(q, objects)
        leg = self.legs[self.leg]
        # The eyes stay on the objects: before the grasp on the block, afterwards on how it lies in the gripper.
        if leg.name == "reach" and valid[BLOCK]:
            self.objects[BLOCK] = objects[BLOCK]
            self.leg_to = leg.goal(self)
            self.leg_slerp = Slerp([0, 1], Rotation.concatenate([self.leg_from[1], self.leg_to[1]]))
        if leg.name in ("grasp", "lift", "return") and valid[BLOCK]:
            p_G, R_G = _as_pose(self.arm.tip(q))
            p_O, R_O = _as_pose(objects[BLOCK])
            self.block_in_tip = (R_G.inv().apply(p_O - p_G), R_G.inv() * R_O)

        if self.pause > 0 and leg.kick > 0:
            self.pause -= TICK_S
        else:
            self.elapsed += TICK_S
        reference = self._reference_at(self.elapsed)
        meant_offset = (1 - self.correction) * self.offset
        meant_twist = (1 - self.correction) * self.twist
        q_meant = self._ik(reference, meant_offset, meant_twist)

        kick = np.zeros(3)
        kick_twist = 0.0
        if leg.kick > 0 and self.disturb > 0 and self.rng.random() < 0.07:
            kick = self.rng.normal(0, self.disturb * leg.kick, 3) * [1, 1, 0.6]
            kick_twist = self.rng.normal(0, self.disturb * 5 * leg.kick)
        q_sent = self._ik(reference, meant_offset + kick, meant_twist + kick_twist) if kick.any() else q_meant

        action = np.append(q_meant - self.q_target, 1.0 if leg.closed else -1.0)
        self.q_target = q_sent
        self.offset, self.twist = meant_offset + kick, meant_twist + kick_twist
        self.reference = reference

        done = False
        if self.elapsed >= leg.duration and np.linalg.norm(self.offset) <= leg.tolerance:
            if leg.name == "grasp":
                self.held_at = reference
            if self.leg + 1 < len(self.legs):
                self.leg += 1
                self._begin_leg()
            else:
                done = True
        return Intent(q_sent, leg.closed, action, done)

    def _ik(self, reference, offset: np.ndarray, twist: float) -> np.ndarray:
        p, R = reference
        x, y, z, w = (Rotation.from_euler("z", twist) * R).as_quat()
        pose = np.concatenate([p + offset, [w, x, y, z]])
        result = self.ik.solve(pose, self.q_target)
        if not result.ok:
            raise RuntimeError(f"the demonstrator cannot reach {np.round(pose[:3], 3).tolist()}: {result.why}")
        return np.array(result.q)
