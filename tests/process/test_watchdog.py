"""Whoever dies in mid-motion: the arm slows down and holds, the status says why, a new session takes over."""

import math
import signal

import pytest

from bench import FAULT, HOLDING, SLOWING, STALE_COMMAND, STOPPED, TRACKING, Bench, need_programs
from intabs import messages

need_programs()
RUNNING, STALE_POSES = 1, 4  # skills/skill_player.h EndReason
ESTOP = 2  # Fault


@pytest.fixture
def moving(tmp_path):
    """All programs in real time, the arm in motion."""
    with Bench(tmp_path) as bench:
        bench.start_all()
        bench.play()
        bench.until(lambda: bench.status.state == TRACKING and speed(bench.status) > 0.1, "the arm moves")
        yield bench


def speed(status) -> float:
    return math.sqrt(sum(v * v for v in status.dq))


def kill(process) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()


def assert_slowed_down_and_holds(bench, killed_at: int) -> None:
    """By way of tracking, (at speed) slowing, holding; no jump of position or speed on the way; then no motion."""
    states = bench.states_since(killed_at)
    assert states in ([TRACKING, HOLDING], [TRACKING, SLOWING, HOLDING]), states
    statuses = bench.heard["LITE6_STATUS"][killed_at:]
    # The command filter's limits, with room for a tick that came late: 2.14 rad/s, 20 rad/s^2.
    for a, b, c in zip(statuses, statuses[1:], statuses[2:], strict=False):
        if max(b.utime - a.utime, c.utime - b.utime) > 6000:
            continue
        for qa, qb, qc in zip(a.q_commanded, b.q_commanded, c.q_commanded, strict=True):
            assert abs(qb - qa) <= 1.5 * 2.14 * 0.004
            assert abs(qc - 2 * qb + qa) <= 1.5 * 20 * 0.004**2
    held = bench.status.q_commanded
    bench.listen(0.5)
    assert bench.status.q_commanded == held
    assert speed(bench.status) < 0.02


def test_control_killed_in_mid_motion_then_a_new_one_takes_over(moving):
    bench = moving
    old_session, killed_at = bench.status.session, len(bench.heard["LITE6_STATUS"])
    kill(bench.processes.running.pop("intabs_control"))
    bench.until(lambda: bench.status.state == HOLDING, "the arm holds", patience_s=5)
    assert_slowed_down_and_holds(bench, killed_at)

    bench.control("second control")
    bench.play(plan_id=2)
    bench.until(lambda: bench.status.state == TRACKING, "the new session is obeyed")
    assert bench.status.session not in (0, old_session)
    bench.until(lambda: speed(bench.status) > 0.1, "the arm moves again")


def test_control_gone_for_long_is_a_fault_that_only_a_reset_ends(moving):
    bench = moving
    kill(bench.processes.running.pop("intabs_control"))
    bench.until(lambda: bench.status.state == FAULT, "fault after 2 s of holding", patience_s=10)
    assert bench.status.fault == STALE_COMMAND

    bench.control("second control")
    bench.play(plan_id=2)
    refused = sum(bench.status.refused)
    bench.until(lambda: sum(bench.status.refused) > refused, "commands are refused and counted")
    assert bench.status.state == FAULT

    reset = messages.reset_t()
    reset.session = bench.heard["LITE6_COMMAND"][-1].session
    bench.bus.publish("RESET", reset)
    bench.until(lambda: bench.status.state != FAULT, "the reset ends the fault")
    bench.play(plan_id=3)
    bench.until(lambda: bench.status.state == TRACKING, "the named session is obeyed")
    assert bench.status.session == reset.session


def test_perception_killed_in_mid_motion_then_a_new_one_takes_over(moving):
    bench = moving
    killed_at = len(bench.heard["LITE6_STATUS"])
    kill(bench.processes.running.pop("intabs_perception"))
    bench.until(lambda: bench.status.state == HOLDING, "the arm holds", patience_s=5)
    assert_slowed_down_and_holds(bench, killed_at)
    bench.until(lambda: bench.heard["SKILL_STATUS"][-1].end_reason == STALE_POSES, "the plan ends", patience_s=10)
    assert "perception" in bench.processes.last_line("intabs_control")

    old_session = bench.status.session
    kill(bench.processes.running.pop("intabs_control"))
    bench.perception("second perception")
    bench.until(bench.perception_keeps_up, "perception keeps up again")
    bench.control("second control")
    bench.play(plan_id=2)
    bench.until(lambda: bench.status.state == TRACKING, "the new session is obeyed")
    assert bench.status.session not in (0, old_session)


def test_perception_that_is_late_makes_the_arm_wait_then_the_plan_goes_on(moving):
    bench = moving
    stopped_at = len(bench.heard["LITE6_STATUS"])
    perception = bench.processes.running["intabs_perception"]
    perception.send_signal(signal.SIGSTOP)
    bench.until(lambda: bench.status.state == HOLDING, "the arm holds", patience_s=5)
    perception.send_signal(signal.SIGCONT)
    bench.until(lambda: bench.status.state == TRACKING and speed(bench.status) > 0.1, "the arm moves again")
    assert bench.heard["SKILL_STATUS"][-1].end_reason == RUNNING
    assert FAULT not in bench.states_since(stopped_at)


def test_a_signal_stops_the_plant_until_a_reset(moving):
    bench = moving
    session = bench.status.session
    bench.processes.running["intabs_plant"].send_signal(signal.SIGUSR1)
    bench.until(lambda: bench.status.state == STOPPED, "stopped", patience_s=5)
    assert bench.status.fault == ESTOP
    bench.listen(0.5)
    assert bench.status.state == STOPPED
    held = bench.status.q_commanded
    bench.listen(0.2)
    assert bench.status.q_commanded == held
    reset = messages.reset_t()
    reset.session = session
    bench.bus.publish("RESET", reset)
    bench.until(lambda: bench.status.state == HOLDING, "the reset ends it")
