"""`intabs compose`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.commands.demo import Clock, Out, Perception, PerceptionOption, Seed, Viewer, play_and_tell
from intabs.errors import UserError


def register(app: typer.Typer) -> None:
    @app.command()
    def compose(
        tasks: Annotated[list[str], typer.Argument(help="Tasks, e.g. drawer_open pick_place.")],
        perception: PerceptionOption = Perception.tags,
        clock: Annotated[Clock, typer.Option(help="lockstep: repeatable; wall: real time.")] = Clock.lockstep,
        seed: Seed = 0,
        out: Out = Path("out/compose"),
        viewer: Viewer = False,
        json: Annotated[Path | None, typer.Option(help="Write the summary there as well.")] = None,
    ) -> None:
        """Play the skills of several tasks, one after the other, in a world that was never demonstrated as a whole.

        Which demonstrations, and in which order, is what the policy in its head gets done best (`intabs plan`)."""
        from intabs import play

        if len(tasks) < 2:
            raise UserError("compose needs two tasks or more; for one use `intabs demo --task`")
        world = "+".join(tasks)
        options = play.Options(world, perception.value, clock.value, "plant", seed, out=out, viewer=viewer)
        play_and_tell(options, "compose", json)
