"""`intabs evaluate`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json


class Unit(StrEnum):
    segment = "segment"
    whole = "whole"


def register(app: typer.Typer) -> None:
    @app.command()
    def evaluate(
        runs: Annotated[list[Path], typer.Argument(help="Runs of `intabs train`: seeds; or a weights folder.")],
        data: Annotated[Path, typer.Option(help="Demonstrations, HDF5; those of mask/valid are scored.")],
        methods: Annotated[str, typer.Option(help="Comma-separated.")] = "intabs,pca,still,mean",
        unit: Annotated[Unit, typer.Option(help="Single segments, or whole demonstrations in a chain.")] = Unit.segment,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Reconstruction error on held-out demonstrations, beside what simpler methods get."""
        try:
            import torch  # noqa: F401
        except ImportError:
            raise UserError("torch is not installed: run tools/setup (without --runtime-only)") from None
        from intabs.evaluate.evaluate import FIGURES
        from intabs.evaluate.evaluate import evaluate as run

        names = [m.strip() for m in methods.split(",") if m.strip()]
        with Progress("evaluate", total=0) as progress:
            figures = run(runs, data, names, unit.value, progress.update)
        write_json(json, figures)
        print(f"{unit.value}, {figures['seeds']} seed{'s' * (figures['seeds'] > 1)}")
        print(f"{'':14}" + "".join(f"{k:>13}" for k in FIGURES))
        for name, f in figures["methods"].items():
            print(f"{name:14}" + "".join(f"{f[k]:13.4f}" for k in FIGURES) + f"   n {f['n']}")
