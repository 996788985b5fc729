"""Reconstruction error and the methods it is measured on."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="skipped: torch is not installed (tools/setup brings it)")
torch.set_num_threads(1)

from scipy.spatial.transform import Rotation  # noqa: E402

from intabs.evaluate.baselines import Mean, Pca, Still  # noqa: E402
from intabs.evaluate.metrics import Motion, Sample, Scaling, errors, fixed_cuts, sample  # noqa: E402


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


def of(m: Motion) -> Sample:
    return Sample(m, None, None)


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


def test_an_object_that_keeps_its_place_in_the_gripper_has_no_error_seen_from_there():
    from intabs import _core
    from intabs.evaluate.metrics import seen_from_tip
    from intabs.model.kinematics import Arm

    arm, rng = Arm(_core.ArmModel.lite6()), np.random.default_rng(0)

    def carried(q: np.ndarray) -> Motion:
        p, R = (x.numpy().astype("f8") for x in arm.tip(torch.from_numpy(q.astype("f4"))))
        agent = np.concatenate([q, np.ones((len(q), 1))], 1)
        return Motion(agent, p[:, None] + R[:, None] @ [0.0, 0.01, 0.02], R[:, None], np.zeros((len(q), 0)),
                      np.ones((len(q), 1), bool))  # fmt: skip

    q = np.array([0.0, 0.3, 1.0, 0.0, 0.7, 0.0]) + 0.2 * rng.normal(size=(20, 6)).cumsum(0) / 10
    one, other = carried(q), carried(q + 0.1)
    scaling = Scaling.fit([one])
    assert errors(other, one, scaling)["position"] > 0.1
    a, b = seen_from_tip(one, arm), seen_from_tip(other, arm)
    assert np.allclose(a.p, [0.0, 0.01, 0.02], atol=1e-6) and np.allclose(a.R, np.eye(3), atol=1e-6)
    assert np.allclose(a.p, b.p, atol=1e-6)


def test_poses_that_nobody_vouched_for_do_not_count(train):
    m = motion(30)
    m.valid[10:] = False
    wrong = Motion(m.agent, m.p.copy(), m.R.copy(), m.environment, m.valid)
    wrong.p[10:] += 1
    wrong.R[10:] = Rotation.from_rotvec([1, 0, 0]).as_matrix()
    assert errors(wrong, m, Scaling.fit(train))["all"] == 0


def test_still_stays_and_the_mean_of_equal_motions_is_that_motion(train):
    m = motion(3)
    still = Still().reconstruct(of(m), [0, 39])
    assert (still.agent == m.agent[0]).all() and (still.p == m.p[0]).all()
    same = [m] * 3
    scaling = Scaling.fit(same)
    assert errors(Mean(same, scaling, 40).reconstruct(of(m), [0, 20, 39]), m, scaling)["all"] < 0.01


def test_pca_with_all_components_rebuilds_its_training_and_with_few_does_not(train):
    scaling = Scaling.fit(train)
    m = train[2]
    cuts = fixed_cuts(len(m), 14)
    assert cuts == [0, 13, 26, 39]
    exact = errors(Pca(train, scaling, 14, (36, 144)).reconstruct(of(m), cuts), m, scaling)
    coarse = errors(Pca(train, scaling, 14, (1, 1)).reconstruct(of(m), cuts), m, scaling)
    assert exact["all"] < 5e-3 < 5e-2 < coarse["all"]


def test_components_are_shared_out_by_what_moves():
    from intabs.evaluate.baselines import share_out

    rng = np.random.default_rng(0)

    def course(ways: int, width: int, size: float) -> np.ndarray:
        """(200, 5, width) of so many independent ways to move, each as large."""
        basis = np.linalg.qr(rng.normal(size=(5 * width, ways)))[0]
        return (size * rng.normal(size=(200, ways)) @ basis.T).reshape(200, 5, width)

    quiet = course(3, 6, 1e-3)
    assert share_out(course(6, 4, 1.0), course(2, 6, 1.0) + quiet, 3, size=8) == (6, 2)
    assert share_out(course(2, 4, 1.0), course(6, 6, 1.0) + quiet, 3, size=8) == (2, 6)
    assert share_out(course(2, 4, 1.0), np.zeros((200, 5, 0)), 0, size=8) == (8, 0)


def lite6_demo(ticks=30, seed=0):
    """Joints at random, one object at rest."""
    from intabs.data.demos import Demo

    rng = np.random.default_rng(seed)
    pose = np.zeros((ticks, 4, 7))
    pose[..., 3] = 1
    pose[:, 0, :3] = rng.normal(size=3)
    valid = np.zeros((ticks, 4), bool)
    valid[:, 0] = True
    q = np.cumsum(rng.normal(size=(ticks, 6)) * 0.02, 0)
    return Demo(
        np.arange(ticks) * 0.04, q, q * 0, np.zeros(ticks), pose, valid, np.zeros((ticks, 7)), {"embodiment": "lite6"}
    )


def lite6_model(demo, kind="split"):
    from intabs.model.networks import InteractionAbstractions
    from intabs.model.space import state_of
    from intabs.train.trainer import load_space

    space = load_space([demo])
    space.fit([state_of(demo)])
    size = {"layers": 1, "hidden": 8, "input_linear": 8, "skip": True}
    config = {"encoders": kind, "pi": size, "encoder": {**size, "pool": "mean"}, "eta": {**size, "skip": False}}
    return InteractionAbstractions(config, space)


def test_a_policy_that_does_nothing_is_still():
    from intabs.evaluate.learned import Learned

    demo = lite6_demo()
    s = sample(demo)
    model = lite6_model(demo)
    for head in model.pi.heads.values():
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.zeros_(head.bias)
    torch.nn.init.constant_(model.pi.heads["agent"].bias, -1.0)  # the gripper stays open; commands move nothing here
    torch.nn.init.constant_(model.pi.heads["carried"].bias, -9.0)
    learned = Learned("intabs", model)
    scaling = Scaling.fit([s.motion])
    got = learned.reconstruct(s, [0, 12, 29])
    assert len(got) == len(demo)
    want = errors(Still().reconstruct(s, [0, 29]), s.motion, scaling)
    assert errors(got, s.motion, scaling) == pytest.approx(want, abs=1e-5)
    torch.nn.init.constant_(model.pi.heads["response"].bias, 1.0)
    assert errors(learned.reconstruct(s, [0, 12, 29]), s.motion, scaling)["joints"] != pytest.approx(
        want["joints"], abs=1e-3
    )
    # What is held moves with the arm, and only then.
    at_rest = learned.reconstruct(s, [0, 29])
    torch.nn.init.constant_(model.pi.heads["carried"].bias, 9.0)
    held = learned.reconstruct(s, [0, 29])
    assert np.abs(at_rest.p[-1, 0] - s.motion.p[0, 0]).max() < 1e-5
    assert np.abs(held.p[-1, 0] - s.motion.p[0, 0]).max() > 0.01


def test_a_held_object_keeps_its_place_in_the_tips_frame():
    from intabs.model.space import state_of

    demo = lite6_demo()
    space = lite6_model(demo).space
    state, _ = state_of(demo)
    now, tip = space.features(state[:1])
    del now
    response = torch.full((1, 6), 0.02)
    carried = space.carried(state[:1], tip, state.agent[:1, :6] + response)
    after = space.move(state[:1], tip, response, carried, state.agent[:1, 6])
    (p0, R0), (p1, R1) = tip, space.arm.tip(after.agent[:, :6])
    before = R0.transpose(-1, -2) @ (state.p[0, 0] - p0[0])
    np.testing.assert_allclose((R1.transpose(-1, -2) @ (after.p[0, 0] - p1[0])).numpy(), before.numpy(), atol=2e-4)


def test_slots_without_an_object_do_not_change_z():
    from intabs.evaluate.learned import Learned

    demo = lite6_demo()
    learned = Learned("intabs", lite6_model(demo))
    pieces = [(0, 12), (12, 29)]
    want = learned.encode(learned.inputs(sample(demo)), pieces)
    demo.object_pose[:, 2:, :3] = 5.0  # nonsense where nothing is valid
    torch.testing.assert_close(learned.encode(learned.inputs(sample(demo)), pieces), want)
    demo.object_pose[:, 0, :3] += 0.5
    assert not torch.allclose(learned.encode(learned.inputs(sample(demo)), pieces), want)


def test_nor_do_they_for_a_hand():
    from intabs.model.networks import InteractionAbstractions, encoder_inputs
    from intabs.model.space import Space, State
    from intabs.train.trainer import load_config

    torch.manual_seed(0)
    model = InteractionAbstractions(load_config("intabs-small", [])["model"], Space(63, 4, 0)).eval()
    known = torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(20, 4)
    s = State(
        torch.randn(20, 63), torch.randn(20, 4, 3), torch.eye(3).repeat(20, 4, 1, 1), torch.zeros(20, 0), known, known
    )

    def z() -> torch.Tensor:
        inputs = encoder_inputs(model.space, model.space.features(s[:-1])[0], None, *model.space.between(s[:-1], s[1:]))
        return model.encode(*(x[None] for x in inputs))[0]

    want = z()
    s.p[:, 2:] += torch.randn(20, 2, 3)  # nonsense where nobody saw an object
    torch.testing.assert_close(z(), want)
    s.p[:, 1] += torch.randn(20, 3)
    assert not torch.allclose(z(), want)


@pytest.mark.parametrize("make", ["FaithfulHdmp", "Hdmp"])
def test_movement_primitives_come_close_to_the_motion_they_are_fitted_to(train, make):
    from intabs.evaluate import hdmp

    if make == "Hdmp" and not hdmp.Hdmp.installed():
        pytest.skip("movement-primitives is not installed")
    scaling = Scaling.fit(train)
    m = motion(5, 80)
    for piece, cuts in ((of(m), [0, 40, 79]), (of(m[20:35]), [0, 14])):  # 14 ticks: about as many as kernels
        got = errors(getattr(hdmp, make)().reconstruct(piece, cuts), piece.motion, scaling)
        assert got["all"] < 0.3 * errors(Still().reconstruct(piece, cuts), piece.motion, scaling)["all"]


def test_mcnemar_counts_the_trials_that_only_one_did():
    from intabs.evaluate.bc_rnn import mcnemar

    ours, theirs = [True] * 9 + [False] * 3, [True] * 3 + [False] * 8 + [True]
    assert mcnemar(ours, theirs)[:2] == (6, 1)
    assert abs(mcnemar(ours, theirs)[2] - 2 * (1 + 7) / 2**7) < 1e-12  # both tails of 7 throws of a coin
    assert mcnemar(ours, ours) == (0, 0, 1.0)


def test_neighbours_vote_and_the_nearer_decides_a_tie():
    from intabs.evaluate.knn import confusion, label_pieces, neighbours

    base = np.array([[0.0], [0.1], [1.0], [1.1], [1.2]])
    labels = np.array([0, 0, 1, 1, 1])
    assert neighbours(base, labels, np.array([[0.02], [1.05]]), k=3).tolist() == [0, 1]
    assert neighbours(base, labels, np.array([[0.4]]), k=4).tolist() == [0]
    assert label_pieces(np.array([3] * 5 + [1] * 2 + [2] * 6)) == [(0, 5, 3), (7, 12, 2)]
    assert confusion(np.array([0, 1, 1]), np.array([0, 1, 0]), 2).tolist() == [[1, 0], [1, 1]]


def test_pieces_of_compositions_are_right_where_one_of_their_tasks_is_voted_for():
    from types import SimpleNamespace

    from intabs.evaluate.knn import score_compositions

    def demo(task: str, value: list[float]):
        """Two pieces of ten ticks each, which the code tells by their value."""
        return SimpleNamespace(attrs={"task": task}, extra={"labels": np.repeat([0, 1], 10)}, value=value)

    class ByValue:
        def of(self, demos, pieces):
            z = np.array([[v, 0.1 * k] for d in demos for v in d.value for k in (1,)]) + 0.0
            z[:, 1] += np.arange(len(z)) * 1e-3
            return {name: [z] for name in ("z", "untrained", "pca")}

    train = [demo(t, [v, v]) for t, v in (("a", 0.0), ("b", 5.0), ("c", 9.0)) for _ in range(5)]
    got = score_compositions(ByValue(), train, [demo("a+b", [0.1, 5.1]), demo("b+c", [0.1, 9.0]), demo("a", [0, 0])])
    assert got["accuracy"] == 0.75 and got["n"] == 4 and abs(got["chance"] - 2 / 3) < 1e-9
    assert score_compositions(ByValue(), train, [demo("a", [0, 0])]) is None


def test_the_confusion_picture_names_what_was_seen(tmp_path):
    from matplotlib import pyplot

    from intabs.evaluate.knn import picture

    shown = {}
    close, pyplot.close = pyplot.close, lambda f: shown.update(rows=[t.get_text() for t in f.axes[0].get_yticklabels()])
    try:
        table = [[3, 0, 1], [0, 0, 0], [0, 0, 2]]
        picture({"confusion": table, "accuracy": 5 / 6, "n": 6}, ["reach", "grasp"], tmp_path / "c.png")
    finally:
        pyplot.close = close
    assert shown["rows"] == ["reach (4)", "2 (2)"] and (tmp_path / "c.png").stat().st_size > 5000


class Labelled:
    """A demonstration of which only the labels matter."""

    def __init__(self, labels, task="a"):
        self.extra, self.attrs = {"labels": np.array(labels)}, {"task": task}

    def __len__(self):
        return len(self.extra["labels"])


def test_found_boundaries_stand_beside_the_best_fixed_cut_and_the_mean_times_of_the_task():
    from types import SimpleNamespace

    from intabs.evaluate.boundaries import mean_times, score_boundaries

    train = [Labelled([0] * 20 + [1] * 20), Labelled([0] * 40 + [1] * 20 + [2] * 20), Labelled([0] * 30 + [1], "b")]
    train += [Labelled([0] * 10 + [1] * 30), Labelled([0] * 100, "none")]
    # One boundary is the task's median; those of its three demonstrations lie at 1/2, (1/2 + 3/4) / 2 and 1/4.
    assert mean_times(train, Labelled([0] * 80)) == pytest.approx([80 * (1 / 2 + 5 / 8 + 1 / 4) / 3])
    assert len(mean_times(train, Labelled([0] * 80, "none"))) == 0

    held_out = [Labelled([0] * 21 + [1] * 19)]
    found = SimpleNamespace(cuts=lambda train, demos: [np.array([0, 22, 33, 40])])
    got = score_boundaries(found, train[:1] * 3, held_out)
    assert (got["precision"], got["recall"], got["f1"]) == (1 / 2, 1, pytest.approx(2 / 3))
    assert got["fixed_cut_f1"] == 1 and got["mean_time_f1"] == 1  # every training demonstration changes at 20 of 40
    got = score_boundaries(found, [Labelled([0] * 10 + [1] * 30)] * 3, held_out)
    assert got["mean_time_f1"] == 0 and got["fixed_cut_f1"] < 1


def test_neighbours_are_of_the_training_split_and_scored_for_every_code():
    from intabs.evaluate.knn import score_neighbours

    class Known:
        """z says the label, PCA nothing, the untrained encoder the opposite of two."""

        def of(self, demos, pieces):
            labels = np.array([x for p in pieces for _, _, x in p])
            some = np.random.default_rng(len(labels)).normal(size=(len(labels), 1)) * 0.1
            return {
                "z": [np.stack([labels, labels], 1) + some],
                "untrained": [some + (labels if len(demos) > 1 else 1 - labels)[:, None]],
                "pca": [some * 0 + np.arange(len(labels))[:, None]],
            }

    train, held_out = [Labelled([0] * 5 + [1] * 6 + [0] * 9 + [1] * 4 + [0] * 7)] * 6, [Labelled([1] * 6 + [0] * 8)]
    got = score_neighbours(Known(), train, held_out, rounds=3)
    assert got["accuracy"] == 1 and got["untrained"] == 0 and got["thesis_protocol"] == 1
    assert got["majority"] == 0.5 and got["classes"] == 2 and got["n"] == 2 and got["confusion"] == [[1, 0], [0, 1]]


def test_a_boundary_counts_once_and_within_three_frames():
    from intabs.evaluate.boundaries import precision_recall_f1

    assert precision_recall_f1([np.array([10, 12, 40])], [np.array([13, 60])]) == (1 / 3, 1 / 2, pytest.approx(0.4))


def test_boundaries_are_found_where_a_motion_starts_and_stops():
    """A tip that rests, moves, rests; Viterbi against the sum over all segmentations by brute force."""
    import itertools

    from intabs.train.boundaries import BoundaryConfig, SemiMarkov

    rng = np.random.default_rng(0)
    x = np.concatenate([np.zeros(10), np.ones(8), np.zeros(12)])[:, None] + 0.05 * rng.normal(size=(30, 1))
    config = BoundaryConfig(penalty=0.3, shortest=4, longest=20, still=0.1)
    assert SemiMarkov(x, config).viterbi().tolist() == [0, 10, 18]
    x = rng.normal(size=(11, 2))
    config = BoundaryConfig(penalty=1.0, shortest=2, longest=6, still=0.1)
    model = SemiMarkov(x, config)

    def price(cuts):
        return sum(((x[a:b] - x[a:b].mean(0)) ** 2).sum() + 1.0 for a, b in zip(cuts, cuts[1:], strict=False))

    every = [
        (0, *inner, 11)
        for n in range(6)
        for inner in itertools.combinations(range(1, 11), n)
        if all(2 <= b - a <= 6 for a, b in zip((0, *inner), (*inner, 11), strict=True))
    ]
    best = min(every, key=price)
    assert tuple(model.viterbi()) == best[:-1]
