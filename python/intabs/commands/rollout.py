"""`intabs rollout`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intabs.commands.demo import Perception
from intabs.output import Progress, write_json


class Way(StrEnum):
    whole = "whole"
    goal = "goal"


class Ablation(StrEnum):
    none = "none"
    objects = "objects"
    z = "z"
    policy = "policy"


def register(app: typer.Typer) -> None:
    @app.command()
    def rollout(
        task: Annotated[str, typer.Option(help="What to do.")],
        trials: Annotated[int, typer.Option(help="Trials, each with a seed of its own.", min=1)],
        spread: Annotated[
            float, typer.Option(help="How far objects lie from their nominal place, cm.", min=0, max=15)
        ] = 2.0,
        weights: Annotated[str, typer.Option(help="A name in models/weights, or a folder.")] = "lite6",
        perception: Annotated[
            Perception, typer.Option(help="Where object poses come from: cameras and tags, or the simulator itself.")
        ] = Perception.tags,
        seed: Annotated[
            int, typer.Option(help="First seed; training data count up from 0.", min=0, max=2**62)
        ] = 1_000_000,
        jobs: Annotated[int, typer.Option(help="Trials at a time.", min=1)] = 1,
        resume: Annotated[bool, typer.Option("--resume", help="Keep the trials already in --report.")] = False,
        report: Annotated[
            Path | None,
            typer.Option(help="Folder for trials.jsonl, figures.json, a picture strip of each failure, a plot."),
        ] = None,
        plan: Annotated[
            Way | None,
            typer.Option(
                help="whole: the demonstration that began most like now; goal: found for the poses the task leaves "
                "behind. Without it: single tasks like whole, where the hand comes to the object in pi's head; "
                "tasks joined by + like goal."
            ),
        ] = None,
        nudge: Annotated[
            bool, typer.Option("--nudge", help="Knock the object away as the fingers first close.")
        ] = False,
        ablate: Annotated[
            Ablation,
            typer.Option(help="objects: poses frozen at their first value; z: skills shuffled; policy: zeros for pi."),
        ] = Ablation.none,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Closed-loop success in the plant: in process, in lockstep, with a 95 % interval."""
        from intabs.rollout import rollout as run

        with Progress("rollout", total=trials) as progress:
            figures = run(
                task, trials, spread, weights, perception.value, seed, jobs,
                "" if ablate is Ablation.none else ablate.value, report, resume,
                plan.value if plan else "", nudge, progress.update,
            )  # fmt: skip
        write_json(json, figures)
        low, high = figures["ci95"]
        print(f"{task}: {figures['success']} of {trials} succeeded (95 % interval {low:.2f} to {high:.2f})")
        for reason, n in sorted(figures["failures"].items(), key=lambda item: -item[1]):
            print(f"  {n} x {reason}")
