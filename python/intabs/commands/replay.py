"""`intabs replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def replay(
        data: Annotated[Path, typer.Option(help="Recorded demonstrations of the Lite 6, HDF5; those of mask/train.")],
        out: Annotated[Path, typer.Option(help="HDF5 to write.")],
        number: Annotated[int, typer.Option(help="Replays that succeed, spread over the tasks.", min=1)] = 500,
        of: Annotated[
            list[str] | None, typer.Option(help="TASK=N: so many of them are of this task; again for more.")
        ] = None,
        spread: Annotated[float, typer.Option(help="Objects are moved by up to so many cm.", min=1.0)] = 10.0,
        disturb: Annotated[float, typer.Option(help="Pushes that the commands get and take back [rad].", min=0)] = 0.01,
        sides: Annotated[
            bool, typer.Option("--sides", help="Pour into the bowl from other sides than the recordings, too.")
        ] = False,
        seed: Annotated[int, typer.Option(min=0)] = 0,
        jobs: Annotated[int, typer.Option(help="Tries at a time.", min=1)] = 1,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Replay demonstrations in the plant with objects elsewhere; what succeeds is kept, for `train --replays`."""
        from intabs.replay.replay import make

        tasks = {}
        for item in of or []:
            task, _, n = item.partition("=")
            if not n.isdigit():
                raise UserError(f"--of {item}: write TASK=N")
            tasks[task] = int(n)
        with Progress("replay", total=number) as progress:
            figures = make(data, out, number, spread, disturb, seed, jobs, progress.update, sides, tasks)
        write_json(json, figures)
        print(f"{out}: {figures['demos']} replays, {figures['frames']} frames, of {figures['tries']} tries")
        for task, f in figures["tasks"].items():
            why = ", ".join(f"{n} x {reason}" for reason, n in sorted(f["failures"].items(), key=lambda x: -x[1]))
            print(f"  {task}: {f['demos']} of {f['tries']}{'; ' if why else ''}{why}")
