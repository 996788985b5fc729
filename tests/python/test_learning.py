"""Learning on a few real demonstrations: recorded here from the plant in process, so that the test needs no file."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")
torch.set_num_threads(1)  # tests share the machine; two threads that wait for each other are slower than one

from intabs import _core, paths  # noqa: E402
from intabs.data.demos import Demo, load_demos, save_demos  # noqa: E402
from intabs.data.features import Normalizer, trajectory  # noqa: E402
from intabs.demonstrate.pick_place import PickPlace  # noqa: E402
from intabs.errors import UserError  # noqa: E402
from intabs.train.objective import kl_to_standard_normal  # noqa: E402
from intabs.train.segments import SegmentSampler, _turned  # noqa: E402
from intabs.train.trainer import Trainer, load_config, load_model  # noqa: E402

SMALL = [
    "model.pi.layers=2", "model.pi.hidden=16", "model.pi.input_linear=16",
    "model.encoder.layers=2", "model.encoder.hidden=8", "model.encoder.input_linear=8",
    "train.batch=16", "train.steps=12", "train.warmup=2",
]  # fmt: skip


def record(seed: int) -> Demo:
    arm = _core.ArmModel.lite6()
    session = _core.Session(str(paths.MODELS), "pick_place", "")
    session.reset(seed, 2.0)
    demonstrator = PickPlace(arm, _core.IkSolver(arm), np.random.default_rng(seed))
    rows = []
    while True:
        o = session.observe()
        intent = demonstrator.step(o["q"], o["object_pose"], o["object_valid"])
        rows.append(
            (
                o["utime"] * 1e-6,
                o["q"],
                o["dq"],
                o["gripper_closed"],
                o["object_pose"],
                o["object_valid"],
                intent.action,
            )
        )
        assert session.command(intent.q_target, intent.gripper_closed) == 0
        if intent.done:
            break
    for _ in range(15):
        session.command(intent.q_target, intent.gripper_closed)
    assert session.success, session.failure_reason
    return Demo(*(np.array(x) for x in zip(*rows, strict=True)), {"task": "pick_place", "seed": seed})


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "demos.hdf5"
    save_demos(path, [record(seed) for seed in range(4)], {"task": "pick_place"}, valid_share=0.25)
    return path


def train(data, run, steps=12, stop_at=None, seed=0, extra=()):
    trainer = Trainer(load_config("intabs-small", [*SMALL, *extra, f"train.steps={steps}"]), data, run, seed, "cpu")
    if stop_at is not None:
        while trainer.step < stop_at:
            trainer.one_step()
        trainer.save()
        return trainer
    trainer.train()
    return trainer


def test_a_file_of_demonstrations_comes_back_as_it_was_written(data):
    demos, attrs = load_demos(data)
    assert len(demos) == 4 and attrs["task"] == "pick_place"
    again = record(0)
    np.testing.assert_allclose(demos[0].joint_pos, again.joint_pos, atol=1e-6)
    np.testing.assert_allclose(demos[0].object_pose, again.object_pose, atol=1e-6)
    np.testing.assert_allclose(demos[0].actions, again.actions, atol=1e-6)
    train_demos, _ = load_demos(data, "train")
    valid_demos, _ = load_demos(data, "valid")
    assert len(train_demos) == 3 and len(valid_demos) == 1


def test_a_missing_cut_or_foreign_file_is_one_clear_line(data, tmp_path):
    with pytest.raises(UserError, match="no such file"):
        load_demos(tmp_path / "none.hdf5")
    cut = tmp_path / "cut.hdf5"
    cut.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    with pytest.raises(UserError, match="cut"):
        load_demos(cut)
    text = tmp_path / "text.hdf5"
    text.write_text("hello")
    with pytest.raises(UserError, match="not an HDF5 file"):
        load_demos(text)


def test_interrupted_writing_leaves_no_file_that_looks_whole(tmp_path):
    out = tmp_path / "demos.hdf5"
    code = f"""
import numpy as np, sys
from intabs.data import demos
from intabs.data.demos import Demo, save_demos
def forever(*a):
    print("writing", flush=True)
    import time; time.sleep(60)
demos._write_demo = forever
save_demos({str(out)!r}, [Demo(*[np.zeros(1)] * 7)], {{}})
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout.readline().strip() == b"writing"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not out.exists()


def test_integrated_actions_are_where_the_robot_went(data):
    demos, _ = load_demos(data)
    for demo in demos:
        target = demo.joint_pos[0] + np.cumsum(demo.actions[:, :6], axis=0)
        # Disturbances are not part of what was meant: the sum drifts from the motion by no more than they are.
        assert np.abs(target[-1] - demo.joint_pos[-1]).max() < 0.3


def test_kl_is_that_of_torch():
    mean, log_std = torch.randn(5, 16), 0.5 * torch.randn(5, 16)
    want = torch.distributions.kl_divergence(
        torch.distributions.Normal(mean, log_std.exp()), torch.distributions.Normal(0.0, 1.0)
    )
    torch.testing.assert_close(kl_to_standard_normal(mean, log_std), want.sum(-1).mean())


def test_small_turns_of_quaternions_agree_with_scipy():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    q = Rotation.random(20, random_state=1).as_quat()
    w = 0.01 * rng.normal(size=(20, 3))
    want = (Rotation.from_rotvec(w) * Rotation.from_quat(q)).as_quat()
    got = _turned(np.roll(q, 1, axis=-1), w)
    error = np.abs(np.abs((np.roll(got, -1, axis=-1) * want).sum(-1)) - 1)
    assert error.max() < 1e-6


def test_segments_come_from_one_demonstration_and_noise_touches_only_what_pi_sees(data):
    arm = _core.ArmModel.lite6()
    demos, _ = load_demos(data)
    raw = [trajectory(d, arm) for d in demos]
    normalizer = Normalizer.fit(raw)
    normal = [normalizer.normalize(t) for t in raw]
    noise = {"object_mm": 1.0, "object_deg": 1.0, "tick_mm": 0.3, "joint_mrad": 0.5}
    sampler = SegmentSampler(normal, normalizer, arm, (12, 16), noise, "cpu")
    batch = sampler.sample(64, np.random.default_rng(0))
    rows = {row.tobytes(): (k, i) for k, t in enumerate(normal) for i, row in enumerate(t.state)}
    for segment in batch.state.numpy():
        places = [rows[row.tobytes()] for row in segment]
        assert len({k for k, _ in places}) == 1
        assert [i for _, i in places] == list(range(places[0][1], places[0][1] + len(places)))
    assert not torch.equal(batch.seen, batch.state)
    quiet = SegmentSampler(normal, normalizer, arm, (12, 16), dict.fromkeys(noise, 0.0), "cpu")
    batch = quiet.sample(64, np.random.default_rng(0))
    torch.testing.assert_close(batch.seen, batch.state, atol=1e-4, rtol=0)


def test_the_same_seed_gives_the_same_weights_and_another_seed_does_not(data, tmp_path):
    a = train(data, tmp_path / "a").model.state_dict()
    b = train(data, tmp_path / "b").model.state_dict()
    c = train(data, tmp_path / "c", seed=1).model.state_dict()
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert not all(torch.equal(a[k], c[k]) for k in a)


def test_resuming_gives_the_weights_of_an_unbroken_run(data, tmp_path):
    whole = train(data, tmp_path / "whole").model.state_dict()
    train(data, tmp_path / "broken", stop_at=5)
    trainer = Trainer(load_config("intabs-small", SMALL), data, tmp_path / "broken", 0, "cpu")
    trainer.resume()
    assert trainer.step == 5
    trainer.train()
    resumed = trainer.model.state_dict()
    assert all(torch.equal(whole[k], resumed[k]) for k in whole)


def test_training_lowers_the_held_out_error(data, tmp_path):
    trainer = Trainer(load_config("intabs-small", [*SMALL, "train.steps=150"]), data, tmp_path / "run", 0, "cpu")
    before = trainer.validate()["agent"]
    trainer.train()
    assert trainer.validate()["agent"] < 0.7 * before


def test_the_default_config_trains_a_step(data, tmp_path):
    trainer = Trainer(load_config("intabs", ["train.batch=4", "train.steps=1"]), data, tmp_path / "run", 0, "cpu")
    figures = trainer.train()
    assert figures["steps"] == 1 and np.isfinite(figures["loss"])


@pytest.mark.parametrize(
    ("config", "overrides", "says"),
    [("nonesuch", [], "known: intabs"), ("intabs", ["train.stepz=3"], "no such setting"), ("intabs", ["x"], "no such")],
)
def test_a_bad_config_is_one_clear_line(config, overrides, says):
    with pytest.raises(UserError, match=says):
        load_config(config, overrides)


def test_a_loss_that_is_not_finite_stops_the_training(data, tmp_path):
    with pytest.raises(UserError, match="not finite at step"):
        train(data, tmp_path / "run", extra=["train.lr=1.0e+12", "train.clip=1.0e+30"], steps=50)


def test_exported_weights_give_the_same_numbers_in_cpp(data, tmp_path):
    pytest.importorskip("safetensors")
    from intabs.train.export import export, verify

    train(data, tmp_path / "run")
    out = tmp_path / "weights"
    figures = export(tmp_path / "run", out, trials=0)
    assert figures["max_abs_error"] < 1e-5
    assert verify(out) == figures["max_abs_error"]
    errors = [figures["formats"][form]["rms_rad"] for form in ("fp32", "16", "8")]
    assert errors[0] < 1e-6 and errors[0] < errors[1] and errors[0] < errors[2] < 1e-3
    plan = json.loads((out / "plans" / "pick_place.json").read_text())
    assert plan["task"] == "pick_place" and all(len(s["z"]) == 16 for s in plan["skills"])
    # The golden vectors can tell: other weights do not pass.
    golden = json.loads((out / "golden.json").read_text())
    golden["pi"]["heads"]["agent"][0][0] += 1e-3
    (out / "golden.json").write_text(json.dumps(golden))
    assert verify(out) > 5e-4


def test_the_normaliser_that_trained_is_the_one_that_runs(data, tmp_path):
    train(data, tmp_path / "run")
    _, normalizer, checkpoint = load_model(tmp_path / "run")
    assert checkpoint["normalizer"] == normalizer.to_dict()
