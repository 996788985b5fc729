"""The driver against the fake controller, on an LCM group and ports of their own, and a session that commands."""

from __future__ import annotations

import json
import random
import socket
import threading
import time
from pathlib import Path

import pytest

from intabs import bus, messages, paths
from intabs.processes import Processes, free_ports

IDLE, TRACKING, SLOWING, HOLDING, FAULT, STOPPED, ALIGNING = range(7)  # core/types.h ArmState
STALE_COMMAND, ESTOP, STALE_STATUS, LINK, VENDOR, OVERRUN = range(1, 7)  # Fault
HOME = [0, -0.0163937938, 0.7773193333, 0, 0.7937131272, 0]
TICK_US = 4000


def need_lite6() -> None:
    """Skips the module where it cannot run."""
    missing = [n for n in ("intabs_lite6", "intabs_fake_lite6") if not (paths.BIN / n).exists()]
    if missing:
        pytest.skip(f"not built in {paths.BIN}: {', '.join(missing)}", allow_module_level=True)
    if fault := bus.route_fault():
        pytest.skip(f"no multicast route ({fault}): {bus.ROUTE_CURE}", allow_module_level=True)


class Fake:
    """A running intabs_fake_lite6 and a line to give it orders."""

    def __init__(self, processes: Processes, *args: object, base: int = 0, name: str = "intabs_fake_lite6"):
        base = base or free_ports(6)
        self.port, self.reports, self.orders = base, base + 1, base + 5
        self.process = processes.start(
            paths.program("intabs_fake_lite6"),
            *("--port", self.port, "--report-port-base", self.reports, "--orders-port", self.orders, *args),
            name=name,
        )
        until = time.monotonic() + 60
        while True:
            try:
                self.line = socket.create_connection(("127.0.0.1", self.orders), timeout=10).makefile("rw")
                return
            except OSError:
                assert self.process.poll() is None, processes.last_line(name)
                assert time.monotonic() < until
                time.sleep(0.05)

    def order(self, text: str) -> dict:
        self.line.write(text + "\n")
        self.line.flush()
        answer = json.loads(self.line.readline())
        assert "error" not in answer or "mode" in answer, answer
        return answer

    @property
    def state(self) -> dict:
        return self.order("state")


class Session(threading.Thread):
    """A control program that is not there: 25 targets a second, from a thread of its own."""

    def __init__(self, url: str, prefix: str = "", path=lambda _t: HOME, rate_hz: float = 25):
        super().__init__(daemon=True)
        self.bus, self.channel, self.rate_hz = bus.Bus(url), f"{prefix}LITE6_COMMAND", rate_hz
        messages.CHANNELS.setdefault(self.channel, messages.lite6_command_t)
        self.id = random.SystemRandom().randrange(1, 2**62)
        self.path = path  # s since the start -> joint target
        self.gripper = False
        self.seq, self.ended, self.began = 0, False, time.monotonic()

    def run(self) -> None:
        due = time.monotonic()
        while not self.ended:
            self.send(self.path(time.monotonic() - self.began))
            due += 1 / self.rate_hz
            time.sleep(max(0.0, due - time.monotonic()))

    def send(self, q) -> None:
        self.seq += 1
        m = messages.lite6_command_t()
        m.seq, m.session, m.mode = self.seq, self.id, 1
        m.q_target, m.dq_max = list(q), [2.14] * 6
        m.gripper_closed = self.gripper
        m.lifetime_us = 200_000
        self.bus.publish(self.channel, m)

    def end(self) -> None:
        self.ended = True
        self.join()


class Lite6Bench:
    def __init__(self, folder: Path, *fake_args: object, prefix: str = ""):
        self.folder, self.prefix = folder, prefix
        self.url = bus.private_url()
        self.processes = Processes(folder)
        self.fake = Fake(self.processes, *fake_args)
        self.sessions: list[Session] = []
        self.bus = bus.Bus(self.url)
        self.statuses: list[messages.lite6_status_t] = []
        self.loops: list[messages.loop_status_t] = []
        for name, kept in (("LITE6_STATUS", self.statuses), ("LOOP_STATUS", self.loops)):
            messages.CHANNELS.setdefault(prefix + name, messages.CHANNELS[name])
            self.bus.subscribe(prefix + name, kept.append)

    def __enter__(self) -> Lite6Bench:
        return self

    def __exit__(self, *_exc) -> None:
        for s in self.sessions:
            s.ended = True
        self.processes.stop()

    def driver(self, *args: object, report_port: int | None = None, name: str = "intabs_lite6"):
        report_port = self.fake.reports if report_port is None else report_port
        process = self.processes.start(
            paths.program("intabs_lite6"),
            *("--host", "127.0.0.1", "--port", self.fake.port, "--report-port", report_port),
            *("--lcm", self.url, "--json", self.folder / "lite6.json", "--flight", self.folder / "flight"),
            *(("--prefix", self.prefix) if self.prefix else ()),
            *args,
            name=name,
        )
        self.until(lambda: self.statuses, "the driver speaks")
        return process

    def session(self, **kwargs) -> Session:
        s = Session(self.url, self.prefix, **kwargs)
        self.sessions.append(s)
        s.start()
        return s

    def reset(self, session: int) -> None:
        m = messages.reset_t()
        m.session = session
        messages.CHANNELS.setdefault(self.prefix + "RESET", messages.reset_t)
        self.bus.publish(self.prefix + "RESET", m)

    def estop(self) -> None:
        m = messages.estop_t()
        m.reason = "test"
        messages.CHANNELS.setdefault(self.prefix + "ESTOP", messages.estop_t)
        self.bus.publish(self.prefix + "ESTOP", m)

    def until(self, what, name: str, patience_s: float = 30) -> None:
        end = time.monotonic() + patience_s
        while not what():
            said = {n: self.processes.last_line(n) for n in self.processes.running}
            assert time.monotonic() < end, f"waited {patience_s} s in vain: {name}; {said}"
            self.bus.handle(50)

    def listen(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.bus.handle(max(1, int(1000 * left)))

    @property
    def status(self) -> messages.lite6_status_t:
        return self.statuses[-1]

    @property
    def state(self) -> int:
        return self.status.state

    def states_since(self, index: int) -> list[int]:
        states = [s.state for s in self.statuses[index:]]
        return [s for i, s in enumerate(states) if i == 0 or s != states[i - 1]]
