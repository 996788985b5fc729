"""`intabs latent`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def latent(
        run: Annotated[Path, typer.Argument(help="Run of `intabs train`, or a weights folder.")],
        data: Annotated[Path, typer.Option(help="Demonstrations, HDF5.")],
        out: Annotated[
            Path, typer.Option(help="FILE.png: a picture; FILE.html: a page whose points show their frames.")
        ],
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Map of the skills of all demonstrations: t-SNE and principal components of z."""
        try:
            from intabs.evaluate.latent import latent as write
        except ModuleNotFoundError as e:
            raise UserError(f"{e.name} is not installed: run tools/setup (without --runtime-only)") from None
        with Progress("latent", total=3) as progress:
            figures = write(run, data, out, progress.update)
        write_json(json, figures)
        print(f"{out}: {figures['skills']} skills of {figures['demos']} demonstrations, {figures['kinds']} kinds")
