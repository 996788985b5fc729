"""`intabs train`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json


class Device(StrEnum):
    cpu = "cpu"
    cuda = "cuda"


def register(app: typer.Typer) -> None:
    @app.command()
    def train(
        config: Annotated[str, typer.Option(help="intabs, intabs-small, tvi, tvi-agent, or a YAML file of that form.")],
        data: Annotated[Path, typer.Option(help="Demonstrations, HDF5.")],
        out: Annotated[Path, typer.Option(help="Folder of the run: checkpoint, TensorBoard curves, result.json.")],
        replays: Annotated[
            Path | None, typer.Option(help="More of the same, by `intabs replay`: objects elsewhere (the Lite 6).")
        ] = None,
        set_: Annotated[
            list[str] | None, typer.Option("--set", help="Change a setting, e.g. train.steps=2000. Repeatable.")
        ] = None,
        resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
        device: Annotated[Device, typer.Option(help="Where to compute.")] = Device.cpu,
        seed: Annotated[int, typer.Option(help="Of initial weights, batches and noise.", min=0)] = 0,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Train encoders, policy and high-level policy; held-out demonstrations are scored on the way.

        By several processes: torchrun --nproc-per-node 2 -m intabs.cli train ..."""
        try:
            import torch
        except ImportError:
            raise UserError("torch is not installed: run tools/setup (without --runtime-only)") from None
        from intabs.train.trainer import Trainer, end_together, load_checkpoint, load_config, sizes_of

        if device is Device.cuda and not torch.cuda.is_available():
            raise UserError("--device cuda: torch sees no GPU here; leave it out")
        settings = load_config(config, set_ or [])
        if resume and settings["model"]["latent"] == [0, 0]:  # as they were found when it began
            settings["model"]["latent"] = sizes_of(load_checkpoint(out))
        elif not resume and (out / "checkpoint.pt").exists():
            raise UserError(f"{out / 'checkpoint.pt'} is there already: add --resume, or give another --out")
        trainer = Trainer(settings, data, out, seed, device.value, replays)
        if resume:
            trainer.resume()
        if trainer.rank > 0:
            trainer.train()
            end_together()
        with Progress("train", total=trainer.config["train"]["steps"]) as progress:
            figures = trainer.train(progress.update)
        write_json(json, figures)
        valid = ", ".join(f"{k} {v:.4f}" for k, v in figures["valid"].items()) or "nothing held out"
        print(f"{out}: {figures['steps']} steps in {figures['seconds']:.0f} s, loss {figures['loss']:.4f}")
        print(f"  held out: {valid}")
        end_together()
