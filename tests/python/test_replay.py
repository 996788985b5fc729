"""Replays of recordings in the plant."""

import numpy as np
import pytest
from test_learning import record

pytest.importorskip("torch")

from intabs import _core  # noqa: E402
from intabs.data.demos import load_demos, save_demos  # noqa: E402
from intabs.data.reader import DemoFile  # noqa: E402
from intabs.replay.replay import Replayer, displacement, make, outline, pad_slots  # noqa: E402


@pytest.fixture(scope="module")
def demo():
    return pad_slots(record(0))


def test_an_outline_says_what_is_moved_and_where_to(demo):
    about = outline(demo, _core.ArmModel.lite6())
    assert (about.mover, about.other) == (0, 1)  # the block, to the goal
    assert about.to_mover[0] < 0.01 and about.to_mover[-1] == 1
    assert about.to_other[0] == 0 and about.to_other[-1] == pytest.approx(1)
    assert (np.diff(about.to_mover) >= -1e-9).all() and (np.diff(about.to_other) >= -1e-9).all()
    still = pad_slots(record(0))
    still.object_pose[:] = still.object_pose[:1]
    assert outline(still, _core.ArmModel.lite6()) is None


def test_with_the_objects_where_they_were_the_commands_are_those_recorded(demo):
    replayer = Replayer("pick_place")
    about = outline(demo, replayer.arm)
    path = replayer.commands(demo, about, demo.object_pose[0])
    assert np.abs(path - about.q_target).max() < 1e-3


def test_a_grasp_goes_along_with_its_object(demo):
    replayer = Replayer("pick_place")
    about = outline(demo, replayer.arm)
    new = demo.object_pose[0].copy()
    new[0, :3] += [0.03, -0.02, 0.0]
    path = replayer.commands(demo, about, new)
    grasp = int(np.argmax(about.gripper))
    old_tip, new_tip = (np.asarray(replayer.arm.tip(q)) for q in (about.q_target[grasp], path[grasp]))
    np.testing.assert_allclose(new_tip[:3] - old_tip[:3], [0.03, -0.02, 0.0], atol=2e-3)
    np.testing.assert_allclose(path[-1], replayer.commands(demo, about, demo.object_pose[0])[-1], atol=2e-3)


def test_a_turn_in_the_plane_is_measured():
    old = np.array([0.1, 0.2, 0, 1, 0, 0, 0])
    new = np.array([0.15, 0.1, 0, np.cos(0.2), 0, 0, np.sin(0.2)])
    step, yaw = displacement(old, new)
    assert yaw == pytest.approx(0.4) and step == pytest.approx([0.05, -0.1, 0])


def test_replays_succeed_with_the_objects_elsewhere_and_keep_their_recordings_ticks(demo, tmp_path):
    data, out = tmp_path / "recorded.hdf5", tmp_path / "replays.hdf5"
    save_demos(data, [record(s) for s in (0, 1)], {"embodiment": "lite6", "rate_hz": 25.0}, valid_share=0.0)
    figures = make(data, out, 6, 5.0, 0.006, 0, 1, lambda *_: None)
    assert figures["demos"] == 6 and figures["tries"] <= 9
    recorded = dict(zip(DemoFile(data).names, load_demos(data)[0], strict=True))
    replays, _ = load_demos(out)
    for d in replays:
        source = recorded[d.attrs["source"]]
        assert len(d) == len(source)
        moved = np.linalg.norm(d.object_pose[0, :2, :2] - source.object_pose[0, :2, :2], axis=-1)
        assert moved.max() > 2e-3
        # Actions say how to go on from where the arm was told to be.
        target = d.joint_pos[0] + np.cumsum(d.actions[:, :6], axis=0)
        assert np.abs(target[-1] - d.joint_pos[-1]).max() < 0.15


def test_training_takes_replays_and_leaves_out_those_of_held_out_demonstrations(demo, tmp_path):
    from test_learning import SMALL

    from intabs.errors import UserError
    from intabs.train.trainer import Trainer, load_config

    data, out = tmp_path / "recorded.hdf5", tmp_path / "replays.hdf5"
    save_demos(data, [record(s) for s in (0, 1)], {"embodiment": "lite6", "rate_hz": 25.0}, valid_share=0.5)
    train, valid = (DemoFile(data, m).names for m in ("train", "valid"))
    rows = []
    for source in (*train, *valid):
        d = record(2)
        length = len(load_demos(data, "train")[0][0])
        d = type(d)(*(getattr(d, f)[:length] for f in ("time", "joint_pos", "joint_vel", "gripper", "object_pose",
                                                       "object_valid", "actions")), d.attrs)  # fmt: skip
        d.attrs["source"] = source
        rows.append(d)
    save_demos(out, rows, {"embodiment": "lite6", "rate_hz": 25.0}, valid_share=0.0)
    trainer = Trainer(load_config("intabs-small", SMALL), data, tmp_path / "run", 0, "cpu", out)
    assert [d.source for d in trainer.sampler.demonstrations] == [*train, *train]
    trainer.one_step()
    save_demos(out, rows[1:], {"embodiment": "lite6", "rate_hz": 25.0}, valid_share=0.0)
    with pytest.raises(UserError, match="no replays"):
        Trainer(load_config("intabs-small", SMALL), data, tmp_path / "run", 0, "cpu", out)
