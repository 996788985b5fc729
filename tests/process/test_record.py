"""intabs_record: what it captures, how the puppet follows the master, and that a recording is the run that was."""

import os
import signal
import subprocess
import sys
import time

import lcm
import numpy as np
import pytest

from bench import FAULT, HOLDING, IDLE, TRACKING, Bench, ends, need_programs
from intabs import bus, messages, paths
from intabs.data.demos import load_demos
from intabs.data.labels import KINDS, segments
from intabs.demonstrate.collect import record
from intabs.demonstrate.in_process import perform
from intabs.demonstrate.log import demo_from_log, read_log
from intabs.demonstrate.tasks import Job
from intabs.errors import UserError
from intabs.processes import Processes

need_programs()
if not (paths.BIN / "intabs_record").exists():
    pytest.skip(f"not built in {paths.BIN}: record", allow_module_level=True)

POLICY_TICK_US = 40_000


def start_record(processes: Processes, url: str, log, *options: object) -> subprocess.Popen:
    process = processes.start(paths.program("intabs_record"), "--lcm", url, "--out", log, *options)
    until = time.monotonic() + 30
    while not log.exists():
        assert time.monotonic() < until and process.poll() is None, processes.last_line("intabs_record")
        time.sleep(0.02)
    time.sleep(0.3)  # it subscribes before it makes the file; LCM's own thread may come a little later
    return process


def test_every_datagram_of_every_channel_is_in_the_log_byte_for_byte(tmp_path):
    url, log = bus.private_url(), tmp_path / "all.lcmlog"
    sent = [(f"ODD_{i % 7}", os.urandom(1 + 13 * (i % 100))) for i in range(500)]
    with Processes(tmp_path) as processes:
        start_record(processes, url, log)
        link = bus.Bus(url)
        for channel, data in sent:
            link.publish_raw(channel, data)
            time.sleep(0.0005)
        time.sleep(0.5)
        assert processes.stop() == {"intabs_record": 0}
    assert [(e.channel, e.data) for e in lcm.EventLog(str(log), "r")] == sent
    assert "500 messages on 7 channels" in (tmp_path / "intabs_record.log").read_text()


def refusal(*args: object) -> str:
    code, lines = ends("intabs_record", "--lcm", bus.private_url(), *args)
    assert code == 1
    assert len(lines) == 1, lines
    return lines[0]


def test_bad_arguments_end_in_one_line(tmp_path):
    there = tmp_path / "there"
    there.write_text("mine")
    assert "--force" in refusal("--out", there)
    assert there.read_text() == "mine"
    assert str(tmp_path / "no" / "log") in refusal("--out", tmp_path / "no" / "log")
    assert "follow itself" in refusal("--out", tmp_path / "a", "--mirror", "--prefix", "MASTER_")
    assert "letters" in refusal("--out", tmp_path / "a", "--mirror", "--master", "M-1/")
    config = tmp_path / "record.yaml"
    config.write_text("outt: x\n")
    assert "outt" in refusal("--out", tmp_path / "a", "--config", config)


class Master:
    """A master arm guided by hand: says where it is, 50 Hz, while the test listens."""

    def __init__(self, bench: Bench):
        self.bench, self.seq = bench, 0

    def say(self, q, closed=False) -> None:
        m = messages.lite6_status_t()
        self.seq += 1
        m.utime, m.seq, m.source = time.monotonic_ns() // 1000, self.seq, 77
        m.q = list(q)
        m.q_commanded = [0.0] * 6  # of an arm that nobody commands: means nothing
        m.gripper_closed = closed
        self.bench.bus.publish("MASTER_LITE6_STATUS", m)

    def move(self, begin, end, seconds: float, closed=False) -> None:
        begin, end = np.array(begin), np.array(end)
        t0 = time.monotonic()
        while (t := time.monotonic() - t0) < seconds:
            s = min(t / seconds, 1.0)
            self.say(begin + (0.5 - 0.5 * np.cos(np.pi * s)) * (end - begin), closed)
            self.bench.listen(0.02)
        self.say(end, closed)


def test_the_puppet_follows_the_master_holds_when_it_is_silent_and_follows_again(tmp_path):
    log = tmp_path / "mirror.lcmlog"
    with Bench(tmp_path, clock="wall", perception="truth") as bench:
        start_record(bench.processes, bench.url, log, "--mirror", "--json", tmp_path / "record.json")
        bench.plant()
        bench.until(lambda: bench.heard["LITE6_STATUS"], "the plant speaks")
        bench.listen(0.5)
        assert bench.status.state == IDLE  # the master has not said a word
        home = np.array(bench.status.q)
        away = home + [0.3, 0, 0, 0, 0, 0.2]
        master = Master(bench)
        master.move(home, away, 2.0, closed=True)
        for _ in range(100):
            master.say(away, closed=True)
            bench.listen(0.02)
        assert bench.status.state == TRACKING
        assert bench.status.gripper_closed
        np.testing.assert_allclose(bench.status.q, away, atol=2e-3)

        # Silence: it holds where it is, and however long that lasts it is no fault.
        silent_at = len(bench.heard["LITE6_STATUS"])
        bench.until(lambda: bench.status.state == HOLDING, "the puppet holds")
        bench.listen(3.0)
        assert FAULT not in bench.states_since(silent_at)
        assert bench.status.gripper_closed
        np.testing.assert_allclose(bench.status.q, away, atol=3e-3)

        # The master comes back elsewhere: the puppet closes up slowly, then follows.
        back_at = len(bench.heard["LITE6_STATUS"])
        there = away + [-0.4, 0, 0, 0, 0, 0]
        for _ in range(150):
            master.say(there)
            bench.listen(0.02)
        speeds = [abs(s.dq[0]) for s in bench.heard["LITE6_STATUS"][back_at:]]
        assert max(speeds) < 1.0  # the last 3 degrees may go faster
        np.testing.assert_allclose(bench.status.q, there, atol=2e-3)
        assert bench.processes.stop()["intabs_record"] == 0
    lines = (tmp_path / "intabs_record.log").read_text().splitlines()
    assert any("silent" in line for line in lines)
    assert any("follows" in line for line in lines)

    demo = demo_from_log(log)
    assert demo.attrs["rate_hz"] == 25
    assert "labels" not in demo.extra  # wall clock: nothing ties truth and status
    # Where the hand first moved it to where it came to rest last; steps add up to the way.
    np.testing.assert_allclose(demo.actions[:, :6].sum(0), there - home, atol=0.02)
    np.testing.assert_allclose(np.diff(demo.time), 0.04, atol=1e-9)


@pytest.mark.parametrize(("perception", "seed"), [("truth", 1), ("tags", 2)])
def test_a_recorded_demonstration_is_the_in_process_one_bit_for_bit(perception, seed):
    job = Job("pick_place", seed, 3.0, perception)
    recorded, twin = record(job), perform(job)
    assert recorded.attrs["success"] and twin.success
    np.testing.assert_array_equal(recorded.joint_pos, twin.q)
    np.testing.assert_array_equal(recorded.object_pose, twin.object_pose)
    np.testing.assert_array_equal(recorded.actions, twin.actions)
    np.testing.assert_allclose(np.diff(recorded.time), 0.04, atol=1e-9)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A log of a demonstration with changes of mind, and the demonstration."""
    log = tmp_path_factory.mktemp("recording") / "kept.lcmlog"
    demo = record(Job("drawer_open", 1, 3.0, "truth", 1.0, 0.6), keep_log=log)
    assert demo.attrs["success"]
    return log, demo


def test_labels_of_a_recording_agree_with_what_the_drawer_did(recording):
    _, demo = recording
    kinds = segments(demo.extra["labels"])
    names = [k for k, _, _ in kinds]
    assert names.index("reach") < names.index("grasp") < names.index("pull") < names.index("release")
    assert names[-1] in ("retreat", "wait")
    x_in = demo.object_pose[:, 3, :3] @ (np.array([np.cos(a := _yaw(demo.object_pose[0, 3])), np.sin(a), 0]))
    for kind, begin, end in kinds:
        way = x_in[end - 1] - x_in[begin]  # into the cabinet
        if kind == "pull":
            assert way < -0.005
        elif kind == "push":
            assert way > 0.005
        else:
            assert abs(way) < 0.006
    assert demo.gripper[np.isin(demo.extra["labels"], [KINDS.index("pull"), KINDS.index("push")])].all()


def _yaw(pose7) -> float:
    w, x, y, z = pose7[3:]
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def test_a_log_that_was_cut_off_gives_what_is_whole(recording, tmp_path):
    log, demo = recording
    data = log.read_bytes()
    cut = tmp_path / "cut.lcmlog"
    cut.write_bytes(data[: int(0.6 * len(data)) + 3])
    part = demo_from_log(cut)
    assert 20 < len(part) < len(demo)
    np.testing.assert_array_equal(part.joint_pos, demo.joint_pos[: len(part)])
    cut.write_bytes(b"no log at all" * 10)
    with pytest.raises(UserError, match="not an LCM log"):
        read_log(cut)


def test_what_is_sent_again_or_damaged_changes_nothing(recording, tmp_path):
    log, demo = recording
    twice = tmp_path / "twice.lcmlog"
    out = lcm.EventLog(str(twice), "w", overwrite=True)
    for event in lcm.EventLog(str(log), "r"):
        for _ in range(2):
            out.write_event(event.timestamp, event.channel, event.data)
        out.write_event(event.timestamp, event.channel, event.data[:-3])
    out.close()
    again = demo_from_log(twice)
    np.testing.assert_array_equal(again.joint_pos, demo.joint_pos)
    np.testing.assert_array_equal(again.actions, demo.actions)


def test_ctrl_c_in_collect_keeps_what_was_recorded(tmp_path):
    out = tmp_path / "demos.hdf5"
    code = "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "collect", "--task", "pick_place", "--demos", "200", "--jobs", "2"]
    with open(tmp_path / "err", "w") as err:
        process = subprocess.Popen(
            [*command, "--perception", "truth", "--out", str(out)], stderr=err, start_new_session=True
        )
    until = time.monotonic() + 300
    while not any(f" {n} of" in (tmp_path / "err").read_text() for n in range(2, 99)):
        assert time.monotonic() < until and process.poll() is None
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert process.wait(60) == 1
    lines = [s for s in (tmp_path / "err").read_text().splitlines() if not s.startswith("collect:")]
    assert len(lines) == 1, lines
    assert "interrupted" in lines[0] and str(out) in lines[0]
    demos, attrs = load_demos(out)
    assert len(demos) >= 2 and all(d.attrs["success"] for d in demos)
    assert f"keeps the {len(demos)} demonstrations" in lines[0]
