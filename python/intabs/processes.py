"""The C++ programs of one run: started together, watched, always stopped.

Each writes what it says to a log file of its own. If one ends on its own, `check` says which, and its last line.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from intabs.errors import UserError

_libc = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


def _die_with_parent() -> None:
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Processes:
    """Use as a context manager: leaving it ends what still runs, whatever happened."""

    def __init__(self, log_dir: Path):
        self.log_dir = Path(log_dir)
        self.log_dir.mkdir(parents=True, exist_ok=True)
        self.running: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_exc) -> None:
        self.stop()

    def log(self, name: str) -> Path:
        return self.log_dir / f"{name}.log"

    def start(self, program: Path, *args: object, name: str | None = None) -> subprocess.Popen:
        """`name` tells two processes of one program apart. A session of its own: Ctrl-C on the terminal goes to us
        alone, and we end the programs in good order."""
        name = name or Path(program).name
        with open(self.log(name), "wb") as out:
            process = subprocess.Popen(
                [str(program), *map(str, args)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent,
            )
        self.running[name] = process
        return process

    def last_line(self, name: str) -> str:
        """The last thing `name` said; its own error line if there is one."""
        lines = [s.strip() for s in self.log(name).read_text(errors="replace").splitlines() if s.strip()]
        own = [s for s in lines if s.startswith("intabs_")]
        return (own or lines or ["(it said nothing)"])[-1]

    def check(self) -> None:
        """Raises UserError if one has ended on its own."""
        for name, process in self.running.items():
            code = process.poll()
            if code is not None:
                raise UserError(f"{name} ended with {_how(code)}: {self.last_line(name)}")

    def stop(self, patience_s: float = 10.0) -> dict[str, int]:
        """SIGINT to all at once, SIGKILL to who does not listen. Returns exit codes."""
        codes = {}
        for process in self.running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        until = time.monotonic() + patience_s
        for name, process in self.running.items():
            try:
                codes[name] = process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                codes[name] = process.wait()
        self.running.clear()
        return codes


def _how(code: int) -> str:
    return f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"


@contextlib.contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM and SIGHUP end a run like Ctrl-C does: through the clean-up."""

    def interrupt(signum, _frame):
        raise KeyboardInterrupt

    # Under nohup SIGHUP is ignored, and stays so.
    chosen = [s for s in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(s) != signal.SIG_IGN]
    before = {s: signal.signal(s, interrupt) for s in chosen}
    try:
        yield
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


def free_ports(n: int) -> int:
    """The first of n TCP ports in a row that nobody listens on."""
    while True:
        base = random.SystemRandom().randrange(20000, 32000 - n)  # below the ephemeral ports
        with contextlib.ExitStack() as stack:
            try:
                for port in range(base, base + n):
                    probe = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
                    probe.bind(("127.0.0.1", port))
                return base
            except OSError:
                continue


def shared_memory_name() -> str:
    """A name for a frame ring that no other run on this machine uses."""
    return f"/intabs_{os.getpid()}_{time.monotonic_ns() % 1_000_000_000}"
