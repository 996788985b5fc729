"""`intabs doctor`: what it finds on this machine, on a controller that answers, and on one that does not."""

import json
import socket
import subprocess
import sys
import threading
import time

import pytest

from intabs import bus, paths
from intabs.commands import doctor


def run(*args: object) -> subprocess.CompletedProcess:
    code = "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))"
    return subprocess.run(
        [sys.executable, "-c", code, "doctor", *map(str, args)], capture_output=True, text=True, timeout=60
    )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def fake_port():
    """A fake controller, ready to be asked."""
    if not (paths.BIN / "intabs_fake_lite6").exists():
        pytest.skip(f"intabs_fake_lite6 is not built in {paths.BIN}")
    port = free_port()
    fake = subprocess.Popen(
        [paths.program("intabs_fake_lite6"), "--port", str(port), "--report-port-base", "0"], stderr=subprocess.DEVNULL
    )
    try:
        for _ in range(100):
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                time.sleep(0.05)
        yield port
    finally:
        fake.terminate()
        fake.wait()


def test_every_check_tells_its_name_and_what_to_do(tmp_path):
    done = run("--json", tmp_path / "doctor.json")
    checks = json.loads((tmp_path / "doctor.json").read_text())["checks"]
    assert {c["name"] for c in checks} >= {
        "Debian packages", "Python packages", "C++ programs", "LCM route", "LCM loss", "headless rendering (EGL)",
        "real-time rights", "scheduler", "clock", "cameras", "arm", "firmware",
    }  # fmt: skip
    assert all(c["ok"] or c["hint"] for c in checks)
    # Without --host no arm, and nothing that only an arm needs, can fail the command.
    missing = [c["name"] for c in checks if c["needed"] and not c["ok"]]
    assert done.returncode == (1 if missing else 0)
    assert not {"arm", "firmware", "cameras", "real-time rights", "scheduler"} & set(missing)
    assert "Traceback" not in done.stderr


def test_an_arm_that_answers_is_named_with_its_firmware(fake_port):
    reachable, firmware = doctor.arm("127.0.0.1", fake_port)
    assert reachable["ok"], reachable
    assert firmware["ok"], firmware
    assert firmware["hint"].startswith("6,9,")


def test_an_arm_that_is_not_there_fails_the_command_and_says_what_to_do(tmp_path):
    done = run("--host", "127.0.0.1", "--port", free_port(), "--json", tmp_path / "doctor.json")
    assert done.returncode == 1
    assert "arm" in done.stderr.splitlines()[-1]
    checks = {c["name"]: c for c in json.loads((tmp_path / "doctor.json").read_text())["checks"]}
    assert not checks["arm"]["ok"]
    assert "switched on" in checks["arm"]["hint"]


def test_something_else_on_the_port_is_not_taken_for_an_arm():
    """Closes at once, talks nonsense, says it is another arm."""
    answers = (b"", b"HTTP/1.1 400\r\n\r\n", bytes.fromhex("000100020014 0100") + b"7,7,XI1300,AC1300,v2.5.0"[:18])
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            for answer in answers:
                link, _ = server.accept()
                with link:
                    link.recv(100)
                    link.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        for _ in answers:
            reachable, firmware = doctor.arm("127.0.0.1", server.getsockname()[1])
            assert reachable["ok"]
            assert not firmware["ok"]
        thread.join()


@pytest.mark.parametrize(
    ("version", "fault"),
    [
        ("6,9,LI1003,DL1000,v2.5.0", ""),
        ("6,9,LI1003,DL1000,v1.8.6", "older than 1.9.0"),
        ("7,7,XI1300,AC1300,v2.5.0", "a Lite 6 says 6, 9"),
        ("", "no version"),
        ("6,9,LI1003,DL1000,vX", "no version"),
    ],
)
def test_the_version_decides_what_is_said(version, fault):
    assert (fault in doctor._firmware_fault(version)) if fault else doctor._firmware_fault(version) == ""


def test_lost_messages_are_counted():
    if bus.route_fault():
        pytest.skip(f"no multicast route: {bus.ROUTE_CURE}")
    assert doctor.lcm_loss(messages=200, rate_hz=500)["ok"]
    # Faster than anybody can read them, and more than the socket holds.
    flooded = doctor.lcm_loss(messages=30000, rate_hz=1e9)
    assert flooded["ok"] or "lost" in flooded["hint"]
