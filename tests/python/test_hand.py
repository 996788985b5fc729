"""Hands: the C++ side called from Python, MediaPipe, and both on real pictures."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from intabs import _core, bus, cli, paths
from intabs.data.check import find_faults
from intabs.data.demos import load_demos
from intabs.data.labels import KINDS, segments
from intabs.errors import UserError
from intabs.hand import estimator, frames, offline
from intabs.hand.sim import record, scripts, sensors
from intabs.hand.track import track_hand

SHARED = paths.ROOT.parent / "shared" / "data"
K = np.array([610.0, 610.0, 319.5, 239.5])


@pytest.fixture
def mediapipe():
    if not estimator.PYTHON.exists():
        pytest.skip(f"MediaPipe is not installed: {estimator.CURE}")


def real(name):
    if not (SHARED / name).is_dir():
        pytest.skip(f"{SHARED / name} is not there")
    return SHARED / name


# --- gaps


def test_gaps_are_filled_from_python_as_in_cpp():
    time = np.arange(60) / 30
    s = time / 2
    x = 0.4 * (10 * s**3 - 15 * s**4 + 6 * s**5)
    pose = np.tile([0.0, 0, 0.1, 1, 0, 0, 0], (60, 1))
    pose[:, 0] = x
    pose[:, 3], pose[:, 6] = np.cos(s / 2), np.sin(s / 2)
    valid = np.ones(60, bool)
    valid[20:26] = valid[40:60] = False
    seen = np.where(valid[:, None], pose, np.nan)
    filled, state, sigma = _core.fill_gaps(time, seen, valid)
    assert (state == np.r_[np.ones(20), np.full(6, 2), np.ones(14), np.zeros(20)]).all()
    assert np.abs(filled[20:26] - pose[20:26]).max() < 2e-3
    assert np.isnan(filled[45]).all()
    assert (sigma[20:26] > 0).all() and sigma[45] == 0
    line, state, _ = _core.fill_gaps(time, seen[:, :3], valid, method="linear")
    assert line[22, 0] == pytest.approx(np.interp(time[22], time[valid], x[valid]))
    assert (state[20:26] == 2).all()
    assert (_core.fill_gaps(time, seen, valid, max_gap=0.1)[1][20:26] == 0).all()
    for arguments, words in (
        ((time[::-1].copy(), seen, valid), "time does not rise at sample 1"),
        ((time, seen[:, :5], valid), "value must be"),
        ((time, seen, np.ones(60, bool)), "pose 20"),
        ((time, seen, valid, "spline"), "spline"),
    ):
        with pytest.raises(ValueError, match=words):
            _core.fill_gaps(*arguments)


def test_the_causal_tracker_predicts_then_gives_up():
    tracker = _core.GapTracker(max_gap=0.3)
    assert not tracker.predict(0)["valid"]
    for k in range(30):
        assert tracker.update(k / 30, [0.5 * k / 30, 0, 0, 1, 0, 0, 0])
    assert not tracker.update(0.1, [0, 0, 0, 1, 0, 0, 0])
    soon, later = tracker.predict(1.0), tracker.predict(1.5)
    assert soon["valid"] and not later["valid"]
    assert soon["pose"][0] == pytest.approx(0.5, abs=0.01)
    assert later["sigma"] > soon["sigma"] > 0


# --- key points and depth


def open_hand(z=0.8):
    """(21, 3) in C: bones of the table."""
    p = np.zeros((21, 3))
    p[0] = 0, 0.1, z
    for a, b, length in _core.hand_bones:
        if (a, b) != (5, 17):
            turn = (-0.75, -0.30, -0.07, 0.12, 0.33)[(b - 1) // 4]
            p[b] = p[a] + length * np.array([np.sin(turn), -np.cos(turn), 0])
    return p


def project(p):
    return p[..., :2] / p[..., 2:] * K[:2] + K[2:]


def test_a_sequence_goes_through_in_one_call():
    time = np.arange(40) / 30
    p = open_hand() + np.stack([0.1 * time, 0 * time, 0 * time], 1)[:, None]
    uv = project(p)
    uv[10:14] = np.nan
    X_WC = np.array([0.4, 0, 0.7, 0, 1, 0, 0])  # upside down
    depth = p[:, :, 2] - 0.008
    depth[30, 8] += 0.5
    track = track_hand(time, uv, depth, K, X_WC)
    want = X_WC[:3] + p * [1, -1, -1]
    assert track.valid.all()
    assert (track.state[10:14] == 2).all() and track.state[30, 8] == 2
    assert np.abs(track.points - want).max() < 2e-3
    assert track.counts()["filled"] == 4 * 21 + 1

    # The same from pictures, one at a time: a hand as flat as a plate.
    pictures = (np.full((480, 640), 792, np.uint16) for _ in time)
    assert np.abs(track_hand(time, uv, pictures, K, X_WC).points - want).max() < 2e-3
    lost = track_hand(time, uv, [None] * 40, K)
    assert not lost.valid.any() and lost.counts()["no_depth"] == 36 * 21


def test_what_does_not_fit_is_refused_in_one_line():
    time = np.arange(3) / 30
    uv = np.tile(project(open_hand()), (3, 1, 1))
    z = np.full((3, 21), 0.8)
    for arguments, words in (
        ((time, uv[:, :20], z, K), "uv must be"),
        ((time, uv, z[:2], K), "2 depth pictures for 3 frames"),
        ((time[:2], uv, z, K), "uv must be"),
        ((time[::-1], uv, z, K), "time does not rise"),
        ((time, uv, z, K[:3]), "intrinsics"),
        ((time, uv, z, K, [0, 0, 0, 2, 0, 0, 0]), "X_WC"),
        ((time, uv, np.zeros((3, 480, 640)), K), "uint16"),
    ):
        with pytest.raises(ValueError, match=words) as e:
            track_hand(*arguments)
        assert "\n" not in str(e.value)
    with pytest.raises(ValueError, match="best"):
        track_hand(time, uv, z, K, method="best")


# --- real pictures


def of_real_hand(method="robust", background=0, tmp_path=None):
    options = offline.Options(method, background_mm=background)
    figures = offline.process_folder(real("hand_rgbd"), tmp_path, options)
    print(f"\nhand_rgbd, {method}, wall {background} mm behind: {offline.describe(figures)}")
    return figures


@pytest.mark.parametrize("background", [0, 500])
def test_a_real_hand_is_found_to_15_mm(mediapipe, background):
    figures = of_real_hand(background=background)
    assert figures["found"] == figures["frames"] == 10
    assert figures["error_mm"]["p50"] <= 15
    assert figures["error_mm"]["max"] <= 60
    assert figures["kept"] >= 0.7
    thesis = of_real_hand("gaussian", background)
    assert figures["error_mm"]["p50"] < thesis["error_mm"]["p50"]


def test_the_labels_are_in_mediapipes_order(mediapipe):
    optimize = pytest.importorskip("scipy.optimize")
    folder = real("hand_rgbd")
    fx, fy, cx, cy = frames.intrinsics(folder)
    with estimator.MediaPipeHands() as hands:
        for shot in frames.shots(folder):
            p = frames.joints(folder, shot)
            uv = p[:, :2] / p[:, 2:] * [fx, fy] + [cx, cy]
            distance = np.linalg.norm(uv[:, None] - hands.find(shot.rgb()).uv[None], axis=2)
            assert optimize.linear_sum_assignment(distance)[1].tolist() == list(range(21))


def test_key_points_in_the_picture_against_labels(mediapipe):
    """Reported: MediaPipe's own business."""
    folder = real("hand_2d")
    for kind in ("freihand", "onehand10k"):
        labels = json.loads((folder / kind / f"test_{kind}.json").read_text())
        points = {a["image_id"]: np.array(a["keypoints"], "f8").reshape(21, 3) for a in labels["annotations"]}
        box = {a["image_id"]: a["bbox"] for a in labels["annotations"]}
        errors, relative, found = [], [], 0
        with estimator.MediaPipeHands(independent=True) as hands:
            pictures = [i for i in labels["images"] if (folder / kind / i["file_name"]).exists()]
            for image in pictures:
                shot = frames.Shot("", 0, folder / kind / image["file_name"], None)
                if hand := hands.find(shot.rgb()):
                    found += 1
                    there = points[image["id"]][:, 2] > 0
                    e = np.linalg.norm(hand.uv - points[image["id"]][:, :2], axis=1)[there]
                    errors.append(e.mean())
                    relative.append(e.mean() / max(box[image["id"]][2:]))
        print(
            f"\nhand_2d, {kind}: found {found} of {len(pictures)}, mean error {np.mean(errors):.1f} px, "
            f"{100 * np.mean(relative):.0f} % of the hand's size"
        )
        assert found >= len(pictures) / 2
        assert np.mean(relative) < 0.15


# --- the producer


def test_key_points_come_over_lcm(mediapipe, tmp_path):
    if fault := bus.route_fault():
        pytest.skip(f"no multicast route for LCM ({fault})")
    for file in sorted(real("hand_rgbd").glob("*_o.jpg")):
        shutil.copy(file, tmp_path / f"{1_000_000_000 + int(file.name.split('_')[0])}.jpg")
    url = bus.private_url()
    link, heard = bus.Bus(url), []
    link.subscribe("HAND_KEYPOINTS_left", heard.append)
    command = "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    producer = subprocess.Popen(
        [sys.executable, "-c", command, "hand", f"folder:{tmp_path}", "--publish", "--lcm", url], env=environment
    )
    while producer.poll() is None:
        link.handle(100)
    while link.handle(100):
        pass
    assert producer.returncode == 0
    assert [m.frame_seq for m in heard] == list(range(1, 11))
    assert heard[0].exposure_utime == 1_790_154_000
    assert np.array(heard[0].uv).shape == (21, 2)
    assert 0 < np.array(heard[0].uv).min() < 480
    assert heard[0].score > 0.5


def test_without_mediapipe_one_line_says_what_to_do(monkeypatch, tmp_path, capsys):
    image = pytest.importorskip("PIL.Image")
    image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "a.png")
    monkeypatch.setattr(estimator, "PYTHON", tmp_path / "python")
    assert cli.run(["hand", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "tools/setup --hands" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "no such folder"),
        (["."], "no pictures"),
        (["video:x.mp4"], "--publish"),
        (["ring:/nothing_there", "--publish"], "there is none"),
    ],
)
def test_bad_input_ends_in_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    if "--publish" in arguments and bus.route_fault():
        pytest.skip("no multicast route for LCM")
    monkeypatch.chdir(tmp_path)
    assert cli.run(["hand", *arguments]) == 1
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


def test_a_worker_that_dies_is_said(mediapipe):
    with estimator.MediaPipeHands() as hands:
        hands._worker.kill()
        with pytest.raises(UserError, match="tools/setup --hands"):
            hands.find(np.zeros((48, 64, 3), np.uint8))


# --- the simulated hand


def test_the_simulated_hand_does_every_task():
    kinds = set()
    for task in (*scripts.TASKS, *scripts.COMPOSITIONS):
        for seed in (1, 2):
            run = scripts.perform(task, seed, 5.0)
            assert scripts.done(run), (task, seed)
            assert not scripts.done(
                scripts.Performance(task, run.names, 1, objects=run.objects[:1], held=["x"], start=run.start)
            )
            joints = run.joints()
            assert np.abs(np.diff(joints, axis=0)).max() < 0.12  # m a frame
            lengths = [np.linalg.norm(joints[:, a] - joints[:, b], axis=1) / run.scale for a, b, _ in _core.hand_bones]
            assert np.ptp(lengths, axis=1).max() < 1e-9  # bones do not stretch
            kinds |= {kind for kind, _, _ in segments(record.labels(run))}
    assert len(kinds) >= 17
    assert (
        scripts.perform("pour", 3, 2.0).objects[-1]["cup"].p.tolist()
        == scripts.perform("pour", 3, 2.0).objects[-1]["cup"].p.tolist()
    )


def test_a_simulated_demonstration_goes_through_the_filters_into_a_sound_file(tmp_path):
    figures = record.collect("drawer_open", 1, tmp_path / "human.hdf5", seed=20)
    assert figures["tasks"] == {"drawer_open": {"demos": 1, "success": 1}}
    assert figures["error_mm"]["p50"] < 15
    assert figures["kept"] > 0.8
    (demo,), attrs = load_demos(tmp_path / "human.hdf5")
    assert attrs["embodiment"] == "human" and attrs["label_names"] == json.dumps(list(KINDS))
    assert demo.obs["hand_keypoints"].shape == (len(demo), 63)
    assert demo.obs["hand_valid"].shape == (len(demo), 21)
    assert demo.object_valid[:, 3].any() and not demo.object_valid[:, :3].any()
    assert find_faults(tmp_path / "human.hdf5") == []
    thesis = record.record(record.Job("drawer_open", 20, 2.0, "gaussian"))
    assert np.median(thesis.error) > np.median(record.record(record.Job("drawer_open", 20, 2.0)).error)


def test_false_detections_do_not_come_through():
    """With the estimator at its worst, what is kept is the hand."""
    run = scripts.perform("pick_place", 5, 2.0)
    rng = np.random.default_rng(5)
    uv = sensors.project(run.joints()) + rng.normal(0, 2, (len(run), 21, 2))
    stain = sensors.project(np.array([0.5, 0.2, 0.0])) + 0.9 * (uv[0] - uv[0].mean(0))
    for first in (20, 50, 80, 81, 110):
        uv[first : first + 3] = stain + rng.normal(0, 0.5, (21, 2))
    depth = list(sensors.depth_pictures(run, uv, rng))
    time = scripts.PERIOD * np.arange(len(run))
    track = track_hand(time, uv, depth, sensors.K, sensors.CAMERA.array())
    error = np.linalg.norm(track.points - run.joints(), axis=2)
    assert error[track.valid].max() < 0.15
    loose = track_hand(time, uv, depth, sensors.K, sensors.CAMERA.array(), fixed_place=False, jumps=False)
    assert np.linalg.norm(loose.points - run.joints(), axis=2)[loose.valid].max() > 0.4
