"""The kinematics that training differentiates are those of the robot."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="skipped: torch is not installed (tools/setup brings it)")

from scipy.spatial.transform import Rotation  # noqa: E402

from intabs import _core  # noqa: E402
from intabs.model import kinematics  # noqa: E402

T = 200


@pytest.fixture
def readings():
    rng = np.random.default_rng(0)
    arm = _core.ArmModel.lite6()
    q = rng.uniform(-2, 2, (T, 6))
    pose = np.concatenate(
        [
            rng.uniform(-0.5, 0.5, (T, 4, 3)),
            np.roll(Rotation.random(4 * T, random_state=1).as_quat(), 1, 1).reshape(T, 4, 4),
        ],
        -1,
    )
    known = rng.random((T, 4)) < 0.8
    valid = known & (rng.random((T, 4)) < 0.8)
    return arm, q, rng.random(T) < 0.5, pose, known, valid


def tensor(x):
    return torch.tensor(np.asarray(x, "f4"))


def test_features_in_torch_are_those_of_the_runtime(readings):
    arm, q, closed, pose, known, valid = readings
    want = _core.assemble_states(arm, q, closed, pose, known, valid)
    got, _ = kinematics.state_features(
        kinematics.Arm(arm), tensor(q), tensor(closed) * 2 - 1, tensor(pose[..., :3]),
        tensor(kinematics.rotation(pose[..., 3:])), tensor(known), tensor(valid),
    )  # fmt: skip
    assert got.shape == want.shape
    np.testing.assert_allclose(got.numpy(), want, atol=3e-4)  # the compressed position is steep near 0
    np.testing.assert_allclose(np.delete(got.numpy(), _compressed(), 1), np.delete(want, _compressed(), 1), atol=5e-6)


def _compressed():
    return [7 + 13 * slot + 10 + i for slot in range(4) for i in range(3)]


def test_moving_objects_undoes_the_motion_the_runtime_measures(readings):
    arm, q, _, pose, _, _ = readings
    pose[1:] = pose[:-1]  # the next pose: a small motion of the last
    pose[1::2, :, :3] += 0.01
    known = np.ones((T, 4), bool)
    motion = _core.object_motions(arm, q, pose, known).reshape(T - 1, 4, 6)
    p, R = tensor(pose[:-1, :, :3]), tensor(kinematics.rotation(pose[:-1, :, 3:]))
    _, R_WG = kinematics.Arm(arm).tip(tensor(q[:-1]))
    p_next, R_next = kinematics.move_objects(p, R, R_WG, tensor(motion))
    np.testing.assert_allclose(p_next.numpy(), pose[1:, :, :3], atol=1e-5)
    np.testing.assert_allclose(R_next.numpy(), kinematics.rotation(pose[1:, :, 3:]), atol=1e-4)


def test_the_angle_between_rotations_is_exact_and_has_a_gradient_at_zero():
    w = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.2, -0.3], [0.0, 3.0, 0.0]], requires_grad=True)
    angle = kinematics.angle_between(kinematics.exp_so3(w), torch.eye(3).expand(3, 3, 3))
    np.testing.assert_allclose(angle.detach().numpy(), np.linalg.norm(w.detach().numpy(), axis=1), atol=1e-3)
    angle.sum().backward()
    assert torch.isfinite(w.grad).all()
