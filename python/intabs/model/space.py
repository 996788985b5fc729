"""States of an embodiment, what the networks see of them, and how predictions move them on: all that a kinematic
rollout needs. Two kinds: the Lite 6, whose features are those of the runtime (cpp/intabs/skills/state.h: objects in the
frame of its tip), and any other agent, with the objects in W.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor, nn

from intabs.data.demos import OBJECT_SLOTS, Demo
from intabs.errors import UserError
from intabs.model import kinematics

SQUASH = 8.0  # predicted changes saturate at so many of their training deviations
LIMIT = 5.0  # normalised features are clamped there
Tip = tuple[Tensor, Tensor]  # p_WG (..., 3), R_WG (..., 3, 3)
LAYOUTS = {"gripper-relative/2": 13, "world/1": 10, "both/1": 23}  # numbers an object
OBJECTS = {"gripper": "gripper-relative/2", "world": "world/1", "both": "both/1"}  # how the Lite 6's are seen
ROTATIONS = {"columns": 6, "quaternion": 4}  # numbers of an object's orientation: the first two columns of R, or wxyz


@dataclass
class State:
    """Of one tick, or batched: any leading shape (...)."""

    agent: Tensor  # (..., A); the Lite 6: q [rad], gripper +-1
    p: Tensor  # (..., S, 3) p_WO [m]
    R: Tensor  # (..., S, 3, 3) R_WO
    environment: Tensor  # (..., E) joints of articulated objects and the like
    known: Tensor  # (..., S) 0 or 1: seen at least once
    valid: Tensor  # (..., S) 0 or 1: the pose is vouched for

    def map(self, f) -> State:
        return State(*(f(getattr(self, field.name)) for field in fields(self)))

    def __getitem__(self, index) -> State:
        return self.map(lambda x: x[index])

    def either(self, other: State, mine: Tensor) -> State:
        """Rows (B, ...) of this one where mine (B,) is true, of the other elsewhere."""
        parts = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return State(*(torch.where(mine.reshape(-1, *[1] * (a.dim() - 1)), a, b) for a, b in parts))

    @staticmethod
    def join(states: list[State], stack: int | None = None, cat: int = 0) -> State:
        """Stacked along a new dimension, or concatenated."""
        parts = zip(*([getattr(s, f.name) for f in fields(State)] for s in states), strict=True)
        return State(*(torch.cat(x, cat) if stack is None else torch.stack(x, stack) for x in parts))


def is_lite6(demo: Demo) -> bool:
    return demo.attrs.get("embodiment", "lite6") == "lite6" and demo.joint_pos is not None


def state_of(demo: Demo) -> tuple[State, np.ndarray | None]:
    """A demonstration as states (T, ...), and the commands a^r (T - 1, 7) where it is of the Lite 6: steps of the joint
    targets [rad a tick], gripper +-1. The Lite 6 always has four slots."""
    arrays = demo.arrays()
    lite6 = is_lite6(demo)
    agent, objects, valid = arrays.agent, arrays.objects, arrays.valid
    if lite6:
        agent = np.concatenate([agent[:, :6], np.where(agent[:, 6:7] > 0.5, 1, -1)], 1)
        missing = OBJECT_SLOTS - objects.shape[1]
        objects = np.pad(objects, ((0, 0), (0, missing), (0, 0)))
        valid = np.pad(valid, ((0, 0), (0, missing)))
    known = np.maximum.accumulate(valid, axis=0)
    parts = (agent, objects[..., :3], kinematics.rotation(objects[..., 3:]), arrays.environment, known, valid)
    state = State(*(torch.from_numpy(np.ascontiguousarray(x, "f4")) for x in parts))
    return state, demo.actions[:-1].astype("f4") if lite6 else None


class Space(nn.Module):
    """Sizes, scales of the training split, features. arm: intabs._core.ArmModel for the Lite 6, None otherwise.
    objects: one of OBJECTS, for the Lite 6; its runtime knows "gripper" alone. rotation: one of ROTATIONS; the runtime
    knows "columns" alone."""

    def __init__(
        self, agent: int, slots: int, environment: int, arm=None, objects: str = "gripper", rotation: str = "columns"
    ):
        super().__init__()
        self.agent, self.slots, self.environment = agent, slots, environment
        self.arm = kinematics.Arm(arm) if arm is not None else None
        if objects not in OBJECTS:
            raise UserError(f"model.objects is {objects!r}: write one of {', '.join(OBJECTS)}")
        if rotation not in ROTATIONS:
            raise UserError(f"model.rotation is {rotation!r}: write one of {', '.join(ROTATIONS)}")
        self.objects, self.rotation = objects, rotation
        layout = OBJECTS[objects if arm is not None else "world"]
        self.layout = layout if rotation == "columns" else f"{layout} {rotation}"
        self.joints = agent - 1 if arm is not None else agent  # what moves by steps; the gripper is set
        frames = 1 + (layout == OBJECTS["both"])
        self.environment_dim = slots * (LAYOUTS[layout] + frames * (ROTATIONS[rotation] - 6)) + environment
        self.change_dim = 6 * slots + environment  # of a^e
        for name, n in (
            ("mean", agent + self.environment_dim),
            ("scale", agent + self.environment_dim),
            ("command_scale", agent),
            ("response_scale", self.joints),
            ("change_scale", self.change_dim),
        ):
            self.register_buffer(name, torch.ones(n))

    @property
    def state_dim(self) -> int:
        return self.agent + self.environment_dim

    @property
    def config(self) -> dict:
        return {
            "agent": self.agent, "slots": self.slots, "environment": self.environment, "lite6": self.arm is not None,
            "objects": self.objects, "rotation": self.rotation,
        }  # fmt: skip

    @staticmethod
    def from_config(config: dict, arm) -> Space:
        arm = arm if config["lite6"] else None
        seen = config.get("objects", "gripper"), config.get("rotation", "columns")
        return Space(config["agent"], config["slots"], config["environment"], arm, *seen)

    def fit(self, demos: list[tuple[State, np.ndarray | None]]) -> None:
        """Scales from the training split."""
        raw = torch.cat([self.raw(s)[0] for s, _ in demos])
        self.mean.copy_(raw.mean(0))
        self.scale.copy_(_deviation(raw))
        steps = [self.between(s[:-1], s[1:], scaled=False) for s, _ in demos]
        response, change = torch.cat([x[0] for x in steps]), torch.cat([x[1] for x in steps])
        self.response_scale.copy_(_rms(response, 1e-4))
        # The motions of all objects share one scale for translations and one for rotations. Only what moves counts:
        # most objects rest most of the time.
        n = 6 * self.slots
        motion = change[:, :n].reshape(-1, 6)
        motion = motion[motion.abs().amax(-1) > 1e-4]
        for k, floor in ((0, 1e-4), (3, 1e-3)):
            rms = _rms(motion[:, k : k + 3].reshape(-1), floor) if len(motion) else 1.0
            self.change_scale[:n].view(-1, 6)[:, k : k + 3] = rms
        self.change_scale[n:] = _rms(change[:, n:], 1e-4)
        if self.arm is not None:
            commands = torch.from_numpy(np.concatenate([c for _, c in demos]))
            self.command_scale[:-1] = _rms(commands[:, :-1], 1e-4)  # not centred: no command is no motion

    def normalizer(self) -> dict:
        """As the runtime reads it (cpp/intabs/skills/policy.cc)."""
        return {
            "state_mean": self.mean.tolist(),
            "state_scale": self.scale.tolist(),
            "agent_action_scale": self.command_scale.tolist(),
            "environment_action_scale": self.change_scale.tolist(),
            "response_scale": self.response_scale.tolist(),
            "limit": LIMIT,
        }

    def load_normalizer(self, d: dict) -> None:
        names = {
            "mean": "state_mean", "scale": "state_scale", "command_scale": "agent_action_scale",
            "change_scale": "environment_action_scale", "response_scale": "response_scale",
        }  # fmt: skip
        for buffer, name in names.items():
            getattr(self, buffer).copy_(torch.tensor(d[name]))

    # --- features -----------------------------------------------------------------------------------------------------
    def raw(self, s: State) -> tuple[Tensor, Tip | None]:
        """(..., state_dim) [s^r, s^e] not normalised, and the tip's pose (None without an arm)."""
        tip, parts = None, []
        if self.arm is not None:
            q, gripper = s.agent[..., :-1], s.agent[..., -1]
            features, tip = kinematics.state_features(self.arm, q, gripper, s.p, s.R, s.known, s.valid)
            parts = [features[..., self.agent :].unflatten(-1, (self.slots, -1))] * (self.objects != "world")
        if self.arm is None or self.objects != "gripper":
            columns = torch.cat([s.R[..., 0], s.R[..., 1]], -1)
            parts.append(torch.cat([s.p, columns, s.valid[..., None]], -1) * s.known[..., None])
        if self.rotation == "quaternion":  # the columns stand at the same place in each frame's numbers
            parts = [torch.cat([x[..., :3], kinematics.quaternion(x[..., 3:9]), x[..., 9:]], -1) for x in parts]
        return torch.cat([s.agent, torch.cat(parts, -1).flatten(-2), s.environment], -1), tip

    def features(self, s: State) -> tuple[Tensor, Tip | None]:
        """raw, normalised."""
        raw, tip = self.raw(s)
        return ((raw - self.mean) / self.scale).clamp(-LIMIT, LIMIT), tip

    # --- changes ------------------------------------------------------------------------------------------------------
    def between(self, a: State, b: State, scaled: bool = True) -> tuple[Tensor, Tensor]:
        """From a to b: response (..., joints), of the agent; change (..., change_dim), a^e: of each object translation
        and rotation vector, in the tip's frame at a or in W; of the scalars. In units of the training deviations."""
        response = (b.agent - a.agent)[..., : self.joints]
        turn = (b.R @ a.R.transpose(-1, -2)).detach().cpu().numpy()
        w = torch.from_numpy(kinematics.log_so3(turn.astype("f8")).astype("f4")).to(a.p)
        p = b.p - a.p
        if self.arm is not None:
            R_GW = self.arm.tip(a.agent[..., :-1])[1].transpose(-1, -2)[..., None, :, :]
            p, w = (R_GW @ p[..., None])[..., 0], (R_GW @ w[..., None])[..., 0]
        # A slot seen for the first time in b has not jumped there.
        motion = torch.cat([p, w], -1) * a.known[..., None]
        change = torch.cat([motion.flatten(-2), b.environment - a.environment], -1)
        if not scaled:
            return response, change
        return response / self.response_scale, (change / self.change_scale).clamp(-SQUASH, SQUASH)

    def carried(self, s: State, tip: Tip | None, q_next: Tensor) -> Tensor | None:
        """a^e (..., change_dim), scaled, if the tip held every object; None without an arm."""
        if tip is None:
            return None
        motion = kinematics.carried_motion(*tip, *self.arm.tip(q_next), s.p)
        scalars = torch.zeros_like(s.environment)
        return torch.cat([motion.flatten(-2), scalars], -1) / self.change_scale

    def move(self, s: State, tip: Tip | None, response: Tensor, change: Tensor, gripper: Tensor | None) -> State:
        """The state a tick later. response (of `respond`), change: pi's; tip: of features(s); gripper (...): to what it
        is set, the Lite 6's."""
        agent = s.agent[..., : self.joints] + response
        if gripper is not None:
            agent = torch.cat([agent, gripper[..., None]], -1)
        change = change * self.change_scale
        motion = change[..., : 6 * self.slots].unflatten(-1, (self.slots, 6)) * s.known[..., None]
        if tip is None:
            p, R = s.p + motion[..., :3], kinematics.exp_so3(motion[..., 3:]) @ s.R
        else:
            p, R = kinematics.move_objects(s.p, s.R, tip[1], motion)
        return State(agent, p, R, s.environment + change[..., 6 * self.slots :], s.known, s.valid)

    def respond(self, response: Tensor) -> Tensor:
        """pi's output -> displacement of the agent."""
        return squash(response) * self.response_scale


def squash(x: Tensor) -> Tensor:
    return SQUASH * torch.tanh(x / SQUASH)


def _deviation(x: Tensor) -> Tensor:
    s = x.std(0)
    return torch.where(s > 1e-4, s, torch.ones_like(s))


def _rms(x: Tensor, floor: float) -> Tensor:
    return x.square().mean(0).sqrt().clamp(min=floor)
