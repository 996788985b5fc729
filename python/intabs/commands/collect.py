"""`intabs collect`: demonstrations from the scripted demonstrator, through the real programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.commands.demo import Perception
from intabs.output import Progress, write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def collect(
        task: Annotated[str, typer.Option(help="Which task, or all.")],
        demos: Annotated[int, typer.Option(help="Successful demonstrations of each task.", min=1)],
        out: Annotated[Path, typer.Option(help="HDF5 file to write.")],
        perception: Annotated[
            Perception, typer.Option(help="Where object poses come from: cameras and tags, or the simulator itself.")
        ] = Perception.tags,
        seed: Annotated[int, typer.Option(help="Seed of the first demonstration.", min=0, max=2**62)] = 0,
        spread: Annotated[
            float, typer.Option(help="How far objects lie from their nominal place, cm.", min=0, max=15)
        ] = 2.0,
        disturb: Annotated[
            float, typer.Option(help="Size of the disturbances that the demonstrator corrects; 0: none.", min=0)
        ] = 1.0,
        detours: Annotated[
            float, typer.Option(help="Probability of each change of mind on the way; 0: none.", min=0, max=1)
        ] = 0.3,
        jobs: Annotated[int, typer.Option(help="Runs at a time.", min=1)] = 1,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Record demonstrations: plant, perception and a scripted demonstrator over the same messages as on a bench."""
        from intabs.demonstrate.collect import collect as run
        from intabs.demonstrate.tasks import DEMONSTRATORS

        total = demos * (len(DEMONSTRATORS) if task == "all" else 1)
        with Progress("collect", total=total) as progress:
            figures = run(task, demos, out, perception.value, seed, spread, disturb, detours, jobs, progress.update)
        write_json(json, figures)
        print(f"{out}: {figures['demos']} demonstrations, {figures['frames']} frames")
        for name, t in figures["tasks"].items():
            print(f"  {name}: {t['success']} of {t['tried']} tries succeeded")
