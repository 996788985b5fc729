"""`intabs human`: demonstrations of a simulated hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.output import Progress, write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def human(
        out: Annotated[Path, typer.Option(help="HDF5 file to write.")],
        task: Annotated[str, typer.Option(help="Which task or composition, or all.")] = "all",
        demos: Annotated[int, typer.Option(help="Demonstrations of each task.", min=1)] = 10,
        seed: Annotated[int, typer.Option(help="Seed of the first demonstration.", min=0, max=2**62)] = 0,
        spread: Annotated[
            float, typer.Option(help="How far objects lie from their nominal place, cm.", min=0, max=15)
        ] = 2.0,
        thesis: Annotated[
            bool, typer.Option("--thesis", help="Depth by the thesis' weighted mean instead of the median.")
        ] = False,
        jobs: Annotated[int, typer.Option(help="Runs at a time.", min=1)] = 1,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Record a simulated human hand that does the tasks, as a colour and a noisy depth camera see it.

        Its 21 key points go through the hand filters of perception, the objects' poses through the gap filling.
        """
        from intabs.hand.sim import record

        total = demos * len(record.tasks_of(task))
        with Progress("human", total=total) as progress:
            method = "gaussian" if thesis else "robust"
            figures = record.collect(task, demos, out, seed, spread, method, jobs, progress.update)
        write_json(json, figures)
        e = figures["error_mm"]
        print(f"{out}: {figures['demos']} demonstrations, {figures['frames']} frames")
        print(
            f"key points: {100 * figures['kept']:.1f} % kept, error median {e['p50']:.1f} mm, p95 {e['p95']:.1f}, "
            f"max {e['max']:.1f}"
        )
        for name, count in figures["tasks"].items():
            print(f"  {name}: {count['success']} of {count['demos']} succeeded")
