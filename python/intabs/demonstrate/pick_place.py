"""Takes the block by its handle, carries it to the goal, lets go.

Changes of mind: it may look at the goal first, rise again before grasping, put the block back, or lift it off the goal
once more.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.demonstrate.base import BLOCK, FINE, GOAL, SLOW, Demonstrator, Leg, as_pose

# Tip of the gripper in the block's frame when it holds the handle: on the handle's axis, above the block's centre [m].
GRASP_HEIGHT = 0.034
BLOCK_HALF = 0.022


class PickPlace(Demonstrator):
    needs = (BLOCK, GOAL)

    # --- way-points -------------------------------------------------------------------------------------------
    def _grasp(self) -> tuple[np.ndarray, Rotation]:
        p_WO, R_WO = as_pose(self.objects[BLOCK])
        return p_WO + R_WO.apply([self.grasp_x, 0, GRASP_HEIGHT + self.grasp_z]), self._down(R_WO)

    def _down(self, R_WO: Rotation) -> Rotation:
        """Gripper pointing down, fingers closing on the handle's faces, turned with the object's yaw."""
        yaw = np.arctan2(*R_WO.as_matrix()[[1, 0], 0])
        return Rotation.from_euler("z", yaw + self.grasp_yaw) * Rotation.from_euler("x", np.pi)

    def _above_block(self):
        p, R = self._grasp()
        return p + [0, 0, self.hover], R

    def _lifted(self):
        p, R = self.memory["held"]
        return p + [0, 0, self.lift], R

    def _above_goal(self):
        p, R = self._place_empty()
        return p + [0, 0, self.hover], R

    def _place_empty(self):
        p_goal, R_goal = as_pose(self.objects[GOAL])
        return p_goal + [0, 0, BLOCK_HALF + GRASP_HEIGHT], self._down(R_goal)

    def _retreat(self, height: float):
        p, R = self.reference
        return p + [0, 0, height], R

    def _place(self, height: float):
        """Where the tip must be for the block, as it lies in the gripper now, to stand on the goal."""
        p_goal, R_goal = as_pose(self.objects[GOAL])
        R_block = Rotation.from_euler("z", np.arctan2(*R_goal.as_matrix()[[1, 0], 0]))
        R_WG = self._down(R_block)  # the tip stays vertical, however the block hangs
        p_block = p_goal + [0, 0, BLOCK_HALF + height]
        return p_block - R_WG.apply(self.p_GO), R_WG

    def plan(self, q: np.ndarray) -> list[Leg]:
        rng = self.rng
        self.hover = rng.uniform(0.045, 0.075)
        self.lift = rng.uniform(0.05, 0.085)
        self.grasp_x = rng.uniform(-0.005, 0.005)
        self.grasp_z = rng.uniform(-0.002, 0.003)
        self.grasp_yaw = rng.uniform(-0.05, 0.05)
        carry_height = rng.uniform(0.045, 0.075)
        retreat = rng.uniform(0.05, 0.08)
        arch = np.append(rng.normal(0, 0.008, 2), rng.uniform(0, 0.015))
        t = self.tempo

        def legs(*names: str) -> list[Leg]:
            return [
                {
                    "reach": lambda: Leg("reach", 1.5 * t, False, 0.006, SLOW, self._above_block, arch * 0.5),
                    "look": lambda: Leg("look", 1.5 * t, False, 0.008, SLOW, self._above_goal, arch * 0.5),
                    "descend": lambda: Leg("descend", 0.9 * t, False, 0.0012, FINE, self._grasp),
                    "rise": lambda: Leg("rise", 0.7 * t, False, 0.006, FINE, self._above_block),
                    "grasp": lambda: Leg("grasp", 0.36, True, 0.01, 0.0, lambda: self.reference),
                    "lift": lambda: Leg("lift", 0.8 * t, True, 0.008, 0.004, self._lifted),
                    "return": lambda: Leg("return", 0.9 * t, True, 0.002, FINE, lambda: self.memory["held"]),
                    "carry": lambda: Leg("carry", 1.5 * t, True, 0.006, SLOW, lambda: self._place(carry_height), arch),
                    "lower": lambda: Leg("lower", 1.0 * t, True, 0.002, FINE, lambda: self._place(0.001)),
                    "release": lambda: Leg("release", 0.32, False, 0.01, 0.0, lambda: self.reference),
                    "retreat": lambda: Leg("retreat", 0.9 * t, False, 0.008, FINE, lambda: self._retreat(retreat)),
                    "rest": lambda: Leg("rest", 0.4, False, 0.01, 0.0, lambda: self.reference),
                }[name]()
                for name in names
            ]

        plan = []
        if self.fancy():
            plan += legs("look")
        plan += legs("reach")
        if self.fancy():
            plan += legs("descend", "rise")
        if self.fancy():
            plan += legs("descend", "grasp", "lift", "return", "release", "rise")
        plan += legs("descend", "grasp", "lift")
        if self.fancy():
            plan += legs("return", "lift")
        plan += legs("carry")
        if self.fancy():
            plan += legs("lower", "carry")
        if self.fancy():
            plan += legs("lower", "release", "retreat", "reach", "descend", "grasp", "lift", "carry")
        plan += legs("lower", "release", "retreat", "rest")
        return plan

    def look(self, leg: Leg, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> None:
        """The eyes stay on the objects: before the grasp on the block, afterwards on how it lies in the gripper."""
        if leg.name == "reach" and valid[BLOCK]:
            self.objects[BLOCK] = objects[BLOCK]
            self.retarget()
        if leg.name in ("grasp", "lift", "return") and valid[BLOCK]:
            p_G, R_G = as_pose(self.arm.tip(q))
            self.p_GO = R_G.inv().apply(objects[BLOCK, :3] - p_G)

    def finished(self, leg: Leg) -> None:
        if leg.name == "grasp":
            self.memory["held"] = self.reference
