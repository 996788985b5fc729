"""Other people's demonstrations: the real files where they are (../shared/data), small ones of the same layout where
they are not."""

import csv
import json
import os
import pickle
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intabs import _core, paths
from intabs.cli import run
from intabs.data import mujoco_model, unpickle
from intabs.data.demos import Demo, load_demos
from intabs.data.importers import Options, import_demos
from intabs.data.reader import DemoFile
from intabs.data.resample import Resampler, heal_signs, resample, wxyz, xyzw
from intabs.errors import UserError

SHARED = paths.ROOT.parent / "shared/data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"the real files ({SHARED}) are not here")


def bring(kind, source, out, **options) -> dict:
    return import_demos(kind, Path(source), out, Options(say=lambda text: None, **options))


# kind, folder, options; demonstrations, frames (of each where the README says it), rate [Hz], width of the source's
# state: as in the README of the data. Then the agent's width, objects, faults that the recordings do have.
REAL = [
    ("robosuite", "robosuite/panda_lift", {}, 1, [412], 20, 32, 8, 1, 0),
    ("robosuite", "robosuite/panda_stack", {}, 1, [532], 20, 45, 8, 2, 0),
    ("robosuite", "robosuite/panda_nut-assembly", {}, 1, [1036], 20, 45, 8, 2, 0),
    ("robosuite", "robosuite/panda_pick-place", {}, 1, [1482], 20, 71, 8, 4, 0),
    ("roboturk", "robosuite/SawyerStack", {}, 2, [1252, 1174], 100, 47, 8, 2, 0),
    ("roboturk", "robosuite/SawyerNutAssembly", {}, 2, [3318, 2430], 83, 47, 8, 2, 0),
    ("kitchen", "franka_kitchen", {}, 1, [232], 12.5, 60, 9, 1, 0),
    # One frame of one recording is there twice.
    ("lerobot", "lerobot_g1", {}, 100, 35965, 30, 26, 26, 0, 1),
    # The toothbrush turns by 84 deg within a frame, the hand on the teapot by 55.
    ("npz", "grab_hand", {"agent": "robot", "object": "object"}, 70, 6243, 50, 36, 29, 1, 2),
    ("lite6-csv", "lite6_kinesthetic/free_motion", {}, 15, 650, 9, 13, 7, 0, 0),
    ("lite6-csv", "lite6_kinesthetic/sepisode1", {}, 4, 2788, (60, 67), 15, 7, 0, 0),
    ("lite6-csv", "lite6_kinesthetic/sepisode2", {}, 4, 1906, (60, 67), 15, 7, 0, 0),
]


@needs_shared
@pytest.mark.parametrize("case", REAL, ids=lambda c: c[1])
def test_the_numbers_of_the_real_files_are_those_of_their_readme(tmp_path, case):
    kind, folder, options, demos, frames, rate, width, agent, objects, faults = case
    figures = bring(kind, SHARED / folder, tmp_path / "a.hdf5", **options)
    assert figures["demos"] == demos
    total = sum(frames) if isinstance(frames, list) else frames
    assert figures["frames"] == total
    low, high = rate if isinstance(rate, tuple) else (rate - 0.5, rate + 0.5)
    assert low <= figures["rate_hz"] <= high
    assert figures["width"] == width
    assert figures["agent"]["width"] == agent and figures["object_slots"] == objects
    assert len(figures["faults"]) == faults, figures["faults"]
    assert any("units" in n for n in figures["notes"]) and any("rate" in n for n in figures["notes"])
    with DemoFile(tmp_path / "a.hdf5") as f:
        if isinstance(frames, list):
            assert f.lengths.tolist() == frames
        arrays = f.arrays(0)
        assert arrays.agent.shape == (f.lengths[0], agent) and arrays.objects.shape[1:] == (objects, 7)


@needs_shared
def test_states_of_robosuite_are_read_in_the_order_of_the_model(tmp_path):
    bring("roboturk", SHARED / "robosuite/SawyerStack", tmp_path / "a.hdf5")
    demo = load_demos(tmp_path / "a.hdf5")[0][0]
    with h5py.File(SHARED / "robosuite/SawyerStack/demo.hdf5") as f:
        states = f["data/demo_1/states"][:]
    # Sawyer's head turns between its first and its second joint.
    np.testing.assert_allclose(demo.joint_pos, states[:, [1, 3, 4, 5, 6, 7, 8]], atol=1e-6)
    np.testing.assert_allclose(demo.obs["robot_finger_pos"], states[:, 9:11], atol=1e-6)
    np.testing.assert_allclose(demo.object_pose[:, 0, :3], states[:, 11:14], atol=1e-6)
    # Differences of the positions are the velocities, so the columns of both belong together.
    speed = np.gradient(demo.joint_pos, demo.time, axis=0)
    assert np.corrcoef(speed.ravel(), demo.joint_vel.ravel())[0, 1] > 0.98
    # A cube at rest lies flat on the table: wxyz.
    cube = Rotation.from_quat(xyzw(demo.object_pose[:50, :, 3:].reshape(-1, 4))).as_matrix()
    assert (np.abs(cube).max(axis=1)[:, 2] > 0.999).all()


@needs_shared
@pytest.mark.parametrize("folder", ["panda_lift", "panda_stack", "SawyerStack", "SawyerNutAssembly"])
def test_fingers_are_closer_where_the_gripper_is_said_to_be_closed(tmp_path, folder):
    bring("robosuite", SHARED / "robosuite" / folder, tmp_path / "a.hdf5")
    for demo in load_demos(tmp_path / "a.hdf5")[0]:
        apart = demo.obs["robot_finger_pos"] @ [1, -1]  # the left finger slides to +, the right one to -
        assert 0.05 < demo.gripper.mean() < 0.95
        assert apart[demo.gripper > 0].mean() < apart[demo.gripper == 0].mean() - 0.01


@needs_shared
def test_fk_of_imported_joints_is_the_logged_tcp_within_6_mm_of_a_constant_offset(tmp_path):
    arm = _core.ArmModel.lite6()
    worst = 0.0
    for folder in ("free_motion", "sepisode1", "sepisode2"):
        bring("lite6-csv", SHARED / "lite6_kinesthetic" / folder, tmp_path / "a.hdf5")
        for demo in load_demos(tmp_path / "a.hdf5")[0]:
            X_BE = np.array([arm.fk(q) for q in demo.joint_pos])
            R_BE = Rotation.from_quat(xyzw(X_BE[:, 3:]))
            p_ET = R_BE.inv().apply(demo.obs["robot_eef_pos"] - X_BE[:, :3])
            worst = max(worst, np.linalg.norm(p_ET - np.median(p_ET, axis=0), axis=1).max())
            turn = R_BE.inv() * Rotation.from_quat(xyzw(demo.obs["robot_eef_quat"]))
            assert np.degrees((turn.mean().inv() * turn).magnitude()).max() < 2
    assert worst < 6e-3


@needs_shared
def test_the_lite6_closes_its_gripper_before_it_carries(tmp_path):
    for folder in ("sepisode1", "sepisode2"):
        bring("lite6-csv", SHARED / "lite6_kinesthetic" / folder, tmp_path / "a.hdf5")
        demos = {d.attrs["source"].split("/")[1][:1]: d for d in load_demos(tmp_path / "a.hdf5")[0]}
        # a reaches and grasps, b carries, d sets down and releases.
        assert demos["a"].gripper[0] == 0 and demos["a"].gripper[-1] == 1
        assert demos["b"].gripper.min() == 1
        assert demos["d"].gripper[0] == 1 and demos["d"].gripper[-1] == 0


@needs_shared
def test_folders_of_several_rates_want_one(tmp_path):
    with pytest.raises(UserError, match="give --rate"):
        bring("lite6-csv", SHARED / "lite6_kinesthetic", tmp_path / "a.hdf5")
    figures = bring("lite6-csv", SHARED / "lite6_kinesthetic", tmp_path / "a.hdf5", rate_hz=9.0)
    assert figures["demos"] == 23 and figures["rate_hz"] == 9.0 and figures["faults"] == []


@needs_shared
def test_robots_of_two_kinds_are_not_mixed_in_one_file(tmp_path):
    with pytest.raises(UserError, match="panda and sawyer"):
        bring("robosuite", SHARED / "robosuite", tmp_path / "a.hdf5")
    assert not (tmp_path / "a.hdf5").exists()


@needs_shared
def test_the_command_does_what_the_function_does(tmp_path, capsys):
    out = tmp_path / "a.hdf5"
    args = ["data", "import", "npz", str(SHARED / "grab_hand"), str(out), "--agent", "robot", "--object", "object"]
    assert run([*args, "--rate", "25", "--json", str(tmp_path / "a.json")]) == 0
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["demos"] == 70 and figures["rate_hz"] == 25
    said = capsys.readouterr().out
    assert "wxyz" in said and "low-passed" in said and "101 changes of sign healed" in said


# ---- pickles -----------------------------------------------------------------------------------------------------


class Evil:
    def __init__(self, *how):
        self.how = how

    def __reduce__(self):
        return self.how


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize(
    "how",
    [(os.system, ("touch {}",)), (eval, ("open('{}', 'w')",)), (np.load, ("{}",)), (open, ("{}", "w")),
     (np.ndarray, ((1 << 40,),))],
)  # fmt: skip
def test_a_malicious_pickle_is_refused_and_runs_nothing(tmp_path, protocol, how):
    f, args = how
    mark = tmp_path / "ran"
    args = tuple(a.format(mark) if isinstance(a, str) else a for a in args)
    path = tmp_path / "evil.pkl"
    value = {"observations": np.zeros((5, 60)), "actions": np.zeros((5, 9)), "x": Evil(f, args)}
    path.write_bytes(pickle.dumps(value, protocol))
    with pytest.raises(UserError, match="refused|damaged"):
        unpickle.load(path)
    assert not mark.exists()


def test_arrays_of_objects_are_refused(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"observations": np.array([{}, []], object)}))
    with pytest.raises(UserError, match="refused"):
        unpickle.load(path)


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_come_back_as_they_were_from_every_protocol(tmp_path, protocol):
    value = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
             "c": [np.float32(1.5), (np.zeros(0), "x")], "d": np.zeros((2, 0, 3))}  # fmt: skip
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(value, protocol))
    got = unpickle.load(path)
    for k in "abd":
        np.testing.assert_array_equal(got[k], value[k])
        assert got[k].shape == value[k].shape
    assert got["c"][0] == 1.5 and got["c"][1][1] == "x"


def test_pickles_of_python_2_are_read(tmp_path):
    # As python 2 and numpy 1 write it: the bytes are a string, names are those of old modules.
    data = np.arange(4.0).tobytes()
    text = b"".join(
        [
            b"\x80\x02}q\x00U\x01aq\x01cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\nq\x03K\x00\x85U\x01b\x87R",
            b"(K\x01K\x02K\x02\x86cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff",
            b"K\x00tb\x89T" + len(data).to_bytes(4, "little") + data + b"tbs.",
        ]
    )
    path = tmp_path / "a.pkl"
    path.write_bytes(text)
    np.testing.assert_array_equal(unpickle.load(path)["a"], np.arange(4.0).reshape(2, 2))


def test_damaged_pickles_end_in_one_line(tmp_path):
    raw = pickle.dumps({"observations": np.zeros((5, 60)), "actions": np.zeros((5, 9))}, 2)
    path = tmp_path / "a.pkl"
    for seed in range(300):
        rng = np.random.default_rng(seed)
        damaged = bytearray(raw[: rng.integers(1, len(raw))] if seed % 2 else raw)
        for _ in range(3):
            damaged[rng.integers(min(len(damaged), 200))] = rng.integers(256)
        path.write_bytes(damaged)
        with pytest.raises(UserError) if seed % 2 else _either():
            bring("kitchen", path, tmp_path / "a.hdf5")


class _either:
    def __enter__(self):
        return None

    def __exit__(self, kind, *_):
        return kind is UserError


# ---- layouts that are not among the real files --------------------------------------------------------------------


def kitchen_observations(n: int, rng) -> np.ndarray:
    o = np.zeros((n, 60))
    o[:, :9] = 0.3 * np.sin(np.linspace(0, 3, n)[:, None] + rng.uniform(0, 6, 9))
    o[:, 9:23] = 0.1
    o[:, 23:30] = [-0.27, 0.35, 1.62, 1, 0, 0, 0]
    return o


def d4rl(path: Path, lengths: list[int], end: str = "terminals") -> Path:
    rng = np.random.default_rng(0)
    flags = np.zeros(sum(lengths), bool)
    flags[np.cumsum(lengths)[:-1] - 1] = True
    with h5py.File(path, "w") as f:
        f["observations"] = np.concatenate([kitchen_observations(n, rng) for n in lengths]).astype("f4")
        f["actions"] = rng.uniform(-1, 1, (sum(lengths), 9)).astype("f4")
        f["rewards"] = np.zeros(sum(lengths), "f4")
        f[end] = flags
    return path


@pytest.mark.parametrize("end", ["terminals", "timeouts"])
def test_d4rl_files_are_cut_into_their_episodes(tmp_path, end):
    lengths = [40, 25, 60]
    figures = bring("kitchen", d4rl(tmp_path / "kitchen.hdf5", lengths, end), tmp_path / "a.hdf5")
    assert figures["demos"] == 3 and figures["frames"] == 125 and figures["rate_hz"] == 12.5
    with DemoFile(tmp_path / "a.hdf5") as f:
        assert f.lengths.tolist() == lengths
        arrays = f.arrays(1)
    assert arrays.agent.shape == (25, 9) and arrays.environment.shape == (25, 14)
    np.testing.assert_allclose(arrays.objects[0, 0], [-0.27, 0.35, 1.62, 1, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("lengths", [[40, 90], [40] * 20])
def test_the_table_takes_files_as_they_come(tmp_path, lengths):
    from intabs.evaluate.table import about, imported

    source, out = d4rl(tmp_path / "kitchen.hdf5", lengths), tmp_path / "runs" / "kitchen.hdf5"
    imported("kitchen", source, None, out, lambda done, text: None)
    few = len(lengths) < 20
    assert about(out) == {
        "about": "4 pieces of 2 demonstrations, 1 held out" if few else "20 demonstrations, 2 held out",
        "demonstrations": len(lengths),
    }
    assert list(out.parent.iterdir()) == [out]
    source.unlink()  # what is there is taken
    assert imported("kitchen", source, None, out, lambda done, text: None) == out


def test_one_command_from_a_file_of_others_to_the_table(tmp_path, monkeypatch, capsys):
    torch = pytest.importorskip("torch")
    torch.set_num_threads(1)
    from intabs.evaluate import table

    source = d4rl(tmp_path / "play.hdf5", [60, 90])
    small = ("train.steps=2", "train.batch=4", "train.warmup=1", "objective.window=20")
    arguments = [
        "--data",
        f"kitchen=kitchen:{source}",
        "--rate",
        "10",
        "--seeds",
        "1",
        "--runs",
        str(tmp_path / "runs"),
    ]
    monkeypatch.setattr("sys.argv", ["table", *arguments, *(x for s in small for x in ("--set", s))])
    table.main()
    said = capsys.readouterr().out
    assert "## kitchen: 4 pieces of 2 demonstrations, 1 held out" in said and "A handful of demonstrations" in said
    assert "| intabs |" in said and "| tvi-agent |" in said and "IntAbs 0.32" in said
    # The same name for something else is not the same run.
    monkeypatch.setattr("sys.argv", ["table", *arguments, "--set", "train.steps=3"])
    with pytest.raises(SystemExit, match="kitchen/intabs-small-0: was trained with other settings"):
        table.main()


PENDULUM = """<mujoco><worldbody>
  <body name="robot0_base"><body name="robot0_link1"><joint name="robot0_joint1"/>
    <body name="robot0_link2"><joint name="robot0_joint2"/>
      <body name="finger"><joint name="gripper0_finger_joint1" type="slide"/></body></body></body></body>
  <body name="door"><joint name="door_hinge"/><body name="cube"/></body>
  <frame><body name="cube0"><freejoint name="cube0_joint"/></body></frame>
</worldbody></mujoco>"""


def mimic(path: Path, with_states: bool) -> np.ndarray:
    """robomimic's layout, as its writers leave it."""
    rng = np.random.default_rng(0)
    n = 50
    quat = np.tile(Rotation.from_euler("z", 30, degrees=True).as_quat(), (n, 1))
    joint = np.cumsum(0.01 * rng.normal(size=(n, 2)), axis=0)
    cube = np.concatenate([np.tile([0.1, 0.2, 0.8], (n, 1)), quat], axis=1)
    with h5py.File(path, "w") as f:
        data = f.create_group("data")
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "type": 1, "env_kwargs": {"robots": ["Panda"], "control_freq": 20}}
        )
        data.attrs["total"] = 3 * n
        for k in (0, 1, 10):  # sorted by number, not by text
            g = data.create_group(f"demo_{k}")
            g.attrs["num_samples"] = n
            g["actions"] = np.concatenate([rng.uniform(-1, 1, (n, 6)), np.sign(np.arange(n)[:, None] - 20.5)], axis=1)
            g["obs/robot0_joint_pos"] = joint + k
            g["obs/robot0_gripper_qpos"] = np.zeros((n, 2))
            g["obs/robot0_eef_quat"] = quat
            g["obs/object"] = np.concatenate([cube, np.zeros((n, 3))], axis=1)
            g["obs/agentview_image"] = np.zeros((n, 8, 8, 3), "u1")
            if with_states:
                g.attrs["model_file"] = PENDULUM
                qpos = np.concatenate([joint + k, np.full((n, 1), 0.02), np.full((n, 1), 0.3), cube], axis=1)
                qpos[:, -4:] = wxyz(quat)
                g["states"] = np.concatenate([np.arange(n)[:, None] / 20, qpos, np.zeros((n, 10))], axis=1)
        f["mask/train"] = np.array(["demo_0", "demo_10"], "S")
        f["mask/valid"] = np.array(["demo_1"], "S")
    return joint


@pytest.mark.parametrize("with_states", [True, False])
def test_robomimics_files_are_read_with_and_without_states(tmp_path, with_states):
    joint = mimic(tmp_path / "low_dim.hdf5", with_states)
    figures = bring("robomimic", tmp_path / "low_dim.hdf5", tmp_path / "a.hdf5")
    assert figures["demos"] == 3 and figures["rate_hz"] == 20 and figures["embodiment"] == "panda"
    assert any("agentview_image" in n for n in figures["notes"])
    assert figures["faults"] == []
    with DemoFile(tmp_path / "a.hdf5") as f:
        assert f.masks() == {"train": ["demo_0", "demo_2"], "valid": ["demo_1"]}
        demo = f.demo(2)
    np.testing.assert_allclose(demo.joint_pos, joint + 10, atol=1e-6)
    want = [0.1, 0.2, 0.8, np.cos(np.pi / 12), 0, 0, np.sin(np.pi / 12)]
    np.testing.assert_allclose(demo.object_pose[7, 0], want, atol=1e-6)
    assert demo.gripper[20] == 0 and demo.gripper[21] == 1
    if with_states:
        np.testing.assert_allclose(demo.obs["object_joint_pos"], 0.3)


def lerobot_v3(folder: Path) -> np.ndarray:
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install pyarrow")
    import pyarrow.parquet as pq

    rng = np.random.default_rng(0)
    lengths, state = [20, 30, 25], []
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [6], "names": {"motors": [f"m{i}" for i in range(6)]}}
    info = {
        "codebase_version": "v3.0", "robot_type": "so101", "total_episodes": 3, "total_frames": 75, "fps": 30,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {"observation.state": feature, "action": feature,
                     "observation.images.top": {"dtype": "video", "shape": [4, 4, 3]}},
    }  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    tasks = {"task_index": [0, 1], "__index_level_0__": ["push", "pull"]}
    pq.write_table(pa.table(tasks), folder / "meta/tasks.parquet")
    rows, episodes, begin = {}, [], 0
    # Two episodes in the first file, one in the second.
    for k, n in enumerate(lengths):
        s = np.cumsum(0.01 * rng.normal(size=(n, 6)), axis=0).astype("f4")
        state.append(s)
        file = int(k == 2)
        t = rows.setdefault(file, {c: [] for c in ("observation.state", "action", "timestamp", "frame_index",
                                                   "episode_index", "index", "task_index")})  # fmt: skip
        t["observation.state"] += s.tolist()
        t["action"] += s.tolist()
        t["timestamp"] += (np.arange(n) / 30).astype("f4").tolist()
        t["frame_index"] += list(range(n))
        t["episode_index"] += [k] * n
        t["index"] += list(range(begin, begin + n))
        t["task_index"] += [k % 2] * n
        episodes.append({"episode_index": k, "tasks": [["push", "pull"][k % 2]], "length": n, "data/chunk_index": 0,
                         "data/file_index": file, "dataset_from_index": begin, "dataset_to_index": begin + n,
                         "stats/action/min": [0.0] * 6})  # fmt: skip
        begin += n
    for file, t in rows.items():
        pq.write_table(pa.table(t), folder / f"data/chunk-000/file-{file:03d}.parquet")
    pq.write_table(pa.Table.from_pylist(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    return state


def test_lerobot_v3_is_read_episode_by_episode(tmp_path):
    state = lerobot_v3(tmp_path / "set")
    figures = bring("lerobot", tmp_path / "set", tmp_path / "a.hdf5")
    assert figures["demos"] == 3 and figures["frames"] == 75 and figures["rate_hz"] == 30
    assert figures["tasks"] == {"push": 2, "pull": 1} and figures["embodiment"] == "so101"
    assert figures["faults"] == []
    for demo, s in zip(load_demos(tmp_path / "a.hdf5")[0], state, strict=True):
        np.testing.assert_allclose(demo.joint_pos, s, atol=1e-6)


def test_lerobots_degrees_are_refused_until_they_are_called_so(tmp_path):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install pyarrow")
    import pyarrow as pa
    import pyarrow.parquet as pq

    lerobot_v3(tmp_path / "set")
    for path in (tmp_path / "set/data").rglob("*.parquet"):
        table = pq.read_table(path)
        degrees = [[90 + 57 * x for x in row] for row in table["observation.state"].to_pylist()]
        pq.write_table(table.set_column(0, "observation.state", pa.array(degrees)), path)
    with pytest.raises(UserError, match="--units deg"):
        bring("lerobot", tmp_path / "set", tmp_path / "a.hdf5")
    assert not (tmp_path / "a.hdf5").exists()
    bring("lerobot", tmp_path / "set", tmp_path / "a.hdf5", units="deg")
    assert abs(load_demos(tmp_path / "a.hdf5")[0][0].joint_pos.mean() - np.pi / 2) < 0.2


def npz(folder: Path, **change) -> Path:
    t = 60
    rng = np.random.default_rng(0)
    quat = wxyz(Rotation.from_rotvec(np.linspace(0, 1, t)[:, None] * [0, 0, 1]).as_quat())
    quat[30:] *= -1
    arrays = {
        "robot": np.cumsum(0.01 * rng.normal(size=(t, 12)), axis=0),
        "object": np.concatenate([np.full((t, 3), 0.1), quat], axis=1),
        "time": np.arange(t) / 50,
    } | change
    folder.mkdir(exist_ok=True)
    np.savez(folder / "Hand_cup_pour1.npz", **{k: v for k, v in arrays.items() if v is not None})
    return folder


def test_an_npz_is_read_by_the_names_of_its_arrays_and_of_its_file(tmp_path):
    figures = bring("npz", npz(tmp_path / "set"), tmp_path / "a.hdf5", agent="robot", object="object")
    assert figures["tasks"] == {"pour": 1} and figures["embodiment"] == "hand"
    demo = load_demos(tmp_path / "a.hdf5")[0][0]
    assert (np.einsum("ij,ij->i", demo.object_pose[1:, 0, 3:], demo.object_pose[:-1, 0, 3:]) > 0).all()
    assert any("1 changes of sign healed" in n for n in figures["notes"])


def test_quaternions_in_the_other_order_are_turned_when_told(tmp_path):
    folder = npz(tmp_path / "set")
    a = bring("npz", folder, tmp_path / "a.hdf5", agent="robot", object="object")
    arrays = dict(np.load(folder / "Hand_cup_pour1.npz"))
    arrays["object"][:, 3:] = xyzw(arrays["object"][:, 3:])
    np.savez(folder / "Hand_cup_pour1.npz", **arrays)
    b = bring("npz", folder, tmp_path / "b.hdf5", agent="robot", object="object", quaternion="xyzw")
    assert a["demos"] == b["demos"]
    one, two = (load_demos(tmp_path / f"{n}.hdf5")[0][0].object_pose for n in "ab")
    np.testing.assert_allclose(one, two, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "options", "says"),
    [
        ({}, {"agent": "hand"}, "no array 'hand'"),
        ({}, {"agent": None}, "--agent KEY"),
        ({"time": None}, {}, "--source-rate"),
        ({"time": np.zeros(60)}, {}, "advance"),
        ({"time": np.zeros(7)}, {}, "times that advance"),
        ({"robot": np.zeros(60)}, {}, "not \\(T, n\\)"),
        ({"robot": np.full((60, 3), np.nan)}, {}, "not finite"),
        ({"robot": np.full((60, 3), 90.0)}, {}, "--units deg"),
        ({"object": np.zeros((60, 7))}, {}, "no unit quaternion"),
        ({"object": np.zeros((60, 6))}, {}, "not \\(T, 7\\)"),
        ({"object": np.array([{}] * 60)}, {}, "not an npz of arrays"),
    ],
)
def test_what_an_npz_lacks_is_said_in_one_line(tmp_path, change, options, says):
    folder = npz(tmp_path / "set", **change)
    with pytest.raises(UserError, match=says) as e:
        bring("npz", folder, tmp_path / "a.hdf5", **({"agent": "robot", "object": "object"} | options))
    assert "\n" not in str(e.value) or len(str(e.value).splitlines()) == 1
    assert not (tmp_path / "a.hdf5").exists() and not list(tmp_path.glob("*.partial"))


def lite6_csv(path: Path, scale_time=1.0, **change) -> Path:
    arm = _core.ArmModel.lite6()
    with open(path, "w", newline="") as f:
        out = csv.writer(f)
        out.writerow(
            ["timestamp", "x", "y", "z", "roll", "pitch", "yaw", *(f"joint{i}" for i in range(1, 7)), "gripper"]
        )
        for k in range(60):
            q = 0.3 * np.sin(0.03 * k + np.arange(6))
            X = arm.fk(q)
            rpy = Rotation.from_quat(xyzw(X[3:])).as_euler("xyz", degrees=True)
            row = [0.016 * k * scale_time, *(1e3 * X[:3]), *rpy, *np.degrees(q), k // 30]
            out.writerow(change.get("row", lambda k, r: r)(k, row))
    return path


@pytest.mark.parametrize("scale_time", [1.0, 1000.0])
def test_a_csv_in_seconds_or_milliseconds_is_brought_to_si(tmp_path, scale_time):
    figures = bring("lite6-csv", lite6_csv(tmp_path / "a.csv", scale_time), tmp_path / "a.hdf5")
    assert figures["rate_hz"] == 62.5 and figures["faults"] == []
    demo = load_demos(tmp_path / "a.hdf5")[0][0]
    np.testing.assert_allclose(demo.joint_pos[10], 0.3 * np.sin(0.3 + np.arange(6)), atol=1e-6)
    X = _core.ArmModel.lite6().fk(demo.joint_pos[10])
    np.testing.assert_allclose(demo.obs["robot_eef_pos"][10], X[:3], atol=1e-5)
    assert abs(abs(demo.obs["robot_eef_quat"][10] @ X[3:]) - 1) < 1e-6
    assert demo.gripper[29] == 1 and demo.gripper[30] == 0  # the bit says open


@pytest.mark.parametrize(
    ("row", "says"),
    [
        (lambda k, r: ["x", *r[1:]] if k == 5 else r, "line 7 is not 14 numbers"),
        (lambda k, r: r[:5] if k == 5 else r, "line 7 is not 14 numbers"),
        (lambda k, r: [r[0], *(1e3 * x for x in r[1:4]), *r[4:]], "not mm and deg"),
        (lambda k, r: [r[0] if k != 9 else 0, *r[1:]], "does not advance"),
        (lambda k, r: [*r[:-1], 0.5], "gripper"),
    ],
)
def test_what_is_wrong_with_a_csv_is_said_with_its_line(tmp_path, row, says):
    with pytest.raises(UserError, match=says):
        bring("lite6-csv", lite6_csv(tmp_path / "a.csv", row=row), tmp_path / "a.hdf5")


@pytest.mark.parametrize("kind", ["robosuite", "robomimic", "roboturk", "kitchen", "lerobot", "lite6-csv", "npz"])
def test_a_source_that_is_none_ends_in_one_line(tmp_path, capsys, kind):
    empty = tmp_path / "empty"
    empty.mkdir()
    text = tmp_path / "text"
    text.write_text("hello\n")
    for source in (empty, text, tmp_path / "absent"):
        for name in ("x.hdf5", "x.pkl", "x.csv", "x.npz"):
            if source == empty:
                shutil.copy(text, empty / name)
        assert run(["data", "import", kind, str(source), str(tmp_path / "a.hdf5"), "--agent", "a"]) == 1
        err = capsys.readouterr().err.strip()
        assert len(err.splitlines()) == 1 and err.startswith("intabs data import: "), err
    assert not (tmp_path / "a.hdf5").exists()


@pytest.mark.parametrize(
    "xml", ["<mujoco>", "<mujoco/>", "<mujoco><worldbody><include file='x'/></worldbody></mujoco>",
            "<mujoco><worldbody><body><joint type='odd'/></body></worldbody></mujoco>"],
)  # fmt: skip
def test_models_that_hide_their_joints_are_refused(xml):
    with pytest.raises(UserError):
        mujoco_model.parse(xml, "model")


def test_joints_are_counted_as_mujoco_does():
    mujoco = pytest.importorskip("mujoco", reason="the Python package mujoco is not installed: order held by the files")
    model = mujoco.MjModel.from_xml_string(re.sub(r'(<body name="\w+">)', r'\1<geom size=".1" mass="1"/>', PENDULUM))
    ours = mujoco_model.parse(PENDULUM, "model")
    assert [model.joint(i).name for i in range(model.njnt)] == [j.name for j in ours.joints]
    assert model.jnt_qposadr.tolist() == [j.qpos for j in ours.joints]


# ---- resampling --------------------------------------------------------------------------------------------------


def sine(hz: float, rate: float, seconds: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(int(seconds * rate)) / rate
    return t, np.sin(2 * np.pi * hz * t)[:, None]


def middle(x: np.ndarray) -> np.ndarray:
    return x[len(x) // 10 : -len(x) // 10]


@pytest.mark.parametrize("rate", [100.0, 83.333, 65.1])
def test_what_the_new_rate_cannot_hold_is_gone_and_the_rest_stays(rate):
    new = 20.0
    for hz in (0.5, 2.0, 4.0):
        t, x = sine(hz, rate)
        r = Resampler(t, new)
        want = np.sin(2 * np.pi * hz * r.time)[:, None]
        assert np.abs(middle(r.continuous(x) - want)).max() < 0.01, hz
    for hz in (15.0, 18.0, 20.0, 25.0, 30.0):
        t, x = sine(hz, rate)
        assert np.abs(middle(Resampler(t, new).continuous(x))).max() < 0.01, hz


def test_an_unsteady_clock_is_made_steady():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.005, 0.02, 2000))
    r = Resampler(t, 25.0)
    assert np.allclose(np.diff(r.time), 0.04)
    assert np.abs(middle(r.continuous(np.sin(t)[:, None]) - np.sin(r.time)[:, None])).max() < 2e-3


def test_rotations_stay_rotations_and_signs_do_not_matter():
    t = np.arange(400) / 100
    true = Rotation.from_euler("zyx", np.stack([2 * t, np.sin(t), 0.5 * t], axis=1))
    q = wxyz(true.as_quat())
    q[np.random.default_rng(0).random(400) < 0.3] *= -1
    r = Resampler(t, 25.0)
    got = r.rotation(q)
    assert np.allclose(np.linalg.norm(got, axis=1), 1)
    assert (np.einsum("ij,ij->i", got[1:], got[:-1]) > 0).all()
    want = Rotation.from_euler("zyx", np.stack([2 * r.time, np.sin(r.time), 0.5 * r.time], axis=1))
    assert np.degrees((want.inv() * Rotation.from_quat(xyzw(got))).magnitude())[5:-5].max() < 0.2


def test_signs_are_healed_and_counted():
    q = np.tile([1.0, 0, 0, 0], (6, 1))
    q[2:4] *= -1
    healed, n = heal_signs(q)
    assert n == 2 and (healed[:, 0] == 1).all()


def recording(rate=100.0, n=500) -> Demo:
    t = np.arange(n) / rate
    joint = np.stack([np.sin(t + k) for k in range(6)], axis=1)
    gripper = (t > 2).astype(float)
    pose = np.tile([0.1, 0.2, 0.3, 1, 0, 0, 0], (n, 2, 1)).astype(float)
    valid = np.ones((n, 2), bool)
    valid[200:300, 1] = False
    pose[200:300, 1] = 0
    step = np.diff(joint, axis=0, append=joint[-1:])
    return Demo(t, joint, np.cos(t[:, None] + np.arange(6)), gripper, pose, valid,
                np.column_stack([step, 2 * gripper - 1]), {"rate_hz": rate},
                extra={"labels": (t > 1).astype("u1"), "states": np.zeros((n, 3))})  # fmt: skip


@pytest.mark.parametrize("rate", [25.0, 33.3, 250.0])
def test_a_whole_demonstration_at_another_rate_means_the_same(rate):
    source = recording()
    d = resample(source, rate)
    assert np.allclose(np.diff(d.time), 1 / rate) and d.attrs["rate_hz"] == rate
    assert abs(len(d) - len(source) * rate / 100) <= 1 + rate / 100
    np.testing.assert_allclose(d.joint_pos[2:-2], np.sin(d.time[:, None] + np.arange(6))[2:-2], atol=2e-3)
    # Actions still add up to the motion, the gripper is still a switch that closes at two seconds.
    path = d.joint_pos[0] + np.cumsum(d.actions[:-1, :6], axis=0)
    assert np.abs(path - d.joint_pos[1:]).max() < 5e-3
    assert set(np.unique(d.gripper)) == {0, 1} and set(np.unique(d.actions[:, 6])) == {-1, 1}
    assert abs(d.time[np.argmax(d.gripper)] - 2.01) <= 1 / rate + 1e-6
    # Nothing is made up where an object was not seen, and what was seen is not bent by what was not.
    assert not d.object_valid[(d.time > 1.991) & (d.time < 2.999), 1].any() and d.object_valid[:, 0].all()
    seen = d.object_pose[d.object_valid]
    np.testing.assert_allclose(seen, np.tile([0.1, 0.2, 0.3, 1, 0, 0, 0], (len(seen), 1)), atol=1e-6)
    assert set(d.extra) == {"labels"} and d.extra["labels"].dtype == np.uint8
