"""Who may include whom (cpp/README.md). A room sees only what its row names, so that what runs in the tick never sees
LCM, OpenCV, MuJoCo, KDL or iostream."""

import re
from pathlib import Path

import pytest

from intabs import paths

# room -> (rooms or single headers of ours, outside libraries). core and the C++ standard library are open to all.
RULES = {
    "core": ((), ("eigen",)),
    "rt": ((), ("eigen", "posix")),
    "nn": ((), ("eigen", "json", "posix")),
    "kinematics": ((), ("eigen", "urdf", "kdl")),
    "skills": (("nn", "kinematics/arm_model.h"), ("eigen", "json")),
    "control": (("kinematics/arm_model.h",), ("eigen",)),
    "perception": ((), ("eigen", "opencv", "apriltag", "yaml")),
    "camera": ((), ("eigen", "opencv", "realsense", "posix")),
    "bus": ((), ("eigen", "lcm", "posix")),
    "plant": (("kinematics",), ("eigen", "mujoco", "egl", "glfw", "posix")),
    "lite6": (("rt", "control"), ("eigen", "posix")),
    # The whole loop in one process, for rollouts: like an app it joins what the processes join, but for LCM.
    "sim": (("control", "kinematics", "plant", "perception", "skills", "nn"), ("eigen", "opencv")),
}
# These never meet what a tick must not do.
NO_IOSTREAM = ("nn", "skills", "control", "rt")
# kinematics hides the parser and the solver behind its own headers.
SOURCE_ONLY = {"kinematics": ("urdf", "kdl")}
BINDINGS_NOT = ("bus",)
BINDINGS_LIBRARIES = ("eigen", "pybind11", "opencv")
APP_LIBRARIES = ("eigen", "posix", "yaml", "cli11", "json", "opencv", "glfw", "mujoco")

LIBRARIES = {
    "eigen": r"Eigen/",
    "json": r"nlohmann/",
    "urdf": r"urdf_(parser|model|world|sensor)/|console_bridge/",
    "kdl": r"kdl/",
    "opencv": r"opencv2/",
    "apriltag": r"apriltag/|apriltag\.h|tag36h11\.h|common/",
    "realsense": r"librealsense2/",
    "lcm": r"lcm/|intabs_lcm/",
    "mujoco": r"mujoco/",
    "egl": r"EGL/|GL/|GLES",
    "glfw": r"GLFW/",
    "yaml": r"yaml-cpp/",
    "cli11": r"CLI/",
    "pybind11": r"pybind11/",
    "posix": r"(sys|netinet|arpa|net|linux)/"
    r"|(unistd|fcntl|pthread|sched|semaphore|poll|signal|dirent|time|errno|netdb|termios)\.h$",
}
# What is written <like_this> without a dot or slash is the standard library; its C headers are allowed by name.
STANDARD = re.compile(
    r"^[a-z_0-9]+$|^(stdint|stddef|math|string|stdlib|stdio|float|limits)\.h$|^(immintrin|x86intrin|cpuid)\.h$"
)
INCLUDE = re.compile(r'^\s*#\s*include\s*[<"]([^">]+)[">]', re.M)


def library(header: str) -> str:
    for name, pattern in LIBRARIES.items():
        if re.match(pattern, header):
            return name
    return "std" if STANDARD.match(header) else "unknown"


def allowed_ours(target: str, room: str, rooms: tuple) -> bool:
    """target: path below intabs/, e.g. nn/lstm.h"""
    return target.split("/")[0] in ("core", room, *rooms) or target in rooms


def violations(cpp: Path) -> list[str]:
    found = []

    def look(path: Path, rooms: tuple | None, room: str, libraries: tuple, never: tuple = ()) -> None:
        for header in INCLUDE.findall(path.read_text(errors="replace")):
            where = f"{path.relative_to(cpp)} includes {header}"
            if header.startswith("intabs/"):
                target = header.removeprefix("intabs/")
                open_to = rooms is None or allowed_ours(target, room, rooms)
                if not open_to or target.split("/")[0] in never:
                    found.append(where)
            elif "apps/" in header or "bindings/" in header:
                found.append(f"{where}: nobody includes an app")
            elif (kind := library(header)) == "std":
                if header == "iostream" and room in NO_IOSTREAM:
                    found.append(where)
            elif kind == "unknown":
                if not (path.parent / header).exists():
                    found.append(f"{where}: of which library? name it in this test")
            elif kind not in libraries:
                found.append(where)
            elif path.suffix == ".h" and kind in SOURCE_ONLY.get(room, ()):
                found.append(f"{where}: in .cc only")

    for path in sorted(p for p in cpp.rglob("*") if p.suffix in (".h", ".cc")):
        part = path.relative_to(cpp).parts
        if part[:2] == ("apps", "intabs_bench"):  # times the libraries that others would use beside ours
            look(path, None, "apps", (*APP_LIBRARIES, "apriltag"))
        elif part[0] == "apps":
            look(path, None, "apps", APP_LIBRARIES)
        elif part[0] == "bindings":
            look(path, None, "bindings", BINDINGS_LIBRARIES, BINDINGS_NOT)
        elif part[0] == "intabs" and part[1] in RULES:
            rooms, libraries = RULES[part[1]]
            look(path, rooms, part[1], libraries)
        else:
            found.append(f"{path.relative_to(cpp)}: this room is in no rule")
    return found


def test_every_include_keeps_to_the_rules():
    found = violations(paths.ROOT / "cpp")
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("intabs/control/a.h", '#include "intabs/kinematics/ik.h"'),
        ("intabs/skills/a.cc", '#include "intabs/bus/bus.h"'),
        ("intabs/nn/a.cc", "#include <iostream>"),
        ("intabs/nn/a.cc", "#include <opencv2/core.hpp>"),
        ("intabs/perception/a.cc", "#include <lcm/lcm-cpp.hpp>"),
        ("intabs/kinematics/ik.h", "#include <kdl/chain.hpp>"),
        ("intabs/camera/a.cc", "#include <mujoco/mujoco.h>"),
        ("intabs/core/a.h", "#include <torch/script.h>"),
        ("intabs/bus/a.cc", '#include "apps/intabs_plant/main.h"'),
        ("bindings/bind_a.cc", '#include "intabs/bus/bus.h"'),
        ("apps/intabs_plant/a.cc", "#include <apriltag/apriltag.h>"),
        ("intabs/attic/a.h", "#include <vector>"),
    ],
)
def test_a_forbidden_include_is_found(tmp_path, file, line):
    path = tmp_path / file
    path.parent.mkdir(parents=True)
    path.write_text(line + "\n")
    assert len(violations(tmp_path)) == 1


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("intabs/control/a.h", '#include "intabs/kinematics/arm_model.h"'),
        ("intabs/kinematics/ik.cc", "#include <kdl/chain.hpp>"),
        ("intabs/sim/a.h", '#include "intabs/plant/world.h"'),
        ("apps/intabs_plant/main.cc", "#include <CLI/CLI.hpp>"),
        ("intabs/rt/a.cc", "#include <sys/mman.h>"),
    ],
)
def test_an_allowed_include_passes(tmp_path, file, line):
    path = tmp_path / file
    path.parent.mkdir(parents=True)
    path.write_text(line + "\n")
    assert violations(tmp_path) == []
