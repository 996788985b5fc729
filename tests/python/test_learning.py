"""Learning on a few real demonstrations: recorded here from the plant in process, so that the test needs no file."""

import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")
torch.set_num_threads(1)  # tests share the machine; two threads that wait for each other are slower than one

from intabs import _core, paths  # noqa: E402
from intabs.data.demos import Demo, load_demos, save_demos  # noqa: E402
from intabs.demonstrate.pick_place import PickPlace  # noqa: E402
from intabs.errors import UserError  # noqa: E402
from intabs.model.space import state_of  # noqa: E402
from intabs.train.objective import kl_between, kl_to_standard_normal  # noqa: E402
from intabs.train.trainer import Trainer, file_hash, load_config, load_model, load_space  # noqa: E402
from intabs.train.windows import WindowSampler, augmented, disturbed, prepare  # noqa: E402

SMALL = [
    "model.pi.layers=2", "model.pi.hidden=16", "model.pi.input_linear=16",
    "model.encoder.layers=2", "model.encoder.hidden=8", "model.encoder.input_linear=8",
    "model.eta.layers=1", "model.eta.hidden=8", "model.eta.input_linear=8",
    "train.batch=8", "train.steps=12", "train.warmup=2", "objective.window=30",
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
    free = 0.5
    assert (want < free).any() and (want > free).any()
    torch.testing.assert_close(kl_to_standard_normal(mean, log_std, free), want.clamp(min=free).sum(-1).mean())


def test_what_z_says_within_its_free_bits_costs_nothing():
    """The price pulls only on numbers of z that say more."""
    mean = torch.zeros(1, 2) + torch.tensor([0.1, 3.0])
    mean.requires_grad_()
    kl_to_standard_normal(mean, torch.zeros(1, 2), 0.5).backward()
    assert mean.grad[0, 0] == 0 and mean.grad[0, 1] == 3


def test_kl_between_gaussians_is_that_of_torch():
    a, b = torch.randn(2, 5, 16), 0.5 * torch.randn(2, 5, 16)
    normal = torch.distributions.Normal
    want = torch.distributions.kl_divergence(normal(a[0], b[0].exp()), normal(a[1], b[1].exp())).sum(-1)
    torch.testing.assert_close(kl_between(a[0], b[0], a[1], b[1]), want)


@pytest.fixture(scope="module")
def demonstrations(data):
    demos, _ = load_demos(data)
    space = load_space(demos)
    space.fit([state_of(d) for d in demos])
    return prepare(demos, space), space


def test_windows_are_consecutive_ticks_of_one_demonstration_and_their_skills_cover_them(demonstrations):
    found, space = demonstrations
    w = WindowSampler(found, space, 40, (8, 24)).sample(32, np.random.default_rng(0))
    places = {}
    for k, d in enumerate(found):
        for i, row in enumerate(d.state.agent):
            places.setdefault(row.numpy().tobytes(), []).append((k, i))
    n = w.within.sum(1).long()
    for b in range(32):
        steps = int(w.mask[b].sum())
        rows = [places[x.numpy().tobytes()] for x in w.state.agent[b, : steps + 1]]
        assert any(all((k, i + j) in row for j, row in enumerate(rows)) for k, i in rows[0])
        assert n[w.skill[b, :steps].unique()].sum() == steps
        assert (w.age[b, :steps] < w.ticks[b, :steps]).all()
    # Each skill's ticks are gathered from where the skill runs.
    skill = w.skill.flatten()
    for m in range(len(n)):
        assert (skill[w.gather[m, : n[m]]] == m).all()
    assert n[w.whole > 0].min() >= 8 and n.max() <= 40


def test_learned_cuts_are_where_skills_begin(demonstrations):
    found, space = demonstrations
    cuts = [np.array([0, 20, 50, len(d.state.agent) - 1]) for d in found]
    w = WindowSampler(found, space, 40, (8, 24), cuts=cuts).sample(64, np.random.default_rng(0))
    starts = {tuple(d.state.agent[c].tolist()) for d, cut in zip(found, cuts, strict=True) for c in cut[:-1]}
    begins = [tuple(w.state.agent[b, t].tolist()) for b in range(64) for t in range(40) if w.age[b, t] == 0]
    assert set(begins) <= starts


def test_a_window_with_a_lead_is_cut_where_the_lead_ends(demonstrations):
    found, space = demonstrations
    sampler = WindowSampler(found, space, 40, (8, 24))
    assert sampler.longest_lead == min(len(d.state.agent) for d in found) - 9
    whole = sampler.sample(32, np.random.default_rng(0), lead=60)
    before, after = whole.split(60)
    assert before.skill.shape == (32, 60) and after.skill.shape == (32, 40) and before.mask.all()
    assert torch.equal(before.state.agent[:, -1], after.state.agent[:, 0])
    # The window is the one without a lead, but for those with too little before them, whose lead is the beginning.
    plain = sampler.sample(32, np.random.default_rng(0))
    begins = {tuple(d.state.agent[0].tolist()) for d in found}
    same = (plain.state.agent[:, 0] == after.state.agent[:, 0]).all(1)
    early = torch.tensor([tuple(x.tolist()) in begins for x in before.state.agent[:, 0]])
    assert (same | early).all() and same.sum() > 16
    for part, state in ((before, whole.state[:, :61]), (after, whole.state[:, 60:])):
        assert torch.equal(part.state.p, state.p)
        skill = part.skill.flatten()
        for m, n in enumerate(part.within.sum(1).long()):
            assert (skill[part.gather[m, :n]] == m).all()
        assert (part.age[:, 0] == 0).all() and part.skill.max() + 1 == len(part.within)
    assert after.within.sum() == after.mask.sum() and torch.equal(after.mask, whole.mask[:, 60:])


def test_a_rollout_that_has_lost_the_thread_begins_where_the_demonstration_is(data, tmp_path):
    trainer = train(data, tmp_path / "run", stop_at=1)
    batch = trainer.sampler.sample(16, np.random.default_rng(0), lead=80)
    before, after = batch.split(80)
    recorded = after.state[:, 0]
    with torch.no_grad():
        ended = trainer.model.rollout(
            before.state[:, 0], trainer._encode(before)[0][before.skill], before.age, before.ticks
        )[0][:, -1]
        led = trainer._led_to(before, recorded)
    apart = ((ended.p - recorded.p).norm(dim=-1) * recorded.known).amax(1)
    kept = (led.agent == ended.agent).all(1)
    assert (led.agent == recorded.agent).all(1)[~kept].all() and (apart[kept] <= 0.03).all()
    assert (led.p[~kept] == recorded.p[~kept]).all() and kept.sum() > 0
    far = recorded.map(lambda x: x)
    far.p = recorded.p + 1.0
    assert (trainer._led_to(before, far).p == far.p).all()


def test_turning_the_scene_about_the_base_changes_no_feature_but_joint_1(demonstrations):
    found, space = demonstrations
    w = WindowSampler(found, space, 30, (8, 24)).sample(8, np.random.default_rng(0))
    turned = augmented(w.state, None, {"turn": 0.3}, space, np.random.default_rng(1))
    a, b = space.raw(w.state)[0], space.raw(turned)[0]
    assert (a[..., 0] - b[..., 0]).abs().min() > 1e-4
    compressed = [7 + 13 * slot + 10 + i for slot in range(4) for i in range(3)]  # steep near 0
    rest = [i for i in range(1, a.shape[-1]) if i not in compressed]
    torch.testing.assert_close(a[..., rest], b[..., rest], atol=2e-5, rtol=0)
    torch.testing.assert_close(a, torch.cat([a[..., :1], b[..., 1:]], -1), atol=2e-3, rtol=0)


def test_strangers_rest_in_slots_that_the_demonstration_does_not_use(demonstrations):
    found, space = demonstrations
    found = [*found]
    other = found[0].state.map(torch.clone)  # another task: its object in slot 3
    for x in (other.p, other.R, other.known, other.valid):
        x[:, 3] = x[:, 0]
    found[0] = type(found[0])(other, found[0].command, found[0].source)
    rng = np.random.default_rng(0)
    plain = WindowSampler(found[1:], space, 30, (8, 24)).sample(16, np.random.default_rng(0))
    assert not plain.state.known[:, :, 3].any()
    w = WindowSampler(found, space, 30, (8, 24), strangers=1.0).sample(32, rng)
    shown = (w.state.known[:, 0, 3] > 0).nonzero()[:, 0]
    assert len(shown) > 16 and not w.state.known[:, :, 2].any()
    moves = (w.state.p[:, 1:, 3] - w.state.p[:, :1, 3]).abs().amax((1, 2))
    assert (moves == 0).sum() >= len(shown) - 16  # all but those of the demonstration itself
    assert (w.state.p[shown, 0, 3] != w.shown.p[shown, 0, 3]).any()  # the encoders see others


def test_encoders_are_shown_another_replay_as_often_as_said(demonstrations):
    found, space = demonstrations
    twins = [type(d)(d.state, d.command, "same") for d in (found[0], found[0])]
    moved = twins[1].state.map(torch.clone)
    moved.p[..., 0] += 0.1
    twins[1] = type(found[0])(moved, twins[1].command, "same")
    for share in (0.0, 1.0):
        w = WindowSampler(twins, space, 30, (8, 24), siblings=share).sample(64, np.random.default_rng(0))
        differ = ((w.state.p - w.shown.p).abs().amax((1, 2, 3)) > 0.05).float().mean()
        assert differ == 0 if share == 0 else 0.3 < differ < 0.7  # one of two is itself


def test_pushed_starts_are_those_in_which_nothing_stirs():
    from intabs.model.space import State
    from intabs.train.objective import FLIPPED, pushed

    n = 4000
    s = State(torch.zeros(n, 30, 7), torch.zeros(n, 30, 4, 3), torch.eye(3).expand(n, 30, 4, 3, 3), torch.zeros(n,
              30, 0), torch.ones(n, 30, 4), torch.ones(n, 30, 4))  # fmt: skip
    s.p[: n // 2, 10:, 1, 2] = 0.02
    push, flip = pushed(s, 0.02, 20, np.random.default_rng(0))
    assert not push[: n // 2].any() and (flip[: n // 2] == 1).all()
    some = push[n // 2 :].abs().amax(1) > 0
    assert 0.45 < some.float().mean() < 0.55 and abs(push[n // 2 :][some].std() - 0.02) < 0.001
    assert abs((flip[n // 2 :] < 0).float().mean() - FLIPPED) < 0.015


def test_disturbances_are_as_large_as_said(demonstrations):
    found, space = demonstrations
    s = WindowSampler(found, space, 30, (8, 24)).sample(64, np.random.default_rng(0)).state
    noise = {"object_mm": 2.0, "object_deg": 3.0, "tick_mm": 0.0, "joint_mrad": 0.5}
    d = disturbed(s, noise, np.random.default_rng(1))
    assert (d.p - s.p).std() == pytest.approx(2e-3, rel=0.1)
    assert torch.allclose((d.p - s.p)[:, 0], (d.p - s.p)[:, -1], atol=1e-6)
    assert (d.agent - s.agent)[..., :6].std() == pytest.approx(5e-4, rel=0.1)
    still = disturbed(s, dict.fromkeys(noise, 0.0), np.random.default_rng(1))
    torch.testing.assert_close(space.raw(still)[0], space.raw(s)[0], atol=1e-6, rtol=0)


def test_recorded_changes_move_the_state_to_the_next_one(demonstrations):
    found, space = demonstrations
    s = found[0].state
    now, after = s[:-1], s[1:]
    _, tip = space.features(now)
    response, change = space.between(now, after)
    got = space.move(now, tip, response * space.response_scale, change, after.agent[:, -1])
    seen = now.known > 0
    torch.testing.assert_close(got.agent, after.agent, atol=1e-5, rtol=0)
    assert (got.p - after.p)[seen].abs().max() < 1e-4 and (got.R - after.R)[seen].abs().max() < 1e-3


def test_z_has_the_sizes_that_are_asked_for(data, tmp_path):
    for latent in ([12, 4], [8, 8]):
        model = train(data, tmp_path / str(latent[0]), steps=1, extra=[f"model.latent={latent}"]).model
        assert [q.spec["heads"]["mean"] for q in model.encoders.values()] == latent
    for wrong in ([8, 9], [16, 0], [16]):
        with pytest.raises(UserError, match="add up to 16"):
            train(data, tmp_path / "wrong", steps=1, extra=[f"model.latent={wrong}"])


def test_what_the_tip_carries_asks_for_no_numbers_of_its_own(demonstrations):
    """The block of pick_place moves as the tip does: z^e says next to nothing that z^r does not."""
    from intabs.evaluate.metrics import Scaling, motion_of
    from intabs.train.linear import measure
    from intabs.train.objective import RolloutError

    found, space = demonstrations
    error = RolloutError(Scaling.fit([motion_of(d.state) for d in found]))
    motion = measure(space, WindowSampler(found, space, 30, (8, 24)), error)
    with_carried = torch.cat([space.between(d.state[:-1], d.state[1:])[1] for d in found])
    assert with_carried.square().sum() > 100
    free = motion.coefficients["environment"].square().mean()
    assert free < 0.05 * with_carried.square().mean()
    assert motion.sizes()[0] >= 14


def test_training_starts_at_the_principal_components(data, tmp_path):
    """The linear paths alone rebuild skills far better than random ones."""
    config = [*SMALL, "train.steps=1"]
    trainer = Trainer(load_config("intabs-small", config), data, tmp_path / "run", 0, "cpu")
    started = trainer.validate()["joints"]
    for net in trainer.model.networks().values():
        for head in net.heads.values():
            torch.nn.init.normal_(head.weight, std=0.01)
            torch.nn.init.zeros_(head.bias)
    assert started < 0.5 * trainer.validate()["joints"]


def test_padding_does_not_change_what_an_encoder_says():
    from intabs.model.networks import Recurrent

    torch.manual_seed(0)
    for pool in ("last", "mean"):
        net = Recurrent(5, 2, 6, {"mean": 3}, residual=True, bidirectional=True, skip=True, pool=pool)
        x = torch.randn(3, 9, 5)
        mask = (torch.arange(9)[None] < torch.tensor([9, 4, 6])[:, None]).float()
        got = net(x, mask)["mean"]
        for row, n in zip(range(3), (9, 4, 6), strict=True):
            torch.testing.assert_close(got[row], net(x[row : row + 1, :n])["mean"][0])


@pytest.mark.parametrize(
    "agent, slots, environment, z_agent",
    [(7, 4, 0, 14), (29, 1, 0, 9), (63, 4, 0, 9), (9, 1, 14, 8), (8, 4, 0, 8), (8, 2, 0, 8)],
)
def test_the_kinds_that_are_compared_have_as_many_parameters(agent, slots, environment, z_agent):
    """The Lite 6, grab_hand, the human set, kitchen, robosuite, RoboTurk's Sawyer."""
    from intabs.model.networks import InteractionAbstractions
    from intabs.model.space import Space

    arm = _core.ArmModel.lite6() if agent == 7 else None
    latent = f"model.latent=[{z_agent}, {16 - z_agent}]"
    models = [
        InteractionAbstractions(load_config(kind, [latent])["model"], Space(agent, slots, environment, arm))
        for kind in ("intabs-small", "tvi", "tvi-agent")
    ]
    ours, *others = [sum(p.numel() for p in m.parameters()) for m in models]
    assert all(abs(n / ours - 1) < 0.05 for n in others)


def test_without_objects_there_is_nothing_to_learn(tmp_path):
    demos = [record(0)]
    demos[0].object_valid[:] = False
    save_demos(tmp_path / "alone.hdf5", demos, {"task": "pick_place"}, valid_share=0)
    with pytest.raises(UserError, match="no demonstration shows an object"):
        train(tmp_path / "alone.hdf5", tmp_path / "run")


def test_settings_are_numbers_however_they_are_written_and_others_are_named():
    assert load_config("intabs-small", ["train.lr=3e-3"])["train"]["lr"] == 3e-3
    assert load_config("intabs-small", ["train.clip=2"])["train"]["clip"] == 2.0
    for wrong in ("train.lr=nan", "train.lr=fast", "train.lr=true", "train.steps=1.5", "train.steps=many"):
        with pytest.raises(UserError, match="wants a value like"):
            load_config("intabs-small", [wrong])
    with pytest.raises(UserError, match="no such setting"):
        load_config("intabs-small", ["train.speed=1"])


def test_the_curves_are_for_tensorboard_too(data, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(data, tmp_path / "run")
    events = EventAccumulator(str(tmp_path / "run")).Reload()
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert {e["of"] for e in logged} == {"train", "valid"}
    for entry in logged:
        for k, v in entry.items():
            if k not in ("step", "of"):
                (point,) = events.Scalars(f"{entry['of']}/{k}")
                assert point.step == entry["step"] and point.value == pytest.approx(v, rel=1e-4)


def test_the_bench_times_three_ways_that_agree():
    from intabs.train.bench import bench

    figures = bench("intabs-small", rounds=1)
    assert list(figures["rows"]) == ["intabs", "loop", "torch.nn.LSTM"] and set(figures["ratios"]) == {
        "loop",
        "torch.nn.LSTM",
    }
    assert all(row["p50_ms"] > 0 and row["n"] == 1 for row in figures["rows"].values())


def test_the_same_seed_gives_the_same_weights_and_another_seed_does_not(data, tmp_path):
    a = train(data, tmp_path / "a").model.state_dict()
    b = train(data, tmp_path / "b").model.state_dict()
    c = train(data, tmp_path / "c", seed=1).model.state_dict()
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert not all(torch.equal(a[k], c[k]) for k in a)


def test_resuming_gives_the_weights_of_an_unbroken_run(data, tmp_path):
    whole = train(data, tmp_path / "whole").model.state_dict()
    train(data, tmp_path / "broken", stop_at=5)
    log = tmp_path / "broken" / "log.jsonl"
    log.write_text('{"step": 4, "of": "train"}\n{"step": 6, "of": "train"}\n{"step": 7, "of"')
    trainer = Trainer(load_config("intabs-small", SMALL), data, tmp_path / "broken", 0, "cpu")
    trainer.resume()
    assert trainer.step == 5
    trainer.train()
    resumed = trainer.model.state_dict()
    assert all(torch.equal(whole[k], resumed[k]) for k in whole)
    # The log is that of the unbroken run too: nothing twice, nothing half.
    lines = log.read_text().splitlines()
    assert lines[0] == '{"step": 4, "of": "train"}'
    assert lines[1:] == (tmp_path / "whole" / "log.jsonl").read_text().splitlines() and len(lines) > 1


def test_a_run_from_before_sizes_could_be_chosen_goes_on(data, tmp_path):
    from intabs.train.trainer import load_checkpoint, sizes_of

    trainer = train(data, tmp_path / "run", stop_at=2, extra=["model.latent=[8, 8]"])
    del trainer.config["model"]["latent"]
    trainer.save()
    checkpoint = load_checkpoint(tmp_path / "run")
    assert "latent" not in checkpoint["config"]["model"] and sizes_of(checkpoint) == [8, 8]
    again = Trainer(load_config("intabs-small", [*SMALL, "model.latent=[8, 8]"]), data, tmp_path / "run", 0, "cpu")
    again.resume()
    again.resume()
    assert again.step == 2 and "then" not in again.code_version  # the same version, said once
    other = Trainer(load_config("intabs-small", [*SMALL, "model.latent=[9, 7]"]), data, tmp_path / "run", 0, "cpu")
    with pytest.raises(UserError, match="another model configuration"):
        other.resume()


def test_a_run_goes_on_only_with_the_cuts_it_began_with(data, tmp_path):
    train(data, tmp_path / "run", stop_at=2)
    other = load_config("intabs-small", [*SMALL, "objective.cuts=viterbi"])
    with pytest.raises(UserError, match="objective.cuts"):
        Trainer(other, data, tmp_path / "run", 0, "cpu").resume()


def test_two_processes_train_as_one_does(data, tmp_path):
    two_train_as_one(data, tmp_path, "motion")


def torchrun(command: list[str], processes: int = 2) -> subprocess.CompletedProcess:
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(processes), "--rdzv-backend", "c10d",
         "--rdzv-endpoint", "127.0.0.1:0", "--local-addr", "127.0.0.1", *command],
        env={**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}, capture_output=True, text=True,
        timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done


def test_processes_that_joined_end_by_themselves(tmp_path):
    """Without leaving the group gloo aborted more than every second such run of two."""
    (tmp_path / "join.py").write_text(
        "import torch\n"
        "from intabs.train.trainer import join_others\n"
        "join_others('cpu')\n"
        "for _ in range(20):\n"
        "    torch.distributed.all_reduce(torch.ones(100_000))\n"
    )
    assert torchrun([str(tmp_path / "join.py")], 4).returncode == 0


def two_train_as_one(data, tmp_path, kind):
    """Odd batches and windows that end early: shares differ in all their counts."""
    settings = [*SMALL, "train.batch=7", "objective.joint_from=0.3", f"objective.cuts={kind}"]
    alone = Trainer(load_config("intabs-small", settings), data, tmp_path / "alone", 0, "cpu")
    result = alone.train()
    command = ["train", "--config", "intabs-small", "--data", str(data), "--out", str(tmp_path / "both")]
    command += [x for s in settings for x in ("--set", s)]
    done = torchrun(["-m", "intabs.cli", *command])
    assert done.stdout.count("held out") == 1  # one of them speaks
    both = json.loads((tmp_path / "both" / "result.json").read_text())
    assert abs(both["loss"] - result["loss"]) < 1e-4 * result["loss"]
    for k, v in result["valid"].items():
        assert abs(both["valid"][k] - v) < 1e-3 * abs(v) + 1e-5, k
    model, _ = load_model(tmp_path / "both")
    want = alone.model.state_dict()
    for k, v in model.state_dict().items():
        torch.testing.assert_close(v, want[k], rtol=1e-3, atol=1e-4)


def test_training_ends_early_with_the_best(data, tmp_path, monkeypatch):
    monkeypatch.setattr("intabs.train.trainer.VALIDATE_EVERY", 1)
    losses = iter([3.0, 2.0, 2.5, 2.6, 1.0])
    config = load_config("intabs-small", [*SMALL, "train.patience=2"])
    trainer = Trainer(config, data, tmp_path / "run", 0, "cpu")
    monkeypatch.setattr(trainer, "validate", lambda: {"loss": next(losses)})
    result = trainer.train()
    assert result["steps"] == 4 and result["best_step"] == 2
    assert load_model(tmp_path / "run")[1]["step"] == 2


def test_training_learns_on_held_out_demonstrations_what_is_held(data, tmp_path):
    trainer = Trainer(
        load_config("intabs-small", [*SMALL, "train.steps=120", "train.lr=4.0e-3"]), data, tmp_path / "run", 0, "cpu"
    )
    before = trainer.validate()["held"]
    trainer.train()
    assert trainer.validate()["held"] < 0.8 * before


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
    with pytest.raises(UserError, match=r"not finite at step \d+, batch of demo"):
        train(data, tmp_path / "run", extra=["train.lr=1.0e+12", "train.clip=1.0e+30"], steps=50)


def test_exported_weights_give_the_same_numbers_in_cpp(data, tmp_path):
    pytest.importorskip("safetensors")
    from intabs.train.export import export, verify

    train(data, tmp_path / "run")
    out = tmp_path / "weights"
    figures = export(tmp_path / "run", out, trials=0)
    assert figures["max_abs_error"] < 1e-5
    assert verify(out) == figures["max_abs_error"]
    training = json.loads((out / "manifest.json").read_text())["training"]
    assert training["data_sha256"] == file_hash(data) and (training["replays"], training["replays_sha256"]) == (0, "")
    assert training["code_version"] == load_model(tmp_path / "run")[1]["code_version"]
    if (paths.ROOT / ".git").exists() and shutil.which("git"):
        commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=paths.ROOT, capture_output=True, text=True).stdout
        assert commit[:12] in training["code_version"]  # nothing where git will not say it
    for name in ("log.jsonl", "result.json"):  # what the training was goes with them
        assert (out / name).read_text() == (tmp_path / "run" / name).read_text() != ""
    errors = [figures["formats"][form]["rms_rad"] for form in ("fp32", "16", "8")]
    assert errors[0] < 1e-6 and errors[0] < errors[1] and errors[0] < errors[2] < 1e-3
    # The golden vectors can tell: other weights do not pass.
    golden = json.loads((out / "golden.json").read_text())
    golden["pi"]["heads"]["agent"][0][0] += 1e-3
    (out / "golden.json").write_text(json.dumps(golden))
    assert verify(out) > 5e-4


def test_weights_of_16_bits_take_half_the_space_and_baselines_beside_weights_are_evaluated_with_them(data, tmp_path):
    pytest.importorskip("safetensors")
    from intabs.evaluate.evaluate import find_sources
    from intabs.train.export import export, load_weights

    train(data, tmp_path / "run")
    sizes = {}
    for bits, name in ((32, "weights"), (16, "weights-tvi")):
        assert export(tmp_path / "run", tmp_path / name, trials=0, bits=bits)["max_abs_error"] < 1e-5
        sizes[bits] = (tmp_path / name / "weights.safetensors").stat().st_size
    assert sizes[16] < 0.6 * sizes[32]
    exact, rounded = (load_weights(tmp_path / n)[0].pi.state_dict() for n in ("weights", "weights-tvi"))
    largest = max(float((exact[k] - rounded[k]).abs().max()) for k in exact)
    assert 0 < largest < 2e-3
    assert find_sources([tmp_path / "weights"]) == [tmp_path / "weights", tmp_path / "weights-tvi"]
    assert find_sources([tmp_path / "run"]) == [tmp_path / "run"]
    with pytest.raises(UserError, match="write 16 or 32"):
        export(tmp_path / "run", tmp_path / "other", trials=0, bits=8)


def test_what_fails_while_exporting_leaves_the_weights_that_were_there(data, tmp_path, monkeypatch):
    pytest.importorskip("safetensors")
    import shutil

    from intabs.train import export as module

    demos = shutil.copy(data, tmp_path / "demos.hdf5")
    train(demos, tmp_path / "run", stop_at=2)
    out = tmp_path / "weights"
    module.export(tmp_path / "run", out, trials=0)
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    train(demos, tmp_path / "run", stop_at=3)
    monkeypatch.setattr(module, "verify", lambda out: 1.0)
    with pytest.raises(UserError, match="differs from torch"):
        module.export(tmp_path / "run", out, trials=0)
    assert before == {p.name: p.read_bytes() for p in out.iterdir()} and {p.name for p in tmp_path.iterdir()} == {
        "demos.hdf5", "run", "weights"
    }  # fmt: skip
    with open(demos, "ab") as f:
        f.write(b" ")
    with pytest.raises(UserError, match="not the demonstrations"):
        module.export(tmp_path / "run", out, trials=0)


def test_layer_norm_runs_in_cpp_as_in_torch(data, tmp_path):
    pytest.importorskip("safetensors")
    from intabs.train.export import export

    norms = [f"model.{net}.layer_norm=true" for net in ("pi", "encoder", "eta")]
    trainer = train(data, tmp_path / "run", stop_at=3, extra=norms)
    assert sum(isinstance(m, torch.nn.LayerNorm) for m in trainer.model.modules()) == 3
    assert export(tmp_path / "run", tmp_path / "weights", trials=0)["max_abs_error"] < 1e-5


@pytest.mark.parametrize(("objects", "numbers"), [("world", 10), ("both", 23)])
def test_objects_may_be_seen_in_the_world_but_not_exported_so(data, tmp_path, objects, numbers):
    from intabs.train.export import export

    trainer = train(data, tmp_path / "run", stop_at=2, extra=[f"model.objects={objects}"])
    space = trainer.model.space
    assert space.state_dim == 7 + 4 * numbers
    s = trainer.recorded[0].state
    raw = space.raw(s)[0][:, 7:].unflatten(-1, (4, numbers))
    assert torch.equal(raw[..., -10:-7], s.p * s.known[..., None])
    assert torch.equal(load_model(tmp_path / "run")[0].space.mean, space.mean)
    with pytest.raises(UserError, match="model.objects=gripper"):
        export(tmp_path / "run", tmp_path / "weights", trials=0)


@pytest.mark.parametrize(("objects", "at"), [("gripper", [3]), ("both", [3, 14])])
def test_orientations_may_be_quaternions_but_not_exported_so(data, tmp_path, objects, at):
    from scipy.spatial.transform import Rotation

    from intabs.train.export import export

    extra = [f"model.objects={objects}", "model.rotation=quaternion"]
    trainer = train(data, tmp_path / "run", stop_at=2, extra=extra)
    space = trainer.model.space
    s = trainer.recorded[0].state
    raw, (_, R_WG) = space.raw(s)
    raw = raw[:, 7:].unflatten(-1, (4, -1))
    for k, R in zip(at, (R_WG.transpose(-1, -2)[:, None] @ s.R, s.R), strict=False):
        want = torch.from_numpy(np.roll(Rotation.from_matrix(R.reshape(-1, 3, 3).numpy()).as_quat(), 1, -1)).float()
        got = raw[..., k : k + 4].reshape(-1, 4)
        same = (want * got).sum(-1).abs()
        used = (s.known > 0).reshape(-1)
        assert used.any() and (same[used] > 1 - 1e-4).all() and (got[~used] == 0).all()
    assert load_model(tmp_path / "run")[0].space.layout.endswith(" quaternion")
    with pytest.raises(UserError, match="model.rotation=columns"):
        export(tmp_path / "run", tmp_path / "weights", trials=0)


def test_exported_weights_come_back_as_the_same_model(data, tmp_path):
    pytest.importorskip("safetensors")
    from intabs.train.export import export, load_weights

    train(data, tmp_path / "run")
    export(tmp_path / "run", tmp_path / "weights", trials=0)
    want, _ = load_model(tmp_path / "run")
    got, _ = load_weights(tmp_path / "weights")
    for (name, a), b in zip(want.state_dict().items(), got.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, msg=name)


def test_a_map_shows_every_skill_as_picture_and_as_page(data, tmp_path):
    pytest.importorskip("sklearn")
    pytest.importorskip("matplotlib")
    from PIL import Image

    from intabs.evaluate.latent import latent

    trainer = train(data, tmp_path / "run", steps=2)
    figures = latent(tmp_path / "run", data, tmp_path / "map.png")
    assert Image.open(tmp_path / "map.png").size[0] > 500
    skills = sum(len(trainer.cuts.of(state_of(d)[0], None)) - 1 for d in load_demos(data)[0])
    assert figures == {"skills": skills, "kinds": 1, "demos": 4}
    latent(tmp_path / "run", data, tmp_path / "map.html")
    page = (tmp_path / "map.html").read_text()
    points = json.loads(page.split("const D=")[1].split(",S='http")[0])["points"]
    assert len(points) == skills and all(len(p["f"]) == 5 and len(p["f"][0][0]) == 8 for p in points)
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")  # nothing from elsewhere
    with pytest.raises(UserError, match="must end in"):
        latent(tmp_path / "run", data, tmp_path / "map.jpg")


def test_evaluate_compares_kinds_of_runs_and_names_what_is_missing(data, tmp_path):
    from intabs.commands.evaluate import unequal
    from intabs.evaluate.evaluate import evaluate

    runs = []
    for k, kind in enumerate(("split", "split", "joint", "agent")):
        run = tmp_path / f"{kind}-{k}"
        train(data, run, steps=2, seed=k, extra=[f"model.encoders={kind}"])
        runs.append(run)
    figures = evaluate(runs, data, None, "whole")
    assert list(figures["methods"])[:3] == ["intabs", "tvi", "tvi-agent"] and figures["seeds"] == 2
    usage, latent = figures["usage"], load_model(runs[0])[1]["config"]["model"]["latent"]
    assert usage["of"] == latent and sum(latent) == 16 and min(latent) > 0 and usage["skills"] > 0
    assert all(n <= most for n, most in zip(usage["active"], latent, strict=True))
    assert figures["methods"]["intabs"]["sd"] > 0 == figures["methods"]["tvi"]["sd"]
    assert {k: len(v) for k, v in figures["training"].items()} == {"intabs": 2, "tvi": 1, "tvi-agent": 1}
    trained = [t for runs in figures["training"].values() for t in runs]
    assert {t["steps"] for t in trained} == {2} and {t["data_sha256"] for t in trained} == {figures["data_sha256"]}
    assert unequal(trained) and not unequal(trained[:2])  # encoders as wide, not as large
    trained[1]["steps"] = 3
    assert unequal(trained[:2])
    ratio, low, high = figures["ratios"]["still"]["all"]
    assert (low, high) == (None, None)  # one demonstration is held out
    assert figures["methods"]["intabs"]["all"] / figures["methods"]["still"]["all"] == pytest.approx(ratio)
    with pytest.raises(UserError, match="no run of that kind"):
        evaluate(runs[:1], data, ["tvi"], "segment")
    with pytest.raises(UserError, match="known are"):
        evaluate(runs[:1], data, ["magic"], "segment")


def test_the_table_trains_what_is_missing_and_compares_all_kinds(data, tmp_path):
    command = [sys.executable, "-m", "intabs.evaluate.table", "--data", f"few={data}", "--seeds", "1"]
    command += ["--runs", str(tmp_path), "--json", str(tmp_path / "t.json")]
    command += [
        x for s in ("train.steps=2", "train.batch=4", "train.warmup=1", "objective.window=30") for x in ("--set", s)
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500)
    assert done.returncode == 0, done.stderr
    for method in ("intabs", "tvi", "tvi-agent", "pca", "still", "mean", "hdmp-faithful"):
        assert f"| {method} |" in done.stdout
    assert "4 demonstrations, 1 held out, 1 seed" in done.stdout and "A handful of demonstrations" in done.stdout
    figures = json.loads((tmp_path / "t.json").read_text())["few"]
    assert set(figures["segment"]["ratios"]) >= {"tvi", "tvi-agent", "pca"}
    # A second time nothing is trained.
    times = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("checkpoint.pt")}
    assert (
        len(times) == 3 and subprocess.run(command, capture_output=True, env=environment, timeout=500).returncode == 0
    )
    assert times == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("checkpoint.pt")}
    wrong = subprocess.run([*command[:3], "--data", "x=nowhere.hdf5"], capture_output=True, text=True, env=environment)
    assert wrong.returncode == 1 and wrong.stderr.strip().count("\n") == 0 and "NAME=FILE" in wrong.stderr
