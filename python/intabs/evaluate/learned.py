"""Skills learned by the networks, as a method of reconstruction: encoded piece by piece, then played by pi on its own
predictions alone."""

from __future__ import annotations

import numpy as np
import torch

from intabs.data.demos import Demo
from intabs.evaluate.metrics import Motion, Sample, joined, motion_of
from intabs.model.networks import InteractionAbstractions, encoder_inputs
from intabs.model.space import state_of
from intabs.train.cutting import DRAWN, Cuts, Cutter
from intabs.train.windows import prepare


class Learned:
    def __init__(
        self, name: str, model: InteractionAbstractions, config: dict | None = None, cutter: Cutter | None = None
    ):
        self.name, self.model, self.config, self.cutter = name, model.eval(), config, cutter
        self.steps, self.replays, self.data_sha256 = 0, 0, ""  # of the training, where it is known

    @property
    def training(self) -> dict[str, int | str]:
        """What a comparison ought to have in common."""
        numbers = sum(p.numel() for p in self.model.parameters())
        return {"parameters": numbers, "steps": self.steps, "replays": self.replays, "data_sha256": self.data_sha256}

    @property
    def cuts_itself(self) -> bool:
        """False for exported weights whose cuts a network drew, as that stays with the run."""
        return self.cutter is not None or self.config["objective"].get("cuts", "motion") not in DRAWN

    def cuts(self, train: list[Demo], demos: list[Demo]) -> list[np.ndarray]:
        """Learned boundaries of demonstrations: ticks at which skills begin, and last T - 1. train: those that the
        boundaries' scales come from."""
        cuts = Cuts(self.model, [state_of(d)[0] for d in train], self.config["objective"], self.cutter)
        return [cuts.of(d.state, d.command) for d in prepare(demos, self.model.space)]

    @torch.no_grad()
    def inputs(self, of: Sample) -> tuple[torch.Tensor, torch.Tensor]:
        """What the encoders see of a demonstration of T states, (T - 1, ...)."""
        space, state = self.model.space, of.state
        command = of.command / space.command_scale if of.command is not None else None
        features, _ = space.features(state[:-1])
        return encoder_inputs(space, features, command, *space.between(state[:-1], state[1:]))

    @torch.no_grad()
    def encode(self, inputs: tuple[torch.Tensor, torch.Tensor], pieces: list[tuple[int, int]]) -> torch.Tensor:
        """Means of z of the pieces from tick a to tick b, (n, 16)."""
        length = torch.tensor([b - a for a, b in pieces])
        offset = torch.arange(int(length.max()))[None]
        at = torch.tensor([a for a, _ in pieces])[:, None] + torch.minimum(offset, length[:, None] - 1)
        return self.model.encode(*(x[at] for x in inputs), (offset < length[:, None]).float())[0]

    @torch.no_grad()
    def reconstruct(self, of: Sample, cuts: list[int]) -> Motion:
        z = self.encode(self.inputs(of), list(zip(cuts, cuts[1:], strict=False)))
        length = np.diff(cuts)
        age = np.concatenate([np.arange(n) for n in length])
        rolled, _ = self.model.rollout(
            of.state[:1],
            z.repeat_interleave(torch.from_numpy(length), 0)[None],
            torch.from_numpy(age[None].astype("f4")),
            torch.from_numpy(np.repeat(length, length)[None].astype("f4")),
        )
        return joined([of.motion[:1], motion_of(rolled[0])])
