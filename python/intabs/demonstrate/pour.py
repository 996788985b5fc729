"""Takes the cup by its handle, pours into the bowl, turns it upright, sets it down where it stood.

The cup turns about a level axis through itself, above and beside the bowl; the wrist follows by inverse kinematics.

Changes of mind: it may look at the bowl first, rise again before grasping, set the lifted cup down again, or tilt a
little, turn back and tilt anew.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.demonstrate.base import BOWL, CUP, FINE, LID, SLOW, SPOON, Demonstrator, Leg, Placement, as_pose, gripper

HANDLE = np.array([-0.050, 0.0, 0.048])  # where the tip holds it, in the cup's frame [m]
PIVOT = np.array([0.0, 0.0, 0.036])  # of the turn, in the cup's frame [m]
RIM = 0.052  # of the bowl, above the table [m]
UP = np.array([0.0, 0.0, 1.0])


def level(R: Rotation) -> Rotation:
    """The yaw alone."""
    return Rotation.from_euler("z", np.arctan2(*R.as_matrix()[[1, 0], 0]))


class Pour(Demonstrator):
    needs = (CUP, BOWL)

    def _tip(self, cup: Placement) -> Placement:
        """Where the tip is when the cup is there."""
        p_CG, R_CG = self.grip
        p, R = cup
        return p + R.apply(p_CG), R * R_CG

    def _standing(self, height: float = 0.0) -> Placement:
        p, R = as_pose(self.objects[CUP])
        return p + [0, 0, height], level(R)

    def _over_bowl(self, tilt: float, height: float = 0.0) -> Placement:
        """The cup beside and above the bowl, tilted towards it."""
        p_bowl, _ = as_pose(self.objects[BOWL])
        _, R_cup = self.pouring
        aside = R_cup.apply([0, -self.side, 0])  # from the bowl's axis to the cup's
        pivot = p_bowl + self.aside * aside + [0, 0, RIM + self.above + height]
        R = Rotation.from_rotvec(-self.side * tilt * R_cup.apply([1, 0, 0])) * R_cup
        return pivot - R.apply(PIVOT), R

    def plan(self, q: np.ndarray) -> list[Leg]:
        rng = self.rng
        grasp_x, grasp_z = rng.uniform(-0.002, 0.002), rng.uniform(-0.003, 0.003)
        before = rng.uniform(0.038, 0.048)
        lift = rng.uniform(0.05, 0.07)
        self.above = rng.uniform(0.044, 0.050)
        self.aside = rng.uniform(0.021, 0.025)
        angle = np.radians(rng.uniform(122, 130))
        sip = rng.uniform(0.2, 0.35)
        pour_time = rng.uniform(2.8, 3.4)
        shake = rng.uniform(0.3, 0.7)
        turn = rng.uniform(-0.1, 0.1)
        arch = np.append(rng.normal(0, 0.005, 2), rng.uniform(0, 0.01))
        retreat = rng.uniform(0.036, 0.046)
        clear = rng.uniform(0.06, 0.09)
        t = self.tempo
        shown = [self.fancy() for _ in range(4)]
        p_cup, R_cup = self._standing()
        p_bowl, _ = as_pose(self.objects[BOWL])
        # Which side of the cup the bowl is on, seen along its handle: +1 where its y axis points.
        self.side = 1.0 if level(R_cup).inv().apply(p_bowl - p_cup)[1] > 0 else -1.0

        def legs(choice: tuple[float, float, bool], plain: bool) -> list[Leg]:
            looks, again, down, back = (s and not plain for s in shown)
            # Of the gripper below the horizontal; of the cup from facing the robot, when it pours; how it comes.
            slope, yaw, from_above = choice
            approach = np.array([np.cos(slope), 0, -np.sin(slope)])
            R_CG = gripper(approach, [0, 1, 0])
            self.grip = HANDLE + [grasp_x, 0, grasp_z], R_CG
            radial = np.arctan2(p_bowl[1], p_bowl[0])
            self.pouring = None, Rotation.from_euler("z", radial + yaw + turn)

            def before_handle() -> Placement:
                p, R = self._tip(self._standing())
                return p + (before * UP if from_above else -before * R.apply([0, 0, 1])), R

            def aback() -> Placement:
                p, R = self.reference
                return p + (retreat * UP if from_above else -retreat * R.apply([0, 0, 1])), R

            def raised() -> Placement:
                p, R = self.reference
                return p + [0, 0, clear], R

            def over_bowl() -> Placement:
                return self._tip(self._over_bowl(0.0, 0.05))

            def tilt(name: str, begin: float, end: float, duration: float) -> Leg:
                def path(s: float, _from: Placement) -> Placement:
                    return self._tip(self._over_bowl(begin + s * (end - begin)))

                return Leg(name, duration * t, True, 0.004, 0.0015, lambda: self._tip(self._over_bowl(end)), path=path)

            def still(name: str, duration: float, closed: bool) -> Leg:
                return Leg(name, duration, closed, 0.01, 0.0, lambda: self.reference)

            reach = Leg("reach", 1.8 * t, False, 0.006, SLOW, before_handle, joints=True)
            approach_leg = Leg("descend", 1.0 * t, False, 0.0015, 0.002, lambda: self._tip(self._standing()))
            rise = Leg("rise", 0.7 * t, False, 0.006, FINE, before_handle)
            lifted = Leg("lift", 1.0 * t, True, 0.006, FINE, lambda: self._tip(self._standing(lift)))
            lower = Leg("lower", 1.1 * t, True, 0.0015, 0.002, lambda: self._tip(self._standing(0.0005)))
            carry = Leg("carry", 1.8 * t, True, 0.004, FINE, lambda: self._tip(self._over_bowl(0.0)), arch)
            plan = [Leg("look", 1.6 * t, False, 0.008, SLOW, over_bowl)] if looks else []
            plan += [reach, approach_leg, rise] if again else [reach]
            plan += [approach_leg, still("grasp", 0.4, True), lifted]
            plan += [lower, lifted] if down else []
            plan += [carry]
            if back:
                plan += [tilt("tilt", 0, sip * angle, 1.2), tilt("return", sip * angle, 0, 1.1)]
            plan += [tilt("tilt", 0, angle, pour_time), still("pour", shake, True)]
            plan += [tilt("return", angle, 0, 2.2)]
            plan += [Leg("carry", 1.8 * t, True, 0.006, FINE, lambda: self._tip(self._standing(lift)), arch)]
            plan += [lower, still("release", 0.36, False)]
            plan += [Leg("retreat", 1.0 * t, False, 0.008, FINE, aback)]
            plan += [Leg("retreat", 0.9 * t, False, 0.008, FINE, raised), still("rest", 0.4, False)]
            return plan

        yaws = [self.side * y for y in (-0.8, -0.4, 0.8, 0.4, 0.0)]
        if self.seen[LID] or self.seen[SPOON]:  # box or rack on the left of the bowl: the arm comes from the right
            yaws = [0.8, 0.4, 0.6, 0.0]
        ways = [(np.radians(s), y, c) for c in (False, True) for s in (15, 25, 8, 35, 50) for y in yaws]
        return self.choose(q, ways, legs)

    def look(self, leg: Leg, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> None:
        if leg.name == "reach" and valid[CUP]:
            self.objects[CUP] = objects[CUP]
            self.retarget()
