"""The command line: bad input ends in one line and a non-zero exit, torch stays out of the runtime."""

import json
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from intabs import paths
from intabs.commands.data import find_faults, inspect


def intabs(*args: object, cwd: Path | None = None) -> subprocess.CompletedProcess:
    code = "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, args)], capture_output=True, text=True, cwd=cwd, timeout=120
    )


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["nonsense"], "intabs: No such command"),
        (["demo", "--seed", "x"], "intabs demo: "),
        (["demo", "--seed", "-1"], "intabs demo: "),
        (["demo", "--perception", "guess"], "intabs demo: "),
        (["demo", "--nonsense"], "intabs demo: No such option"),
        (["data"], "intabs data: Missing command"),
        (["data", "info"], "intabs data info: Missing argument"),
        (["data", "info", "absent.hdf5"], "intabs data info: absent.hdf5: no such file"),
        (["data", "check", __file__], f"intabs data check: {__file__}: not an HDF5 file"),
    ],
)
def test_bad_input_ends_in_one_line(tmp_path, args, says):
    done = intabs(*args, cwd=tmp_path)
    assert done.returncode != 0
    assert done.stderr.startswith(says)
    assert len(done.stderr.splitlines()) == 1
    assert "Traceback" not in done.stdout + done.stderr


def test_help_lists_the_verbs_that_exist_and_no_others():
    done = intabs("--help")
    assert done.returncode == 0
    there = {p.stem for p in (paths.ROOT / "python/intabs/commands").glob("[a-z]*.py")}
    assert {"demo", "data", "doctor"} <= there
    assert set(re.findall(r"^│ (\w+) ", done.stdout, re.M)) == there


def test_torch_stays_out_of_the_runtime():
    code = (
        "import sys; from intabs.cli import run; run(['--help']); run(['demo', '--help']); import intabs.play;"
        "assert 'torch' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def write(path: Path, frames: int = 20, **change) -> Path:
    """A sound file of two demonstrations, but for `change`: field of demo_1 -> value, None: left out."""
    with h5py.File(path, "w") as f:
        data = f.create_group("data")
        data.attrs.update({"rate": 25.0, "embodiment": "lite6", "task": "pick_place"})
        for name in ("demo_0", "demo_1"):
            fields = {
                "obs/robot_joint_pos": np.zeros((frames, 6), "f4"),
                "obs/object_0_pose": np.tile(np.array([0, 0, 0, 1, 0, 0, 0], "f4"), (frames, 1)),
                "obs/object_0_valid": np.ones((frames, 1), "u1"),
                "obs/time": np.arange(frames) * 0.04,
                "actions": np.zeros((frames, 7), "f4"),
            }
            if name == "demo_1":
                fields.update(change)
            for field, value in fields.items():
                if value is not None:
                    data[f"{name}/{field}"] = value
        f["mask/train"] = np.array(["demo_0"], dtype="S")
        f["mask/valid"] = np.array(["demo_1"], dtype="S")
    return path


def test_data_info_says_what_a_file_holds(tmp_path):
    figures = inspect(write(tmp_path / "a.hdf5"))
    assert figures["demos"] == 2
    assert figures["frames"] == 40
    assert figures["rate_hz"] == 25.0
    assert figures["embodiment"] == "lite6"
    assert figures["tasks"] == {"pick_place": 2}
    assert figures["state"]["robot_joint_pos"] == [6]


def nan_at(row: int) -> np.ndarray:
    array = np.zeros((20, 6), "f4")
    array[row, 2] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"obs/robot_joint_pos": nan_at(7)}, "not finite"),
        ({"obs/robot_joint_pos": np.zeros((19, 6), "f4")}, "length"),
        ({"obs/time": np.zeros(20)}, "time"),
        ({"obs/object_0_pose": np.zeros((20, 7), "f4")}, "quaternion"),
        ({"obs/object_0_pose": np.zeros((20, 6), "f4")}, "shape"),
        ({"actions": None}, "missing"),
    ],
)
def test_data_check_finds_the_fault_and_only_that(tmp_path, change, kind):
    faults = find_faults(write(tmp_path / "a.hdf5", **change))
    assert [(f["demo"], f["kind"]) for f in faults] == [("demo_1", kind)], faults


def test_data_check_passes_a_sound_file_and_fails_a_faulty_one(tmp_path):
    sound = intabs("data", "check", write(tmp_path / "a.hdf5"), "--json", tmp_path / "a.json")
    assert sound.returncode == 0, sound.stderr
    assert json.loads((tmp_path / "a.json").read_text()) == {"faults": []}
    faulty = intabs("data", "check", write(tmp_path / "b.hdf5", **{"obs/time": np.zeros(20)}))
    assert faulty.returncode == 1
    assert "1 fault" in faulty.stderr


def test_an_unused_object_slot_is_no_fault(tmp_path):
    change = {"obs/object_0_pose": np.zeros((20, 7), "f4"), "obs/object_0_valid": np.zeros((20, 1), "u1")}
    assert find_faults(write(tmp_path / "a.hdf5", **change)) == []


def test_setup_refuses_what_it_does_not_know():
    done = subprocess.run([paths.ROOT / "tools/setup", "--nonsense"], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("tools/setup: unknown argument '--nonsense'")
