"""Where skills begin in joint training: train/cutting.py."""

import itertools
import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: tools/setup installs it")

from test_learning import SMALL, record, train, two_train_as_one  # noqa: E402

from intabs.data.demos import load_demos, save_demos  # noqa: E402
from intabs.train.cutting import (  # noqa: E402
    RATE,
    all_skills,
    begins_of,
    best_cuts,
    choices,
    draw,
    log_sum,
    prior_error,
    straight_through,
    table,
)
from intabs.train.trainer import Trainer, load_config  # noqa: E402
from intabs.train.windows import Windows, skills_of  # noqa: E402

SEGMENT = (2, 4)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "demos.hdf5"
    save_demos(path, [record(seed) for seed in range(3)], {"task": "pick_place"}, valid_share=0.25)
    return path


def windows(counts, steps):
    mask = torch.tensor([[1.0] * n + [0.0] * (steps - n) for n in counts])
    begins = torch.zeros_like(mask)
    begins[:, 0] = 1
    return Windows(None, None, None, None, mask, *skills_of(begins, mask))


def segmentations(ticks, low, high):
    """Every way to cut 0 .. ticks into skills of low .. high ticks, the last maybe shorter."""
    for n in range(1, ticks + 1):
        for lengths in itertools.product(range(1, high + 1), repeat=n):
            if sum(lengths) == ticks and all(k >= low for k in lengths[:-1]):
                yield lengths


def tables(seed=0):
    """Random costs of all skills of two windows of 9 and 7 ticks: as a table and by (window, first tick, length)."""
    batch, place = all_skills(windows([9, 7], 9), SEGMENT)
    cost = 3 * torch.rand(len(place), generator=torch.Generator().manual_seed(seed))
    named = {tuple(p): float(c) for p, c in zip(place.tolist(), cost, strict=True)}
    return batch, table(cost, place, 2, 9, SEGMENT[1]), named


def total(named, b, lengths):
    starts = np.cumsum([0, *lengths[:-1]])
    return sum(named[b, int(a), n] for a, n in zip(starts, lengths, strict=True))


def test_the_sum_is_that_over_every_segmentation():
    _, costs, named = tables()
    for b, ticks in ((0, 9), (1, 7)):
        every = [total(named, b, x) for x in segmentations(ticks, *SEGMENT)]
        assert len(every) > 5
        assert math.isclose(
            float(log_sum(costs)[b, ticks - 1]), -math.log(sum(math.exp(-c) for c in every)), rel_tol=1e-5
        )


def test_viterbi_finds_the_cheapest_segmentation():
    for seed in range(5):
        _, costs, named = tables(seed)
        for b, ticks in ((0, 9), (1, 7)):
            every = list(segmentations(ticks, *SEGMENT))
            best = min(every, key=lambda x: total(named, b, x))
            assert best_cuts(costs[b].numpy(), ticks) == np.cumsum([0, *best]).tolist()


def test_every_stretch_that_may_be_a_skill_is_there_once_and_gathers_its_ticks():
    batch, _, named = tables()
    used = {(b, int(a), n) for b, t in ((0, 9), (1, 7)) for x in segmentations(t, *SEGMENT)
            for a, n in zip(np.cumsum([0, *x[:-1]]), x, strict=True)}  # fmt: skip
    assert used <= set(named) and len(named) == len(batch.gather)
    for (b, a, n), row, within in zip(named, batch.gather.tolist(), batch.within.tolist(), strict=True):
        assert row[:n] == list(range(9 * b + a, 9 * b + a + n)) and sum(within) == n
    coarse = all_skills(windows([9, 7], 9), SEGMENT, grid=2)[1].tolist()
    assert all(a % 2 == 0 and ((a + n) % 2 == 0 or a + n == (9, 7)[b]) for b, a, n in coarse)


def test_drawn_skills_are_as_short_and_as_long_as_allowed_and_follow_the_probabilities():
    mask = torch.ones(4000, 30)
    chance = torch.from_numpy(np.random.default_rng(0).random((4000, 30), dtype="f4"))
    logit = torch.full((4000, 30), math.log(0.3 / 0.7))
    begins = draw(logit, mask, (3, 6), chance)
    w = Windows(None, None, None, None, mask, *skills_of(begins, mask))
    assert torch.equal(begins_of(w), begins)
    n = w.within.sum(1)[w.skill[:, 0]]  # the first of each window: no end cuts it short
    assert n.min() == 3 and n.max() == 6
    # Geometric from the third tick on, the rest at the sixth.
    share = [float((n == k).float().mean()) for k in (3, 4, 5, 6)]
    assert np.allclose(share, [0.3, 0.21, 0.147, 0.343], atol=0.015)
    free = choices(begins, mask, (3, 6))
    at = torch.zeros_like(free)
    age = torch.zeros(4000)
    for t in range(1, 30):
        age = age + 1
        at[:, t] = ((age >= 3) & (age < 6)).float()
        age = torch.where(begins[:, t] > 0, 0, age)
    assert torch.equal(free, at)
    assert abs(float((begins * free).sum() / free.sum()) - 0.3) < 0.01


def test_the_straight_through_estimate_keeps_the_draw_and_says_which_way():
    logit = torch.zeros(1, 3, requires_grad=True)
    begins, free = torch.tensor([[1.0, 0.0, 1.0]]), torch.tensor([[0.0, 1.0, 1.0]])
    b = straight_through(logit, begins, free, torch.full((1, 3), 0.5))
    assert torch.equal(b.detach(), begins)
    b.sum().backward()
    assert logit.grad[0, 0] == 0 and (logit.grad[0, 1:] > 0).all()


def test_the_prior_is_its_own_least():
    free = torch.ones(1, 4)
    at = math.log(RATE / (1 - RATE))
    assert float(prior_error(torch.full((1, 4), at), free)) < 1e-6
    for other in (at - 1, at + 1):
        p = 1 / (1 + math.exp(-other))
        expected = p * math.log(p / RATE) + (1 - p) * math.log((1 - p) / (1 - RATE))
        assert math.isclose(float(prior_error(torch.full((1, 4), other), free)), expected, rel_tol=1e-4)


@pytest.mark.parametrize("kind", ["viterbi", "exact", "gumbel", "reinforce"])
def test_every_kind_of_cuts_trains_resumes_and_cuts_what_is_held_out(data, tmp_path, kind):
    from intabs.evaluate.evaluate import load_learned

    extra = [f"objective.cuts={kind}", "objective.joint_from=0.25"]
    whole = train(data, tmp_path / "whole", 8, extra=extra)
    train(data, tmp_path / "part", 8, stop_at=5, extra=extra)
    again = Trainer(load_config("intabs-small", [*SMALL, *extra, "train.steps=8"]), data, tmp_path / "part", 0, "cpu")
    again.resume()
    again.train()
    for a, b in zip(whole._parameters(), again._parameters(), strict=True):
        assert torch.equal(a, b)
    demos, _ = load_demos(data)
    before = whole.cuts.of(*(lambda d: (d.state, d.command))(whole.recorded[0]))
    for d, cuts in zip(demos, load_learned(tmp_path / "whole").cuts(demos, demos), strict=True):
        assert cuts[0] == 0 and cuts[-1] == len(d) - 1
        assert (np.diff(cuts)[:-1] >= 8).all() and np.diff(cuts).max() <= 24
    assert len(before) > 4


def test_drawn_cuts_learn_where_the_motion_changes():
    """One number that is 0, then 1: z says it, pi repeats it; a skill that spans both costs. Cuts are to go there."""
    from intabs.train import cutting

    class Teller:
        """Stands for encoders and pi: z is the mean of what the skill's ticks say, pi repeats z."""

        def __init__(self, x, batch):
            self.x, self.batch = x, batch

        def z(self):
            b = self.batch
            return (b.pieces(self.x) * b.within[..., None]).sum(1) / b.within.sum(1, keepdim=True)

        def errors(self, z):
            seen = self.batch.pieces(self.x)
            z = z if z.dim() == 3 else z[:, None].expand_as(seen)
            return ((z - seen) ** 2).sum(-1) / (2 * 0.1**2) * self.batch.within

    segment, steps, rng = (2, 12), 16, np.random.default_rng(0)
    for kind in ("gumbel", "reinforce"):
        torch.manual_seed(0)
        net = torch.nn.Linear(3, 1)  # sees the tick before, this one and the next
        optimizer = torch.optim.Adam(net.parameters(), 0.05)
        for _ in range(400):
            at = torch.from_numpy(rng.integers(4, 12, 64))
            x = (torch.arange(steps)[None] >= at[:, None]).float()[..., None]
            seen = torch.cat([x.roll(1, 1), x, x.roll(-1, 1)], -1)
            mask = torch.ones(64, steps)
            logit = net(seen)[..., 0]
            chance = torch.from_numpy(rng.random((64, steps), dtype="f4"))
            begins = cutting.draw(logit, mask, segment, chance)
            told = Teller(x, Windows(None, None, None, None, mask, *skills_of(begins, mask)))
            if kind == "gumbel":
                noise = torch.from_numpy(rng.random((64, steps), dtype="f4"))
                error = cutting.gumbel_error(told, told.z(), logit, noise, segment)
            else:
                error = cutting.reinforce_error(told, told.z(), logit, segment)
            free = cutting.choices(begins, mask, segment)
            optimizer.zero_grad()
            (error + cutting.prior_error(logit, free)).backward()
            optimizer.step()
        for at in range(4, 12):
            x = (torch.arange(steps) >= at).float()
            seen = torch.stack([x.roll(1), x, x.roll(-1)], -1)
            seen[0] = seen[1]
            seen[-1] = seen[-2]
            assert cutting.likeliest(net(seen)[:, 0].detach(), segment).tolist() == [0, at, steps], (kind, at)


@pytest.mark.parametrize("kind", ["exact", "gumbel", "reinforce"])
def test_two_processes_cut_as_one_does(data, tmp_path, kind):
    two_train_as_one(data, tmp_path, kind)
