"""`intabs doctor`: what is installed, missing or misconfigured, and what to do about it."""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.metadata
import os
import platform
import resource
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path
from typing import Annotated

import typer

from intabs import paths
from intabs.errors import UserError
from intabs.output import Progress, write_json

ARM_PORT = 502
TIMEOUT_S = 2.0


def register(app: typer.Typer) -> None:
    @app.command()
    def doctor(
        host: Annotated[str | None, typer.Option(help="An arm's address: look at it and at what it needs.")] = None,
        port: Annotated[int, typer.Option(help="Its control port.", min=1, max=65535)] = ARM_PORT,
        json: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
    ) -> None:
        """Check this machine: packages, programs, LCM's route and loss, rendering; rights, scheduler, clock and cameras
        as an arm needs them; the arm itself."""
        # What an arm alone needs fails the command only where there is one.
        needed = (debian_packages, python_packages, programs, lcm_route, lcm_loss, egl)
        for_an_arm = (realtime_rights, scheduler, clock, cameras)
        checks = []
        with Progress("doctor", total=len(needed) + len(for_an_arm) + 1) as progress:
            for check in (*needed, *for_an_arm):
                progress.update(len(checks), check.__name__.replace("_", " "))
                checks.append(check() | {"needed": check in needed or host is not None})
            progress.update(len(checks), "arm")
            checks += [c | {"needed": host is not None} for c in arm(host, port)]
        write_json(json, {"checks": checks})
        for check in checks:
            state = "ok     " if check["ok"] else "MISSING" if check["needed"] else "absent "
            print(f"{state} {check['name']}" + (f": {check['hint']}" if check["hint"] else ""))
        bad = [c["name"] for c in checks if c["needed"] and not c["ok"]]
        if bad:
            raise UserError(f"not in order: {', '.join(bad)}")


def _check(name: str, fault: str, said: str = "") -> dict:
    """`fault`: what is wrong and what to do; without one, `said` may tell what was found."""
    return {"name": name, "ok": not fault, "hint": fault or said}


def debian_packages() -> dict:
    lines = (paths.ROOT / "tools" / "debian-packages.txt").read_text().splitlines()
    wanted = {word for line in lines for word in line.split("#")[0].split()}
    try:
        said = subprocess.run(
            ["dpkg-query", "-W", "-f=${Package} ${db:Status-Status}\n", *sorted(wanted)], capture_output=True, text=True
        ).stdout
    except FileNotFoundError:
        return _check("Debian packages", "dpkg is not here: this needs Debian 12, or a system like it")
    missing = wanted - {line.split()[0] for line in said.splitlines() if line.endswith(" installed")}
    return _check("Debian packages", f"run tools/setup ({', '.join(sorted(missing))})" if missing else "")


def python_packages() -> dict:
    """What pyproject.toml asks for at run time; torch is the training side's."""
    missing = []
    for requirement in importlib.metadata.requires("intabs") or []:
        if "extra ==" in requirement:
            continue
        name = requirement.split(";")[0].split(">")[0].split("=")[0].strip()
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    return _check("Python packages", f"run tools/setup --runtime-only ({', '.join(missing)})" if missing else "")


def programs() -> dict:
    names = ("intabs_plant", "intabs_perception", "intabs_control", "intabs_lite6", "intabs_record")
    missing = [n for n in names if not (paths.BIN / n).exists()]
    return _check("C++ programs", f"run tools/setup --runtime-only ({', '.join(missing)})" if missing else "")


def lcm_route() -> dict:
    from intabs import bus

    fault = bus.route_fault()
    return _check("LCM route", f"{fault}; run as root: {bus.ROUTE_CURE}" if fault else "")


def lcm_loss(messages: int = 2000, rate_hz: float = 2000) -> dict:
    """As many messages of 1400 bytes as a busy system sends in four seconds, within one."""
    import lcm

    from intabs import bus

    name = "LCM loss"
    if bus.route_fault():
        return _check(name, "not looked at: LCM has no route")
    url = bus.private_url()
    receiver, sender = lcm.LCM(url), lcm.LCM(url)
    got = 0

    def count(_channel: str, _data: bytes) -> None:
        nonlocal got
        got += 1

    receiver.subscribe("DOCTOR", count).set_queue_capacity(0)
    sent = threading.Event()

    def send() -> None:
        payload = bytes(1400)
        begin = time.monotonic()
        for i in range(messages):
            sender.publish("DOCTOR", payload)
            while time.monotonic() < begin + i / rate_hz:
                time.sleep(0.0005)
        sent.set()

    thread = threading.Thread(target=send)
    thread.start()
    while receiver.handle_timeout(200) > 0 or not sent.is_set():
        pass
    thread.join()
    lost = messages - got
    cure = "free the CPUs, and raise the socket buffer: sysctl -w net.core.rmem_max=4194304"
    return _check(name, f"{lost} of {messages} messages lost: {cure}" if lost else "", f"0 of {messages}")


def realtime_rights() -> dict:
    """What EnterRealtime (cpp/intabs/rt/realtime.h) will be given."""
    if os.geteuid() == 0:
        return _check("real-time rights", "")
    short = []
    if resource.getrlimit(resource.RLIMIT_RTPRIO)[0] < 80:
        short.append("rtprio 80")
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        short.append("memlock unlimited")
    cure = f"as root: echo '{os.environ.get('USER', 'USER')} - rtprio 80' and '... - memlock unlimited' into"
    fault = f"{' and '.join(short)} not allowed; {cure} /etc/security/limits.d/intabs.conf, then log in anew"
    return _check("real-time rights", fault if short else "")


def scheduler() -> dict:
    faults = []
    if "PREEMPT_RT" not in platform.version():
        faults.append("the kernel is not PREEMPT_RT (Debian: linux-image-rt-amd64)")
    slow = [p for p in Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
            if p.read_text().strip() not in ("performance", "schedutil")]  # fmt: skip
    if slow:
        faults.append("the CPUs save power (cpupower frequency-set -g performance)")
    budget = Path("/proc/sys/kernel/sched_rt_runtime_us")
    if budget.exists() and budget.read_text().strip() == "0":
        faults.append("real-time threads get no CPU time (sysctl -w kernel.sched_rt_runtime_us=950000)")
    said = f"{os.cpu_count()} CPUs; intabs_bench loop says how late a loop wakes up"
    return _check("scheduler", f"{'; '.join(faults)}; {said}" if faults else "", said)


class _Timex(ctypes.Structure):
    # struct timex of <sys/timex.h>, 64 bit: what comes before the status; the rest is room.
    _fields_ = [("modes", ctypes.c_uint), ("numbers", ctypes.c_long * 4), ("status", ctypes.c_int),
                ("rest", ctypes.c_byte * 256)]  # fmt: skip


def clock() -> dict:
    """The loops run on the monotonic clock; several hosts on one bus need theirs in step."""
    faults = []
    source = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    if source.exists() and (name := source.read_text().strip()) in ("hpet", "acpi_pm", "jiffies"):
        faults.append(f"the clock source is {name}, which is slow (kernel option clocksource=tsc)")
    timex = _Timex()
    libc = ctypes.CDLL(ctypes.util.find_library("c"), use_errno=True)
    unsynchronised = libc.adjtimex(ctypes.byref(timex)) == 5 or timex.status & 0x40  # TIME_ERROR, STA_UNSYNC
    said = "not in step with a time server: matters when several hosts share a bus (systemctl enable --now chrony)"
    return _check("clock", "; ".join(faults), said if unsynchronised else "")


def cameras() -> dict:
    name = "cameras"
    devices = sorted(Path("/dev").glob("video*"))
    if not devices:
        return _check(name, "no /dev/video*: plug one in; intabs_plant has simulated ones")
    closed = [str(d) for d in devices if not os.access(d, os.R_OK | os.W_OK)]
    if closed:
        cure = f"usermod -aG video {os.environ.get('USER', 'USER')}, log in anew"
        return _check(name, f"{', '.join(closed)}: not allowed; {cure}")
    return _check(name, "", ", ".join(map(str, devices)))


def arm(host: str | None, port: int) -> list[dict]:
    """Reachable, and what it says it is. Asks for its version alone (register 1 of the vendor's protocol)."""
    reachable, firmware = "arm", "firmware"
    if host is None:
        hint = "not looked at: give --host ADDRESS"
        return [_check(reachable, hint), _check(firmware, hint)]
    begin = time.monotonic()
    try:
        link = socket.create_connection((host, port), timeout=TIMEOUT_S)
    except OSError as e:
        why = f"{host}:{port}: {e}; is it switched on, on this network, and is this its address?"
        return [_check(reachable, why), _check(firmware, "not looked at: no connection")]
    took = f"{1e3 * (time.monotonic() - begin):.1f} ms"
    with link:
        link.settimeout(TIMEOUT_S)
        try:
            link.sendall(struct.pack(">HHHB", 1, 2, 1, 1))
            body = _receive(link, struct.unpack(">HHH", _receive(link, 6))[2])
        except (OSError, EOFError) as e:
            return [_check(reachable, "", took), _check(firmware, f"tells no version ({e}): is it a Lite 6?")]
    version = body[2:].split(b"\0")[0].decode(errors="replace").strip()
    return [_check(reachable, "", took), _check(firmware, _firmware_fault(version), version)]


def _firmware_fault(version: str) -> str:
    """Of "6,9,LI1003,DL1000,v2.5.0": axes, type (9: Lite 6), serial numbers, version."""
    fields = version.split(",")
    if len(fields) < 5 or not fields[-1].lstrip("v").replace(".", "").isdigit():
        return f"answers '{version}', which is no version of a Lite 6"
    if fields[:2] != ["6", "9"]:
        return f"{version}: {fields[0]} axes, type {fields[1]}; a Lite 6 says 6, 9"
    if tuple(int(n) for n in fields[-1].lstrip("v").split(".")) < (1, 9, 0):
        return f"{version}: older than 1.9.0, which first tells joint speeds; update it with the vendor's studio"
    return ""


def _receive(link: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = link.recv(size - len(data))
        if not part:
            raise EOFError("it closed the connection")
        data += part
    return data


def egl() -> dict:
    """A display without a window system, as the cameras of the plant want it."""
    hint = "install libegl1, libegl-mesa0 and libgl1-mesa-dri (tools/setup does)"
    try:
        lib = ctypes.CDLL("libEGL.so.1")
    except OSError as e:
        return _check("headless rendering (EGL)", f"{e}; {hint}")
    lib.eglGetPlatformDisplay.restype = ctypes.c_void_p
    lib.eglGetPlatformDisplay.argtypes = [ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p]
    lib.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    surfaceless = 0x31DD  # EGL_PLATFORM_SURFACELESS_MESA
    display = lib.eglGetPlatformDisplay(surfaceless, None, None)
    if not display or not lib.eglInitialize(display, None, None):
        return _check("headless rendering (EGL)", f"no surfaceless display; {hint}")
    lib.eglTerminate.argtypes = [ctypes.c_void_p]
    lib.eglTerminate(display)
    return _check("headless rendering (EGL)", "")
