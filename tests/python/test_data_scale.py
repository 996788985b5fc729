"""Files of many demonstrations are listed, checked and sampled without being read. 5,000 demonstrations here; README.md
of python/intabs/data has the figures of 100,000."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

from intabs.data import synthetic
from intabs.data.check import find_faults
from intabs.data.demos import Demo, DemoWriter
from intabs.data.reader import DemoFile, inspect
from intabs.errors import UserError

DEMOS, FRAMES = 5000, 300


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    path = tmp_path_factory.mktemp("large") / "large.hdf5"
    synthetic.write(path, DEMOS, FRAMES)
    return path


def alone(code: str) -> dict:
    """Figures of a process of its own: {..., mb, read}: most memory, bytes read from files."""
    tail = """
import json
# Not ru_maxrss: that remembers the parent's.
mb = int(next(l for l in open("/proc/self/status") if l.startswith("VmHWM")).split()[1]) / 1024
read = int(next(l for l in open("/proc/self/io") if l.startswith("rchar")).split()[1]) - before
print(json.dumps(figures | {"mb": mb, "read": read}))
"""
    head = "import numpy as np\nfrom intabs.data.reader import DemoFile, inspect\nfrom intabs.data import check\n"
    head += 'before = int(next(l for l in open("/proc/self/io") if l.startswith("rchar")).split()[1])\n'
    done = subprocess.run([sys.executable, "-c", head + code + tail], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_first_batch_comes_without_reading_the_file(large):
    got = alone(
        f"f = DemoFile({str(large)!r}, 'train')\n"
        "b = f.sample(64, 16, np.random.default_rng(0))\n"
        "figures = {'demos': len(f), 'agent': b.agent.shape, 'objects': b.objects.shape}"
    )
    assert got["demos"] == 4500 and got["agent"] == [64, 16, 7] and got["objects"] == [64, 16, 3, 7]
    assert got["read"] < 0.3 * large.stat().st_size
    assert got["mb"] < 300


def test_listing_reads_the_index_only(large):
    got = alone(f"figures = {{'info': inspect({str(large)!r})}}")
    assert got["info"]["demos"] == DEMOS and got["info"]["frames"] == DEMOS * FRAMES
    assert len(got["info"]["tasks"]) == 5 and got["info"]["layout"] == "packed"
    assert got["read"] < 0.05 * large.stat().st_size


def test_checking_keeps_its_memory_and_finds_one_fault_among_all(large):
    got = alone(f"figures = {{'faults': check.find_faults({str(large)!r})}}")
    assert got["faults"] == [] and got["mb"] < 500
    import h5py

    with h5py.File(large, "r+") as f:
        rows = f["packed/obs/robot_joint_pos"]
        k = 3210 * FRAMES + 17
        before = rows[k]
        rows[k] = np.nan
        f.flush()
    try:
        assert [(x["demo"], x["kind"]) for x in find_faults(large)] == [("demo_3210", "not finite")]
    finally:
        with h5py.File(large, "r+") as f:
            f["packed/obs/robot_joint_pos"][k] = before


def test_windows_are_pieces_of_their_demonstrations(large):
    with DemoFile(large, "valid") as f:
        batch = f.sample(32, 20, np.random.default_rng(1))
        for i in range(32):
            demo = f.demo(int(batch.demo[i]))
            piece = slice(int(batch.start[i]), int(batch.start[i]) + 20)
            np.testing.assert_array_equal(batch.agent[i, :, :6], demo.joint_pos[piece].astype("f4"))
            np.testing.assert_array_equal(batch.agent[i, :, 6], demo.gripper[piece])
            np.testing.assert_array_equal(batch.objects[i], demo.object_pose[piece].astype("f4"))
            np.testing.assert_array_equal(batch.actions[i], demo.actions[piece].astype("f4"))
        again = f.sample(32, 20, np.random.default_rng(1))
        np.testing.assert_array_equal(batch.agent, again.agent)


@pytest.mark.parametrize("packed", [False, True])
def test_every_start_is_equally_likely_and_short_ones_are_left_out(tmp_path, packed):
    path = tmp_path / "a.hdf5"
    rng = np.random.default_rng(0)
    with DemoWriter(path, {"embodiment": "lite6", "rate_hz": 25.0}, packed=packed) as writer:
        for n in (15, 40, 19, 100):
            writer.add(synthetic.demo(rng, n))
    with DemoFile(path) as f:
        batch = f.sample(2000, 20, np.random.default_rng(0))
        assert set(batch.demo) == {1, 3} and batch.start[batch.demo == 3].max() == 80
        counts = np.bincount(batch.start[batch.demo == 3], minlength=81)
        assert (batch.demo == 1).mean() == pytest.approx(21 / 102, abs=0.04) and counts.min() > 0
        with pytest.raises(UserError, match="no demonstration has 500 frames"):
            f.sample(4, 500, rng)


@pytest.mark.parametrize("packed", [False, True])
def test_a_window_knows_what_was_seen_before_it_began(tmp_path, packed):
    path = tmp_path / "a.hdf5"
    d = synthetic.demo(np.random.default_rng(0), 60)
    d.object_valid[:, 1] = False
    d.object_valid[10:15, 1] = True
    with DemoWriter(path, {"embodiment": "lite6", "rate_hz": 25.0}, packed=packed) as writer:
        writer.add(d)
    with DemoFile(path) as f:
        w = f.windows(np.array([0, 0]), np.array([5, 30]), 20)
    assert w.known[1, :, 1].all() and not w.valid[1, :, 1].any()
    assert w.known[0, :, 1].tolist() == [False] * 5 + [True] * 15
    assert w.known[:, :, 0].all()


def test_a_reader_can_be_sent_to_a_worker(large):
    with DemoFile(large, "valid") as f, pickle.loads(pickle.dumps(f)) as g:
        a, b = (x.sample(8, 16, np.random.default_rng(0)) for x in (f, g))
        np.testing.assert_array_equal(a.objects, b.objects)


def test_an_index_that_does_not_fit_is_refused(tmp_path):
    import h5py

    path = tmp_path / "a.hdf5"
    synthetic.write(path, 10, 50, packed=True)
    with h5py.File(path, "r+") as f:
        f["index/length"][3] = 60
    with pytest.raises(UserError, match="index does not fit"):
        inspect(path)


def test_a_packed_file_holds_one_kind_of_field(tmp_path):
    rng = np.random.default_rng(0)
    other = synthetic.demo(rng, 50)
    other = Demo(**(vars(other) | {"object_pose": other.object_pose[:, :1], "object_valid": other.object_valid[:, :1]}))
    with pytest.raises(UserError, match="object_1_pose"), DemoWriter(tmp_path / "a.hdf5", {}, packed=True) as writer:
        writer.add(synthetic.demo(rng, 50))
        writer.add(other)
    assert not list(tmp_path.iterdir())
