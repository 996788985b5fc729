"""`intabs doctor`: what is installed, missing or misconfigured, and what to do about it."""

from __future__ import annotations

import ctypes
import importlib.metadata
import subprocess
from pathlib import Path
from typing import Annotated

import typer

from intabs import paths
from intabs.errors import UserError
from intabs.output import write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def doctor(json: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None) -> None:
        """Check this machine: packages, programs, LCM's route, headless rendering."""
        checks = [check() for check in (debian_packages, python_packages, programs, lcm_route, egl)]
        write_json(json, {"checks": checks})
        for check in checks:
            state = "ok     " if check["ok"] else "MISSING"
            print(f"{state} {check['name']}" + (f": {check['hint']}" if check["hint"] else ""))
        bad = [c["name"] for c in checks if not c["ok"]]
        if bad:
            raise UserError(f"not in order: {', '.join(bad)}")


def _check(name: str, hint: str) -> dict:
    return {"name": name, "ok": not hint, "hint": hint}


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
    names = ("intabs_plant", "intabs_perception", "intabs_control")
    missing = [n for n in names if not (paths.BIN / n).exists()]
    return _check("C++ programs", f"run tools/setup --runtime-only ({', '.join(missing)})" if missing else "")


def lcm_route() -> dict:
    from intabs import bus

    fault = bus.route_fault()
    return _check("LCM route", f"{fault}; run as root: {bus.ROUTE_CURE}" if fault else "")


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
