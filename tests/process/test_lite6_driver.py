"""intabs_lite6 against intabs_fake_lite6: whatever goes wrong, the arm slows down and holds, says why, goes on after a
RESET; nothing needs a restart."""

import json
import math
import os
import pty
import signal
import subprocess
import sys
import time

import pytest
from lite6_bench import (
    ALIGNING,
    ESTOP,
    FAULT,
    HOLDING,
    HOME,
    IDLE,
    LINK,
    OVERRUN,
    SLOWING,
    STALE_COMMAND,
    STALE_STATUS,
    STOPPED,
    TRACKING,
    VENDOR,
    Fake,
    Lite6Bench,
    need_lite6,
)

from bench import ends
from intabs import bus, messages, paths
from intabs.processes import Processes, free_ports

need_lite6()


def swing(t: float) -> list[float]:
    """Joints 1 and 6 to and fro, at most .5 rad/s."""
    return [0.4 * math.sin(1.2 * t), *HOME[1:5], 0.4 * math.sin(1.2 * t)]


def speed(status) -> float:
    return math.sqrt(sum(v * v for v in status.dq))


def assert_smooth(statuses) -> None:
    """The reference never jumps from tick to tick; a new start after a RESET is let through."""
    for a, b, c in zip(statuses, statuses[1:], statuses[2:], strict=False):
        if c.seq != a.seq + 2 or {a.state, b.state, c.state} & {FAULT, STOPPED}:
            continue
        for qa, qb, qc in zip(a.q_commanded, b.q_commanded, c.q_commanded, strict=True):
            assert abs(qb - qa) <= 1.5 * 2.14 * 0.004
            assert abs(qc - 2 * qb + qa) <= 1.5 * 20 * 0.004**2


@pytest.fixture
def bench(tmp_path):
    with Lite6Bench(tmp_path) as bench:
        yield bench


@pytest.fixture
def moving(bench):
    """The arm in motion; at the end the driver still runs, and the controller never saw a target too fast."""
    bench.driver()
    bench.session(path=swing)
    bench.until(lambda: bench.state == TRACKING and speed(bench.status) > 0.1, "the arm moves")
    yield bench
    bench.processes.check()
    assert_smooth(bench.statuses)
    state = bench.fake.state
    assert state["max_joint_speed"] <= 3.14
    assert state["max_tip_speed"] <= 0.6
    bench.processes.running["intabs_lite6"].send_signal(signal.SIGINT)
    assert bench.processes.running["intabs_lite6"].wait(10) == 0
    figures = json.loads((bench.folder / "lite6.json").read_text())["lite6"]
    assert figures["worst_ticks_moving_without_link"] <= 2


def goes_on(bench) -> None:
    bench.until(lambda: bench.state == TRACKING and speed(bench.status) > 0.1, "the arm moves again")


def reset_until_it_goes_on(bench) -> None:
    bench.reset(bench.sessions[-1].id)
    bench.until(lambda: bench.state not in (FAULT, STOPPED), "the reset ends the fault")
    goes_on(bench)


def test_a_session_is_obeyed_and_far_targets_are_approached_slowly(bench):
    bench.driver()
    bench.until(lambda: bench.state == IDLE, "the driver is idle")
    session = bench.session(path=lambda _t: [0.5, *HOME[1:]])
    bench.until(lambda: bench.state == TRACKING, "it tracks")
    bench.until(lambda: abs(bench.status.q[0] - 0.5) < 1e-4 and speed(bench.status) < 1e-3, "it arrives")
    assert bench.states_since(0) == [IDLE, ALIGNING, TRACKING]
    aligning = [s for s in bench.statuses if s.state == ALIGNING]
    for a, b in zip(aligning, aligning[1:], strict=False):
        assert abs(b.q_commanded[0] - a.q_commanded[0]) < 0.4 * 0.004 * (b.seq - a.seq)
    assert bench.status.session == session.id
    assert_smooth(bench.statuses)
    assert bench.processes.stop()["intabs_lite6"] == 0
    figures = json.loads((bench.folder / "lite6.json").read_text())["lite6"]
    assert figures["connections"] == 1
    assert figures["bad_reports"] == figures["bad_replies"] == 0


# order -> how it may end, its fault, whether it goes on by itself
FAULTS = {
    "delay 200": ({SLOWING, HOLDING}, 0, True),
    "silence 200": ({SLOWING, HOLDING}, 0, True),
    "mute 200": ({SLOWING, HOLDING}, 0, True),
    "corrupt 3": ({SLOWING, HOLDING}, 0, True),
    "drop reports": ({SLOWING, HOLDING}, 0, True),
    "drop": ({FAULT}, LINK, False),
    "unplug 1": ({FAULT}, LINK, False),
    "garble": ({FAULT}, LINK, False),
    "error 31": ({FAULT}, VENDOR, False),
    "error 24": ({FAULT}, VENDOR, False),
}


@pytest.mark.parametrize("order", FAULTS)
def test_a_fault_in_mid_motion(moving, order):
    bench = moving
    ends_in, fault, goes_on_alone = FAULTS[order]
    begun = len(bench.statuses)
    bench.fake.order(order)
    bench.until(lambda: any(s.state in ends_in for s in bench.statuses[begun:]), f"{order}: the arm stops")
    if goes_on_alone:
        goes_on(bench)
    else:
        bench.listen(0.5)
        assert (bench.state, bench.status.fault) == (FAULT, fault)
        assert bench.status.vendor_error == (int(order.split()[1]) if fault == VENDOR else 0)
        held = bench.status.q_commanded
        bench.listen(0.2)
        assert bench.status.q_commanded == held
        reset_until_it_goes_on(bench)


def test_a_long_silence_is_a_fault(moving):
    moving.fake.order("silence 4000")
    moving.until(lambda: moving.state == FAULT, "fault")
    assert moving.status.fault in (STALE_STATUS, LINK)
    moving.until(lambda: moving.fake.state["connections"] >= 1 and moving.fake.order("state")["utime"], "it is back")
    moving.listen(4)
    reset_until_it_goes_on(moving)


def test_the_emergency_button_outlasts_a_reset_that_comes_too_early(moving):
    bench = moving
    bench.fake.order("estop on")
    bench.until(lambda: bench.state == FAULT, "fault")
    bench.until(lambda: bench.status.vendor_error == 2, "it says which")
    bench.reset(bench.sessions[-1].id)
    bench.listen(1)
    assert bench.state == FAULT
    assert "C2 " in bench.processes.last_line("intabs_lite6")
    bench.fake.order("estop off")
    reset_until_it_goes_on(bench)
    assert bench.status.vendor_error == 0


@pytest.mark.parametrize("by", ["message", "signal"])
def test_estop_stops_the_controller_too(moving, by):
    bench = moving
    if by == "message":
        bench.estop()
    else:
        bench.processes.running["intabs_lite6"].send_signal(signal.SIGUSR1)
    bench.until(lambda: bench.state == STOPPED, "stopped")
    assert bench.status.fault == ESTOP
    bench.until(lambda: bench.fake.state["state"] == 4, "the controller is stopped")
    bench.listen(0.3)
    assert bench.state == STOPPED
    reset_until_it_goes_on(bench)


def test_the_space_bar_stops(bench):
    arguments = (
        "--host",
        "127.0.0.1",
        "--port",
        bench.fake.port,
        "--report-port",
        bench.fake.reports,
        "--lcm",
        bench.url,
    )
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(paths.program("intabs_lite6"), ["intabs_lite6", *map(str, arguments), "--flight", str(bench.folder)])
    try:
        bench.session(path=swing)
        bench.until(lambda: bench.statuses and bench.state == TRACKING and speed(bench.status) > 0.1, "the arm moves")
        os.write(terminal, b" ")
        bench.until(lambda: bench.state == STOPPED, "stopped")
        assert bench.status.fault == ESTOP
    finally:
        os.kill(pid, signal.SIGINT)
        os.close(terminal)
        assert os.waitpid(pid, 0)[1] in (0, signal.SIGHUP)


def test_a_loop_that_stood_still_is_a_fault(moving):
    bench = moving
    driver = bench.processes.running["intabs_lite6"]
    driver.send_signal(signal.SIGSTOP)
    time.sleep(0.3)
    driver.send_signal(signal.SIGCONT)
    bench.until(lambda: bench.state == FAULT, "fault")
    assert bench.status.fault == OVERRUN
    reset_until_it_goes_on(bench)


def test_a_session_that_dies_leaves_an_arm_that_holds(moving):
    bench = moving
    bench.sessions[-1].end()
    bench.until(lambda: bench.state == HOLDING, "it holds")
    bench.until(lambda: bench.state == FAULT, "fault after 2 s")
    assert bench.status.fault == STALE_COMMAND
    bench.session(path=swing)
    refused = sum(bench.status.refused)
    bench.until(lambda: sum(bench.status.refused) > refused, "a new session is refused")
    reset_until_it_goes_on(bench)


def kill(process) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()


def test_a_driver_that_is_killed_leaves_an_arm_that_a_new_driver_takes_over(bench):
    bench.driver()
    bench.session(path=swing)
    bench.until(lambda: bench.state == TRACKING and speed(bench.status) > 0.1, "the arm moves")
    kill(bench.processes.running.pop("intabs_lite6"))
    time.sleep(0.3)
    q = bench.fake.state["q"]
    time.sleep(0.3)
    assert bench.fake.state["q"] == q  # at the last target
    bench.statuses.clear()
    bench.driver(name="second driver")
    goes_on(bench)
    assert bench.fake.state["max_joint_speed"] <= 3.14
    assert bench.fake.state["error"] == 0


def test_a_controller_that_is_killed_and_comes_back(moving):
    bench = moving
    kill(bench.processes.running.pop("intabs_fake_lite6"))
    bench.until(lambda: bench.state == FAULT, "fault")
    assert bench.status.fault == LINK
    bench.fake = Fake(bench.processes, base=bench.fake.port, name="second controller")
    reset_until_it_goes_on(bench)


FLOOD = """
import random, sys, time
import lcm
bus, rng, seconds = lcm.LCM(sys.argv[1]), random.Random(1), float(sys.argv[2])
junk = [rng.randbytes(n) for n in (0, 8, 40, 400)]
channels = ["LITE6_COMMAND", "ESTOP", "RESET", "LITE6_STATUS"]
begin, n = time.monotonic(), 0
while time.monotonic() - begin < seconds:
    ahead = n / 5e4 - (time.monotonic() - begin)
    if ahead > 0.001:
        time.sleep(0.001)
        continue
    for _ in range(50):
        bus.publish(channels[n % 4], junk[n % 3])
        n += 1
print(n / seconds)
"""


def test_a_flood_of_garbage(moving):
    bench = moving
    sender = [sys.executable, "-c", FLOOD, bench.url, "3"]
    floods = [subprocess.Popen(sender, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    begun = len(bench.statuses)
    while any(f.poll() is None for f in floods):
        bench.listen(0.1)
    print("datagrams/s:", sum(float(f.communicate()[0]) for f in floods))
    print("states:", bench.states_since(begun), "counted:", bench.status.refused[0])
    assert not {FAULT, STOPPED} & set(bench.states_since(begun)) or bench.status.fault == STALE_COMMAND
    bench.listen(0.2)
    assert bench.status.refused[0] > 0
    if bench.state in (FAULT, STOPPED):
        reset_until_it_goes_on(bench)
    goes_on(bench)


def test_the_gripper_is_told_only_what_is_new_and_is_opened_before_it_closes(bench):
    bench.driver()
    session = bench.session()
    bench.until(lambda: bench.state == TRACKING, "it tracks")
    bench.until(lambda: bench.fake.state["gripper"] == "open", "it opens")
    writes = bench.fake.state["gripper_writes"]
    bench.listen(0.3)
    assert bench.fake.state["gripper_writes"] == writes == 2
    session.gripper = True
    bench.until(lambda: bench.fake.state["gripper"] == "closed", "it closes")
    bench.listen(0.3)
    state = bench.fake.state
    assert state["gripper_writes"] == 4
    assert state["close_ignored"] == 0
    assert bench.status.gripper_closed
    bench.until(lambda: bench.status.gripper_opening == 0, "its opening is estimated")


def test_a_gripper_that_was_stopped_is_opened_first(bench):
    bench.driver()
    session = bench.session()
    session.gripper = True
    bench.until(lambda: bench.fake.state["gripper"] == "closed", "it closes")
    assert bench.fake.state["close_ignored"] == 0


def test_an_arm_that_is_guided_by_hand_says_where_it_is_and_nothing_moves_it(tmp_path):
    with Lite6Bench(tmp_path, prefix="MASTER_") as bench:
        bench.driver("--teach")
        bench.until(lambda: bench.fake.state["mode"] == 2, "manual mode")
        pose = [0.3, 0.1, 0.9, 0.2, 0.7, -0.3]
        bench.fake.order("guide " + " ".join(map(str, pose)))
        bench.until(lambda: max(abs(a - b) for a, b in zip(bench.status.q, pose, strict=True)) < 1e-4, "it is led")
        assert bench.status.q_commanded == pytest.approx(bench.status.q, abs=1e-3)
        session = bench.session()
        session.gripper = True
        session.path = swing
        bench.until(lambda: bench.fake.state["gripper"] == "closed", "the gripper obeys")
        bench.listen(0.3)
        assert bench.fake.state["servo_requests"] == 0
        assert bench.status.q == pytest.approx(pose, abs=1e-4)
        assert bench.status.gripper_closed
        assert bench.state == IDLE


@pytest.mark.parametrize("port", ["real", "none"])
def test_other_ways_to_hear_of_the_joints(bench, port):
    bench.driver(report_port=bench.fake.reports + 3 if port == "real" else 0)
    bench.session(path=swing)
    bench.until(lambda: bench.state == TRACKING and speed(bench.status) > 0.3, "the arm moves")
    begun = len(bench.statuses)
    bench.listen(1)
    moved = bench.statuses[begun:]
    # Speeds belong to the positions, differences or not.
    way = sum(s.dq[0] * 0.004 for s in moved)
    seconds = (moved[-1].utime - moved[0].utime) * 1e-6
    assert way * seconds / (0.004 * len(moved)) == pytest.approx(moved[-1].q[0] - moved[0].q[0], abs=0.06)


def one_line(*args: object) -> str:
    code, lines = ends("intabs_lite6", *args)
    assert code != 0
    assert len(lines) == 1, lines
    assert lines[0].startswith("intabs_lite6: "), lines
    return lines[0]


def test_bad_input_ends_in_one_line(tmp_path):
    assert "--host" in one_line()
    assert "no.such.host.invalid" in one_line("--host", "no.such.host.invalid", "--lcm", bus.private_url())
    assert "--port" in one_line("--host", "127.0.0.1", "--port", "70000")
    (tmp_path / "arm.urdf").write_text("<robot/>")
    assert "arm.urdf" in one_line(
        *("--host", "127.0.0.1", "--lcm", bus.private_url(), "--kinematics", tmp_path / "arm.urdf")
    )


def test_a_second_driver_gives_way(bench):
    bench.driver()
    line = one_line("--host", "127.0.0.1", "--port", bench.fake.port, "--lcm", bench.url)
    assert "another" in line
    assert bench.processes.running["intabs_lite6"].poll() is None


def test_a_driver_without_an_arm_says_so_and_waits_for_it(tmp_path):
    url, ports = bus.private_url(), free_ports(6)
    with Processes(tmp_path) as processes:
        program = paths.program("intabs_lite6")
        processes.start(program, "--host", "127.0.0.1", "--port", ports, "--report-port", ports + 1, "--lcm", url)
        heard = []
        listener = bus.Bus(url)
        listener.subscribe("LITE6_STATUS", heard.append)
        end = time.monotonic() + 1
        while time.monotonic() < end:
            listener.handle(100)
        assert not heard
        assert "no arm at 127.0.0.1" in processes.last_line("intabs_lite6")
        fake = paths.program("intabs_fake_lite6")
        processes.start(fake, "--port", ports, "--report-port-base", ports + 1)
        end = time.monotonic() + 30
        while not heard and time.monotonic() < end:
            listener.handle(100)
        assert isinstance(heard[0], messages.lite6_status_t)
