"""`intabs export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def export(
        run: Annotated[Path, typer.Argument(help="Folder of a training run.")],
        out: Annotated[Path, typer.Option(help="Weights folder to write, e.g. models/weights/NAME.")],
        trials: Annotated[
            int, typer.Option(help="Closed-loop runs for each weight format (fp32, 16, 8 bit); 0: none.", min=0)
        ] = 20,
        practice: Annotated[
            int,
            typer.Option(
                help="Tries of each demonstration in the plant: the library notes which do their task.", min=0
            ),
        ] = 6,
        jobs: Annotated[int, typer.Option(help="Tries at a time.", min=1)] = 1,
        bits: Annotated[int, typer.Option(help="Of a stored weight: 32, or 16 for half the space.")] = 32,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Write weights, manifest, golden vectors and the skill library; done when C++ loads them and agrees."""
        try:
            from intabs.train.export import export as write
        except ModuleNotFoundError as e:
            raise UserError(f"{e.name} is not installed: run tools/setup (without --runtime-only)") from None
        with Progress("export", total=1.0) as progress:
            figures = write(run, out, trials, practice, jobs, progress.update, bits)
        write_json(json, figures)
        print(f"{out}: {figures['tensors']} tensors, C++ within {figures['max_abs_error']:.1e} of torch")
        for name, f in figures["formats"].items():
            line = f"  {name:>4}: joint steps within {f['max_rad']:.1e} rad (rms {f['rms_rad']:.1e}) of torch"
            if loop := f.get("closed_loop"):
                line += "".join(f"; {task} {n} of {loop['trials']}" for task, n in loop["success"].items())
            print(line)
