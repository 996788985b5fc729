"""Replays of recordings in the plant."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_learning import record

pytest.importorskip("torch")

from intabs import _core, paths  # noqa: E402
from intabs.data.demos import load_demos, save_demos  # noqa: E402
from intabs.data.reader import DemoFile  # noqa: E402
from intabs.errors import UserError  # noqa: E402
from intabs.model.space import state_of  # noqa: E402
from intabs.replay import replay as module  # noqa: E402
from intabs.replay.replay import (  # noqa: E402
    ANOTHER_SIDE,
    MAX_STEP,
    SLOW,
    Replayer,
    Try,
    displacement,
    make,
    outline,
    pad_slots,
    started_at,
)


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


def recorded(task: str) -> list:
    """Shipped recordings, (name, demonstration)."""
    with DemoFile(paths.MODELS / "demos/lite6.hdf5", "train") as f:
        own = [k for k in range(len(f)) if f.own_attrs(k)["task"] == task]
        return [(f.names[k], pad_slots(f.demo(k))) for k in own]


@pytest.fixture(scope="module")
def poured():
    return recorded("pour")


def test_what_is_lowered_into_a_bowl_goes_with_the_bowl_before():
    """Else it comes down on the rim where the bowl lies elsewhere."""
    arm = _core.ArmModel.lite6()
    for name, stirred in recorded("stir"):
        about = outline(stirred, arm)
        spoon, bowl = stirred.object_pose[:, about.mover], stirred.object_pose[:, about.other]
        # The spoon hangs .086 m down from its grip; the bowl's rim is .052 m above the table.
        lowered = (spoon[:, 2] - 0.086 < bowl[:, 2] + 0.052) & (np.linalg.norm((spoon - bowl)[:, :2], axis=1) < 0.04)
        assert lowered.any() and about.to_other[np.argmax(lowered)] > 0.97, name


def test_what_the_command_filter_would_stop_is_done_steeper_or_not_tried(poured, monkeypatch):
    """A cup so near the base that the hand cannot be level behind it."""
    replayer = Replayer("pour")
    name, demo = poured[5]
    about = outline(demo, replayer.arm)
    replay = replayer.replay(demo, about, 390005, 6.8, 0.0)
    assert name == "demo_36" and not isinstance(replay, str), replay
    assert replay.attrs["pitch"] > 0
    monkeypatch.setattr(module, "PITCHES", (0.0,))
    assert "too near" in replayer.replay(demo, about, 390005, 6.8, 0.0)
    session = replayer.session
    session.reset(390005, 6.8)
    path = replayer.commands(demo, about, session.observe()["object_pose"])
    grasp = int(np.argmax(about.gripper))
    for t, q in enumerate(path[: grasp + 1]):
        assert session.command(q, bool(about.gripper[t])) == 0
    tip = np.asarray(replayer.arm.tip(session.observe()["q"]))[:3]
    assert np.linalg.norm(tip - np.asarray(replayer.arm.tip(path[grasp]))[:3]) > 0.03  # it is right not to


def test_a_bowl_may_be_come_to_from_another_side(poured):
    demo = poured[0][1]
    replayer = Replayer("pour")
    about = outline(demo, replayer.arm)
    assert (about.mover, about.other) == (0, 1)  # the cup, to the bowl
    paths_ = [replayer.commands(demo, about, demo.object_pose[0], side) for side in (0.0, ANOTHER_SIDE)]
    tip = [np.array([replayer.arm.tip(q) for q in path]) for path in paths_]
    away = [x[:, :2] - demo.object_pose[0, 1, :2] for x in tip]
    pouring = int(np.argmin(np.linalg.norm(demo.object_pose[:, 0, :3] - demo.object_pose[0, 1, :3], axis=1)))
    angle = [np.arctan2(*a[pouring, ::-1]) for a in away]
    assert np.remainder(angle[1] - angle[0], 2 * np.pi) == pytest.approx(ANOTHER_SIDE, abs=1e-3)
    np.testing.assert_allclose(*(np.linalg.norm(a[pouring]) for a in away), atol=1e-3)
    np.testing.assert_allclose(tip[0][:, 2], tip[1][:, 2], atol=1e-3)
    grasp = int(np.argmax(about.gripper))
    np.testing.assert_allclose(tip[0][: grasp + 1], tip[1][: grasp + 1], atol=1e-3)  # and taken as it was
    np.testing.assert_allclose(tip[0][-1, :3], tip[1][-1, :3], atol=0.02)  # and set down where it was


def test_where_the_arm_cannot_come_as_recorded_the_hand_takes_it_steeper_or_flatter():
    """As far as it must, on the same place of the handle, the fingers closing along the same line."""
    replayer = Replayer("stir")
    name, demo = recorded("stir")[0]
    about = outline(demo, replayer.arm)
    replayer.session.reset(390010, 10.0)
    new = replayer.session.observe()["object_pose"]
    assert name == "demo_40" and replayer.commands(demo, about, new) is None
    path, pitch = replayer.way(demo, about, new, 0.0)
    assert pitch == -0.2
    grasp = int(np.argmax(about.gripper))
    before, after = (np.asarray(replayer.arm.tip(q)) for q in (about.q_target[grasp], path[grasp]))
    R = [Rotation.from_quat(np.roll(x[3:], -1)) for x in (before, after)]
    step, yaw = displacement(demo.object_pose[0, about.mover], new[about.mover])
    Rz = Rotation.from_rotvec([0, 0, yaw])
    was = demo.object_pose[0, about.mover, :3]
    np.testing.assert_allclose(after[:3], was + step + Rz.apply(before[:3] - was), atol=2e-3)
    np.testing.assert_allclose(R[1].as_matrix()[:, 1], (Rz * R[0]).as_matrix()[:, 1], atol=1e-3)
    assert ((Rz * R[0]).inv() * R[1]).as_rotvec() == pytest.approx([0, pitch, 0], abs=2e-3)
    assert R[1].as_matrix()[2, 2] > R[0].as_matrix()[2, 2]  # flatter: it points down less
    replay = replayer.replay(demo, about, 390010, 10.0, 0.0)
    assert not isinstance(replay, str), replay
    assert replay.attrs["pitch"] == pitch


def test_replays_from_another_side_succeed_and_a_library_takes_the_one_most_like_its_recording(poured, tmp_path):
    from intabs.train.export import variants
    from intabs.train.trainer import file_hash, load_space
    from intabs.train.windows import WindowSampler, prepare

    data, out = tmp_path / "recorded.hdf5", tmp_path / "replays.hdf5"
    save_demos(data, [poured[1][1]], {"embodiment": "lite6", "rate_hz": 25.0}, valid_share=0.0)
    (name,) = DemoFile(data).names
    replays = []
    for seed, side in ((7, 0.0), (8, ANOTHER_SIDE)):
        _, replay = module.attempt(Try(name, poured[1][1], seed, 0.5, 0.0, None, False, side))
        assert replay.attrs["side"] == side
        replay.attrs |= {"task": "pour", "source": name}
        replays.append(replay)
    save_demos(out, replays, {"embodiment": "lite6", "rate_hz": 25.0}, valid_share=0.0)
    recorded = {name: load_demos(data)[0][0]}
    made = {"replays_path": str(out), "replays_sha256": file_hash(out)}
    found = variants(made, recorded)
    assert [x[:2] for x in found] == [(f"{name} {np.degrees(ANOTHER_SIDE):+.0f} deg", name)]
    assert len(found[0][2]) == len(recorded[name])
    assert variants({}, recorded) == []
    with pytest.raises(UserError, match="not the replays of the training"):
        variants(made | {"replays_sha256": ""}, recorded)
    # What the encoders are shown of another replay is the same motion.
    space = load_space(replays, "gripper")
    space.fit([state_of(d) for d in replays])
    three = prepare([*replays, replays[0]], space, [name] * 3)
    assert [x.tolist() for x in WindowSampler(three, space, 20, (8, 20)).same] == [[0, 2], [1], [0, 2]]


def test_a_start_too_far_for_the_recordings_pace_makes_the_way_there_longer(demo):
    replayer = Replayer("pick_place")
    about = outline(demo, replayer.arm)
    slow = module.slowed(about, SLOW)
    n = about.approach
    assert len(slow.gripper) == len(about.gripper) + SLOW and slow.approach == n
    at = module.in_replay(np.arange(len(demo)), {"slow": SLOW, "approach": n})
    assert at[0] == 0 and (np.diff(at) >= 1).all() and at[-1] == len(demo) - 1 + SLOW
    np.testing.assert_array_equal(module.in_replay(np.arange(9), {}), np.arange(9))
    np.testing.assert_allclose(slow.q_target[at], about.q_target, atol=0.03)
    np.testing.assert_array_equal(slow.gripper[at[n:]], about.gripper[n:])
    # Where a pour ends: joint 4 by half a turn away.
    far = about.q_target[0] + [0.3, 0.3, -0.3, -3.0, 0.5, 0.0]
    assert started_at(far, about.q_target, about, (1.0,)) is None
    path = started_at(far, slow.q_target, slow, (1.0,))
    assert np.abs(np.diff(path, axis=0)).max() <= MAX_STEP
    np.testing.assert_allclose(path[0], far)
    np.testing.assert_allclose(path[at[n + 5] :], slow.q_target[at[n + 5] :])


def test_a_replay_may_begin_where_a_grasp_was_missed(demo):
    replayer = Replayer("pick_place")
    about = outline(demo, replayer.arm)
    replay = replayer.replay(demo, about, 5, 6.0, 0.0, np.full(6, 0.02), at_grasp=True)
    assert not isinstance(replay, str), replay
    path = replayer.commands(demo, about, replay.object_pose[0])
    grasp = int(np.argmax(about.gripper))
    assert np.abs(replay.joint_pos[0] - path[grasp] - 0.02).max() < 0.01 and not replay.gripper[0]
    in_tip = np.linalg.norm(np.asarray(replayer.arm.tip(replay.joint_pos[0]))[:3] - replay.object_pose[0, 0, :3])
    assert in_tip < 0.06
    np.testing.assert_allclose(replay.joint_pos[grasp], path[grasp], atol=0.05)  # and comes there as recorded


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
    with pytest.raises(UserError, match="--of nosuch"):
        make(data, out, 6, 5.0, 0.006, 0, 1, lambda *_: None, of={"nosuch": 1})
    with pytest.raises(UserError, match="--number 2: --of says 3"):
        make(data, out, 2, 5.0, 0.006, 0, 1, lambda *_: None, of={"pick_place": 3})
    recorded = dict(zip(DemoFile(data).names, load_demos(data)[0], strict=True))
    replays, _ = load_demos(out)
    for d in replays:
        source = recorded[d.attrs["source"]]
        assert len(d) == len(source) + d.attrs["slow"] and d.attrs["slow"] in (0, SLOW)
        moved = np.linalg.norm(d.object_pose[0, :2, :2] - source.object_pose[0, :2, :2], axis=-1)
        assert moved.max() > 2e-3
        # Actions say how to go on from where the arm was told to be.
        target = d.joint_pos[0] + np.cumsum(d.actions[:, :6], axis=0)
        assert np.abs(target[-1] - d.joint_pos[-1]).max() < 0.15


def test_training_takes_replays_and_leaves_out_those_of_held_out_demonstrations(demo, tmp_path):
    from test_learning import SMALL

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
