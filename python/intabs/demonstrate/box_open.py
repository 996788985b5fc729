"""Opens the box: closed fingers push the lid up from under its tab, along the lid's circle, without turning. (Gripping
the tab and turning with the lid would lead the wrist through its singularity.)

Changes of mind: it may miss the tab, pushing up in front of it, and come again; or open the lid half, draw back, and
push on.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.demonstrate.base import FINE, LID, SLOW, Demonstrator, Leg, Placement, as_pose, gripper

TAB = np.array([-0.094, 0.0, -0.003])  # middle of the tab's under side, in the lid's frame [m]
FINGER_HALF = 0.010  # of the closed fingers, across [m]


class BoxOpen(Demonstrator):
    needs = (LID,)

    def _closed_lid(self) -> Placement:
        """The hinge, as if the lid were closed: x away from the robot, y along the hinge."""
        p, R = as_pose(self.objects[LID])
        x = np.cross(R.apply([0, 1, 0]), [0, 0, 1])  # the hinge is level
        return p, Rotation.from_matrix(np.column_stack([x, np.cross([0, 0, 1], x), [0, 0, 1]]))

    def _under(self, way: tuple[float, float], angle: float, gap: float = 0.0, short: float = 0.0) -> Placement:
        """Tip under the tab when the lid is open by `angle`; `gap` m below it, `short` m nearer to the robot.

        `way`: the fingers point away from the robot, so far [rad] below the horizontal and to the left, and never
        turn. The lid lies on their upper side while it is flat, and on their end when it stands.
        """
        p, R = self._closed_lid()
        slope, yaw = way
        lid = Rotation.from_euler("y", angle)
        flat = np.array([np.cos(slope), 0, -np.sin(slope)])
        # The corner of the fingers that touches is the upper one of the tip.
        corner = FINGER_HALF * np.array([np.sin(slope), 0, np.cos(slope)])
        touch = lid.apply(TAB + [self.reach_in, 0, 0])
        back = -gap * lid.apply([0, 0, 1]) - short * np.array([1, 0, 0])
        to_left = Rotation.from_euler("z", yaw)
        R_WG = gripper(R.apply(to_left.apply(flat)), R.apply(to_left.apply([0, 1, 0])))
        return p + R.apply(touch - to_left.apply(corner) + back + [0, self.aside, 0]), R_WG

    def plan(self, q: np.ndarray) -> list[Leg]:
        rng = self.rng
        self.reach_in = rng.uniform(0.0, 0.006)
        self.aside = rng.uniform(-0.004, 0.004)
        before = rng.uniform(0.05, 0.07)
        gap = rng.uniform(0.008, 0.014)
        part = rng.uniform(0.4, 0.7)
        angle = np.radians(rng.uniform(78, 90))
        retreat = rng.uniform(0.06, 0.09)
        lean = rng.uniform(-0.05, 0.05)
        push_time = rng.uniform(2.2, 3.0)
        t = self.tempo
        missed, halves = self.fancy(), self.fancy()

        def legs(way: tuple[float, float], plain: bool) -> list[Leg]:
            def push(begin: float, end: float) -> Leg:
                def path(s: float, _from: Placement) -> Placement:
                    p, R = self._under(way, begin + s * (end - begin))
                    # From where it is, onto the circle within the first tenth.
                    blend = min(10 * s, 1.0)
                    return (1 - blend) * _from[0] + blend * p, R

                duration = push_time * t * abs(end - begin) / 1.5
                return Leg("push", duration, True, 0.006, 0.002, lambda: self._under(way, end), path=path)

            def before_tab() -> Placement:
                return self._under(way, 0, gap, before)

            def back(distance: float) -> Placement:
                p, R = self.reference
                return p - distance * (np.array([1, 1, 0]) * R.apply([0, 0, 1])), R

            def away() -> Placement:
                p, R = back(0.4 * retreat)
                return p + [0, 0, retreat], R

            close = Leg("close", 0.36, True, 0.01, 0.0, lambda: self.reference)
            reach = Leg("reach", 1.8 * t, True, 0.006, SLOW, before_tab, joints=True)
            under = Leg("under", 0.9 * t, True, 0.002, FINE, lambda: self._under(way, 0, gap))
            plan = [close, reach]
            if missed and not plain:
                near = gap + 0.02

                def short() -> Placement:
                    return self._under(way, 0, gap, 0.034)

                def beside() -> Placement:
                    p, R = short()
                    return p + [0, 0, near], R

                plan += [Leg("under", 0.8 * t, True, 0.004, FINE, short)]
                plan += [Leg("miss", 0.7 * t, True, 0.006, FINE, beside)]
                plan += [Leg("under", 0.6 * t, True, 0.006, FINE, before_tab)]
            plan += [under]
            begin = 0.0
            if halves and not plain:
                begin = part * angle
                plan += [push(0.0, begin)]
                plan += [Leg("back", 0.8 * t, True, 0.006, FINE, lambda: self._under(way, begin, 0.02, 0.02))]
                plan += [Leg("under", 0.8 * t, True, 0.002, FINE, lambda: self._under(way, begin, 0.004))]
            plan += [push(begin, angle)]
            plan += [Leg("back", 0.7 * t, True, 0.008, FINE, lambda: back(0.03))]
            plan += [Leg("retreat", 0.9 * t, True, 0.008, FINE, away)]
            return [*plan, Leg("rest", 0.4, False, 0.01, 0.0, lambda: self.reference)]

        ways = [(np.radians(d) + lean, y) for y in (0.0, -0.35, 0.35) for d in (20, 28, 12, 36, 44)]
        return self.choose(q, ways, legs)

    def look(self, leg: Leg, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> None:
        if leg.name == "reach" and valid[LID]:
            self.objects[LID] = objects[LID]
            self.retarget()
