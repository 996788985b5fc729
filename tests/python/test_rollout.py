"""Rollouts of the shipped weights: figures, resuming, bad input, a worker that dies."""

import os
import signal

import numpy as np
import pytest

from intabs import _core, paths
from intabs.errors import UserError
from intabs.jobs import in_processes
from intabs.rollout import UNSEEN, rollout, wilson
from intabs.skills.library import Library
from intabs.skills.planner import seen_from, whole

WEIGHTS = paths.MODELS / "weights" / "lite6"
if not (WEIGHTS / "manifest.json").exists():
    pytest.skip(f"{WEIGHTS} is not there: train and export first", allow_module_level=True)


def test_an_interval_holds_the_rate_it_is_of():
    for n in range(1, 60):
        for k in (0, n):
            low, high = wilson(k, n)
            assert low <= k / n <= high


def test_wilson_interval_is_the_known_one():
    low, high = wilson(42, 50)
    assert abs(low - 0.7149) < 1e-3 and abs(high - 0.9166) < 1e-3


def test_a_cut_report_is_taken_up_again_as_often_as_wanted(tmp_path):
    whole = rollout("pick_place", 3, report=tmp_path / "a")
    path = tmp_path / "a" / "trials.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    for _ in range(2):
        assert rollout("pick_place", 3, report=tmp_path / "a", resume=True) == whole
    with pytest.raises(UserError, match="is there already"):
        rollout("pick_place", 3, report=tmp_path / "a")
    with pytest.raises(UserError, match="other settings"):
        rollout("pick_place", 3, spread=1.0, report=tmp_path / "a", resume=True)


def test_without_actions_the_task_fails_with_its_reason():
    figures = rollout("pick_place", 1, ablate="policy")
    assert figures["success"] == 0 and sum(figures["failures"].values()) == 1


def test_an_object_knocked_away_as_the_fingers_close_is_grasped_again():
    world = _core.Rollout(str(paths.MODELS), "pick_place", str(WEIGHTS))
    library = Library.load(WEIGHTS)
    for nudge in (False, True):
        plan = whole(library, "pick_place", seen_from(world.reset(UNSEEN, 1.0)))
        got = world.run(*plan.arrays(), nudge=nudge)
        jump = np.linalg.norm(np.diff(got["object_pose"][:, 0, :2], axis=0), axis=1).max()
        assert got["success"], got["reason"]
        assert (jump > 0.03) == nudge and (got["retries"] > 0) == nudge


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"task": "nosuch"}, "unknown task"),
        ({"task": "pick_place", "weights": "nosuch"}, "no such weights"),
        ({"task": "pick_place", "spread": 1000.0}, "spread"),
        ({"task": "pick_place", "ablate": "nosuch"}, "known are objects"),
    ],
)
def test_bad_input_is_one_line(arguments, says):
    with pytest.raises(UserError, match=says):
        rollout(trials=1, **arguments)


def _die(_item):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_dies_is_said_and_not_waited_for():
    with pytest.raises(UserError, match="worker process died"):
        list(in_processes(_die, range(3), 1))
