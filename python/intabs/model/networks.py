"""The networks: encoders q^r, q^e, policy pi, high-level policy eta. The same shapes and tensor names are read by the
C++ room `nn`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from intabs.errors import UserError
from intabs.model.space import Space, State, squash

LATENT = 8  # numbers of each of z^r and z^e, where nothing else is said; always twice as many together
AGE = 20.0  # ticks, unit of a skill's age
BASIS = 5  # hat functions over a skill's phase


class Recurrent(nn.Module):
    """Linear input layer, stacked LSTM with optional residual connections, named linear heads.

    Residual: layer l >= 1 hands on h_l + x_l; its own recurrent state stays h_l.
    Layer norm: layer l >= 1 reads norm(x_l); the residual path goes past it.
    Skip: heads see [top layer, network's input], a linear path beside the LSTMs.
    Bidirectional: heads give one value a sequence: of [forward half at the last tick, backward half at the first] of
    the top layer, or with pool "mean" their mean over the ticks.
    """

    def __init__(
        self,
        inputs: int,
        layers: int,
        hidden: int,
        heads: dict[str, int],
        input_linear: int = 0,
        residual: bool = False,
        layer_norm: bool = False,
        bidirectional: bool = False,
        skip: bool = False,
        pool: str = "last",
    ):
        super().__init__()
        self.spec = {
            "input": inputs,
            "input_linear": input_linear,
            "layers": layers,
            "hidden": hidden,
            "residual": residual,
            "layer_norm": layer_norm,
            "bidirectional": bidirectional,
            "skip": skip,
            "pool": pool,
            "heads": dict(heads),
        }
        self.residual = residual
        self.bidirectional = bidirectional
        self.skip, self.pool = skip, pool
        self.input = nn.Linear(inputs, input_linear) if input_linear else nn.Identity()
        first = input_linear or inputs
        width = hidden * (2 if bidirectional else 1)
        self.lstm = nn.ModuleList(
            nn.LSTM(first if i == 0 else width, hidden, batch_first=True, bidirectional=bidirectional)
            for i in range(layers)
        )
        self.norm = nn.ModuleList(nn.LayerNorm(width) if layer_norm and i > 0 else nn.Identity() for i in range(layers))
        read = width + (inputs if skip else 0)
        self.heads = nn.ModuleDict({k: nn.Linear(read, n) for k, n in heads.items()})
        for head in self.heads.values():
            head.weight.data *= 0.3  # begin near zero motion
        for lstm in self.lstm:
            for suffix in ("", "_reverse") if bidirectional else ("",):
                weight_hh = getattr(lstm, f"weight_hh_l0{suffix}")
                for k in range(4):
                    nn.init.orthogonal_(weight_hh.data[k * hidden : (k + 1) * hidden])
                nn.init.zeros_(getattr(lstm, f"bias_hh_l0{suffix}"))
                bias = getattr(lstm, f"bias_ih_l0{suffix}")
                nn.init.zeros_(bias)
                bias.data[hidden : 2 * hidden] = 1.0  # forget gate open at the start

    def forward(self, x: Tensor, mask: Tensor | None = None) -> dict[str, Tensor]:
        """x (B, T, inputs). Causal: heads at every tick, (B, T, n). Bidirectional: one value a sequence, (B, n).
        mask (B, T): 1 within a sequence, 0 after its end; None: all are T long."""
        seen, x = x, self.input(x)
        for i, lstm in enumerate(self.lstm):
            normed = self.norm[i](x)
            h = self._both_ways(lstm, normed, mask) if self.bidirectional and mask is not None else lstm(normed)[0]
            x = h + x if self.residual and i > 0 else h
        if self.bidirectional and self.pool == "last":
            hidden = self.spec["hidden"]
            last = -1 if mask is None else mask.sum(1).long() - 1
            at = torch.arange(len(x), device=x.device)
            x, seen = torch.cat([x[at, last, :hidden], x[:, 0, hidden:]], dim=-1), seen[at, last]
        if self.skip:
            x = torch.cat([x, seen], -1)
        if self.bidirectional and self.pool == "mean":
            x = x.mean(1) if mask is None else (x * mask[..., None]).sum(1) / mask.sum(1, keepdim=True)
        return {k: head(x) for k, head in self.heads.items()}

    @staticmethod
    def _both_ways(lstm: nn.LSTM, x: Tensor, mask: Tensor) -> Tensor:
        """The backward half begins at each sequence's own end. Turning sequences around by a gather costs half of what
        packing does on a CPU."""
        length = mask.sum(1, keepdim=True).long()
        t = torch.arange(x.shape[1], device=x.device)[None]
        turned = torch.where(t < length, length - 1 - t, t)[..., None]
        halves = []
        for suffix, y in (("", x), ("_reverse", x.gather(1, turned.expand_as(x)))):
            names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
            zero = x.new_zeros(1, len(x), lstm.hidden_size)
            weights = [getattr(lstm, n + suffix) for n in names]
            halves.append(torch.lstm(y, (zero, zero), weights, True, 1, 0.0, lstm.training, False, True)[0])
        return torch.cat([halves[0], halves[1].gather(1, turned.expand_as(halves[1]))], -1)

    def step(self, x: Tensor, memory: list | None = None) -> tuple[dict[str, Tensor], list]:
        """One tick of a causal network, x (B, inputs); memory None: zero state. Heads (B, n), and the new memory."""
        seen, x, carried = x, self.input(x), []
        for i, lstm in enumerate(self.lstm):
            weights = (lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, lstm.bias_hh_l0)
            before = memory[i] if memory else (x.new_zeros(len(x), lstm.hidden_size),) * 2
            h, c = torch.lstm_cell(self.norm[i](x), before, *weights)
            carried.append((h, c))
            x = h + x if self.residual and i > 0 else h
        if self.skip:
            x = torch.cat([x, seen], -1)
        return {k: head(x) for k, head in self.heads.items()}, carried

    def tensors(self) -> dict[str, Tensor]:
        """Names and values as the C++ side reads them."""
        out = {}
        if isinstance(self.input, nn.Linear):
            out["input.weight"], out["input.bias"] = self.input.weight, self.input.bias
        for i, lstm in enumerate(self.lstm):
            for suffix in ("", "_reverse") if self.bidirectional else ("",):
                for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
                    out[f"lstm.{i}.{name}{suffix}"] = getattr(lstm, f"{name}_l0{suffix}")
            if isinstance(self.norm[i], nn.LayerNorm):
                out[f"lstm.{i}.norm.weight"], out[f"lstm.{i}.norm.bias"] = self.norm[i].weight, self.norm[i].bias
        for name, head in self.heads.items():
            out[f"heads.{name}.weight"], out[f"heads.{name}.bias"] = head.weight, head.bias
        return {k: v.detach().contiguous() for k, v in out.items()}


def phase_basis(phase: Tensor) -> Tensor:
    """Hat functions at BASIS places of [0, 1]: (...) -> (..., BASIS), each row sums to 1."""
    centre = torch.linspace(0, 1, BASIS, device=phase.device)
    return (1 - (phase[..., None] - centre).abs() * (BASIS - 1)).clamp(min=0)


def phase(age: Tensor, ticks: Tensor) -> Tensor:
    """Of a skill of `ticks` ticks, 0 at its first, 1 at its last and after."""
    return (age / (ticks - 1).clamp(min=1)).clamp(max=1)


def with_basis(x: Tensor, basis: Tensor) -> Tensor:
    """[x, x b_0, ..., x b_K-1]: what lets a linear map read or write a value's course in time. Last dimension."""
    return torch.cat([x, (x[..., None, :] * basis[..., None]).flatten(-2)], -1)


def encoder_inputs(
    space: Space, state: Tensor, command: Tensor | None, response: Tensor, change: Tensor
) -> tuple[Tensor, Tensor]:
    """What q^r and q^e see of each tick, (..., agent_dim) and (..., environment_dim): state and what happens in the
    tick, all normalised."""
    agent = [state[..., : space.agent], response] + ([command] if command is not None else [])
    return torch.cat(agent, -1), torch.cat([state[..., space.agent :], change], -1)


class InteractionAbstractions(nn.Module):
    """q^r(z^r | tau^r), q^e(z^e | tau^e), pi(a^r, response, a^e | s, z, phase), eta(b, z of the next | s, z, age).

    config: {encoders: split | joint | agent, latent, encoder, pi, eta: {...}}. All inputs are normalised.
    - split: z = [z^r, z^e] by two encoders; joint: one encoder of both (tvi); agent: one of the agent (tvi-agent).
    - latent: numbers in z^r and z^e; [0, 0]: LATENT each here, and what the motion asks for when training begins.
    - pi's heads: `agent`, the command (the Lite 6: steps of the joint targets, gripper > 0 closed; else what moves the
      agent); `environment`, a^e. The Lite 6 also has `response`: what the joints will have moved, as a servo lags
      behind its targets and commands added up are not where the arm is; and `carried`, for each object the logit of
      its being held: a^e is the tip's motion as far as it is, and `environment` beside it.
    """

    def __init__(self, config: dict, space: Space):
        super().__init__()
        self.config, self.space = config, space
        self.kind = config["encoders"]
        lite6 = space.arm is not None
        # What the encoders see each tick.
        self.agent_dim = space.agent + (space.agent if lite6 else 0) + space.joints
        self.environment_dim = space.environment_dim + space.change_dim
        self.latent = config.get("latent", [0, 0])  # weights of before there was a choice do not say it
        if self.latent == [0, 0]:
            self.latent = [LATENT, LATENT]
        if len(self.latent) != 2 or sum(self.latent) != 2 * LATENT or min(self.latent) < 1:
            raise UserError(f"model.latent is {self.latent}: write two sizes that add up to {2 * LATENT}, or [0, 0]")
        agent, environment = self.latent
        inputs = {
            "split": {"q_agent": (self.agent_dim, agent), "q_environment": (self.environment_dim, environment)},
            "joint": {"q_joint": (self.agent_dim + self.environment_dim, 2 * LATENT)},
            "agent": {"q_agent": (self.agent_dim, 2 * LATENT)},
        }[self.kind]
        self.encoders = nn.ModuleDict(
            {
                name: Recurrent(
                    n * (BASIS + 1), heads={"mean": size, "log_std": size}, bidirectional=True, **config["encoder"]
                )
                for name, (n, size) in inputs.items()
            }
        )
        heads = {"agent": space.agent, "environment": space.change_dim}
        if lite6:
            heads["response"], heads["carried"] = space.joints, space.slots
        self.pi = Recurrent(space.state_dim + BASIS + 2 * LATENT * (BASIS + 1), heads=heads, **config["pi"])
        self.eta = Recurrent(
            space.state_dim + 2 * LATENT + 1, heads={"mean": 2 * LATENT, "log_std": 2 * LATENT, "b": 1}, **config["eta"]
        )

    def encode(self, agent: Tensor, environment: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Segments (M, L, agent_dim), (M, L, environment_dim) -> mean and log standard deviation of z, (M, 16)."""
        steps = agent.shape[1]
        age = torch.arange(steps, device=agent.device, dtype=agent.dtype)[None]
        length = mask.sum(1, keepdim=True) if mask is not None else torch.full_like(age[:, :1], steps)
        basis = phase_basis(phase(age, length)).expand(len(agent), -1, -1)
        views = {"q_agent": agent, "q_environment": environment, "q_joint": torch.cat([agent, environment], -1)}
        y = [q(with_basis(views[name], basis), mask) for name, q in self.encoders.items()]
        mean, log_std = (torch.cat([x[k] for x in y], -1) for k in ("mean", "log_std"))
        return mean, (log_std - 3).clamp(-6, 1)

    def policy_input(self, state: Tensor, z: Tensor, basis: Tensor) -> Tensor:
        """state (..., state_dim), z (..., 16), basis (..., BASIS): [s, basis, z, z b_0, ...]."""
        return torch.cat([state, basis, with_basis(z, basis)], -1)

    def terminate(self, state: Tensor, z: Tensor, age: Tensor) -> dict[str, Tensor]:
        """eta beside a skill from its first tick on: state (M, L, state_dim), z (M, 16), age (M, L) -> logit `b`
        (M, L, 1) that it is over and the next begins at this tick, and mean and log_std of the next one's z."""
        z = z[:, None].expand(-1, state.shape[1], -1)
        return self.eta(torch.cat([state, z, age[..., None] / AGE], -1))

    def change(self, heads: dict[str, Tensor], carried: Tensor | None) -> Tensor:
        """a^e (..., change_dim) in units of its scale. carried: Space.carried."""
        change = squash(heads["environment"])
        if carried is None:
            return change
        # Truly 0 or 1 where pi is sure: a far object must not stir. `held_error` trains the logit beyond.
        held = (1.2 * torch.sigmoid(heads["carried"]) - 0.1).clamp(0, 1).repeat_interleave(6, -1)
        held = torch.nn.functional.pad(held, (0, change.shape[-1] - held.shape[-1]))
        return change + held * carried

    def rollout(self, start: State, z: Tensor, age: Tensor, ticks: Tensor, hard: bool = True) -> tuple[State, Tensor]:
        """Closed on its own predictions. start (B, ...), z (B, N, 16), age and ticks (B, N): of the running skill; a
        skill begins with zero memory. hard: the gripper is set, not moved half. The N states after `start`,
        (B, N, ...), and a^r (B, N, agent)."""
        space, state, memory, states, commands = self.space, start, None, [], []
        moves = "agent" if space.arm is None else "response"
        basis = phase_basis(phase(age, ticks))
        for t in range(z.shape[1]):
            s, tip = space.features(state)
            if memory is not None:
                keep = (age[:, t] > 0).to(s.dtype)[:, None]
                memory = [(h * keep, c * keep) for h, c in memory]
            y, memory = self.pi.step(self.policy_input(s, z[:, t], basis[:, t]), memory)
            response, gripper = space.respond(y[moves]), None
            if space.arm is not None:
                gripper = y["agent"][..., -1]
                gripper = torch.where(gripper > 0, 1.0, -1.0) if hard else gripper.clamp(-1, 1)
            carried = space.carried(state, tip, state.agent[..., : space.joints] + response)
            state = space.move(state, tip, response, self.change(y, carried), gripper)
            states.append(state)
            commands.append(y["agent"])
        return State.join(states, stack=1), torch.stack(commands, 1)

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Weights as exported, named NETWORK.TENSOR."""
        for net, module in self.networks().items():
            for name, value in module.tensors().items():
                value.copy_(tensors[f"{net}.{name}"])  # a detached view of the parameter

    def networks(self) -> dict[str, Recurrent]:
        return {"pi": self.pi, "eta": self.eta, **self.encoders}
