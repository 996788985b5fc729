"""Pulls the drawer out by its bar, gripper straight down, or leaning back to one that is far away.

Changes of mind: it may look into the cabinet from above first, rise again before grasping, push the half-open drawer
back, or let go half-way and grasp anew.
"""

from __future__ import annotations

import numpy as np

from intabs.demonstrate.base import DRAWER, FINE, SLOW, Demonstrator, Leg, Placement, as_pose, gripper


class DrawerOpen(Demonstrator):
    needs = (DRAWER,)

    def _bar(self, way: tuple[float, float], above: float = 0.0) -> Placement:
        """Tip at the bar, fingers before and behind it. `way`: which finger is before it, and by how much [rad] the
        gripper leans back to reach further."""
        closing, lean = way
        p, R = as_pose(self.objects[DRAWER])
        R_WG = gripper(R.apply([np.sin(lean), 0, -np.cos(lean)]), R.apply([closing, 0, 0]))
        p = p + R.apply([0, self.grasp_y, self.grasp_z]) + [0, 0, above]
        return p, R_WG

    def _pulled(self, distance: float) -> Placement:
        p, R_WG = self.memory["held"]
        return p - distance * as_pose(self.objects[DRAWER])[1].apply([1, 0, 0]), R_WG

    def plan(self, q: np.ndarray) -> list[Leg]:
        rng = self.rng
        hover = rng.uniform(0.05, 0.08)
        self.grasp_y = rng.uniform(-0.006, 0.006)
        self.grasp_z = rng.uniform(-0.004, 0.003)
        part = rng.uniform(0.03, 0.06)
        distance = rng.uniform(0.092, 0.112)
        inside = rng.uniform(0.03, 0.06)
        arch = np.append(rng.normal(0, 0.008, 2), rng.uniform(0, 0.015))
        retreat = rng.uniform(0.05, 0.08)
        slow_pull = rng.uniform(1.0, 1.5)
        t = self.tempo
        shown = [self.fancy() for _ in range(4)]

        def legs(way: tuple[float, float], plain: bool) -> list[Leg]:
            def up(height: float) -> Placement:
                p, R = self.reference
                return p + [0, 0, height], R

            def over_cabinet() -> Placement:
                p, R = self._bar(way, above=hover + 0.03)
                return p + inside * as_pose(self.objects[DRAWER])[1].apply([1, 0, 0]), R

            reach = Leg("reach", 1.5 * t, False, 0.006, SLOW, lambda: self._bar(way, hover), arch * 0.5)
            descend = Leg("descend", 0.9 * t, False, 0.0015, FINE, lambda: self._bar(way))
            rise = Leg("rise", 0.7 * t, False, 0.006, FINE, lambda: self._bar(way, hover))
            grasp = Leg("grasp", 0.4, True, 0.01, 0.0, lambda: self.reference)
            release = Leg("release", 0.32, False, 0.01, 0.0, lambda: self.reference)

            def pull(d: float) -> Leg:
                return Leg("pull", slow_pull * (0.5 + 8 * d) * t, True, 0.006, FINE, lambda: self._pulled(d))

            look, again, back, twice = (s and not plain for s in shown)
            plan = [Leg("look", 1.5 * t, False, 0.008, SLOW, over_cabinet)] if look else []
            plan += [reach, descend, rise] if again else [reach]
            plan += [descend, grasp]
            if back:
                plan += [pull(part), Leg("push", 0.9 * t, True, 0.006, FINE, lambda: self._pulled(0.008))]
            if twice:
                # The second grasp is where the first ended.
                plan += [pull(part), release, Leg("rise", 0.7 * t, False, 0.006, FINE, lambda: up(0.045))]
                plan += [Leg("descend", 0.8 * t, False, 0.0015, FINE, lambda: self._pulled(part)), grasp]
            plan += [pull(distance), release]
            plan += [Leg("retreat", 0.9 * t, False, 0.008, FINE, lambda: up(retreat))]
            return [*plan, Leg("rest", 0.4, False, 0.01, 0.0, lambda: self.reference)]

        closings = self.nearer_first(as_pose(self.objects[DRAWER])[1].apply([1, 0, 0]))
        return self.choose(q, [(c, lean) for lean in (0.0, 0.15, 0.3) for c in closings], legs)

    def look(self, leg: Leg, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> None:
        if leg.name == "reach" and valid[DRAWER]:
            self.objects[DRAWER] = objects[DRAWER]
            self.retarget()

    def finished(self, leg: Leg) -> None:
        if leg.name == "grasp":
            self.memory.setdefault("held", self.reference)
