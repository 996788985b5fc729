"""The networks: encoders q^r, q^e and the policy pi. The same shapes and tensor names are read by the C++ room `nn`."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LATENT = 8  # of each of z^r, z^e
AGENT_DIM = 7  # joints, gripper
OBJECTS = 4
OBJECT_DIM = 13  # p_GO, two columns of R_GO, valid, p_GO compressed: cpp/intabs/skills/state.h
ENVIRONMENT_DIM = OBJECTS * OBJECT_DIM
STATE_DIM = AGENT_DIM + ENVIRONMENT_DIM
AGENT_ACTION_DIM = 7  # joint steps, gripper
ENVIRONMENT_ACTION_DIM = OBJECTS * 6


class Recurrent(nn.Module):
    """Linear input layer, stacked LSTM with optional residual connections, named linear heads.

    Residual: layer l >= 1 hands on h_l + x_l; its own recurrent state stays h_l.
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
        read = width + (inputs if skip else 0)
        self.heads = nn.ModuleDict({k: nn.Linear(read, n) for k, n in heads.items()})
        for lstm in self.lstm:
            for suffix in ("", "_reverse") if bidirectional else ("",):
                weight_hh = getattr(lstm, f"weight_hh_l0{suffix}")
                for k in range(4):
                    nn.init.orthogonal_(weight_hh.data[k * hidden : (k + 1) * hidden])
                nn.init.zeros_(getattr(lstm, f"bias_hh_l0{suffix}"))
                bias = getattr(lstm, f"bias_ih_l0{suffix}")
                nn.init.zeros_(bias)
                bias.data[hidden : 2 * hidden] = 1.0  # forget gate open at the start

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """x (B, T, inputs). Causal: heads at every tick, (B, T, n). Bidirectional: one value a sequence, (B, n)."""
        seen, x = x, self.input(x)
        for i, lstm in enumerate(self.lstm):
            h, _ = lstm(x)
            x = h + x if self.residual and i > 0 else h
        if self.bidirectional and self.pool == "last":
            hidden = self.spec["hidden"]
            x, seen = torch.cat([x[:, -1, :hidden], x[:, 0, hidden:]], dim=-1), seen[:, -1]
        if self.skip:
            x = torch.cat([x, seen], -1)
        if self.bidirectional and self.pool == "mean":
            x = x.mean(1)
        return {k: head(x) for k, head in self.heads.items()}

    def step(self, x: Tensor, memory: list | None = None) -> tuple[dict[str, Tensor], list]:
        """One tick of a causal network, x (B, inputs); memory None: zero state. Heads (B, n), and the new memory."""
        seen, x, carried = x, self.input(x), []
        for i, lstm in enumerate(self.lstm):
            weights = (lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, lstm.bias_hh_l0)
            before = memory[i] if memory else (x.new_zeros(len(x), lstm.hidden_size),) * 2
            h, c = torch.lstm_cell(x, before, *weights)
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
        for name, head in self.heads.items():
            out[f"heads.{name}.weight"], out[f"heads.{name}.bias"] = head.weight, head.bias
        return {k: v.detach().contiguous() for k, v in out.items()}


class InteractionAbstractions(nn.Module):
    """q^r(z^r | tau^r), q^e(z^e | tau^e) and pi(a^r, a^e | s, z), z = [z^r, z^e]. All inputs are normalised."""

    def __init__(self, config: dict):
        super().__init__()
        gaussian = {"mean": LATENT, "log_std": LATENT}
        self.q_agent = Recurrent(AGENT_DIM + AGENT_ACTION_DIM, heads=gaussian, bidirectional=True, **config["encoder"])
        self.q_environment = Recurrent(
            ENVIRONMENT_DIM + ENVIRONMENT_ACTION_DIM, heads=gaussian, bidirectional=True, **config["encoder"]
        )
        self.pi = Recurrent(
            STATE_DIM + 2 * LATENT,
            heads={"agent": AGENT_ACTION_DIM, "environment": ENVIRONMENT_ACTION_DIM},
            **config["pi"],
        )

    def encode(self, state: Tensor, agent_action: Tensor, environment_action: Tensor) -> tuple[Tensor, Tensor]:
        """Segments (B, T, .) -> mean and log standard deviation of z, (B, 16)."""
        agent = self.q_agent(torch.cat([state[..., :AGENT_DIM], agent_action], -1))
        environment = self.q_environment(torch.cat([state[..., AGENT_DIM:], environment_action], -1))
        mean = torch.cat([agent["mean"], environment["mean"]], -1)
        log_std = torch.cat([agent["log_std"], environment["log_std"]], -1).clamp(-6, 2)
        return mean, log_std

    def act(self, state: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """state (B, T, 59), z (B, 16) held over the segment -> a^r (B, T, 7), a^e (B, T, 24). From zero state."""
        y = self.pi(torch.cat([state, z[:, None].expand(-1, state.shape[1], -1)], -1))
        return y["agent"], y["environment"]

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Weights as exported, named NETWORK.TENSOR."""
        for net, module in self.networks().items():
            for name, value in module.tensors().items():
                value.copy_(tensors[f"{net}.{name}"])  # a detached view of the parameter

    def networks(self) -> dict[str, Recurrent]:
        return {"pi": self.pi, "q_agent": self.q_agent, "q_environment": self.q_environment}
