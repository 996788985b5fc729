"""The Pipeline of the C++ side, called from Python."""

import math

import numpy as np
import pytest

from intabs import _core, paths

CONFIG = paths.MODELS / "config" / "perception.yaml"


@pytest.fixture
def pipeline():
    return _core.Pipeline(str(CONFIG))


def black(*shape):
    return np.zeros(shape, np.uint8)


def test_frames_without_tags_give_unused_slots(pipeline):
    assert pipeline.cameras == ["left", "right"]
    for images in ([black(480, 640), black(480, 640, 3)], [None, None]):
        out = pipeline.process(images, 7, 40_000)
        assert out["frame_seq"] == 7
        assert out["exposure_us"] == 40_000
        assert (out["id"] == -1).all()
        assert out["pose"].shape == (4, 7)
        assert (out["pose"] == [0, 0, 0, 1, 0, 0, 0]).all()
        assert out["covariance"].shape == (4, 21)
        assert not out["valid"].any()
        assert out["tags"] == {"left": [], "right": []}
    assert pipeline.camera_pose(0) is None


def test_what_does_not_fit_is_refused_in_one_line(pipeline):
    for images, words in (
        ([black(480, 640)], "1 images for 2 cameras"),
        ([black(240, 320), black(480, 640)], "320 x 240"),
        ([black(480, 640).astype(float), black(480, 640)], "uint8"),
        ([black(480, 640, 4), black(480, 640)], "RGB"),
        ([black(480, 1280)[:, ::2], black(480, 640)], "contiguous"),
    ):
        with pytest.raises((ValueError, RuntimeError), match=words) as e:
            pipeline.process(images, 1, 0)
        assert "\n" not in str(e.value)
    with pytest.raises(IndexError):
        pipeline.camera_pose(2)
    with pytest.raises(RuntimeError, match="nowhere.yaml"):
        _core.Pipeline("nowhere.yaml")


def picture_of_ground_tag(R_CW, p_WC):
    """What a camera at p_WC sees of the ground tag: its picture, as the plant has it, on grey."""
    image = pytest.importorskip("PIL.Image")
    tag = image.open(paths.MODELS / "objects" / "tags" / "tag36h11_0.png").convert("L")
    # PIL asks for the map from the output to the input, with pixel (0, 0) from 0 to 1.
    rows, rhs = [], []
    for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)):
        p_C = R_CW @ (np.array([0.52 + 0.15 * (x - 0.5), 0.15 * (0.5 - y), 0.001]) - p_WC)
        u, v = 610 * p_C[:2] / p_C[2] + (320, 240)
        x, y = x * tag.width, y * tag.height
        rows += [[u, v, 1, 0, 0, 0, -x * u, -x * v], [0, 0, 0, u, v, 1, -y * u, -y * v]]
        rhs += [x, y]
    view = tag.transform(
        (640, 480), image.Transform.PERSPECTIVE, np.linalg.solve(rows, rhs), image.Resampling.BICUBIC, fillcolor=120
    )
    return np.array(view, np.uint8)


def test_the_ground_tag_tells_where_a_camera_stands(pipeline):
    # 0.7 m behind the tag and 0.6 m above it, looking at it: z ahead, y down.
    p_WC = np.array([1.22, 0.0, 0.6])
    ahead = np.array([0.52, 0, 0]) - p_WC
    z = ahead / np.linalg.norm(ahead)
    x = np.array([0.0, 1.0, 0.0])
    R_CW = np.stack([x, np.cross(z, x), z])
    out = pipeline.process([picture_of_ground_tag(R_CW, p_WC), None], 1, 0)
    (tag,) = out["tags"]["left"]
    assert tag["id"] == 0
    assert tag["corners"].shape == (4, 2)
    assert tag["corners"].mean(axis=0) == pytest.approx([319.5, 239.5], abs=3)
    assert tag["ambiguity"] < 0.5
    pose = pipeline.camera_pose(0)
    assert pose[:3] == pytest.approx(p_WC, abs=0.01)
    # A turn of q is the rotation R_WC; its third column is where the camera looks.
    w, v = pose[3], pose[4:]
    looks = np.array([0, 0, 1.0])
    looks = looks + 2 * w * np.cross(v, looks) + 2 * np.cross(v, np.cross(v, looks))
    assert math.degrees(math.acos(min(1.0, looks @ z))) < 0.5
    assert pipeline.camera_pose(1) is None
