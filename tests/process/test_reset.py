"""PLANT_CONTROL: a reset is taken while nobody moves the arm, whether or not somebody holds it."""

import signal

import pytest

from bench import HOLDING, IDLE, TRACKING, Bench, need_programs
from intabs import messages

need_programs()
FINISHED = 2  # skills/skill_player.h EndReason


def ask(bench: Bench) -> None:
    bench.bus.publish("PLANT_CONTROL", messages.plant_control_t())  # no reset wanted: nothing happens
    wish = messages.plant_control_t()
    wish.seed, wish.reset = 1, True
    bench.bus.publish("PLANT_CONTROL", wish)


def reset(bench: Bench) -> None:
    """Asks for one and waits for it."""
    first = len(bench.heard["LITE6_STATUS"])
    ask(bench)
    bench.until(
        lambda: any(s.session == 0 and s.state == IDLE for s in bench.heard["LITE6_STATUS"][first:]),
        "the plant starts over",
    )


def play_out(bench: Bench, plan_id: int) -> None:
    bench.play(plan_id)
    bench.until(
        lambda: any(s.plan_id == plan_id and s.end_reason == FINISHED for s in bench.heard["SKILL_STATUS"][-200:]),
        "the plan ends",
        patience_s=120,
    )


@pytest.mark.parametrize("perception", ["truth", "tags"])
def test_in_lockstep_a_plan_is_played_again_after_a_reset_and_succeeds_again(tmp_path, perception):
    with Bench(tmp_path, clock="lockstep", perception=perception) as bench:
        bench.start_all()
        for plan_id in (1, 2):
            play_out(bench, plan_id)
            bench.until(lambda: bench.heard["PLANT_TRUTH"][-1].success, "success", patience_s=20)
            bench.until(lambda: bench.status.state == HOLDING, "the session only holds")
            reset(bench)
            bench.until(lambda: not bench.heard["PLANT_TRUTH"][-1].success, "the block is back")


def test_while_a_session_moves_the_arm_a_reset_is_refused(tmp_path):
    with Bench(tmp_path, perception="truth") as bench:
        bench.start_all()
        bench.play()
        bench.until(lambda: bench.status.state == TRACKING, "the arm moves")
        ask(bench)
        bench.until(lambda: "moves the arm" in bench.processes.last_line("intabs_plant"), "the plant refuses")
        assert bench.status.session != 0


def test_in_lockstep_a_reset_is_taken_after_control_died_in_mid_motion(tmp_path):
    with Bench(tmp_path, clock="lockstep", perception="truth") as bench:
        bench.start_all()
        bench.play()
        bench.until(lambda: bench.status.state == TRACKING, "the arm moves")
        control = bench.processes.running.pop("intabs_control")
        control.send_signal(signal.SIGKILL)
        control.wait()
        bench.listen(1.5)
        reset(bench)
        bench.control("second control")
        play_out(bench, 2)
