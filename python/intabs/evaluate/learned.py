"""Skills learned by the networks, as a method of reconstruction: encoded piece by piece, then played by pi on its own
predictions alone."""

from __future__ import annotations

import numpy as np
import torch

from intabs.data.features import Normalizer, Trajectory
from intabs.evaluate.metrics import Motion, joined
from intabs.model import kinematics
from intabs.model.networks import InteractionAbstractions


class Learned:
    """arm: intabs._core.ArmModel. `prepare` must have been given the trajectory of a motion before it is rebuilt."""

    def __init__(self, name: str, model: InteractionAbstractions, normalizer: Normalizer, arm):
        self.name, self.model, self.normalizer = name, model.eval(), normalizer
        self.arm = kinematics.Arm(arm)

    def encode(self, trajectory: Trajectory, a: int, b: int) -> torch.Tensor:
        """(1, 16), the mean of z for ticks a..b-1. trajectory: normalised."""
        piece = (trajectory.state, trajectory.agent_action, trajectory.environment_action)
        with torch.no_grad():
            return self.model.encode(*(torch.from_numpy(np.ascontiguousarray(x[None, a:b], "f4")) for x in piece))[0]

    def reconstruct(self, motion: Motion, cuts: list[int], trajectory: Trajectory) -> Motion:
        """trajectory: of the same ticks as `motion`, not normalised."""
        normalized = self.normalizer.normalize(trajectory)
        parts = [motion[:1]]
        for a, b in zip(cuts, cuts[1:], strict=False):
            parts.append(self.play(parts[-1][-1:], self.encode(normalized, a, b), b - a))
        return joined(parts)

    @torch.no_grad()
    def play(self, start: Motion, z: torch.Tensor, ticks: int) -> Motion:
        """Kinematic: joints by a^r, objects by a^e, nothing of the truth. Gives the `ticks` states after `start`."""
        n = self.normalizer
        q = torch.from_numpy(start.agent[:, :6].astype("f4"))
        gripper = torch.from_numpy(start.agent[:, 6].astype("f4"))
        p, R = torch.from_numpy(start.p.astype("f4")), torch.from_numpy(start.R.astype("f4"))
        known = torch.from_numpy(start.valid.astype("f4"))
        scale_r, scale_e = torch.from_numpy(n.agent_action_scale), torch.from_numpy(n.environment_action_scale)
        memory, out = None, []
        for _ in range(ticks):
            raw, (_, R_WG) = kinematics.state_features(self.arm, q, gripper, p, R, known, known)
            s = torch.from_numpy(n.normalize_state(raw.numpy()))
            y, memory = self.model.pi.step(torch.cat([s, z], -1), memory)
            q = q + y["agent"][:, :6] * scale_r[:6]
            gripper = torch.where(y["agent"][:, 6] > 0, 1.0, -1.0)
            moved = (y["environment"].clamp(-8, 8) * scale_e).unflatten(-1, (-1, 6)) * known[..., None]
            p, R = kinematics.move_objects(p, R, R_WG, moved)
            agent = torch.cat([q, gripper[:, None]], 1)
            out.append((agent.numpy(), p.numpy(), R.numpy()))
        agent, p, R = (np.concatenate(x) for x in zip(*out, strict=True))
        repeat = np.zeros(ticks, int)
        return Motion(agent, p, R, start.environment[repeat], start.valid[repeat])
