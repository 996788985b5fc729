"""Groups, routes and child processes: what `intabs demo` stands on."""

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from intabs import bus, messages, paths
from intabs.errors import UserError
from intabs.processes import Processes

SH = "/bin/sh"


def wait_until(what, patience_s=10.0):
    until = time.monotonic() + patience_s
    while not what():
        assert time.monotonic() < until
        time.sleep(0.01)


def test_a_process_that_ends_on_its_own_is_named_with_its_last_line(tmp_path):
    with Processes(tmp_path) as processes:
        child = processes.start(SH, "-c", "echo starting; echo 'intabs_x: no camera' >&2; exit 3", name="intabs_x")
        child.wait()
        with pytest.raises(UserError, match=r"^intabs_x ended with exit code 3: intabs_x: no camera$"):
            processes.check()


def test_a_process_that_is_killed_is_named_with_the_signal(tmp_path):
    with Processes(tmp_path) as processes:
        child = processes.start(SH, "-c", "kill -9 $$", name="intabs_x")
        child.wait()
        with pytest.raises(UserError, match="intabs_x ended with signal SIGKILL"):
            processes.check()


def test_leaving_ends_every_process_even_a_deaf_one(tmp_path):
    with pytest.raises(RuntimeError), Processes(tmp_path) as processes:
        polite = processes.start("/bin/sleep", 60)
        deaf = processes.start(SH, "-c", "trap '' INT; echo deaf; while :; do sleep 0.1; done", name="deaf")
        wait_until(lambda: processes.last_line("deaf") == "deaf")
        stop = processes.stop
        processes.stop = lambda: stop(patience_s=0.3)
        raise RuntimeError
    assert polite.poll() == -signal.SIGINT
    assert deaf.poll() == -signal.SIGKILL


def test_processes_die_with_whoever_started_them(tmp_path):
    code = (
        "import os, sys; from intabs.processes import Processes;"
        f"p = Processes({str(tmp_path)!r}); print(p.start('/bin/sleep', 60).pid, flush=True);"
        "os.kill(os.getpid(), 9)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout

    def gone():
        try:
            return open(f"/proc/{int(said)}/stat").read().split(") ")[1][0] == "Z"
        except FileNotFoundError:
            return True

    wait_until(gone)


def test_a_private_group_is_one_that_nobody_uses():
    heard = []
    url = bus.private_url()
    listener, other, speaker = bus.Bus(url), bus.Bus(bus.private_url()), bus.Bus(url)
    listener.subscribe("ESTOP", heard.append)
    other.subscribe("ESTOP", lambda m: pytest.fail("heard on another group"))
    message = messages.estop_t()
    message.seq = 7
    speaker.publish("ESTOP", message)
    wait_until(lambda: listener.handle(100))
    assert [m.seq for m in heard] == [7]
    assert not other.handle(50)


def test_what_does_not_decode_is_counted_and_not_handed_on():
    url = bus.private_url()
    listener, speaker = bus.Bus(url), bus.Bus(url)
    for channel, kind in messages.CHANNELS.items():
        listener.subscribe(channel, lambda m: pytest.fail("handed on"))
        for data in (b"", b"garbage", kind._get_packed_fingerprint() + b"cut"):
            speaker.publish_raw(channel, data)
    wait_until(lambda: listener.handle(100) and listener.undecodable == 3 * len(messages.CHANNELS))


def test_a_long_plan_travels_in_parts_that_fit_a_datagram():
    skills = [{"z": [float(i)] * 16, "min_ticks": 1, "max_ticks": i + 1} for i in range(35)]
    parts = messages.plan_parts(5, skills)
    assert [(p.part, p.parts, p.n) for p in parts] == [(0, 3, 16), (1, 3, 16), (2, 3, 3)]
    assert max(len(p.encode()) for p in parts) <= 1400
    back = [messages.skill_plan_t.decode(p.encode()) for p in parts]
    assert [s.max_ticks for p in back for s in p.skills] == list(range(1, 36))


def test_without_a_network_the_line_that_is_printed_cures_it():
    alone = ["unshare", "-n"]
    if not shutil.which("unshare") or subprocess.run([*alone, "true"], capture_output=True).returncode:
        pytest.skip("unshare -n is not allowed here (needs root)")
    env = {**os.environ, "PYTHONPATH": str(paths.ROOT / "python")}

    def fault_after(line: str) -> str:
        ask = f'{line}\n"{sys.executable}" -c "from intabs import bus; print(bus.route_fault())"'
        return subprocess.run([*alone, SH, "-c", ask], capture_output=True, text=True, env=env).stdout.strip()

    assert fault_after("") not in ("", "None")
    assert fault_after("ip link set lo up") not in ("", "None")
    assert fault_after(bus.ROUTE_CURE) == "None"
