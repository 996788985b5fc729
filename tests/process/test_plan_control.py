"""Plans over LCM: skills named by their index, pause, going on, a new plan on the move, the end before its time."""

import numpy as np

from bench import TASK, WEIGHTS, Bench, need_programs
from intabs import messages
from intabs.skills.library import Library
from intabs.skills.planner import whole

need_programs()

RUNNING, ABORTED = 1, 3
SERVO = 1


def tell(bench: Bench, plan_id: int, action: int) -> None:
    m = messages.skill_control_t()
    m.plan_id, m.action = plan_id, action
    bench.bus.publish("SKILL_CONTROL", m)


def last(bench: Bench):
    return bench.heard["SKILL_STATUS"][-1]


def test_a_plan_pauses_goes_on_gives_way_to_another_and_ends_when_told(tmp_path):
    with Bench(tmp_path, clock="lockstep", perception="truth", seed=3, spread=2.0) as bench:
        bench.start_all()
        bench.play(plan_id=1)
        bench.until(lambda: last(bench).skill_index > 0, "the second skill")

        # Of another plan nothing is taken.
        tell(bench, 99, 2)
        tell(bench, 1, 1)
        bench.until(lambda: last(bench).end_reason == RUNNING and stands(bench), "a pause")
        before = last(bench)
        tell(bench, 1, 0)
        bench.until(lambda: last(bench).skill_index > before.skill_index, "the next skill")

        # By index alone: z of the message is not looked at.
        skills = [{**s.as_plan(), "z": [9.0] * 16} for s in whole(Library.load(WEIGHTS), TASK, None).skills]
        parts = messages.plan_parts(2, skills)

        def taken() -> bool:
            for part in parts:
                bench.bus.publish("SKILL_PLAN", part)
            return last(bench).plan_id == 2 and last(bench).end_reason == RUNNING

        bench.until(taken, "the second plan")
        bench.until(lambda: last(bench).skill_index > 0, "the second plan on its way")
        # The command filter's limits, 2.14 rad/s and 20 rad/s^2, at a tick of 4 ms: no jump, no jolt. LCM loses some.
        heard = bench.heard["LITE6_STATUS"]
        q, t = np.array([s.q_commanded for s in heard]), np.array([s.utime for s in heard])
        whole_way = np.flatnonzero(t[2:] - t[:-2] == 8000)
        assert len(whole_way) > 0.8 * len(t)
        assert np.abs(np.diff(q, axis=0)[whole_way]).max() < 1.1 * 2.14 * 0.004
        assert np.abs(np.diff(q, n=2, axis=0)[whole_way]).max() < 1.1 * 20 * 0.004**2
        tell(bench, 2, 2)
        bench.until(lambda: last(bench).end_reason == ABORTED, "the end")


def stands(bench: Bench) -> bool:
    """The arm is held and the plan has not moved on for ten policy ticks."""
    statuses, arm = bench.heard["SKILL_STATUS"][-10:], bench.heard["LITE6_STATUS"][-1]
    same = {(s.skill_index, s.progress) for s in statuses}
    return (
        len(statuses) == 10
        and len(same) == 1
        and statuses[-1].utime - statuses[0].utime >= 9 * 40_000
        and (np.abs(arm.dq).max() < 1e-2)
    )
