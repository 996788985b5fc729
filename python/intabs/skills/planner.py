"""Plans from the skill library: whole demonstrations, compositions, and what leads to wanted object poses.

A chain is the skills of one demonstration. What it does to the objects is told by its recording, carried over to
where the objects lie now; the best candidates are then played in the head, by pi itself
(cpp/intabs/skills/kinematic_rollout.h).
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intabs import _core
from intabs.errors import UserError
from intabs.skills.library import SLOTS, TURN_LENGTH, Frame, Library, Skill, rotation

AS_GOOD = 0.15  # success in practice that is as good as another
AS_WELL = 0.05  # success in practice by which another does not do better
MOVES = 0.04  # m (a turn counts TURN_LENGTH a radian): an object that comes so far is moved by a chain
CANDIDATES = 64  # verified, at most,
KEPT = 2  # beginnings with all that goes on from them
REMEMBERED = 64  # paths, by each chain
UNPRACTISED = 0.2  # m: what a chain that never did its task in practice counts as farther from the goal
APART = 0.1  # of how differently its recordings began counts likewise
BEGINS = 0.015  # m (a turn counts TURN_LENGTH a radian): an object that came so far in a skill began to move in it
FORGIVEN = 0.01  # m, of how far beside where the recording's came the hand comes to it
HOPELESS = 0.1  # m: what by the recordings ends so much farther from the goal than the best is not tried in the head
BROUGHT_WITHIN = 0.12  # m: an object that ends so near another one was brought to it
CLEAR = 0.07  # m: an object that the arm's line passes so near is in the arm's way,
IN_THE_WAY = 0.1  # m: and that counts as so much farther from the goal; leaving a task out counts more
POURED_WITHIN = 0.16  # m: an object turned so near another one is poured into it
LOOK = 4  # ticks apart, where it is looked whether the command filter would stop the arm,
INTO_MARGIN = 0.015  # m: so far inside its margin it often gets past
DONE = 0.03  # m (a turn counts TURN_LENGTH a radian): a wanted pose is reached


def too_near(q: np.ndarray) -> bool:
    """Whether the arm comes so near to itself or the table on its way (T, 6) that the command filter stops it."""
    return min(min(_core.arm_clearance(x)) for x in q[::LOOK]) < -INTO_MARGIN


@dataclass(frozen=True)
class Goal:
    """A pose an object is to come to; those of a plan in this order."""

    slot: int
    pose: np.ndarray  # (7,) p_WO, q_WO
    position: bool = True  # what counts of it
    turn: bool = True
    # x, y of a vertical axis: turned about it the pose is as good. Into a bowl one pours from any side.
    axis: np.ndarray | None = None

    def missing(self, pose: np.ndarray) -> np.ndarray:
        """How far poses (..., 7) are from it [m]."""
        if self.axis is not None:
            (r, z, lean), (mine, height, leaning) = (self._about(x) for x in (pose, self.pose))
            return np.hypot(r - mine, z - height) + TURN_LENGTH * np.abs(lean - leaning)
        out = np.zeros(pose.shape[:-1])
        if self.position:
            out = out + np.linalg.norm(pose[..., :3] - self.pose[:3], axis=-1)
        if self.turn:
            angle = (rotation(self.pose).inv() * rotation(pose.reshape(-1, 7))).magnitude()
            out = out + TURN_LENGTH * angle.reshape(out.shape)
        return out

    def _about(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance from the axis [m], height [m], angle of its z from the vertical [rad], of poses (..., 7)."""
        up = rotation(pose.reshape(-1, 7)).apply([0, 0, 1])[:, 2].reshape(pose.shape[:-1])
        return np.linalg.norm(pose[..., :2] - self.axis, axis=-1), pose[..., 2], np.arccos(np.clip(up, -1, 1))


@dataclass
class Plan:
    skills: list[Skill]
    about: str
    predicted: np.ndarray | None = None  # (4, 7) object poses at its end, by pi in its head
    missing: float = float("nan")  # m, of the goals in that prediction
    search_s: float = 0.0
    verify_s: float = 0.0
    goals: list[Goal] | None = None  # that it was found for

    def arrays(self) -> tuple[np.ndarray, np.ndarray, list[int]]:
        """As _core.Rollout.run takes it: z (n, 16), shortest and longest duration (n, 2), index in the library."""
        ticks = np.array([[s.min_ticks, s.max_ticks] for s in self.skills])
        return np.stack([s.z for s in self.skills]), ticks, [s.index for s in self.skills]

    def as_messages(self) -> list[dict]:
        return [s.as_plan() for s in self.skills]

    def expected(self, seen: Frame) -> str:
        """Of a plan that was found: what it is, where the objects should end."""
        lines = [f"{self.about}: {len(self.skills)} skills, {0.04 * sum(s.ticks for s in self.skills):.0f} s"]
        for i in np.flatnonzero(seen.known):
            p = ", ".join(f"{100 * v:.1f}" for v in self.predicted[i, :3])
            lines.append(f"  object {i} should end at ({p}) cm")
        times = f"searched {self.search_s:.2f} s, verified {self.verify_s:.2f} s"
        return "\n".join([*lines, f"  {1000 * self.missing:.0f} mm from the goal; {times}"])


def seen_from(observation: dict) -> Frame:
    """Of _core.Session.observe or _core.Rollout.reset."""
    return Frame(
        np.asarray(observation["q"]),
        bool(observation["gripper_closed"]),
        np.asarray(observation["object_pose"]),
        np.asarray(observation["object_valid"]),
    )


def whole(library: Library, task: str, seen: Frame | None, source: str = "") -> Plan:
    """Of the demonstrations that do their task in practice the one whose objects lay as they lie now, most nearly;
    tasks joined by + one after the other. source: only this one."""
    skills: list[Skill] = []
    sources = []
    for one in task.split("+"):
        chains = [c for c in library.of_task(one) if c[0].source == source] if source else as_good(library, one)
        chain = chains[0] if seen is None else min(chains, key=lambda c: _apart(c, seen))
        skills += chain
        sources.append(f"{one}: {chain[0].source}")
    return Plan(skills, ", ".join(sources))


def as_good(library: Library, task: str) -> list[list[Skill]]:
    """Demonstrations of a task that do it in practice about as well as the best one."""
    chains = library.of_task(task)
    best = max(library.rate(c) for c in chains)
    return [c for c in chains if library.rate(c) >= best - AS_GOOD]


def _apart(chain: list[Skill], seen: Frame) -> float:
    """How differently the objects of a chain lay as it began, and the arm stood (TURN_LENGTH a radian) [m]."""
    first = chain[0].frames[0]
    both = np.flatnonzero(first.known & seen.known)
    if len(both) < first.known.sum():
        return float("inf") if not len(both) else 1e3 + len(both)
    a, b = first.object_pose[both], seen.object_pose[both]
    turn = (rotation(a).inv() * rotation(b)).magnitude()
    arm = TURN_LENGTH * np.abs(first.q - seen.q).max()
    return float((np.linalg.norm(a[:, :3] - b[:, :3], axis=1) + TURN_LENGTH * turn).sum() + arm)


# --- what chains do ---------------------------------------------------------------------------------------------------
def _turns(path: np.ndarray) -> np.ndarray:
    """Angles from the first of poses (F, 7) [rad]."""
    return (rotation(path[0]).inv() * rotation(path)).magnitude()


def _nearest(a: np.ndarray, b: np.ndarray) -> float:
    """Of two paths (F, 3) [m]."""
    return float(np.linalg.norm(a - b, axis=-1).min())


class Effect:
    """What a chain's recording did, object by object, so that it can be carried over to another scene."""

    def __init__(self, chain: list[Skill]):
        self.chain = chain
        self._told: dict[tuple[int, bytes], np.ndarray] = {}
        frames = [chain[0].frames[0], *(f for s in chain for f in s.frames[1:])]
        self.first, last = frames[0], frames[-1]
        self.path = np.stack([f.object_pose for f in frames])  # (F, 4, 7)
        far = np.linalg.norm(self.path[..., :3] - self.path[0, :, :3], axis=-1).max(0)
        turn = np.array([_turns(self.path[:, i]).max() for i in range(SLOTS)])
        self.moved = [i for i in range(SLOTS) if self.first.known[i] and far[i] + TURN_LENGTH * turn[i] > MOVES]
        # Where a moved object ended near one that rested, its path is told from there.
        self.brought_to = {}
        resting = [j for j in range(SLOTS) if self.first.known[j] and j not in self.moved]
        p = self.path[..., :3]
        self.concerns = {*self.moved}  # and what they came near
        self.concerns |= {j for i in self.moved for j in resting if _nearest(p[:, i], p[:, j]) < BROUGHT_WITHIN}
        for i in self.moved:
            distance = {j: np.linalg.norm(last.object_pose[i, :3] - last.object_pose[j, :3]) for j in resting}
            if distance and min(distance.values()) < BROUGHT_WITHIN and far[i] > MOVES:
                self.brought_to[i] = min(distance, key=distance.get)

    def on(self, pose: np.ndarray) -> np.ndarray:
        """The objects' paths if they lie at pose (4, 7) now, (F, 4, 7)."""
        out = np.repeat(pose[None], len(self.path), 0)
        for i in self.moved:
            out[:, i] = self._path(i, self.brought_to.get(i, i), pose)
        if self.brought_to:
            out[0] = pose
        return out

    def _path(self, i: int, at: int, pose: np.ndarray) -> np.ndarray:
        """Of object i (F, 7), told from object `at`. A search asks for the same again and again."""
        key = i, pose[at].tobytes()
        if key not in self._told:
            if len(self._told) >= REMEMBERED:
                self._told.clear()
            old, new = self.path[0, at], pose[at]
            R = rotation(new) * rotation(old).inv()
            if at != i:  # brought to something: upright things stay upright
                R = Rotation.from_rotvec([0, 0, R.as_rotvec()[2]])
            p = new[:3] + R.apply(self.path[:, i, :3] - old[:3])
            q = np.roll((R * rotation(self.path[:, i])).as_quat(), 1, -1)
            self._told[key] = np.concatenate([p, q], 1)
        return self._told[key]


def missing(goals: list[Goal], path: np.ndarray) -> tuple[float, int]:
    """How far a path of the objects (F, 4, 7) stays from the goals, which are to be reached in their order, and the
    last of each object at the end: the mean distance [m], and how many of them are reached."""
    at, total, reached = 0, 0.0, 0
    last = {g.slot: k for k, g in enumerate(goals)}
    for k, g in enumerate(goals):
        d = g.missing(path[at:, g.slot])
        best = len(d) - 1 if last[g.slot] == k else int(np.argmin(d))
        total += float(d[best])
        reached += d[best] < DONE
        at = at if last[g.slot] == k else at + best
    return total / max(len(goals), 1), reached


def goals_of(library: Library, task: str, seen: Frame) -> list[Goal]:
    """What a task leaves behind, from the demonstration of it that began most like now, of those that do it best in
    practice: for each object it moves the pose farthest from its start, if it does not stay there, and the last one."""
    pose, out = seen.object_pose.copy(), []
    for one in task.split("+"):
        chains = library.of_task(one)
        best = max(library.rate(c) for c in chains) - AS_WELL
        chains = [c for c in chains if library.rate(c) >= best]
        effect = Effect(min(chains, key=lambda c: _apart(c, replace(seen, object_pose=pose))))
        path = effect.on(pose)
        for i in effect.moved:
            far = TURN_LENGTH * _turns(path[:, i])
            k = int(np.argmax(far))
            if far[k] - far[-1] > 0.05:  # turned and turned back: poured
                out.append(_poured(effect, i, k, pose, path[k, i]))
            out.append(Goal(i, path[-1, i]))
        pose = path[-1]
    return out


def _poured(effect: Effect, i: int, k: int, now: np.ndarray, pose: np.ndarray) -> Goal:
    """Object i as it is in frame k of the recording, told from what it is poured into; `pose`: if that is nothing."""
    then = effect.path[k]
    resting = [j for j in range(SLOTS) if effect.first.known[j] and j not in effect.moved]
    into = min(resting, key=lambda j: np.linalg.norm(then[i, :3] - then[j, :3]), default=None)
    if into is None or np.linalg.norm(then[i, :3] - then[into, :3]) > POURED_WITHIN:
        return Goal(i, pose)
    R = Rotation.from_rotvec([0, 0, (rotation(now[into]) * rotation(then[into]).inv()).as_rotvec()[2]])
    p = now[into, :3] + R.apply(then[i, :3] - then[into, :3])
    return Goal(i, np.concatenate([p, np.roll((R * rotation(then[i])).as_quat(), 1)]), axis=now[into, :2].copy())


def load_goals(path: Path) -> list[Goal]:
    """{"goals": [{"object": slot, "p_WO": [x, y, z], "q_WO": [w, x, y, z]}, ...]}; one of the two may be left out."""
    try:
        out = []
        for g in json.loads(path.read_text())["goals"]:
            if not 0 <= int(g["object"]) < SLOTS or not ("p_WO" in g or "q_WO" in g):
                raise ValueError(f"a goal needs an object from 0 to {SLOTS - 1} and p_WO or q_WO")
            q = np.array(g.get("q_WO", [1, 0, 0, 0]), float)
            pose = np.concatenate([np.array(g.get("p_WO", [0, 0, 0]), float), q / (np.linalg.norm(q) or np.nan)])
            if pose.shape != (7,) or not np.isfinite(pose).all():
                raise ValueError("p_WO takes 3 numbers, q_WO 4, not all 0")
            out.append(Goal(int(g["object"]), pose, "p_WO" in g, "q_WO" in g))
    except FileNotFoundError:
        raise UserError(f"--goal {path}: neither a task of the library nor a file") from None
    except (ValueError, KeyError, TypeError, OSError) as e:
        raise UserError(f"{path}: not goals ({type(e).__name__}: {e})") from None
    if not out:
        raise UserError(f"{path}: holds no goals")
    return out


@dataclass(frozen=True)
class Candidate:
    """Chains one after the other."""

    sequence: list[Effect]
    doubt: float  # [m]


class Planner:
    """Finds plans for goals. Allocates the rollouts once."""

    def __init__(self, weights: Path):
        self.library = Library.load(weights)
        self.effects = [Effect(chain) for chain in self.library.chains.values()]
        self.head = _core.KinematicRollout(str(weights), CANDIDATES)
        self.arm = _core.ArmModel.lite6()

    def search(self, goals: list[Goal], seen: Frame) -> list[Candidate]:
        """Sequences of chains, the most promising by their recordings first: one, or two that move different things."""
        unknown = [g.slot for g in goals if not seen.known[g.slot]]
        if unknown:
            raise UserError(f"the goal names object {unknown[0]}, which is not seen")
        wanted = {g.slot for g in goals}
        # Chains that move something nobody asked for are left out, unless nothing else is there.
        able = [e for e in self.effects if seen.known[e.moved].all() and e.moved and set(e.moved) & wanted]
        tidy = [e for e in able if set(e.moved) <= wanted]
        found = self._ranked(goals, seen, tidy or able)
        if not found:
            raise UserError("no demonstration moves what the goal names")
        return found

    def _ranked(self, goals: list[Goal], seen: Frame, effects: list[Effect]) -> list[Candidate]:
        found = []
        first = {id(e): e.on(seen.object_pose) for e in effects}
        begins = {id(e): _apart(e.chain, seen) for e in effects}
        for e in effects:
            found.append((missing(goals, first[id(e)])[0], begins[id(e)], [e]))
        if len({g.slot for g in goals}) > 1:
            named = {g.slot: k for k, g in reversed(list(enumerate(goals)))}  # slot -> its first goal
            turn = {id(e): min(named[i] for i in e.moved if i in named) for e in effects}
            for a, b in product(effects, effects):
                if set(a.moved) == set(b.moved):
                    continue
                # What concerns the same object is done in the order it was asked for: poured, then stirred.
                if a.concerns & b.concerns and turn[id(a)] > turn[id(b)]:
                    continue
                path = first[id(a)]
                more = b.on(path[-1])
                there = replace(seen, q=a.chain[-1].frames[-1].q, object_pose=path[-1])
                apart = begins[id(a)] + _apart(b.chain, there)
                found.append((missing(goals, np.concatenate([path, more]))[0], apart, [a, b]))
        # Recordings that do as well as each other: rather the one that began as things are now.
        ranked = [
            (left + APART * min(apart, 10.0) + self.unpractised(e), Candidate(e, self.doubt(e, seen)))
            for left, apart, e in found
        ]
        ranked.sort(key=lambda x: x[0])
        return [c for cost, c in ranked if cost < ranked[0][0] + HOPELESS]

    def doubt(self, sequence: list[Effect], seen: Frame) -> float:
        """What counts as farther from the goal, whatever the head says [m]: practice, and a first chain that began with
        the arm elsewhere."""
        elsewhere = TURN_LENGTH * float(np.abs(sequence[0].first.q - seen.q).max())
        return self.unpractised(sequence) + APART * elsewhere

    def unpractised(self, sequence: list[Effect]) -> float:
        """What counts as farther from the goal for what its chains did not do in practice [m]. The mean: leaving a task
        out must not make a plan better."""
        return UNPRACTISED * float(np.mean([1 - self.library.rate(e.chain) for e in sequence]))

    def for_task(self, task: str, seen: Frame) -> Plan:
        """The demonstration of it that began most like now and whose hand, in pi's head, comes to what it moves; for
        tasks joined by +, which nobody demonstrated as a whole, what is found for the poses they leave behind, in the
        order that pi gets done best."""
        return self.find(goals_of(self.library, task, seen), seen) if "+" in task else self._nearest(task, seen)

    def _nearest(self, task: str, seen: Frame) -> Plan:
        chains = sorted(as_good(self.library, task), key=lambda c: _apart(c, seen))[:CANDIDATES]
        got = self._play(chains, seen)
        beside = [self._beside(c, *way) for c, *way in zip(chains, got["q"], got["object_pose"], strict=True)]
        cost = [APART * _apart(c, seen) + b for c, b in zip(chains, beside, strict=True)]
        best = chains[int(np.argmin(cost))]
        return Plan(best, f"{task}: {best[0].source}")

    def _beside(self, chain: list[Skill], q: np.ndarray, object_pose: np.ndarray) -> float:
        """How far beside where the recording's came the hand comes to what it moves, as far as that matters [m]. q
        (T, 6), object_pose (T, 4, 7), told from the object, at the end of the last skill before it moves."""
        slot = int(np.argmax(np.max([s.moved for s in chain], 0)))
        first = next((k for k, s in enumerate(chain) if s.moved[slot] > BEGINS), 0)
        if first == 0:
            return 0.0
        at = sum(s.ticks for s in chain[:first]) - 1
        recorded = chain[first].frames[0]
        off = self._from(object_pose[at, slot], q[at]) - self._from(recorded.object_pose[slot], recorded.q)
        return max(0.0, float(np.linalg.norm(off)) - FORGIVEN)

    def _from(self, pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Where the tip of the arm at q is, told from an object (3,) [m]."""
        return rotation(pose).inv().apply(np.asarray(self.arm.tip(q))[:3] - pose[:3])

    def _play(self, chains: list[list[Skill]], seen: Frame) -> dict:
        """In pi's head, each from as things are now."""
        return self.head.run(
            seen.q, seen.gripper_closed, seen.object_pose, seen.known,
            [np.stack([s.z for s in c]) for c in chains], [[s.ticks for s in c] for c in chains],
        )  # fmt: skip

    def find(self, goals: list[Goal], seen: Frame) -> Plan:
        began = time.perf_counter()
        found = self.search(goals, seen)
        searched = time.perf_counter()
        # What the arm meets, and where pi misses, is only seen in the head: first each beginning with what seems to go
        # on from it best, then the best beginnings with all that goes on from them.
        begin: dict[int, Candidate] = {}
        for c in found:
            begin.setdefault(id(c.sequence[0]), c)
        tried = list(begin.values())[: CANDIDATES // 2]
        cost, ends, left = self._in_the_head(tried, goals, seen)
        kept = {id(tried[k].sequence[0]) for k in np.argsort(cost)[:KEPT]}
        known = {id(c) for c in tried}
        more = [c for c in found if id(c.sequence[0]) in kept and id(c) not in known][: CANDIDATES - len(tried)]
        if more:
            cost, ends, left = (
                np.concatenate(x) for x in zip((cost, ends, left), self._in_the_head(more, goals, seen), strict=True)
            )
        best = int(np.argmin(cost))
        sequence = (tried + more)[best].sequence
        return Plan(
            [s for e in sequence for s in e.chain],
            ", ".join(f"{e.chain[0].task}: {e.chain[0].source}" for e in sequence),
            ends[best],
            float(left[best]),
            searched - began,
            time.perf_counter() - searched,
            goals,
        )

    def _in_the_head(self, candidates: list[Candidate], goals: list[Goal], seen: Frame) -> tuple[np.ndarray, ...]:
        """Played by pi: what each costs [m], where the objects end (n, 4, 7), how far from the goals [m]."""
        got = self._play([[s for e in c.sequence for s in e.chain] for c in candidates], seen)
        left = np.array([missing(goals, path)[0] for path in got["object_pose"]])
        blocked = [
            self._meets(c.sequence, seen, *way)
            for c, *way in zip(candidates, got["q"], got["object_pose"], strict=True)
        ]
        cost = left + [c.doubt for c in candidates] + IN_THE_WAY * np.array(blocked)
        return cost, got["object_pose"][:, -1], left

    def _meets(self, sequence: list[Effect], seen: Frame, q: np.ndarray, object_pose: np.ndarray) -> bool:
        """Whether the arm, at q (T, 6), comes on its way too near to itself or the table, or near an object that the
        chain it plays does not concern."""
        if too_near(q[: sum(s.ticks for e in sequence for s in e.chain)]):
            return True
        at = 0
        for e in sequence:
            end = at + sum(s.ticks for s in e.chain)
            for slot in np.flatnonzero(seen.known):
                if slot not in e.concerns:
                    distance = self.arm.distance_from(q[at:end], object_pose[at:end, slot, :3])
                    if distance.min() < CLEAR:
                        return True
            at = end
        return False
