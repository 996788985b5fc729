"""tools/calibrate from pictures to the YAML that perception and control take."""

import json
import math
import subprocess

import numpy as np
import pytest
from PIL import Image

from bench import TASK, WEIGHTS, Bench, need_programs
from intabs import _core, paths

need_programs()

PHOTOS = paths.ROOT.parent / "shared" / "data" / "apriltag" / "photos" / "calibration"
CONFIG = paths.MODELS / "config" / "perception.yaml"
WIDTH, HEIGHT, F = 640, 480, 610.065


def calibrate(*arguments: object) -> subprocess.CompletedProcess:
    command = [paths.ROOT / "tools" / "calibrate", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env={"INTABS_BIN_DIR": str(paths.BIN)})


def refusal(*arguments: object) -> str:
    done = calibrate(*arguments)
    lines = done.stderr.splitlines()
    assert done.returncode == 1
    assert len(lines) == 1, lines
    assert lines[0].startswith("intabs_calibrate: ")
    return lines[0]


def rotation(w) -> np.ndarray:
    angle = np.linalg.norm(w)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = np.asarray(w) / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def pose(p, w) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation(w), p
    return X


def matrix(p_wxyz) -> np.ndarray:
    w, x, y, z = p_wxyz[3:]
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, p_wxyz[:3]
    return X


def wxyz(R: np.ndarray) -> list[float]:
    # The eigenvector of Bar-Itzhack's matrix (J. Guidance 2000): no case of R is special.
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K = np.zeros((4, 4))
    K[0, 0], K[0, 1:], K[1:, 0] = np.trace(R), (a, b, c), (a, b, c)
    K[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return list(np.linalg.eigh(K)[1][:, -1])


def yaml_pose(X: np.ndarray) -> str:
    p, q = [float(v) for v in X[:3, 3]], [float(v) for v in wxyz(X[:3, :3])]
    return f"{{p: {p}, q: {q}}}"


def test_intrinsics_of_the_real_photos(tmp_path):
    if not PHOTOS.exists():
        pytest.skip(f"no {PHOTOS}")
    out, figures = tmp_path / "c.yaml", tmp_path / "c.json"
    done = calibrate("intrinsics", PHOTOS, "--camera", "photo", "--out", out, "--json", figures)
    assert done.returncode == 0, done.stderr
    found = json.loads(figures.read_text())
    assert found["rms_px"] <= 0.5
    assert found["held_out_rms_px"] <= 0.5
    text = out.read_text()
    for word in ("name: photo", "distortion:", "rms_px:", "coverage:", "date:"):
        assert word in text


def test_pictures_that_tell_no_lens_are_refused(tmp_path):
    out = tmp_path / "c.yaml"
    for i in range(3):
        Image.fromarray(np.full((48, 64), 40 * i, "u1")).save(tmp_path / f"{i}.png")
    done = calibrate("intrinsics", tmp_path, "--out", out)
    assert done.returncode == 1
    assert "usable in 0 pictures" in done.stderr
    Image.fromarray(np.zeros((40, 64), "u1")).save(tmp_path / "3.png")
    assert "3.png has 64 x 40" in refusal("intrinsics", tmp_path, "--out", out)
    (tmp_path / "3.png").write_bytes(b"no picture")
    assert "3.png: no readable picture" in refusal("intrinsics", tmp_path / "3.png", "--out", out)
    assert not out.exists()


def test_both_cameras_of_the_plant_from_recorded_frames_and_perception_takes_what_was_found(tmp_path):
    world = _core.World(str(paths.MODELS), TASK)
    world.reset(1, 0)
    renderer = _core.Renderer(world, WIDTH, HEIGHT)
    random = np.random.default_rng(0)
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        picture = renderer.render(world, name).astype(float)
        for i in range(12):
            noisy = np.clip(picture + random.normal(0, 2, picture.shape), 0, 255).astype("u1")
            Image.fromarray(noisy).save(tmp_path / name / f"{i:02}.png")
    out = tmp_path / "c.yaml"
    sources = [a for n in ("left", "right") for a in ("--source", f"{n}=folder:{tmp_path / n}")]
    done = calibrate("extrinsics", "--config", CONFIG, *sources, "--out", out)
    assert done.returncode == 0, done.stderr
    text = out.read_text()
    assert text.count("X_WC:") == 2
    assert text.count("sigma_mm:") == 2

    rest = CONFIG.read_text()
    rest = rest[: rest.index("cameras:")] + "calibration: c.yaml\n" + rest[rest.index("ground:") :]
    (tmp_path / "p.yaml").write_text(rest)
    pipeline = _core.Pipeline(str(tmp_path / "p.yaml"))
    seen = pipeline.process([renderer.render(world, n) for n in ("left", "right")], 1, 1000)
    for i, truth in world.objects().items():
        assert seen["valid"][i]
        assert np.linalg.norm(seen["pose"][i][:3] - truth[:3]) < 0.002

    (tmp_path / "blank").mkdir()
    for i in range(3):
        Image.fromarray(np.full((HEIGHT, WIDTH), 90, "u1")).save(tmp_path / "blank" / f"{i}.png")
    source = f"left=folder:{tmp_path / 'blank'}"
    assert "0 frames show the ground tag" in refusal("extrinsics", "--config", CONFIG, "--source", source, "--out", out)
    assert "nobody=" in refusal("extrinsics", "--config", CONFIG, "--source", "nobody=folder:x", "--out", out)


def tag_picture(X_CT: np.ndarray, size: float) -> np.ndarray | None:
    """What a camera sees of tag 10; None when it does not face the camera or is not wholly in view."""
    texture = np.asarray(Image.open(paths.MODELS / "objects" / "tags" / "tag36h11_10.png").convert("L"), float)
    n, half, scale = texture.shape[0], size / 2 * 10 / 8, 3
    normal = X_CT[:3, 2]
    if normal @ X_CT[:3, 3] / np.linalg.norm(X_CT[:3, 3]) < 0.5:
        return None
    K = np.array([[F, 0, 319.5], [0, F, 239.5], [0, 0, 1]])
    # Texture (u, v, 1) -> tag plane -> picture.
    step = 2 * half / n
    H = K @ X_CT[:3, [0, 1, 3]] @ np.array([[step, 0, -half + step / 2], [0, step, -half + step / 2], [0, 0, 1]])
    corners = H @ np.array([[0, n, n, 0], [0, 0, n, n], [1, 1, 1, 1]], float)
    corners = corners[:2] / corners[2]
    if corners.min() < 10 or corners[0].max() > WIDTH - 10 or corners[1].max() > HEIGHT - 10:
        return None
    y, x = np.mgrid[0 : HEIGHT * scale, 0 : WIDTH * scale]
    ray = np.linalg.inv(H) @ np.stack(
        [(x.ravel() + 0.5) / scale - 0.5, (y.ravel() + 0.5) / scale - 0.5, np.ones(x.size)]
    )
    u, v = np.round(ray[0] / ray[2]).astype(int), np.round(ray[1] / ray[2]).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < n) & (v < n)
    picture = np.full(x.size, 120.0)
    picture[inside] = 30 + 0.7 * texture[v[inside], u[inside]]
    return picture.reshape(HEIGHT, scale, WIDTH, scale).mean(axis=(1, 3))


def test_hand_eye_from_pictures_and_joints(tmp_path):
    arm = _core.ArmModel.lite6()
    random = np.random.default_rng(3)
    X_WB, X_FT = pose([0.4, -0.3, 0.02], [0, 0, 0.5]), pose([0, 0.01, 0.06], [0.2, 3.0, 0.1])
    home = np.asarray(_core.World(str(paths.MODELS), TASK).arm()["q"])
    # The camera looks at where the arm shows the tag at home, from 0.5 m.
    X_BE = lambda q: matrix(np.asarray(arm.fk(q)))  # noqa: E731
    X_WT = X_WB @ X_BE(home) @ X_FT
    X_WC = X_WT @ pose([0, 0, 0], [0.3, 0.2, 0]) @ pose([0.02, -0.01, -0.5], [0, 0, 0])
    samples = tmp_path / "samples"
    samples.mkdir()
    rows = ["left,q1,q2,q3,q4,q5,q6"]
    while len(rows) < 17:
        q = home + random.uniform(-1, 1, 6) * [0.25, 0.2, 0.2, 0.8, 0.5, 1.0]
        picture = tag_picture(np.linalg.inv(X_WC) @ X_WB @ X_BE(q) @ X_FT, 0.05)
        if picture is None:
            continue
        noisy = np.clip(picture + random.normal(0, 2, picture.shape), 0, 255).astype("u1")
        Image.fromarray(noisy).save(samples / f"{len(rows)}.png")
        rows.append(f"{len(rows)}.png," + ",".join(repr(float(v)) for v in q))
    (samples / "samples.csv").write_text("\n".join(rows) + "\n")
    config = tmp_path / "p.yaml"
    camera = f"{{name: left, width: {WIDTH}, height: {HEIGHT}, fx: {F}, fy: {F}, cx: 319.5, cy: 239.5"
    config.write_text(f"cameras:\n  - {camera}, X_WC: {yaml_pose(X_WC)}}}\nobjects: []\n")
    out = tmp_path / "c.yaml"
    arguments = ("hand-eye", "--config", config, "--samples", samples, "--tag", 10, "--tag-size", 0.05, "--out", out)
    done = calibrate(*arguments)
    assert done.returncode == 0, done.stderr
    text = out.read_text()
    line = next(s for s in text.splitlines() if s.startswith("X_WB:"))
    p = np.array(json.loads(line[line.index("p: ") + 3 : line.index("]") + 1]))
    q = np.array(json.loads(line[line.index("q: ") + 3 : line.rindex("]") + 1]))
    assert np.linalg.norm(p - X_WB[:3, 3]) < 0.002
    assert 2 * math.acos(min(1, abs(q @ wxyz(X_WB[:3, :3])))) < math.radians(0.3)
    assert "hand_eye: {date:" in text

    (samples / "samples.csv").write_text("\n".join(rows[:5]) + "\n")
    assert "4 arm poses show the tag" in refusal(*arguments)
    (samples / "samples.csv").write_text("\n".join([*rows[:5], "5.png,1,2,3,4,five,6"]) + "\n")
    assert "samples.csv: line 6" in refusal(*arguments)
    (samples / "samples.csv").write_text("left,right\n")
    assert "line 1 must name" in refusal(*arguments)


def commands(folder, config, *hand_eye: object) -> list:
    """The first joint targets of a run in lockstep."""
    with Bench(folder, clock="lockstep") as bench:
        bench.plant()
        bench.until(lambda: bench.heard["PLANT_TRUTH"], "the plant speaks")
        program = paths.program("intabs_perception")
        bench.processes.start(program, "--lcm", bench.url, "--ring", bench.ring, "--config", config)
        bench.processes.start(paths.program("intabs_control"), "--lcm", bench.url, "--weights", WEIGHTS, *hand_eye)
        bench.play()
        bench.until(lambda: bench.status.utime >= 20 * 40_000, "20 ticks", patience_s=120)
        first = {c.utime: c.q_target for c in bench.heard["LITE6_COMMAND"]}
        return [first[t * 40_000] for t in range(1, 19)]


def test_an_arm_that_does_not_stand_at_the_world_frame_is_commanded_alike_once_its_base_is_known(tmp_path):
    """W put elsewhere: perception says other numbers, control turns them back."""
    X_VW = pose([0.3, -0.2, 0.1], [0.1, 0.2, 0.9])  # V: the other world frame; W is still the arm's base
    text = CONFIG.read_text()
    at = text.index("X_WT: ")
    ground = pose([0.52, 0, 0.001], [math.pi, 0, 0])
    turned = X_VW @ ground
    moved = text[:at] + "X_WT: " + yaml_pose(turned) + text[text.index("\n", at) :]
    (tmp_path / "p.yaml").write_text(moved)
    (tmp_path / "c.yaml").write_text(f"X_WB: {yaml_pose(X_VW)}\n")
    straight = commands(tmp_path / "a", CONFIG)
    known = commands(tmp_path / "b", tmp_path / "p.yaml", "--hand-eye", tmp_path / "c.yaml")
    unknown = commands(tmp_path / "c", tmp_path / "p.yaml")
    assert np.abs(np.array(known) - straight).max() < 1e-3
    assert np.abs(np.array(unknown) - straight).max() > 1e-2


def test_a_hand_eye_file_that_does_not_hold_is_refused(tmp_path):
    file = tmp_path / "c.yaml"
    for text, part in (
        ("X_WB: 5\n", "X_WB.p"),
        ("X_WB: {p: [0, 0, 0], q: [1, 1, 0, 0]}\n", "norm"),
        ("X_WB: {p: [0, 0], q: [1, 0, 0, 0]}\n", "3 numbers"),
        ("X_WB: [\n", "line"),
    ):
        file.write_text(text)
        done = subprocess.run(
            [paths.program("intabs_control"), "--hand-eye", file], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1
        assert str(file) in done.stderr
        assert part in done.stderr


def test_capture_keeps_a_picture_of_each_camera_and_the_joints_where_the_arm_rests(tmp_path):
    with Bench(tmp_path / "out", clock="wall") as bench:
        bench.plant()
        bench.until(lambda: bench.heard["PLANT_TRUTH"], "the plant speaks")
        sources = [a for n in ("left", "right") for a in ("--source", f"{n}=ring:{bench.ring}")]
        samples = tmp_path / "samples"
        done = calibrate(
            "capture", "--config", CONFIG, *sources, "--samples", samples, "--lcm", bench.url, "--poses", 1
        )
        assert done.returncode == 0, done.stderr
        head, row = (samples / "samples.csv").read_text().splitlines()
        assert head == "left,right,q1,q2,q3,q4,q5,q6"
        left, right, *q = row.split(",")
        bench.listen(0.1)
        assert np.abs(np.array([float(v) for v in q]) - bench.status.q).max() < 0.01
        for file in (left, right):
            assert Image.open(samples / file).size == (WIDTH, HEIGHT)
        assert "is there already" in refusal("capture", "--config", CONFIG, *sources, "--samples", samples)
