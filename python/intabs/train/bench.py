"""What forward and backward of the networks cost in joint training, without rollouts and losses, three ways in one
run: `tools/bench_training`.

- intabs: as training does it, each network once over all ticks of all skills, the encoders with masks.
- loop: the same networks and numbers, tick by tick over the batch.
- torch.nn.LSTM: its own stacks of the same sizes on the same inputs, with nothing around them.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from intabs import _core
from intabs.errors import UserError
from intabs.model.networks import BASIS, LATENT, InteractionAbstractions, Recurrent
from intabs.model.space import Space
from intabs.output import write_json
from intabs.train.trainer import load_config

WINDOWS, TICKS, SKILL = 32, 100, 20  # of a batch; 20 ticks a skill: 160 skills


def tick_by_tick(net: Recurrent, x: Tensor) -> dict[str, Tensor]:
    """Recurrent.forward of the skills (M, SKILL, n), but over the windows they come from, (WINDOWS, TICKS, n), without
    nn.LSTM: a skill begins with zero memory."""
    x = x.unflatten(0, (WINDOWS, -1)).flatten(1, 2)
    if not net.bidirectional:
        memory, out = None, []
        for t in range(TICKS):
            y, memory = net.step(x[:, t], memory if t % SKILL else None)
            out.append(y)
        return {k: torch.stack([y[k] for y in out], 1) for k in out[0]}
    seen, x = x, net.input(x)
    for i, lstm in enumerate(net.lstm):
        halves = []
        for suffix, order, first in (("", range(TICKS), 0), ("_reverse", reversed(range(TICKS)), SKILL - 1)):
            weights = [getattr(lstm, n + suffix) for n in ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")]
            ticks = {}
            for t in order:
                if t % SKILL == first:
                    h = c = x.new_zeros(len(x), lstm.hidden_size)
                h, c = torch.lstm_cell(x[:, t], (h, c), *weights)
                ticks[t] = h
            halves.append(torch.stack([ticks[t] for t in range(TICKS)], 1))
        h = torch.cat(halves, -1)
        x = h + x if net.residual and i > 0 else h
    if net.skip:
        x = torch.cat([x, seen], -1)
    return {k: head(x.unflatten(1, (-1, SKILL)).mean(2)) for k, head in net.heads.items()}


def plain(net: Recurrent) -> nn.LSTM:
    s = net.spec
    return nn.LSTM(
        s["input_linear"] or s["input"], s["hidden"], s["layers"], batch_first=True, bidirectional=net.bidirectional
    )


def measure(work: dict[str, Callable[[], Tensor]], rounds: int) -> dict[str, list[float]]:
    """Seconds of forward and backward; they take turns, so that ratios compare neighbours in time."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for r in range(rounds + 1):
        for name, f in work.items():
            began = time.perf_counter()
            f().backward()
            if r > 0:
                times[name].append(time.perf_counter() - began)
    return times


def bench(config: str, rounds: int) -> dict:
    torch.manual_seed(0)
    model = InteractionAbstractions(load_config(config, [])["model"], Space(7, 4, 0, _core.ArmModel.lite6()))
    skills = WINDOWS * TICKS // SKILL
    inputs = {name: torch.randn(skills, SKILL, net.spec["input"]) for name, net in model.networks().items()}
    stacks = {name: plain(net) for name, net in model.networks().items()}
    assert inputs["pi"].shape[-1] == model.space.state_dim + BASIS + 2 * LATENT * (BASIS + 1)

    def total(heads: dict[str, Tensor]) -> Tensor:
        return sum(y.square().mean() for y in heads.values())

    mask = torch.ones(skills, SKILL)

    def ours() -> Tensor:
        nets = model.networks().items()
        return sum(total(net(inputs[name], mask if net.bidirectional else None)) for name, net in nets)

    def loop() -> Tensor:
        return sum(total(tick_by_tick(net, inputs[name])) for name, net in model.networks().items())

    def stacked() -> Tensor:
        return sum(
            stacks[name](model.networks()[name].input(inputs[name]))[0].square().mean() for name in model.networks()
        )

    with torch.no_grad():
        difference = abs(float(ours() - loop()))
    if not difference < 1e-4:
        raise UserError(f"the loop over ticks gives something else ({difference:.1e})")
    times = measure({"intabs": ours, "loop": loop, "torch.nn.LSTM": stacked}, rounds)
    rows = {k: {"p50_ms": 1e3 * statistics.median(v), "max_ms": 1e3 * max(v), "n": len(v)} for k, v in times.items()}
    ratios = {
        k: statistics.median(a / b for a, b in zip(times["intabs"], times[k], strict=True))
        for k in ("loop", "torch.nn.LSTM")
    }
    return {"config": config, "batch": [WINDOWS, TICKS], "rows": rows, "ratios": ratios}


def main() -> int:
    parser = argparse.ArgumentParser(prog="tools/bench_training", description=__doc__.split("\n")[0])
    parser.add_argument("--config", default="intabs")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the figures there")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    try:
        figures = bench(a.config, a.rounds)
    except UserError as e:
        print(f"tools/bench_training: {e}", file=sys.stderr)
        return 1
    for name, row in figures["rows"].items():
        print(f"{name}: {row['p50_ms']:.0f} ms (median of {row['n']}; at most {row['max_ms']:.0f})")
    print("intabs to " + ", to ".join(f"{k}: {v:.2f}" for k, v in figures["ratios"].items()))
    write_json(a.json, figures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
