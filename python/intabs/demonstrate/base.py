"""What the scripted demonstrators share: movements of the tip, one leg after another, with a person's unevenness.

A demonstrator sees what perception sees (OBJECT_POSES, LITE6_STATUS) and says where the arm shall be, 25 Hz. Like a
person it varies speed, way-points and grasp, pauses, is disturbed and corrects, and changes its mind. Without the last,
the state alone would tell what comes next, and skills would have nothing to say. Nothing of it is in the learned
policy's path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from intabs import _core

TICK_S = 0.04
SLOW, FINE = 0.006, 0.003  # m, disturbances while moving freely, and close to things
ENOUGH = 0.25  # of Demonstrator.rehearse
DAMPING = 0.05  # of least squares near singularities
ROOM = 0.003  # m, more than the command filter demands
FASTEST = 1.2  # rad/s, a joint; the command filter allows 2.14

# Slots of OBJECT_POSES; they mean the same in every task.
BLOCK = CUP = 0
GOAL = BOWL = 1
SPOON = 2
DRAWER = LID = 3

Placement = tuple[np.ndarray, Rotation]  # p_WG [m], R_WG: where the tip is


class CannotReach(Exception):
    """The demonstrator finds no joint angles for where it wants to be."""


@dataclass
class Intent:
    """What the demonstrator does at one tick."""

    q_target: np.ndarray  # (6,) rad: what is sent
    q_meant: np.ndarray  # (6,) rad: the same without the disturbance
    gripper_closed: bool
    action: np.ndarray  # (7,) what was meant: step of the target without the disturbance, gripper +-1
    done: bool = False


@dataclass
class Leg:
    """One movement of the tip: where to, how long, what the gripper does, how still it must be before the next."""

    name: str
    duration: float  # s
    closed: bool
    tolerance: float  # m
    kick: float  # m, size of disturbances
    goal: Callable[[], Placement]  # asked when the leg begins
    arch: np.ndarray | None = None  # m, detour in the middle
    # Where the tip is at the share s of the way, from where it began; None: straight, turning evenly.
    path: Callable[[float, Placement], Placement] | None = None
    joints: bool = False  # straight in the joints instead: turns the wrist over where the tip could not go straight


def minimum_jerk(x: float) -> float:
    """Flash and Hogan 1985."""
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x)


def as_pose(pose7: np.ndarray) -> Placement:
    return np.array(pose7[:3]), Rotation.from_quat(np.roll(pose7[3:], -1))


def as_array(placement: Placement) -> np.ndarray:
    p, R = placement
    x, y, z, w = R.as_quat()
    return np.concatenate([p, [w, x, y, z]])


def gripper(approach: np.ndarray, closing: np.ndarray) -> Rotation:
    """R_WG of a gripper whose fingers point along `approach` and close along `closing` (made square to it)."""
    z = np.asarray(approach, float) / np.linalg.norm(approach)
    y = np.asarray(closing, float) - z * (z @ closing)
    y /= np.linalg.norm(y)
    return Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z]))


class Demonstrator:
    """ik: intabs._core.IkSolver; arm: intabs._core.ArmModel; rng: numpy Generator, the whole source of variation."""

    needs: tuple[int, ...] = ()  # slots that must be valid before it starts

    def __init__(self, arm, ik, rng: np.random.Generator, disturb: float = 1.0, detours: float = 0.0):
        """disturb scales the disturbances, detours is the probability of each change of mind."""
        self.arm, self.ik, self.rng = arm, ik, rng
        self.disturb, self.detours = disturb, detours
        self.tempo = rng.uniform(0.85, 1.2)
        self.legs: list[Leg] | None = None
        self.leg = 0
        self.elapsed = 0.0
        self.pause = 0.0
        self.offset = np.zeros(3)  # of the tip from its reference [m]
        self.twist = 0.0  # about the vertical [rad]
        self.correction = rng.uniform(0.14, 0.25)  # share of the offset taken back a tick
        self.objects = None  # (S, 7) as last looked at
        self.seen = None  # (S,) which of them were there at the start
        self.memory: dict[str, Placement] = {}  # places to come back to

    # --- for the tasks ------------------------------------------------------------------------------------------
    def plan(self, q: np.ndarray) -> list[Leg]:
        """The legs, with all that is drawn once. self.objects and self.reference are there."""
        raise NotImplementedError

    def look(self, leg: Leg, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> None:
        """At every tick, before it moves: what it sees on the way."""

    def finished(self, leg: Leg) -> None:
        """A leg has ended."""

    def fancy(self) -> bool:
        """Whether it changes its mind here."""
        return self.rng.random() < self.detours

    def nearer_first(self, closing: np.ndarray) -> tuple[float, float]:
        """The two ways round to close the fingers along `closing`, as signs: first that which turns the wrist less."""
        ahead = self.reference[1].apply([0, 1, 0]) @ closing >= 0
        return (1.0, -1.0) if ahead else (-1.0, 1.0)

    def rehearse(self, legs: list[Leg], q: np.ndarray) -> float:
        """Goes through the legs in the mind, from q (6,), and gives each the time its fastest joint needs. Returns the
        least arm_score on the way (a centimetre to the arm's own body counts like .25), -1 if some place cannot be
        reached or the arm would touch itself or the table there."""
        reference, objects, held = self.reference, self.objects.copy(), dict(self.memory)
        worst = np.inf
        for leg in legs:
            begin = self.reference
            end = leg.goal()
            slerp = Slerp([0, 1], Rotation.concatenate([begin[1], end[1]]))
            n = 16 if leg.path is None else 32
            q_begin = q
            for k in range(1, n + 1):
                s = k / n
                if leg.joints:
                    if k == 1:
                        found = self.ik.solve(as_array(end), q)
                    q_next = q_begin + s * (np.array(found.q) - q_begin)
                    where = end
                else:
                    where = leg.path(s, begin) if leg.path else ((1 - s) * begin[0] + s * end[0], slerp(s))
                    found = self.ik.solve(as_array(where), q)
                    q_next = np.array(found.q)
                itself, table, _ = _core.arm_clearance(q_next)
                if not found.ok or min(itself, table) < ROOM:
                    worst = -1.0
                    break
                # Least jerk goes 1.875 times as fast in the middle as on the average.
                leg.duration = max(leg.duration, 1.875 * n * np.abs(q_next - q).max() / FASTEST)
                worst = min(worst, found.score, 25 * itself)
                q = q_next
            if worst < 0:
                break
            self.reference = where
            self.finished(leg)
        self.reference, self.objects, self.memory = reference, objects, held
        return worst

    def choose(
        self, q: np.ndarray, candidates: Sequence, legs: Callable[[object, bool], list[Leg]], enough: float = 0.25
    ):
        """legs(candidate, plain) of the first candidate that goes well enough, else of the one that goes best; plain,
        without changes of mind, if it goes with none otherwise. Raises CannotReach."""
        for plain in (False, True):
            best, best_score = None, 0.0
            for candidate in candidates:
                score = self.rehearse(legs(candidate, plain), q)
                if score > best_score:
                    best, best_score = candidate, score
                if score >= ENOUGH:
                    break
            if best is not None:
                plan = legs(best, plain)
                self.rehearse(plan, q)
                return plan
        raise CannotReach("the demonstrator finds no way through the task")

    def retarget(self) -> None:
        """The goal of the running leg has moved."""
        leg = self.legs[self.leg]
        self.leg_to = leg.goal()
        if leg.joints:
            self.q_goal = self._solve(self.leg_to, self.q_goal)
        self.leg_slerp = Slerp([0, 1], Rotation.concatenate([self.leg_from[1], self.leg_to[1]]))

    # --- one tick -----------------------------------------------------------------------------------------------
    def step(self, q: np.ndarray, objects: np.ndarray, valid: np.ndarray) -> Intent | None:
        """q (6,) measured; objects (S, 7) xyz wxyz in W; valid (S,). None while it can't start (objects not seen).
        Raises CannotReach."""
        if self.legs is None:
            if not all(valid[i] for i in self.needs):
                return None
            self.objects, self.seen = objects.copy(), valid.copy()
            self.reference = as_pose(self.arm.tip(q))
            self.q_target = np.array(q)
            self.legs = self.plan(q)
            self._begin_leg()
        leg = self.legs[self.leg]
        self.look(leg, q, objects, valid)

        if self.pause > 0 and leg.kick > 0:
            self.pause -= TICK_S
        else:
            self.elapsed += TICK_S
        reference = self._reference_at(self.elapsed)
        meant_offset = (1 - self.correction) * self.offset
        meant_twist = (1 - self.correction) * self.twist
        try:
            q_meant = self._joints(reference, meant_offset, meant_twist)
        except CannotReach:  # at the edge of its reach it gives way to the disturbance at once
            meant_offset, meant_twist = np.zeros(3), 0.0
            q_meant = self._joints(reference, meant_offset, meant_twist)

        kick = np.zeros(3)
        kick_twist = 0.0
        if leg.kick > 0 and self.disturb > 0 and self.rng.random() < 0.07:
            kick = self.rng.normal(0, self.disturb * leg.kick, 3) * [1, 1, 0.6]
            kick_twist = self.rng.normal(0, self.disturb * 5 * leg.kick)
        q_sent = q_meant
        if kick.any():
            try:
                q_sent = self._joints(reference, meant_offset + kick, meant_twist + kick_twist)
            except CannotReach:
                kick, kick_twist = np.zeros(3), 0.0

        action = np.append(q_meant - self.q_target, 1.0 if leg.closed else -1.0)
        self.q_target = q_sent
        self.offset, self.twist = meant_offset + kick, meant_twist + kick_twist
        self.reference = reference

        done = False
        if self.elapsed >= leg.duration and np.linalg.norm(self.offset) <= leg.tolerance:
            self.finished(leg)
            if self.leg + 1 < len(self.legs):
                self.leg += 1
                self._begin_leg()
            else:
                done = True
        return Intent(q_sent, q_meant, leg.closed, action, done)

    def _begin_leg(self) -> None:
        self.elapsed = 0.0
        self.leg_from = self.reference
        self.q_from = self.q_goal = self.q_target
        self.retarget()
        if self.rng.random() < 0.12:
            self.pause = self.rng.uniform(0.08, 0.3)

    def _reference_at(self, elapsed: float) -> Placement:
        leg = self.legs[self.leg]
        x = elapsed / leg.duration
        s = minimum_jerk(x)
        if leg.joints:
            self.q_reference = self.q_from + s * (self.q_goal - self.q_from)
            return as_pose(self.arm.tip(self.q_reference))
        if leg.path is not None:
            return leg.path(s, self.leg_from)
        p = (1 - s) * self.leg_from[0] + s * self.leg_to[0]
        if leg.arch is not None and x < 1:
            p = p + leg.arch * np.sin(np.pi * s) ** 2
        return p, self.leg_slerp(s)

    def _joints(self, reference: Placement, offset: np.ndarray, twist: float) -> np.ndarray:
        if self.legs[self.leg].joints:  # on the way over the wrist's singularity there is no telling by the tip
            J = self.arm.jacobian(self.q_reference)
            step = np.concatenate([offset, [0, 0, twist]])
            return self.q_reference + J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), step)
        p, R = reference
        return self._solve((p + offset, Rotation.from_euler("z", twist) * R), self.q_target)

    def _solve(self, tip: Placement, q_seed: np.ndarray) -> np.ndarray:
        pose = as_array(tip)
        result = self.ik.solve(pose, q_seed)
        if not result.ok:
            raise CannotReach(f"the demonstrator cannot reach {np.round(pose[:3], 3).tolist()}: {result.why}")
        return np.array(result.q)
