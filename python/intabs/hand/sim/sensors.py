"""What a colour camera with a 2-D estimator, an aligned depth camera and tags say of a Performance.

Key points: noise, times without a hand, a stain that is taken for a hand, hands out of nowhere. Depth: noise that grows
with the square of the distance, holes, pixels that fly between fore- and background. Tags: noise, hidden by the hand.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from intabs.hand.sim import skeleton
from intabs.hand.sim.scripts import FURNITURE, SHAPES, Performance, Pose

WIDTH, HEIGHT = 640, 480
K = np.array([610.0, 610.0, 319.5, 239.5])
# The plant's left camera (models/scenes/common.xml): x, y of MuJoCo's camera; ours looks along z, y down.
_X = np.array([-0.565842497, 0.824513353, 0.0])
_Y = np.array([-0.518326131, -0.355714011, 0.777692461])
CAMERA = Pose(np.array([0.85, 0.35, 0.55]), Rotation.from_matrix(np.stack([_X, -_Y, -np.cross(_X, _Y)], axis=1)))

PIXEL_NOISE = 2.0  # px, fresh in every frame
PIXEL_DRIFT = 2.0  # px, slow
DEPTH_NOISE = 0.0036  # m at 1 m: 0.9 mm at half a metre
TAG_NOISE, TAG_TURN = 0.001, 0.009  # m, rad
MARGIN = 14  # px about the key points where depth is made


def project(p_W: np.ndarray) -> np.ndarray:
    p = CAMERA.inverse().R.apply(np.reshape(p_W, (-1, 3)) - CAMERA.p)
    return (p[:, :2] / p[:, 2:] * K[:2] + K[2:]).reshape(*np.shape(p_W)[:-1], 2)


def bursts(rng: np.random.Generator, n: int, start: float, mean: float) -> np.ndarray:
    """(n,) bool: begins with probability `start` a frame, lasts `mean` frames."""
    out, on = np.zeros(n, bool), False
    for k in range(n):
        on = rng.random() < (1 - 1 / mean) if on else rng.random() < start
        out[k] = on
    return out


def key_points(run: Performance, rng: np.random.Generator) -> np.ndarray:
    """(T, 21, 2) px, NaN where the estimator finds no hand."""
    n = len(run)
    uv = project(run.joints())
    drift = np.zeros((n, 21, 2))
    state = rng.normal(0, PIXEL_DRIFT, (21, 2))
    for k in range(n):
        state = 0.9 * state + np.sqrt(1 - 0.9**2) * rng.normal(0, PIXEL_DRIFT, (21, 2))
        drift[k] = state
    uv = uv + drift + rng.normal(0, PIXEL_NOISE, uv.shape)
    uv[bursts(rng, n, 0.010, 4) | bursts(rng, n, 0.0012, 16)] = np.nan
    # False detections have the shape of a hand: this one's, elsewhere.
    shape = project(run.joints()[:1])[0]
    shape = shape - shape.mean(axis=0)
    stain = np.array([rng.uniform(60, 580), rng.uniform(60, 420)])
    sticks = bursts(rng, n, 0.008, 3)
    uv[sticks] = stain + 0.9 * shape + rng.normal(0, 0.6, (int(sticks.sum()), 21, 2))
    nowhere = rng.random(n) < 0.004
    uv[nowhere] = rng.uniform((80, 80), (560, 400), (int(nowhere.sum()), 2))[:, None] + shape
    return uv


def depth_pictures(run: Performance, uv: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray | None]:
    """(H, W) uint16 mm, made only about the key points (elsewhere 0); None: the camera gave nothing."""
    joints = run.joints()
    furniture = [(run.start[n], FURNITURE[n]) for n in run.start if n in FURNITURE]
    for k in range(len(run)):
        if np.isnan(uv[k]).any() or rng.random() < 0.005:
            yield None
            continue
        low = np.clip(uv[k].min(axis=0) - MARGIN, 0, (WIDTH - 1, HEIGHT - 1)).astype(int)
        high = np.clip(uv[k].max(axis=0) + MARGIN, 0, (WIDTH - 1, HEIGHT - 1)).astype(int) + 1
        boxes = [(X, *shape) for X, shape in furniture]
        for name, X in run.objects[k].items():
            boxes += [(X, *shape) for shape in SHAPES[name]]
        z = _scene(low, high, skeleton.flesh(joints[k], run.scale), boxes)
        picture = np.zeros((HEIGHT, WIDTH), np.uint16)
        picture[low[1] : high[1], low[0] : high[0]] = _sensed(z, rng)
        yield picture


def _rays(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(h, w, 3) in C, depth 1."""
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
    return np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones(u.shape)], axis=-1)


def _scene(low: np.ndarray, high: np.ndarray, flesh: tuple[np.ndarray, np.ndarray], boxes: list) -> np.ndarray:
    """True depth (h, w) [m]: table, boxes, spheres."""
    rays = _rays(low, high)
    up = CAMERA.R.inv().apply([0, 0, 1])
    fall = rays @ up
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(fall < 0, -CAMERA.p[2] / fall, 5.0)
    z = np.minimum(z, 5.0)
    to_C = CAMERA.inverse()
    for X_WO, half, centre in boxes:
        X = to_C * X_WO
        corners = X.p + X.R.apply(np.array(np.meshgrid(*([-1, 1],) * 3)).reshape(3, -1).T * half + centre)
        place = _window(corners[:, :2] / corners[:, 2:] * K[:2] + K[2:], 1, low, high)
        if place is None:
            continue
        R = X.R.as_matrix()
        d = rays[place] @ R
        o = -R.T @ X.p - centre
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-np.array(half) - o) / d, (np.array(half) - o) / d
        enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
        hit = (enter < leave) & (enter > 0)
        z[place] = np.where(hit, np.minimum(z[place], enter), z[place])
    centres, radii = flesh
    for c, r in zip(to_C.p + to_C.R.apply(centres), radii, strict=True):
        place = _window((c[:2] / c[2] * K[:2] + K[2:])[None], r / c[2] * K[0] + 1, low, high)
        if place is None:
            continue
        d = rays[place]
        dd, dc = (d * d).sum(axis=-1), d @ c
        root = dc * dc - dd * (c @ c - r * r)
        hit = root > 0
        near = np.where(hit, (dc - np.sqrt(np.maximum(root, 0))) / dd, np.inf)
        z[place] = np.minimum(z[place], near)
    return z


def _window(uv: np.ndarray, margin: float, low: np.ndarray, high: np.ndarray):
    """The part of the picture from low to high that holds uv, as an index; None: none of it."""
    first = np.maximum(np.floor(uv.min(axis=0) - margin).astype(int), low) - low
    last = np.minimum(np.ceil(uv.max(axis=0) + margin).astype(int) + 1, high) - low
    return (slice(first[1], last[1]), slice(first[0], last[0])) if (last > first).all() else None


def _sensed(z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """True depth -> uint16 mm."""
    h, w = z.shape
    padded = np.pad(z, 2, mode="edge")
    around = np.stack(
        [padded[2 + dy : 2 + dy + h, 2 + dx : 2 + dx + w] for dy, dx in ((2, 0), (-2, 0), (0, 2), (0, -2))]
    )
    near, far = around.min(axis=0), around.max(axis=0)
    edge = far - near > 0.03
    seen = z + rng.normal(0, 1, z.shape) * DEPTH_NOISE * z * z
    flies = edge & (rng.random(z.shape) < 0.3)
    seen[flies] = (near + rng.random(z.shape) * (far - near))[flies]
    seen[edge & (rng.random(z.shape) < 0.25)] = 0
    for _ in range(rng.poisson(0.4)):
        size = rng.integers(8, 28, 2)
        y, x = rng.integers(0, h), rng.integers(0, w)
        seen[y : y + size[0], x : x + size[1]] = 0
    return np.clip(np.rint(1000 * seen), 0, 65535).astype(np.uint16)


def tag_poses(run: Performance, name: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pose (T, 7) and whether it was seen (T,): tags get lost more often near the hand."""
    true = [o[name] for o in run.objects]
    seen = np.stack(
        [
            Pose(X.p + rng.normal(0, TAG_NOISE, 3), X.R * Rotation.from_rotvec(rng.normal(0, TAG_TURN, 3))).array()
            for X in true
        ]
    )
    grip = np.array(
        [X.p + X.R.apply(skeleton.grip_point(c, run.scale)) for X, c in zip(run.wrist, run.closure, strict=True)]
    )
    near = np.linalg.norm(grip - np.stack([X.p for X in true]), axis=1) < 0.10
    lost = np.where(near, bursts(rng, len(run), 0.05, 5), bursts(rng, len(run), 0.006, 3))
    lost |= near & bursts(rng, len(run), 0.003, 16)
    return seen, ~lost
