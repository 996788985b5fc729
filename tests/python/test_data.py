"""Files of demonstrations: what `check` finds, what editing leaves, that nothing broken ends in a traceback."""

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from intabs import paths
from intabs.cli import run
from intabs.data import demos as formats
from intabs.data import edit, synthetic, view
from intabs.data.check import find_faults
from intabs.data.demos import Demo, DemoWriter, load_demos, save_demos
from intabs.data.reader import DemoFile, inspect
from intabs.errors import UserError

FRAMES = 120
N = 6
SHIPPED = sorted((paths.MODELS / "demos").glob("*.hdf5"))
# The package lies wherever it is installed: `pip install --no-deps robomimic` is enough for its script.
ROBOMIMIC = os.environ.get("INTABS_ROBOMIMIC")


def write(path: Path, packed: bool = False, n: int = N, **attrs) -> Path:
    rng = np.random.default_rng(3)
    with DemoWriter(path, {"embodiment": "lite6", "rate_hz": 25.0} | attrs, 0.34, packed) as writer:
        for k in range(n):
            d = synthetic.demo(rng, FRAMES)
            d.attrs = {"task": f"task_{k % 2}", "seed": k, "success": True}
            d.extra["labels"] = np.repeat(np.arange(3), FRAMES // 3).astype("u1")
            writer.add(d)
    return path


@pytest.fixture(params=["a group each", "packed"])
def sound(request, tmp_path):
    return write(tmp_path / "a.hdf5", request.param == "packed")


class Plant:
    """Writes into demo_3 of either layout."""

    def __init__(self, path: Path):
        self.file = h5py.File(path, "r+")
        self.packed = "packed" in self.file
        self.rows = slice(3 * FRAMES, 4 * FRAMES) if self.packed else slice(None)
        self.group = self.file["packed" if self.packed else "data/demo_3"]

    def change(self, field: str, f) -> None:
        dataset = self.group[f"obs/{field}"]
        value = dataset[self.rows]
        f(value)
        dataset[self.rows] = value


def nan(x):
    x[7, 2] = np.nan


def back(x):
    x[50:] -= 0.5


def repeat(x):
    x[60] = x[59]


def jump(x):
    x[70:, 1] += 0.4


def spike(x):
    x[70, 1] += 0.4


def move(x):
    x[70:, :3] += 0.3


def turn(x):
    w, z = np.cos(np.pi / 4), np.sin(np.pi / 4)
    q = x[70:, 3:].copy()
    x[70:, 3:] = np.stack([w * q[:, 0] - z * q[:, 3], w * q[:, 1] - z * q[:, 2],
                           w * q[:, 2] + z * q[:, 1], w * q[:, 3] + z * q[:, 0]], axis=1)  # fmt: skip


def stretch(x):
    x[30:40, 3:] *= 1.1


def reorder(x):
    x[:, 3:] = np.roll(x[:, 3:], -1, axis=1)


def slower(x):
    x *= 2


def zero(x):
    x[:] = 0


def degrees(x):
    x[:] = np.degrees(x)


def millimetres(x):
    x[:, :3] *= 1000


def three(x):
    x[5] = 3


MOVING = ("robot_joint_pos", "object_0_pose", "object_1_pose", "object_2_pose")
PLANTED = {
    "a number that is none": (("robot_joint_pos",), nan, "not finite"),
    "time that goes back": (("time",), back, "time"),
    "a frame twice": (MOVING, repeat, "doubled"),
    "joints that jump": (("robot_joint_pos",), jump, "jump"),
    "joints that jump for one frame": (("robot_joint_pos",), spike, "jump"),
    "an object that jumps": (("object_1_pose",), move, "jump"),
    "an object that turns at once": (("object_1_pose",), turn, "jump"),
    "a quaternion that is none": (("object_2_pose",), stretch, "quaternion"),
    "quaternions as x, y, z, w": (("object_1_pose",), reorder, "quaternion order"),
    "a rate that is not what it says": (("time",), slower, "rate"),
    "a gripper that never moves": (("robot_gripper",), zero, "gripper"),
    "an object that is never seen": (("object_1_valid",), zero, "never valid"),
    "joints in degrees": (("robot_joint_pos",), degrees, "unit"),
    "an object in millimetres": (("object_2_pose",), millimetres, "unit"),
    "a validity that is none": (("object_0_valid",), three, "range"),
}


def test_a_sound_file_has_no_faults(sound):
    assert find_faults(sound) == []


@pytest.mark.parametrize("fault", PLANTED)
def test_check_names_what_is_planted_and_nothing_else(sound, fault):
    fields, f, kind = PLANTED[fault]
    plant = Plant(sound)
    for field in fields:
        plant.change(field, f)
    plant.file.close()
    faults = find_faults(sound)
    assert {x["demo"] for x in faults} == {"demo_3"}, faults
    assert kind in {x["kind"] for x in faults}, faults
    assert {x["kind"] for x in faults} == {kind}, faults
    assert any(field in x["where"] for field in fields for x in faults) or kind in ("doubled", "time", "rate"), faults


def put(group, field, value):
    del group[field]
    group[field] = value


STRUCTURE = {
    "an observation is missing": (lambda g: g.__delitem__("obs/object_1_pose"), "missing"),
    "the validity of an object is missing": (lambda g: g.__delitem__("obs/object_1_valid"), "missing"),
    "the joints are missing": (lambda g: g.__delitem__("obs/robot_joint_pos"), "missing"),
    "the actions are missing": (lambda g: g.__delitem__("actions"), "missing"),
    "all observations are missing": (lambda g: g.__delitem__("obs"), "missing"),
    "three joints": (lambda g: put(g, "obs/robot_joint_pos", np.zeros((FRAMES, 3), "f4")), "shape"),
    "poses of six numbers": (lambda g: put(g, "obs/object_0_pose", np.zeros((FRAMES, 6), "f4")), "shape"),
    "a field too short": (lambda g: put(g, "obs/robot_joint_vel", np.zeros((FRAMES - 1, 6), "f4")), "length"),
    "a field of one value": (lambda g: put(g, "obs/robot_joint_vel", 3.0), "length"),
    "text for numbers": (lambda g: put(g, "obs/robot_gripper", np.array([[b"x"]] * FRAMES)), "type"),
    "observations that are one array": (lambda g: put(g, "obs", np.zeros((FRAMES, 6), "f4")), "missing"),
    "actions that are one number": (lambda g: put(g, "actions", 1.0), "length"),
    "a wrong number of samples": (lambda g: g.attrs.__setitem__("num_samples", 5), "length"),
    "a rate that is text": (lambda g: g.attrs.__setitem__("rate_hz", "fast"), "attribute"),
}


@pytest.mark.parametrize("fault", STRUCTURE)
def test_check_names_what_is_missing_or_misshapen(tmp_path, fault):
    path = write(tmp_path / "a.hdf5")
    f, kind = STRUCTURE[fault]
    with h5py.File(path, "r+") as file:
        f(file["data/demo_3"])
    faults = find_faults(path)
    assert {x["demo"] for x in faults} == {"demo_3"}, faults
    assert kind in {x["kind"] for x in faults}, faults
    if fault not in ("a wrong number of samples", "a rate that is text"):
        with pytest.raises(UserError):
            load_demos(path)


def test_check_names_a_file_without_embodiment_and_rate(tmp_path):
    path = write(tmp_path / "a.hdf5")
    with h5py.File(path, "r+") as f:
        del f["data"].attrs["embodiment"]
        del f["data"].attrs["rate_hz"]
    assert {x["kind"] for x in find_faults(path)} == {"attribute"}


def test_check_finds_reordered_quaternions_of_a_whole_file(tmp_path):
    path = write(tmp_path / "a.hdf5")
    with h5py.File(path, "r+") as f:
        for name in f["data"]:
            pose = f[f"data/{name}/obs/object_1_pose"]
            value = pose[:]
            reorder(value)
            pose[:] = value
    assert "quaternion order" in {x["kind"] for x in find_faults(path)}


@pytest.mark.parametrize("value", [np.array(3), np.zeros(4), np.array(["demo_99"], "S")])
def test_masks_that_are_none_or_name_what_is_not_there_are_named(tmp_path, value):
    path = write(tmp_path / "a.hdf5")
    with h5py.File(path, "r+") as f:
        put(f, "mask/train", value)
    assert {x["kind"] for x in find_faults(path)} <= {"mask", "missing"} and find_faults(path)
    assert run(["data", "info", str(path)]) in (0, 1)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.name)
def test_the_shipped_demonstrations_have_no_faults(path):
    assert find_faults(path) == []


def test_the_exit_code_and_json_say_what_was_found(tmp_path, capsys):
    path = write(tmp_path / "a.hdf5")
    assert run(["data", "check", str(path), "--json", str(tmp_path / "a.json")]) == 0
    assert json.loads((tmp_path / "a.json").read_text()) == {"faults": []}
    plant = Plant(path)
    plant.change("time", back)
    plant.file.close()
    assert run(["data", "check", str(path), "--json", str(tmp_path / "a.json")]) == 1
    faults = json.loads((tmp_path / "a.json").read_text())["faults"]
    assert [(x["demo"], x["kind"]) for x in faults] == [("demo_3", "time")]
    assert capsys.readouterr().err.strip().endswith("has 1 fault")


# ---- broken files ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [False, True])
def test_a_damaged_file_ends_in_one_line_whatever_is_done_with_it(tmp_path, packed):
    whole = write(tmp_path / "a.hdf5", packed, 3)
    raw = whole.read_bytes()
    words = [m.start() for m in re.finditer(rb"TREE|SNOD|HEAP|OHDR|GCOL|FRHP|demo_|object_|robot_", raw)]
    broken, out = tmp_path / "b.hdf5", tmp_path / "c.hdf5"
    said = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        damaged = bytearray(raw)
        if seed % 3 == 0:
            damaged = damaged[: rng.integers(len(raw))]
        else:
            for _ in range(rng.integers(1, 5)):
                damaged[rng.integers(len(damaged))] = rng.integers(256)
                damaged[min(int(rng.choice(words)) + int(rng.integers(48)), len(raw) - 1)] = rng.integers(256)
        broken.write_bytes(damaged)
        for work in (
            lambda: find_faults(broken),
            lambda: inspect(broken),
            lambda: load_demos(broken),
            lambda: view.page(broken, [0]),
            lambda: edit.split(broken, out, 0.3, 0, False),
            lambda: edit.merge([whole, broken], out),
        ):
            try:
                work()
            except UserError:
                said += 1
        assert not list(tmp_path.glob("*.partial"))
    assert said > 60


def test_names_that_are_no_text_are_said_nevertheless(tmp_path):
    path = write(tmp_path / "a.hdf5")
    with h5py.File(path, "r+") as f:
        f["data/demo_3/obs"].id.link(b"robot_gripper", b"robot_\xff\xfe")
        del f["data/demo_3/obs/robot_gripper"]
        f["data"].attrs["task"] = b"\xff\xfe"
    for command in ("info", "check", "view"):
        done = subprocess.run(
            [sys.executable, "-c", "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))",
             "data", command, path], capture_output=True, text=True, env=os.environ | {"LC_ALL": "C.UTF-8"},
        )  # fmt: skip
        assert "Traceback" not in done.stderr, done.stderr
        assert done.returncode == {"info": 0, "check": 1, "view": 1}[command], done.stderr


def test_a_field_that_claims_a_terabyte_is_refused_and_not_allocated(tmp_path):
    path = write(tmp_path / "a.hdf5")
    with h5py.File(path, "r+") as f:
        del f["data/demo_3/obs/robot_joint_vel"]
        f["data/demo_3/obs"].create_dataset("robot_joint_vel", (1 << 38, 6), "f4", chunks=(1024, 6))
    assert ("demo_3", "unreadable") in {(x["demo"], x["kind"]) for x in find_faults(path)}
    with pytest.raises(UserError, match="claims"):
        load_demos(path)


# ---- format ------------------------------------------------------------------------------------------------------


def test_either_layout_gives_back_what_was_written(tmp_path):
    a, _ = load_demos(write(tmp_path / "a.hdf5"))
    b, attrs = load_demos(write(tmp_path / "b.hdf5", packed=True))
    assert attrs["embodiment"] == "lite6" and len(a) == len(b) == N
    for x, y in zip(a, b, strict=True):
        for field in ("time", "joint_pos", "joint_vel", "gripper", "object_pose", "object_valid", "actions"):
            np.testing.assert_array_equal(getattr(x, field), getattr(y, field))
        np.testing.assert_array_equal(x.extra["labels"], y.extra["labels"])
        assert x.attrs["task"] == y.attrs["task"] and x.attrs["seed"] == y.attrs["seed"]
    for path in (tmp_path / "a.hdf5", tmp_path / "b.hdf5"):
        held, _ = load_demos(path, "valid")
        assert [d.attrs["seed"] for d in held] == [0, 5]


def test_an_embodiment_without_joints_keeps_its_own_fields(tmp_path):
    t = 30
    rng = np.random.default_rng(0)
    hand = Demo(
        time=np.arange(t) / 30, joint_pos=None, joint_vel=None, gripper=None,
        object_pose=np.tile([0, 0, 0, 1, 0, 0, 0.0], (t, 5, 1)), object_valid=np.ones((t, 5), bool),
        actions=np.zeros((t, 63)), attrs={"task": "pour"},
        obs={"hand_keypoints": np.cumsum(0.001 * rng.normal(size=(t, 63)), axis=0)},
    )  # fmt: skip
    path = tmp_path / "hand.hdf5"
    save_demos(path, [hand], {"embodiment": "human", "rate_hz": 30.0})
    assert find_faults(path) == []
    with DemoFile(path) as f:
        arrays = f.arrays(0)
        assert arrays.agent.shape == (t, 63) and arrays.objects.shape == (t, 5, 7) and arrays.valid.all()
        np.testing.assert_allclose(arrays.agent, hand.obs["hand_keypoints"], atol=1e-6)
    assert inspect(path)["agent"] == {"fields": ["hand_keypoints"], "width": 63}


def test_a_keypoint_may_jump_where_it_was_not_seen_and_only_there(tmp_path):
    t = 60
    keypoints = np.tile(np.linspace(0, 0.3, t)[:, None], (1, 63))
    keypoints[30:, :3] += 0.4
    seen = np.ones((t, 21), "u1")
    for valid, kinds in ((seen, {"jump"}), (np.where(np.arange(t)[:, None] == 29, 0, seen), set())):
        hand = Demo(
            time=np.arange(t) / 30, joint_pos=None, joint_vel=None, gripper=None,
            object_pose=np.zeros((t, 0, 7)), object_valid=np.zeros((t, 0), bool), actions=np.zeros((t, 63)),
            obs={"hand_keypoints": keypoints, "hand_valid": valid},
        )  # fmt: skip
        save_demos(tmp_path / "a.hdf5", [hand], {"embodiment": "human", "rate_hz": 30.0})
        assert {x["kind"] for x in find_faults(tmp_path / "a.hdf5")} == kinds


def test_robomimic_reads_our_files(tmp_path):
    if ROBOMIMIC:
        folder = Path(ROBOMIMIC)
    else:
        spec = importlib.util.find_spec("robomimic")
        if spec is None:
            pytest.skip("robomimic is not installed: pip install --no-deps robomimic, or INTABS_ROBOMIMIC=its folder")
        folder = Path(spec.submodule_search_locations[0])
    path = write(tmp_path / "a.hdf5")
    script = folder / "scripts/get_dataset_info.py"
    done = subprocess.run([sys.executable, script, "--dataset", path, "--verbose"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"total transitions: {N * FRAMES}" in done.stdout
    assert "filter key valid with 2 demos" in done.stdout
    assert "observation key object_0_pose with shape (120, 7)" in done.stdout
    held = subprocess.run(
        [sys.executable, script, "--dataset", path, "--filter_key", "valid"], capture_output=True, text=True
    )
    assert "total trajectories: 2" in held.stdout, held.stderr


@pytest.mark.parametrize("packed", [False, True])
def test_a_killed_writer_leaves_nothing_that_looks_whole(tmp_path, packed):
    out = tmp_path / "a.hdf5"
    code = f"""
import itertools, numpy as np
from pathlib import Path
from intabs.data import synthetic
from intabs.data.demos import DemoWriter
rng = np.random.default_rng(0)
with DemoWriter(Path({str(out)!r}), {{}}, packed={packed}) as writer:
    for k in itertools.count():
        writer.add(synthetic.demo(rng, 300))
        if k == 20:
            print("writing", flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout.readline().strip() == b"writing"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not out.exists()


def test_a_failed_writer_keeps_the_file_that_was_there(tmp_path):
    path = write(tmp_path / "a.hdf5")
    before = path.read_bytes()
    with pytest.raises(RuntimeError), DemoWriter(path, {}) as writer:
        writer.add(synthetic.demo(np.random.default_rng(0), 50))
        raise RuntimeError
    assert path.read_bytes() == before and not list(tmp_path.glob("*.partial"))


# ---- editing -----------------------------------------------------------------------------------------------------


def test_dropped_ones_are_gone_and_cut_ones_shorter(sound, tmp_path):
    out = tmp_path / "out.hdf5"
    assert run(["data", "edit", str(sound), "--drop", "0,2-3", "--cut", "4:10:60", "-o", str(out)]) == 0
    a, _ = load_demos(sound)
    with DemoFile(out) as f:
        assert f.names == ["demo_1", "demo_4", "demo_5"]
        assert f.masks() == {"train": ["demo_1", "demo_4"], "valid": ["demo_5"]}
        piece, whole = f.demo(1), f.demo(0)
    assert len(piece) == 50 and piece.time[0] == 0 and piece.attrs["seed"] == 4
    np.testing.assert_array_equal(piece.joint_pos, a[4].joint_pos[10:60])
    np.testing.assert_array_equal(piece.extra["labels"], a[4].extra["labels"][10:60])
    np.testing.assert_array_equal(whole.object_pose, a[1].object_pose)
    assert find_faults(out) == []


def test_editing_in_place_replaces_the_file(sound):
    assert run(["data", "edit", str(sound), "--drop", "demo_0"]) == 0
    assert inspect(sound)["demos"] == N - 1
    assert find_faults(sound) == []


@pytest.mark.parametrize(
    "args",
    [[], ["--drop", "99"], ["--drop", "x"], ["--cut", "1:5"], ["--cut", "1:100:500"], ["--cut", "1:9:9"],
     ["--drop", "0-5"], ["--cut", "77:0:5"]],
)  # fmt: skip
def test_an_edit_that_cannot_be_done_leaves_the_file_and_says_why(tmp_path, capsys, args):
    path = write(tmp_path / "a.hdf5")
    before = path.read_bytes()
    assert run(["data", "edit", str(path), *args]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert path.read_bytes() == before


def test_a_merged_file_holds_both_and_keeps_what_was_held_out(tmp_path):
    a = write(tmp_path / "a.hdf5", label_names=["reach", "grasp", "lift"])
    b = write(tmp_path / "b.hdf5", packed=True, n=3, label_names=["grasp", "pour", "reach"])
    out = tmp_path / "out.hdf5"
    assert run(["data", "merge", str(a), str(b), "-o", str(out)]) == 0
    figures = inspect(out)
    assert figures["demos"] == N + 3 and figures["frames"] == (N + 3) * FRAMES
    with DemoFile(out) as f:
        assert f.masks()["valid"] == ["demo_0", "demo_5", "demo_6"]
        names = formats.name_list(f.attrs["label_names"])
        said = [names[i] for i in f.demo(7).extra["labels"]]
    assert said[:: FRAMES // 3] == ["grasp", "pour", "reach"]
    assert find_faults(out) == []


@pytest.mark.parametrize("change", [{"embodiment": "panda"}, {"rate_hz": 50.0}])
def test_files_of_another_kind_are_not_merged(tmp_path, capsys, change):
    a, b = write(tmp_path / "a.hdf5"), write(tmp_path / "b.hdf5", **change)
    assert run(["data", "merge", str(a), str(b), "-o", str(tmp_path / "out.hdf5")]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "out.hdf5").exists()


def test_a_split_holds_out_a_share_of_every_task_and_the_same_for_the_same_seed(sound):
    assert run(["data", "split", str(sound), "--valid", "0.34", "--seed", "5"]) == 0
    with DemoFile(sound, "valid") as f:
        assert sorted(f.tasks) == ["task_0", "task_1"]
        first = f.names
    assert run(["data", "split", str(sound), "--valid", "0.34", "--seed", "5"]) == 0
    with DemoFile(sound, "valid") as f:
        assert f.names == first
    assert run(["data", "split", str(sound), "--valid", "0.34", "--apart"]) == 0
    train, valid = (sound.with_name(f"a_{m}.hdf5") for m in ("train", "valid"))
    assert inspect(train)["demos"] == 4 and inspect(valid)["demos"] == 2
    assert find_faults(train) == find_faults(valid) == []


def test_pieces_are_all_of_it_and_know_where_they_come_from(sound, tmp_path):
    out = tmp_path / "pieces.hdf5"
    assert run(["data", "pieces", str(sound), "--out", str(out), "--frames", "10"]) == 0
    with DemoFile(sound) as whole, DemoFile(out) as f:
        assert sum(f.lengths) == sum(whole.lengths) and max(f.lengths) <= 15 and len(f) > 2 * len(whole)
        for k in range(len(f)):
            piece = f.demo(k)
            source = whole.demo(whole.names.index(piece.attrs["piece_of"]))
            a = int(piece.attrs["first_frame"])
            assert np.array_equal(piece.actions, source.actions[a : a + len(piece)]) and piece.time[0] == 0
            assert f.tasks[k] == whole.tasks[whole.names.index(piece.attrs["piece_of"])]
    with DemoFile(sound, "valid") as whole, DemoFile(out, "valid") as f:
        assert sum(f.lengths) == sum(whole.lengths) > 0
    assert run(["data", "split", str(out), "--valid", "0.2"]) == 0 and find_faults(out) == []
    assert run(["data", "pieces", str(sound), "--out", str(sound), "--frames", "10"]) == 1


# ---- looking -----------------------------------------------------------------------------------------------------


def test_the_page_needs_nothing_from_elsewhere_and_shows_every_demonstration(sound):
    out = sound.with_suffix(".html")
    assert run(["data", "view", str(sound)]) == 0
    page = out.read_text()
    assert page.count("<section>") == N
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//|@import|url\(", page)
    for name in ("robot_joint_pos", "object 0: position", "labels", "from above"):
        assert name in page


def test_pictures_are_shown_where_there_are_any(tmp_path):
    from PIL import Image

    d = synthetic.demo(np.random.default_rng(0), 40)
    d.obs["camera_image"] = np.random.default_rng(0).integers(0, 255, (40, 48, 64, 3), "u1")
    path = tmp_path / "a.hdf5"
    save_demos(path, [d], {"embodiment": "lite6", "rate_hz": 25.0})
    assert find_faults(path) == []
    assert len(view.pictures(load_demos(path)[0][0], 10)) == 10
    assert "<img" in view.page(path, [0])
    assert run(["data", "view", str(path), "-o", str(tmp_path / "a.png")]) == 0
    assert Image.open(tmp_path / "a.png").width > 300


def test_names_in_a_file_do_not_become_code_of_the_page(tmp_path):
    d = synthetic.demo(np.random.default_rng(0), 40)
    d.attrs = {"task": "<script>alert(1)</script>", "object_names": ["<b>x</b>"], "joint_names": ["<i>"] * 6}
    path = tmp_path / "a.hdf5"
    save_demos(path, [d], {"embodiment": "lite6", "rate_hz": 25.0})
    page = view.page(path, [0])
    assert "alert(1)</script>" not in page.replace("&lt;script&gt;alert(1)&lt;/script&gt;", "")
    assert "<b>x" not in page and "<i>" not in page


@pytest.mark.parametrize("tool", ["rerun", "viser"])
def test_a_viewer_that_is_not_installed_is_named(tmp_path, capsys, tool):
    if importlib.util.find_spec(tool):
        pytest.skip(f"{tool} is installed: nothing to say")
    assert run(["data", "view", str(write(tmp_path / "a.hdf5")), f"--{tool}"]) == 1
    assert f"{tool} is not installed: pip install" in capsys.readouterr().err
