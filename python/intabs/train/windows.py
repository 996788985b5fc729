"""Batches for training: windows of consecutive ticks, each cut into skills.

A window is N ticks of one demonstration. Its cuts are drawn anew each time (segment pretraining) or are those learned.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch
from torch import Tensor

from intabs.data.demos import Demo
from intabs.errors import UserError
from intabs.model import kinematics
from intabs.model.space import Space, State, state_of
from intabs.replay.replay import in_replay


@dataclass
class Demonstration:
    state: State  # (T, ...)
    command: Tensor | None  # (T - 1, A) a^r in units of its scale; None: the agent's displacement is the command
    source: str = ""  # what it is a replay of, tick by tick; recordings have their own name
    about: dict = field(default_factory=dict)  # and how: side, slow, approach (replay/replay.py)

    def at(self, cuts: list[int]) -> np.ndarray:
        """Where the skills of its recording begin in it."""
        return in_replay(np.array(cuts), self.about)

    @property
    def motion(self) -> str:
        """The same, tick by tick, of demonstrations that differ in where things are."""
        return f"{self.source} {float(self.about.get('side', 0)):.3f} {self.about.get('slow', 0)}"


def prepare(demos: list[Demo], space: Space, names: list[str] | None = None) -> list[Demonstration]:
    scale = space.command_scale.cpu()
    out = []
    for i, demo in enumerate(demos):
        state, command = state_of(demo)
        scaled = torch.from_numpy(command) / scale if command is not None else None
        out.append(Demonstration(state, scaled, names[i] if names else "", demo.attrs))
    return out


@dataclass
class Ours:
    """Which windows and skills of a batch are those of one process."""

    windows: int  # of all processes
    rows: slice  # those of this one
    skills: int
    mine: np.ndarray | slice


class Chance:
    """Draws for the rows of all processes, of which some are ours: so several processes train as one does."""

    def __init__(self, rng: np.random.Generator, total: int, rows):
        self.rng, self.total, self.rows = rng, total, rows

    def normal(self, size: tuple[int, ...]) -> np.ndarray:
        return self.rng.normal(size=(self.total, *size[1:]))[self.rows]

    def random(self, n: int) -> np.ndarray:
        return self.rng.random(self.total)[self.rows]

    def standard_normal(self, size: tuple[int, ...]) -> np.ndarray:
        """float32"""
        return self.rng.standard_normal((self.total, *size[1:]), dtype="f4")[self.rows]


@dataclass
class Windows:
    """B windows of N ticks, M skills of at most L ticks in them."""

    state: State  # (B, N + 1, ...)
    command: Tensor | None  # (B, N, A)
    shown: State  # what the encoders see: `state`, or the same ticks of another replay of the same recording
    shown_command: Tensor | None
    mask: Tensor  # (B, N) 1: a tick, 0: after the demonstration's end
    skill: Tensor  # (B, N) long, which of the M skills runs
    age: Tensor  # (B, N) ticks since it began
    ticks: Tensor  # (B, N) how many it lasts
    gather: Tensor  # (M, L) long, the skill's ticks among the B N
    within: Tensor  # (M, L) 1: a tick of the skill, 0: after its end
    whole: Tensor  # (M,) 1: its end lies in the window; 0: the window's last, which may go on
    names: list[str] = field(default_factory=list)  # of the windows' demonstrations
    ours: Ours | None = None  # where these stand in a batch that several processes share

    @staticmethod
    def one(state: State, command: Tensor | None) -> Windows:
        """A recording of N + 1 ticks as a window of one skill."""
        state, mask = state[None], torch.ones(1, len(state.agent) - 1)
        command = command[None] if command is not None else None
        begins = (torch.arange(mask.shape[1]) == 0).float()[None]
        return Windows(state, command, state, command, mask, *skills_of(begins, mask))

    def recut(self, begins: Tensor) -> Windows:
        """The same windows with skills that begin where (B, N) is 1."""
        names = ("skill", "age", "ticks", "gather", "within", "whole")
        return replace(self, **dict(zip(names, skills_of(begins, self.mask), strict=True)))

    def first(self, n: int) -> Windows:
        """The first n windows, each one skill."""
        names = ("state", "command", "shown", "shown_command", "mask")
        parts = {k: getattr(self, k)[:n] if getattr(self, k) is not None else None for k in names}
        begins = torch.zeros_like(parts["mask"])
        begins[:, 0] = 1
        return Windows(*parts.values(), *skills_of(begins, parts["mask"]))

    def stretches(self, gather: Tensor, within: Tensor) -> Windows:
        """Other stretches of the same windows as pieces, which may overlap."""
        return replace(self, gather=gather, within=within)

    def share(self, rank: int, world: int) -> Windows:
        """Every world-th window: the share of one of several processes."""
        steps = self.skill.shape[1]
        rows, mine = slice(rank, None, world), self.gather[:, 0] // steps % world == rank
        taken = ("state", "command", "shown", "shown_command", "mask", "age", "ticks")
        parts = {k: getattr(self, k)[rows] if getattr(self, k) is not None else None for k in taken}
        gather = self.gather[mine]
        return Windows(
            **parts,
            skill=(mine.long().cumsum(0) - 1)[self.skill[rows]],
            gather=gather // steps // world * steps + gather % steps,
            within=self.within[mine],
            whole=self.whole[mine],
            ours=Ours(len(self.skill), rows, len(self.gather), mine.numpy()),
        )

    def split(self, ticks: int) -> tuple[Windows, Windows]:
        """The first ticks, where every window has a cut, and the rest."""
        steps = self.skill.shape[1]
        first = self.gather[:, 0] % steps < ticks
        both = []
        for mine, a, b in ((first, 0, ticks), (~first, ticks, steps)):
            parts = {k: getattr(self, k)[:, a:b] for k in ("mask", "age", "ticks")}
            states = {k: getattr(self, k)[:, a : b + 1] for k in ("state", "shown")}
            commands = {k: x if (x := getattr(self, k)) is None else x[:, a:b] for k in ("command", "shown_command")}
            gather, within = self.gather[mine], self.within[mine]
            longest = int(within.sum(1).max())
            gather, within = gather[:, :longest], within[:, :longest]
            both.append(
                Windows(
                    **parts, **states, **commands,
                    skill=(mine.long().cumsum(0) - 1)[self.skill[:, a:b]],
                    gather=gather // steps * (b - a) + gather % steps - a,
                    within=within,
                    whole=self.whole[mine],
                    names=self.names,
                )
            )  # fmt: skip
        return both[0], both[1]

    def chance(self, rng: np.random.Generator) -> tuple[Chance, Chance]:
        """For draws a window, and draws a skill."""
        o = self.ours or Ours(len(self.skill), slice(None), len(self.gather), slice(None))
        return Chance(rng, o.windows, o.rows), Chance(rng, o.skills, o.mine)

    def pieces(self, x: Tensor) -> Tensor:
        """(B, N, d) -> (M, L, d), by skill."""
        return x.flatten(0, 1)[self.gather]

    def to(self, device: str) -> Windows:
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        moved = {k: v.to(device) for k, v in parts.items() if isinstance(v, Tensor)}
        states = {k: v.map(lambda x: x.to(device)) for k, v in parts.items() if isinstance(v, State)}
        return Windows(**{**parts, **moved, **states})


def skills_of(begins: Tensor, mask: Tensor) -> tuple[Tensor, ...]:
    """Windows' skill, age, ticks, gather, within, whole for skills that begin where (B, N) is 1, the first at 0."""
    rows, steps = begins.shape
    flat = (begins * mask).flatten()
    begin = torch.nonzero(flat)[:, 0]
    skill = flat.long().cumsum(0) - 1
    window = begin // steps
    end = window * steps + mask.sum(1).long()[window]
    whole = torch.zeros(len(begin), device=begin.device)
    if len(begin) > 1:
        same = window[1:] == window[:-1]
        whole[:-1] = same.float()
        end[:-1] = torch.where(same, begin[1:], end[:-1])
    length = end - begin
    offset = torch.arange(int(length.max()), device=begin.device)[None]
    t = torch.arange(rows * steps, device=begin.device)
    return (
        skill.view(rows, steps),
        (t - begin[skill]).float().view(rows, steps),
        length[skill].float().view(rows, steps),
        begin[:, None] + torch.minimum(offset, length[:, None] - 1),
        (offset < length[:, None]).float(),
        whole,
    )


class WindowSampler:
    """A demonstration is drawn by the root of its length: a task that takes three times as long as another is
    neither three times as important nor as quickly learned. Each of its ticks is equally likely to begin a window;
    with a lead, each that has it before.

    ticks: N; segment: shortest and longest skill drawn; cuts: instead of drawing, for each demonstration the ticks at
    which skills begin and, last, T - 1. augment: {"turn": rad} of the whole scene about the base (the Lite 6) or
    {"mix", "scale", "shift", "turn"} of motions in W (any other agent): see `augmented`.

    strangers: how often a slot that a demonstration of the Lite 6 does not use holds a resting object of another
    one: in compositions there is more to see than in any demonstration.

    siblings: how often the encoders see the same ticks of another replay of the recording, where there is one: a
    skill is to be what they have in common, and pi to find from the state how it goes here.
    """

    def __init__(
        self,
        demonstrations: list[Demonstration],
        space: Space,
        ticks: int,
        segment: tuple[int, int],
        augment: dict | None = None,
        cuts: list[np.ndarray] | None = None,
        strangers: float = 0.0,
        siblings: float = 0.0,
    ):
        for i, d in enumerate(demonstrations):
            if len(d.state.agent) < 3:
                raise UserError(f"demonstration {i} has {len(d.state.agent)} frames: 3 are the least")
        self.demonstrations, self.space, self.cuts = demonstrations, space, cuts
        self.siblings = siblings
        self.strangers = strangers if space.arm is not None else 0.0
        self.ticks, self.segment, self.augment = ticks, segment, augment or {}
        self.count = np.array([len(d.state.agent) - 1 for d in demonstrations])
        self.longest_lead = int(max(0, self.count.min() - segment[0]))
        self.first = np.concatenate([[0], np.cumsum(self.count + 1)])
        self.state = State.join([d.state for d in demonstrations])
        # For each slot the ticks that know it: strangers come from there.
        self.seen = [torch.nonzero(self.state.known[:, i])[:, 0].numpy() for i in range(space.slots)]
        self.used = np.array([(d.state.known > 0).any(0).numpy() for d in demonstrations])
        with_command = demonstrations[0].command is not None
        names = np.array([d.motion if d.source else "" for d in demonstrations])
        self.same = [np.flatnonzero(names == n) if n else np.array([i]) for i, n in enumerate(names)]
        # One row more a demonstration, so that states and commands share their index.
        self.command = (
            torch.cat([torch.cat([d.command, d.command[-1:]]) for d in demonstrations]) if with_command else None
        )

    def _pick(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Demonstrations and first ticks. A window may run over the end, but holds a short skill at least."""
        room = np.maximum(self.count - self.segment[0] + 1, 1)
        demo = rng.choice(len(room), size=n, p=np.sqrt(room) / np.sqrt(room).sum())
        start = rng.integers(room[demo])
        if self.cuts is not None:  # from the beginning of a skill
            for i, d in enumerate(demo):
                begins = self.cuts[d][:-1]
                start[i] = begins[np.searchsorted(begins, start[i], side="right") - 1]
        return demo, start

    def _cut(self, demo: int, start: int, ticks: int, low: int, high: int, rng: np.random.Generator) -> list[int]:
        """Lengths of the skills of a window of `ticks` ticks: learned, or drawn from low .. high."""
        if not ticks:
            return []
        if self.cuts is not None:
            inside = self.cuts[demo] - start
            inside = inside[(inside > 0) & (inside < ticks)]
            return np.diff(np.concatenate([[0], inside, [ticks]])).tolist()
        lengths: list[int] = []
        while (left := ticks - sum(lengths)) > 0:
            n = int(rng.integers(low, high + 1))
            lengths.append(left if left - n < low else n)
        return lengths

    def sample(self, n: int, rng: np.random.Generator, lead: int = 0) -> Windows:
        """`rng` is the whole source of chance. lead: ticks more, before the window, with a cut where it begins; no more
        than `longest_lead`."""
        demo, start = self._pick(n, rng)
        start = np.maximum(start - lead, 0)
        steps = lead + self.ticks
        # Short skills are as likely as long ones; those of a batch are of similar length, as padding costs time.
        low, high = np.log(self.segment)
        middle = np.exp(rng.uniform(low, high))
        low, high = max(self.segment[0], int(0.85 * middle)), min(self.segment[1], int(1.15 * middle) + 1)
        t = start[:, None] + np.arange(steps + 1)[None]
        last = self.count[demo][:, None]
        index = torch.from_numpy(self.first[demo][:, None] + np.minimum(t, last))
        begins = np.zeros((n, steps), "f4")
        for b in range(n):
            within = min(steps, int(last[b, 0] - start[b]))
            lengths = self._cut(int(demo[b]), int(start[b]), lead, low, high, rng)
            lengths += self._cut(int(demo[b]), int(start[b]) + lead, within - lead, low, high, rng)
            begins[b, np.cumsum([0, *lengths[:-1]])] = 1
        shown = demo.copy()
        for i, d in enumerate(demo):
            if len(self.same[d]) > 1 and rng.random() < self.siblings:
                shown[i] = rng.choice(self.same[d])
        shown_index = torch.from_numpy(self.first[shown][:, None] + np.minimum(t, last))
        state, seen = self.state[index], self.state[shown_index]
        if self.augment:
            other = self.state[torch.from_numpy(self._others(demo, t, rng))] if "mix" in self.augment else None
            both = augmented(State.join([state, seen], cat=1), other, self.augment, self.space, rng)
            state, seen = both[:, : steps + 1], both[:, steps + 1 :]
        if self.strangers:
            self._show_strangers(state, self.used[demo], rng)
            self._show_strangers(seen, self.used[shown], rng)
        mask = torch.from_numpy((t[:, 1:] <= last).astype("f4"))
        return Windows(
            state,
            self.command[index[:, :-1]] if self.command is not None else None,
            seen,
            self.command[shown_index[:, :-1]] if self.command is not None else None,
            mask,
            *skills_of(torch.from_numpy(begins), mask),
            [self.demonstrations[d].source or f"demonstration {d}" for d in demo],
        )

    def _show_strangers(self, s: State, used: np.ndarray, rng: np.random.Generator) -> None:
        """In place. s (B, N, ...), used (B, S)."""
        show = ~used & (rng.random(used.shape) < self.strangers) & np.array([len(x) > 0 for x in self.seen])
        for b, slot in np.argwhere(show):
            at = int(rng.choice(self.seen[slot]))
            s.p[b, :, slot], s.R[b, :, slot] = self.state.p[at, slot], self.state.R[at, slot]
            s.known[b, :, slot] = s.valid[b, :, slot] = 1

    def _others(self, demo: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Windows to mix in, from anywhere."""
        other = rng.integers(len(self.demonstrations), size=len(demo))
        room = np.maximum(self.count[other] - self.ticks, 0)
        start = (rng.random(len(demo)) * (room + 1)).astype(int)
        at = np.minimum(start[:, None] + np.arange(t.shape[1])[None], self.count[other][:, None])
        return self.first[other][:, None] + at


def augmented(s: State, other: State | None, how: dict, space: Space, rng: np.random.Generator) -> State:
    """Motions that might have been recorded as well. s: (B, N + 1, ...).

    The Lite 6: the scene turned about the base's z axis by N(0, turn): exact, as joint 1 turns about it.
    Others: displacement from the window's first state scaled by `scale` (a range) and mixed with `mix` times that of
    another window (half of the time); the whole shifted by `shift` of its deviation, objects turned by N(0, turn).
    """
    n = len(s.agent)

    def normal(*shape):
        return torch.from_numpy(rng.normal(size=shape).astype("f4"))

    if space.arm is not None:
        angle = how["turn"] * normal(n, 1)
        zero = torch.zeros_like(angle)
        Rz = kinematics.exp_so3(torch.stack([zero, zero, angle], -1))
        agent = torch.cat([s.agent[..., :1] + angle[..., None], s.agent[..., 1:]], -1)
        p = (Rz[:, :, None] @ s.p[..., None])[..., 0]
        return State(agent, p, Rz[:, :, None] @ s.R, s.environment, s.known, s.valid)

    low, high = how["scale"]
    scale = torch.from_numpy(rng.uniform(low, high, (n, 1, 1)).astype("f4"))
    half = torch.from_numpy((rng.random((n, 1, 1)) < 0.5).astype("f4"))
    mix = torch.from_numpy(rng.uniform(-how["mix"], how["mix"], (n, 1, 1)).astype("f4")) * half

    other = State.join([other, other], cat=1) if other.agent.shape[1] < s.agent.shape[1] else other

    def moved(x: Tensor, y: Tensor, deviation: Tensor) -> Tensor:
        more = (1,) * (x.dim() - 3)
        shift = how["shift"] * deviation * normal(n, 1, *x.shape[2:])
        a, b = scale.reshape(*scale.shape, *more), mix.reshape(*mix.shape, *more)
        return x[:, :1] + a * (x - x[:, :1]) + b * (y - y[:, :1]) + shift

    a, e = space.scale[: space.agent], space.scale[space.state_dim - space.environment :]
    width = (space.environment_dim - space.environment) // space.slots if space.slots else 0
    spread = torch.stack([space.scale[space.agent + width * i :][:3] for i in range(space.slots)]) if width else a[:0]
    turn = s.R @ s.R[:, :1].transpose(-1, -2), other.R @ other.R[:, :1].transpose(-1, -2)
    w, v = (torch.from_numpy(kinematics.log_so3(x.numpy().astype("f8")).astype("f4")) for x in turn)
    first = kinematics.exp_so3(how["turn"] * normal(n, 1, space.slots, 3)) @ s.R[:, :1]
    R = kinematics.exp_so3(scale[..., None] * w + mix[..., None] * v) @ first
    return State(
        moved(s.agent, other.agent, a),
        moved(s.p, other.p, spread),
        R,
        moved(s.environment, other.environment, e),
        s.known,
        s.valid,
    )


def disturbed(s: State, noise: dict, rng: np.random.Generator | Chance) -> State:
    """As a servo and cameras with errors would give it. Standard deviations: {"object_mm", "object_deg"} one error an
    object and window, {"tick_mm", "joint_mrad"} one a tick. s (B, N, ...) of the Lite 6."""
    n, t, slots, _ = s.p.shape

    def normal(scale, *shape):
        return scale * torch.from_numpy(rng.normal(size=shape).astype("f4")).to(s.p)

    joints = s.agent.shape[-1] - 1
    q = s.agent[..., :-1] + normal(1e-3 * noise["joint_mrad"], n, t, joints)
    p = s.p + normal(1e-3 * noise["object_mm"], n, 1, slots, 3) + normal(1e-3 * noise["tick_mm"], n, t, slots, 3)
    R = kinematics.exp_so3(normal(np.radians(noise["object_deg"]), n, 1, slots, 3)) @ s.R
    return State(torch.cat([q, s.agent[..., -1:]], -1), p, R, s.environment, s.known, s.valid)
