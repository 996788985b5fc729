"""Takes the spoon out of its rack, stirs in the bowl, lifts the spoon out again and keeps it.

Changes of mind: it may look into the bowl first, rise again before grasping, hang the spoon back and take it anew,
pause in mid-stir, or stir a little the other way first.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.demonstrate.base import BOWL, FINE, SLOW, SPOON, Demonstrator, Leg, Placement, as_pose, gripper

TIP = -0.086  # middle of the spoon's ball below the middle of its grip [m]
DEPTH = 0.015  # where the ball goes round, above the bowl's bottom [m]
RIM = 0.052  # of the bowl [m]
LEAST_TURNS = 2.35


class Stir(Demonstrator):
    needs = (BOWL, SPOON)

    def _grip(self, above: float = 0.0) -> Placement:
        p, R = as_pose(self.objects[SPOON])
        R_WG = gripper([0, 0, -1], R.apply([0, self.closing, 0])) * Rotation.from_euler("z", self.grasp_yaw)
        return p + R.apply([self.grasp_x, 0, self.grasp_z]) + [0, 0, above], R_WG

    def _in_bowl(self, angle: float, radius: float, height: float) -> Placement:
        """Tip of the gripper when the spoon's is at this angle and distance from the bowl's axis, `height` above where
        it goes round; the gripper leans outwards as chosen."""
        p_bowl, _ = as_pose(self.objects[BOWL])
        outward = np.arctan2(p_bowl[1], p_bowl[0])
        axis = Rotation.from_euler("z", outward).apply([0, 1, 0])
        lean = Rotation.from_rotvec(-self.lean * axis)
        _, R_grip = self._grip()
        R = lean * Rotation.from_euler("z", self.turn) * R_grip
        ball = p_bowl + [radius * np.cos(angle), radius * np.sin(angle), DEPTH + height]
        # The ball, seen from the gripper's tip, is where the grasp has put it.
        to_ball = R_grip.inv().apply(np.array([0, 0, TIP - self.grasp_z]))
        return ball - R.apply(to_ball), R

    def plan(self, q: np.ndarray) -> list[Leg]:
        rng = self.rng
        hover = rng.uniform(0.05, 0.07)
        self.grasp_x, self.grasp_z = rng.uniform(-0.003, 0.003), rng.uniform(-0.004, 0.004)
        self.grasp_yaw = rng.uniform(-0.04, 0.04)
        lift = rng.uniform(0.082, 0.092)
        over = rng.uniform(0.052, 0.06)
        radius = rng.uniform(0.020, 0.025)
        turns = LEAST_TURNS + rng.uniform(0.0, 0.5)
        period = rng.uniform(1.5, 2.1)
        way = 1.0 if rng.random() < 0.5 else -1.0
        begin = rng.uniform(-np.pi, np.pi)
        wrong = rng.uniform(0.3, 0.7)
        wait = rng.uniform(0.3, 0.8)
        part = rng.uniform(0.3, 0.7)
        arch = np.append(rng.normal(0, 0.006, 2), rng.uniform(0, 0.006))
        t = self.tempo
        shown = [self.fancy() for _ in range(5)]

        def legs(choice: tuple[float, float, float], plain: bool) -> list[Leg]:
            looks, again, back, pauses, other = (s and not plain for s in shown)
            self.closing, self.lean, self.turn = choice

            def stir(start: float, turn: float) -> Leg:
                def path(s: float, _from: Placement) -> Placement:
                    return self._in_bowl(start + 2 * np.pi * turn * s, radius, 0.0)

                end = start + 2 * np.pi * turn
                duration = max(period * abs(turn) * t, 0.8)
                return Leg("stir", duration, True, 0.006, 0.0015, lambda: self._in_bowl(end, radius, 0.0), path=path)

            def still(name: str, duration: float, closed: bool) -> Leg:
                return Leg(name, duration, closed, 0.01, 0.0, lambda: self.reference)

            def above_bowl() -> Placement:
                return self._in_bowl(begin, 0.8 * radius, over)

            reach = Leg("reach", 1.5 * t, False, 0.006, SLOW, lambda: self._grip(hover), joints=True)
            descend = Leg("descend", 0.9 * t, False, 0.0012, 0.002, self._grip)
            rise = Leg("rise", 0.7 * t, False, 0.006, FINE, lambda: self._grip(hover))
            up = Leg("lift", 1.1 * t, True, 0.004, 0.002, lambda: self._grip(lift))
            hang = Leg("lower", 1.2 * t, True, 0.0012, 0.001, lambda: self._grip(0.0005))
            plan = [Leg("look", 1.5 * t, False, 0.008, SLOW, above_bowl)] if looks else []
            plan += [reach, descend, rise] if again else [reach]
            plan += [descend, still("grasp", 0.4, True), up]
            plan += [hang, still("release", 0.36, False), descend, still("grasp", 0.4, True), up] if back else []
            plan += [Leg("carry", 1.6 * t, True, 0.004, FINE, above_bowl, arch)]
            plan += [Leg("insert", 1.0 * t, True, 0.003, 0.002, lambda: self._in_bowl(begin, radius, 0.0))]
            at = begin
            if other:
                plan += [stir(at, -way * wrong), still("pause", 0.3, True)]
                at -= way * wrong * 2 * np.pi
            whole = turns + (wrong if other else 0.0)
            if pauses:
                plan += [stir(at, way * part * whole), still("pause", wait, True)]
                plan += [stir(at + way * part * whole * 2 * np.pi, way * (1 - part) * whole)]
            else:
                plan += [stir(at, way * whole)]
            end = at + way * whole * 2 * np.pi
            plan += [Leg("withdraw", 1.2 * t, True, 0.006, 0.002, lambda: self._in_bowl(end, 0.3 * radius, over))]
            return [*plan, still("rest", 0.5, True)]

        closings = self.nearer_first(as_pose(self.objects[SPOON])[1].apply([0, 1, 0]))
        choices = [(c, lean, turn) for lean in (0.0, 0.2, 0.4) for turn in (0.0, -0.8) for c in closings]
        return self.choose(q, choices, legs)

    def look(self, leg: Leg, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> None:
        if leg.name == "reach" and valid[SPOON]:
            self.objects[SPOON] = objects[SPOON]
            self.retarget()
