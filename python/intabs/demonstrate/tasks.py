"""Who demonstrates what. A composition is its tasks' demonstrators, one after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intabs import _core
from intabs.demonstrate.base import CannotReach, Demonstrator, Intent
from intabs.demonstrate.box_open import BoxOpen
from intabs.demonstrate.drawer_open import DrawerOpen
from intabs.demonstrate.pick_place import PickPlace
from intabs.demonstrate.pour import Pour
from intabs.demonstrate.stir import Stir
from intabs.errors import UserError

DEMONSTRATORS: dict[str, type[Demonstrator]] = {
    "pick_place": PickPlace,
    "drawer_open": DrawerOpen,
    "box_open": BoxOpen,
    "pour": Pour,
    "stir": Stir,
}
COMPOSITIONS = ("drawer_open+pick_place", "pour+stir", "box_open+pour")

SETTLE_TICKS = 15  # the plant goes on holding after the last movement, so that success can show
MAX_TICKS = 2000


@dataclass(frozen=True)
class Job:
    task: str
    seed: int
    spread: float = 2.0  # cm
    perception: str = "truth"
    disturb: float = 1.0  # scale of the disturbances the demonstrator has to correct
    detours: float = 0.3  # probability of each change of mind


def known_tasks() -> list[str]:
    parts = set(DEMONSTRATORS)
    return [*DEMONSTRATORS, *(c for c in COMPOSITIONS if parts.issuperset(c.split("+")))]


def require_task(task: str) -> None:
    if task not in known_tasks():
        raise UserError(f"unknown task '{task}': known are {', '.join(known_tasks())}")


@dataclass
class Tick:
    """What the master arm does at one tick."""

    q: np.ndarray  # (6,) rad: where it is
    q_meant: np.ndarray  # (6,) rad: where it would be had nobody knocked it
    gripper_closed: bool
    action: np.ndarray | None  # (7,) as recorded; None: it does not demonstrate, only waits


class Performance:
    """One demonstration, tick by tick: waits until it sees what it needs, demonstrates, and stays a moment."""

    def __init__(self, job: Job):
        rng = np.random.default_rng([job.seed, 7])
        arm = _core.ArmModel.lite6()
        ik = _core.IkSolver(arm)
        self._left: list[Demonstrator] = [
            DEMONSTRATORS[part](arm, ik, rng, job.disturb, job.detours) for part in job.task.split("+")
        ]
        self._last: Intent | None = None
        self._ticks = 0
        self._settled = 0
        self.failure = ""  # why it gave up

    @property
    def finished(self) -> bool:
        return self._settled >= SETTLE_TICKS or bool(self.failure)

    def tick(self, q: Sequence, q_commanded: Sequence, pose: np.ndarray, valid: np.ndarray) -> Tick:
        """q measured and q_commanded of the puppet (6,); pose (S, 7), valid (S,) of the objects."""
        if self._left and not self.failure:
            try:
                intent = self._left[0].step(np.array(q), pose, valid)
            except CannotReach as e:
                self.failure, intent = str(e), None
            if intent is not None:
                self._last = intent
                self._ticks += 1
                if intent.done:
                    self._left.pop(0)
                if self._ticks >= MAX_TICKS:
                    self._left.clear()
                return Tick(intent.q_target, intent.q_meant, intent.gripper_closed, intent.action)
        else:
            self._settled += 1
        if self._last is None:
            q = np.array(q_commanded)
            return Tick(q, q, False, None)
        return Tick(self._last.q_target, self._last.q_target, self._last.gripper_closed, None)
