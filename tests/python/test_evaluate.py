"""Reconstruction error and the methods it is measured on."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="skipped: torch is not installed (tools/setup brings it)")
torch.set_num_threads(1)

from scipy.spatial.transform import Rotation  # noqa: E402

from intabs.evaluate.baselines import Mean, Pca, Still  # noqa: E402
from intabs.evaluate.metrics import Motion, Scaling, errors, fixed_cuts  # noqa: E402


def motion(seed: int, ticks: int = 40) -> Motion:
    """Smooth: agent 3, one object that moves and turns, one that was never seen."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, ticks)[:, None]
    agent = rng.normal(size=(1, 3)) + np.sin(3 * t * rng.normal(size=(1, 3)))
    p = np.zeros((ticks, 2, 3))
    p[:, 0] = rng.normal(size=(1, 3)) + t * rng.normal(size=(1, 3))
    R = np.tile(np.eye(3), (ticks, 2, 1, 1))
    R[:, 0] = Rotation.from_rotvec(t * rng.normal(size=(1, 3))).as_matrix()
    valid = np.zeros((ticks, 2), bool)
    valid[:, 0] = True
    return Motion(agent, p, R, np.zeros((ticks, 0)), valid)


@pytest.fixture
def train():
    return [motion(seed) for seed in range(8)]


def test_a_perfect_rollout_has_no_error_and_units_do_not_matter(train):
    scaling = Scaling.fit(train)
    m, other = motion(20), motion(21)
    assert errors(m, m, scaling) == {k: 0.0 for k in errors(m, m, scaling)}
    want = errors(other, m, scaling)

    def millimetres(x: Motion) -> Motion:
        return Motion(x.agent * 57, x.p * 1000, x.R, x.environment, x.valid)

    got = errors(millimetres(other), millimetres(m), Scaling.fit([millimetres(x) for x in train]))
    assert got == pytest.approx(want)


def test_an_error_of_known_size_is_measured_as_that():
    ticks = 11
    flat = motion(0, ticks)
    ramp = Motion(
        np.linspace(0, 2, ticks)[:, None] * [1, 0, 0], flat.p * 0, flat.R * 0 + np.eye(3), flat.environment, flat.valid
    )
    scaling = Scaling.fit([ramp])
    off = Motion(ramp.agent + [0.5, 7, 0], ramp.p, ramp.R.copy(), ramp.environment, ramp.valid)
    off.R[:, 0] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    e = errors(off, ramp, scaling)
    assert e["joints"] == pytest.approx(0.25)  # of a range of 2; constant dimensions are dropped
    assert e["position"] == 0
    assert e["orientation"] == pytest.approx(0.5)
    assert e["all"] == pytest.approx(np.hypot(0.25, 0.5))


def test_poses_that_nobody_vouched_for_do_not_count(train):
    m = motion(30)
    m.valid[10:] = False
    wrong = Motion(m.agent, m.p.copy(), m.R.copy(), m.environment, m.valid)
    wrong.p[10:] += 1
    wrong.R[10:] = Rotation.from_rotvec([1, 0, 0]).as_matrix()
    assert errors(wrong, m, Scaling.fit(train))["all"] == 0


def test_still_stays_and_the_mean_of_equal_motions_is_that_motion(train):
    m = motion(3)
    still = Still().reconstruct(m, [0, 39])
    assert (still.agent == m.agent[0]).all() and (still.p == m.p[0]).all()
    same = [m] * 3
    scaling = Scaling.fit(same)
    assert errors(Mean(same, scaling, 40).reconstruct(m, [0, 20, 39]), m, scaling)["all"] < 0.01


def test_pca_with_all_components_rebuilds_its_training_and_with_few_does_not(train):
    scaling = Scaling.fit(train)
    m = train[2]
    cuts = fixed_cuts(len(m), 14)
    assert cuts == [0, 13, 26, 39]
    exact = errors(Pca(train, scaling, 14, agent=36, environment=144).reconstruct(m, cuts), m, scaling)
    coarse = errors(Pca(train, scaling, 14, agent=1, environment=1).reconstruct(m, cuts), m, scaling)
    assert exact["all"] < 5e-3 < 5e-2 < coarse["all"]


def test_a_policy_that_does_nothing_is_still(train):
    from intabs import _core
    from intabs.data.demos import Demo
    from intabs.data.features import Normalizer
    from intabs.evaluate.evaluate import sample
    from intabs.evaluate.learned import Learned
    from intabs.model.networks import InteractionAbstractions

    ticks, rng = 30, np.random.default_rng(0)
    pose = np.zeros((ticks, 4, 7))
    pose[..., 3] = 1
    pose[:, 0, :3] = rng.normal(size=3)
    valid = np.zeros((ticks, 4), bool)
    valid[:, 0] = True
    q = np.cumsum(rng.normal(size=(ticks, 6)) * 0.02, 0)
    demo = Demo(
        np.arange(ticks) * 0.04, q, q * 0, np.zeros(ticks), pose, valid, np.zeros((ticks, 7)), {"embodiment": "lite6"}
    )
    arm = _core.ArmModel.lite6()
    s = sample(demo, arm)
    size = {"layers": 1, "hidden": 8, "input_linear": 8}
    model = InteractionAbstractions({"pi": size, "encoder": size})
    for head in model.pi.heads.values():
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.zeros_(head.bias)
    learned = Learned("intabs", model, Normalizer.fit([s.trajectory]), arm)
    scaling = Scaling.fit([s.motion])
    got = learned.reconstruct(s.motion, [0, 12, 29], s.trajectory)
    assert len(got) == ticks
    want = errors(Still().reconstruct(s.motion, [0, 29]), s.motion, scaling)
    assert errors(got, s.motion, scaling) == pytest.approx(want, abs=1e-5)
    torch.nn.init.constant_(model.pi.heads["agent"].bias, 1.0)
    assert errors(learned.reconstruct(s.motion, [0, 12, 29], s.trajectory), s.motion, scaling)[
        "joints"
    ] != pytest.approx(want["joints"], abs=1e-3)
