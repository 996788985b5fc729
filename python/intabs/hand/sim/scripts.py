"""What the simulated hand does: kinematic scripts, in W (the table's top is z = 0, the person sits at the origin and
looks along x). Objects follow the hand that holds them; there is no physics.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.hand.sim import skeleton

PERIOD = 0.04  # s, one frame
SLOTS = 4
REST = np.array([0.13, -0.10, 0.16])
PINCH, GRASP, OPEN = 0.75, 0.60, 0.25  # closures

# Nominal places as in the plant: azimuth [rad], radius, height [m] about the origin, turn [rad]; slot.
PLACES = {
    "block": (0, -0.262, 0.28, 0.022, 0.0),
    "cup": (0, -0.21, 0.43, 0.0, 0.0),
    "goal": (1, 0.27, 0.30, 0.0, 0.0),
    "bowl": (1, 0.28, 0.38, 0.0, 0.0),
    "spoon": (2, 0.698, 0.25, 0.107, 0.0),
    "drawer": (3, -0.785, 0.40, 0.063, 0.0),
    "lid": (3, 0.785, 0.43, 0.076, 0.0),
}
FIXED_YAW = ("drawer", "lid", "spoon")  # less turned: furniture
OBJECTS = {
    "pick_place": ("block", "goal"),
    "drawer_open": ("drawer",),
    "box_open": ("lid",),
    "pour": ("cup", "bowl"),
    "stir": ("bowl", "spoon"),
}
TASKS = tuple(OBJECTS)
COMPOSITIONS = ("drawer_open+pick_place", "pour+stir", "box_open+pour")

# What the depth camera sees of an object: boxes (half sizes, place in O).
SHAPES = {
    "block": [((0.022, 0.022, 0.022), (0, 0, 0)), ((0.012, 0.005, 0.016), (0, 0, 0.038))],
    "goal": [],
    "cup": [((0.027, 0.027, 0.033), (0, 0, 0.033))],
    "bowl": [((0.038, 0.038, 0.026), (0, 0, 0.026))],
    "spoon": [((0.012, 0.005, 0.017), (0, 0, 0)), ((0.003, 0.003, 0.033), (0, 0, -0.05))],
    "drawer": [((0.004, 0.014, 0.021), (0, 0, 0)), ((0.003, 0.048, 0.030), (0.04, 0, -0.03)),
               ((0.062, 0.043, 0.015), (0.105, 0, -0.045))],
    "lid": [((0.040, 0.053, 0.003), (-0.04, 0, 0.003)), ((0.014, 0.014, 0.004), (-0.094, 0, 0.001))],
}  # fmt: skip
FURNITURE = {  # about the object's own place at the start
    "drawer": ((0.075, 0.050, 0.035), (0.118, 0, -0.028)),
    "lid": ((0.040, 0.053, 0.036), (-0.04, 0, -0.040)),
}


@dataclass
class Pose:
    p: np.ndarray
    R: Rotation

    def __mul__(self, other: Pose) -> Pose:
        return Pose(self.p + self.R.apply(other.p), self.R * other.R)

    def inverse(self) -> Pose:
        inv = self.R.inv()
        return Pose(-inv.apply(self.p), inv)

    def array(self) -> np.ndarray:
        x, y, z, w = self.R.as_quat()
        return np.array([*self.p, w, x, y, z])


@dataclass
class Performance:
    """One run, by frame."""

    task: str
    names: list[str]  # by slot, "" unused
    scale: float  # of the hand
    wrist: list[Pose] = field(default_factory=list)
    closure: list[float] = field(default_factory=list)
    objects: list[dict[str, Pose]] = field(default_factory=list)
    held: list[str] = field(default_factory=list)  # what the hand touches, ""
    start: dict[str, Pose] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.closure)

    def joints(self) -> np.ndarray:
        """(T, 21, 3) in W."""
        p = skeleton.joints(np.array(self.closure), self.scale)
        return np.stack([X.p + X.R.apply(q) for X, q in zip(self.wrist, p, strict=True)])

    def object_pose(self, name: str) -> np.ndarray:
        """(T, 7)"""
        return np.stack([o[name].array() for o in self.objects])


def yaw(a: float) -> Rotation:
    return Rotation.from_euler("z", a)


# Hand orientations at azimuth 0: fingers forward and down; fingers forward, thumb up and to the side.
DOWN = Rotation.from_euler("y", 0.75)
SIDE = Rotation.from_euler("x", 0.85) * Rotation.from_euler("y", 0.25)


class Hand:
    """Writes a Performance by moving its grip point."""

    def __init__(self, task: str, seed: int, spread: float):
        self.rng = np.random.default_rng([seed, 11])
        parts = task.split("+")
        present = [n for part in parts for n in OBJECTS[part]]
        names = [next((n for n in present if PLACES[n][0] == slot), "") for slot in range(SLOTS)]
        self.run = Performance(task, names, float(np.clip(self.rng.normal(1, 0.06), 0.85, 1.15)))
        self.place(dict.fromkeys(n for n in present), spread)
        self.X = Pose(REST + self.rng.normal(0, 0.01, 3), yaw(self.rng.normal(0, 0.1)) * DOWN)  # of the grip point
        self.closure = OPEN
        self.pace = float(np.exp(self.rng.normal(0, 0.15)))
        self.tremor = np.zeros(3)

    def place(self, names, spread: float) -> None:
        for name in names:
            _, azimuth, radius, height, turn = PLACES[name]
            at = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
            for _ in range(100):
                r, a = spread / 100 * np.sqrt(self.rng.random()), self.rng.uniform(0, 2 * np.pi)
                p = at + [r * np.cos(a), r * np.sin(a), 0]
                if all(np.linalg.norm((p - X.p)[:2]) > 0.10 for X in self.run.start.values()):
                    break
            most = np.radians(min(3 * spread, 30)) * (0.5 if name in FIXED_YAW else 1)
            self.run.start[name] = Pose(p, yaw(azimuth + turn + self.rng.uniform(-most, most)))
        self.objects = dict(self.run.start)

    # --- movements

    def frame(self, held: str) -> None:
        self.tremor = 0.8 * self.tremor + self.rng.normal(0, 2e-4, 3)
        grip = skeleton.grip_point(self.closure, self.run.scale)
        self.run.wrist.append(Pose(self.X.p + self.tremor - self.X.R.apply(grip), self.X.R))
        self.run.closure.append(self.closure)
        self.run.objects.append(dict(self.objects))
        self.run.held.append(held)

    def along(self, path, seconds: float, held: str = "", closure: float | None = None) -> None:
        """path(s), s from 0 to 1 with minimum jerk -> pose of the grip point; it may move objects."""
        n = max(2, round(seconds * self.pace * float(np.exp(self.rng.normal(0, 0.08))) / PERIOD))
        first = self.closure
        for k in range(1, n + 1):
            x = k / n
            s = x**3 * (10 - 15 * x + 6 * x * x)
            self.X = path(s)
            if closure is not None:
                self.closure = first + (closure - first) * s
            self.frame(held)

    def go(self, p, R=None, seconds=0.8, hold="", closure=None, bump=0.0) -> None:
        """In a line (with a bump upwards) to a place of the grip point; what it holds comes along."""
        start, R = self.X, self.X.R if R is None else R
        turn = (start.R.inv() * R).as_rotvec()
        carried = start.inverse() * self.objects[hold] if hold else None

        def path(s: float) -> Pose:
            up = np.array([0, 0, bump * np.sin(np.pi * s) ** 2])
            X = Pose(start.p + s * (np.asarray(p) - start.p) + up, start.R * Rotation.from_rotvec(s * turn))
            if hold:
                self.objects[hold] = X * carried
            return X

        self.along(path, seconds, hold, closure)

    def reach(self, p, R, closure=OPEN, seconds=0.9) -> None:
        """Towards a place, sometimes a little wrong at first, sometimes with a stop."""
        p = np.asarray(p, "f8")
        above = p + [0, 0, 0.05]
        self.go(above + self.rng.normal(0, 0.006, 3), R, seconds, closure=closure, bump=0.02)
        if self.rng.random() < 0.25:
            self.pause()
        if self.rng.random() < 0.35:
            self.go(p + self.rng.normal(0, 0.010, 3) + [0, 0, 0.01], R, 0.45)
            self.go(p, R, 0.3)
        else:
            self.go(p, R, 0.5)

    def grasp(self, name: str, closure: float) -> None:
        self.go(self.X.p, seconds=0.3, closure=closure)
        self.pause(0.1, held=name)

    def release(self) -> None:
        self.go(self.X.p, seconds=0.3, closure=OPEN)
        self.pause(0.2)

    def pause(self, seconds: float = 0.3, held: str = "") -> None:
        for _ in range(max(1, round(seconds * self.rng.uniform(0.5, 1.5) / PERIOD))):
            self.frame(held)

    def retreat(self) -> None:
        self.go(self.X.p + [-0.03, 0, 0.07], seconds=0.5)

    def rest(self) -> None:
        self.go(REST + self.rng.normal(0, 0.015, 3), yaw(0) * DOWN, 0.9)
        self.pause(0.3)

    def offset(self, size: float = 0.004) -> np.ndarray:
        return self.rng.normal(0, size, 3)

    def facing(self, X: Pose, R: Rotation) -> Rotation:
        """R turned to the object's azimuth, with some freedom."""
        return yaw(np.arctan2(X.p[1], X.p[0]) * 0.7 + self.rng.normal(0, 0.1)) * R

    # --- tasks

    def pick_place(self) -> None:
        block, goal = self.objects["block"], self.objects["goal"]
        self.reach(block.p + [0, 0, 0.035] + self.offset(), self.facing(block, DOWN))
        self.grasp("block", PINCH)
        self.go(self.X.p + [0, 0, self.rng.uniform(0.06, 0.11)], seconds=0.6, hold="block")
        over = goal.p + [0, 0, 0.022] + self.X.p - self.objects["block"].p
        target = over + np.append(self.rng.normal(0, 0.004, 2), 0)
        self.go(target + [0, 0, 0.07], self.facing(goal, DOWN), 0.9, hold="block", bump=0.02)
        target = self.X.p + goal.p + [0, 0, 0.022] - self.objects["block"].p + self.offset(0.003) * [1, 1, 0]
        self.go(target, seconds=0.7, hold="block")
        self.release()
        self.retreat()

    def drawer_open(self) -> None:
        drawer = self.objects["drawer"]
        self.reach(drawer.p + self.offset(), self.facing(drawer, DOWN))
        self.grasp("drawer", PINCH)
        out = drawer.R.apply([-1, 0, 0])
        length, start = self.rng.uniform(0.09, 0.125), self.X

        def pull(s: float) -> Pose:
            self.objects["drawer"] = Pose(drawer.p + s * length * out, drawer.R)
            return Pose(start.p + s * length * out, start.R)

        self.along(pull, 1.2, "drawer")
        self.release()
        self.retreat()

    def box_open(self) -> None:
        lid = self.objects["lid"]
        tab = np.array([-0.094, 0, 0.001])
        self.reach(lid.p + lid.R.apply(tab) + self.offset(), self.facing(lid, DOWN))
        self.grasp("lid", PINCH)
        angle, start = self.rng.uniform(np.radians(70), np.radians(95)), self.X

        def turn(s: float) -> Pose:
            R = lid.R * Rotation.from_euler("y", s * angle)
            self.objects["lid"] = Pose(lid.p, R)
            half = lid.R * Rotation.from_euler("y", 0.5 * s * angle) * lid.R.inv()
            return Pose(start.p + R.apply(tab) - lid.R.apply(tab), half * start.R)

        self.along(turn, 1.5, "lid")
        self.release()
        self.retreat()

    def pour(self) -> None:
        cup, bowl = self.objects["cup"], self.objects["bowl"]
        self.reach(cup.p + [0, 0, 0.062] + self.offset(), self.facing(cup, SIDE))
        self.grasp("cup", GRASP)
        home = self.X
        self.go(self.X.p + [0, 0, self.rng.uniform(0.08, 0.11)], seconds=0.6, hold="cup")
        # Beside the bowl, on the side where the cup comes from; it tips over its lip into the bowl.
        beside = np.array([bowl.p[0], bowl.p[1] - 0.075, 0.13]) + self.offset(0.005)
        self.go(beside, None, 0.9, hold="cup", bump=0.02)
        tip = Rotation.from_euler("x", -self.rng.uniform(np.radians(105), np.radians(130)))
        # The lip ends over the bowl's middle, 4 to 5 cm above its rim.
        carried = self.X.inverse() * self.objects["cup"]
        R = tip * self.X.R
        lip = bowl.p + [0, -0.01, self.rng.uniform(0.09, 0.10)] + self.offset(0.005)
        self.go(lip - R.apply(carried.p + carried.R.apply([0, 0, 0.066])), R, 1.6, hold="cup")
        for _ in range(self.rng.integers(1, 4)):  # shakes the last ones out
            self.go(self.X.p + [0, 0, 0.012], seconds=0.2, hold="cup")
            self.go(self.X.p - [0, 0, 0.012], seconds=0.2, hold="cup")
        self.pause(0.3, held="cup")
        self.go(beside, tip.inv() * self.X.R, 1.0, hold="cup")
        self.go(home.p + [0, 0, 0.06], home.R, 0.9, hold="cup", bump=0.02)
        self.go(home.p, home.R, 0.5, hold="cup")
        self.release()
        self.retreat()

    def stir(self) -> None:
        bowl, spoon = self.objects["bowl"], self.objects["spoon"]
        self.reach(spoon.p + self.offset(0.002), self.facing(spoon, DOWN))
        self.grasp("spoon", PINCH)
        home = self.X
        self.go(self.X.p + [0, 0, 0.10], seconds=0.6, hold="spoon")
        over = bowl.p + [0, 0, 0.107] + self.X.p - self.objects["spoon"].p
        self.go(over + [0, 0, 0.08], seconds=0.9, hold="spoon", bump=0.01)
        radius, turns = self.rng.uniform(0.014, 0.020), self.rng.uniform(2.2, 4.0)
        centre, phase = over + np.append(self.offset(0.002)[:2], 0), self.rng.uniform(0, 2 * np.pi)

        def at(angle: float) -> np.ndarray:
            return centre + radius * np.array([np.cos(phase + angle), np.sin(phase + angle), 0])

        self.go(at(0), seconds=0.7, hold="spoon")
        R, carried = self.X.R, self.X.inverse() * self.objects["spoon"]
        way = self.rng.choice([-1, 1]) * 2 * np.pi * turns

        def around(s: float) -> Pose:
            X = Pose(at(s * way), R)
            self.objects["spoon"] = X * carried
            return X

        self.along(around, 0.9 * turns, "spoon")
        self.go(self.X.p + [0, 0, 0.09], seconds=0.6, hold="spoon")
        self.go(home.p + [0, 0, 0.08], home.R, 0.9, hold="spoon")
        self.go(home.p, home.R, 0.6, hold="spoon")
        self.release()
        self.retreat()


def perform(task: str, seed: int, spread: float) -> Performance:
    """spread in cm, as in the plant."""
    hand = Hand(task, seed, spread)
    hand.pause(0.3)
    for part in task.split("+"):
        getattr(hand, part)()
    hand.rest()
    return hand.run


def done(run: Performance) -> bool:
    """Success by the definitions of the tasks, measured on what the objects did."""
    return all(_done(run, part) for part in run.task.split("+"))


def _done(run: Performance, part: str) -> bool:
    last = run.objects[-1]
    if part == "pick_place":
        return run.held[-1] == "" and bool(np.linalg.norm((last["block"].p - last["goal"].p)[:2]) < 0.02)
    if part == "drawer_open":
        return bool(np.linalg.norm(last["drawer"].p - run.start["drawer"].p) >= 0.08)
    if part == "box_open":
        return bool((run.start["lid"].R.inv() * last["lid"].R).magnitude() >= np.radians(60))
    if part == "pour":  # nothing can flow here: a cup tipped over the bowl for a second has poured
        poured = 0
        for o in run.objects:
            up = o["cup"].R.apply([0, 0, 1])[2]
            lip = o["cup"].p + o["cup"].R.apply([0, 0, 0.066])
            poured += up < -0.2 and np.linalg.norm((lip - o["bowl"].p)[:2]) < 0.06
        return poured * PERIOD >= 0.8 and last["cup"].R.apply([0, 0, 1])[2] > 0.95
    turned, before = 0.0, None
    for o in run.objects:
        tip = o["spoon"].p + o["spoon"].R.apply([0, 0, -0.086]) - o["bowl"].p
        angle = np.arctan2(tip[1], tip[0]) if np.linalg.norm(tip[:2]) < 0.04 and 0 < tip[2] < 0.05 else None
        if angle is not None and before is not None:
            turned += (angle - before + np.pi) % (2 * np.pi) - np.pi
        before = angle
    return abs(turned) >= 4 * np.pi
