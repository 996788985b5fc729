"""`intabs demo`: cameras, policy and arm as separate programs; one learned task."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json


class Perception(StrEnum):
    tags = "tags"
    truth = "truth"


class Arm(StrEnum):
    plant = "plant"
    lite6 = "lite6"


class Clock(StrEnum):
    lockstep = "lockstep"
    wall = "wall"


PerceptionOption = Annotated[
    Perception, typer.Option(help="Where object poses come from: cameras and tags, or the simulator itself.")
]
Seed = Annotated[int, typer.Option(help="Where the objects lie.", min=0, max=2**62)]
Out = Annotated[Path, typer.Option(help="Folder for summary, pictures, video and logs.")]
Viewer = Annotated[bool, typer.Option("--viewer", help="Open a window on the simulation.")]


def register(app: typer.Typer) -> None:
    @app.command()
    def demo(
        task: Annotated[str, typer.Option(help="What to do.")] = "pick_place",
        perception: PerceptionOption = Perception.tags,
        clock: Annotated[
            Clock | None,
            typer.Option(help="lockstep (default): repeatable, as fast as it goes; wall: real time, as a real arm's."),
        ] = None,
        arm: Annotated[
            Arm, typer.Option(help="plant: MuJoCo; lite6: the arm's driver and a fake controller before MuJoCo.")
        ] = Arm.plant,
        weights: Annotated[str, typer.Option(help="A name in models/weights, or a folder.")] = "lite6",
        seed: Seed = 0,
        out: Out = Path("out/demo"),
        viewer: Viewer = False,
        json: Annotated[Path | None, typer.Option(help="Write the summary there as well.")] = None,
    ) -> None:
        """Play a learned task in simulation: plant, perception and control as separate C++ programs."""
        from intabs import play

        if arm == Arm.lite6 and clock == Clock.lockstep:
            raise UserError("--arm lite6 runs by the wall clock: leave out --clock lockstep")
        rule = clock or (Clock.wall if arm == Arm.lite6 else Clock.lockstep)
        play_and_tell(
            play.Options(task, perception.value, rule.value, arm.value, seed, out=out, viewer=viewer, weights=weights),
            "demo",
            json,
        )


def play_and_tell(options, name: str, json: Path | None) -> None:
    """options: play.Options. Plays, writes the summary, prints; UserError if the task failed."""
    from intabs import play

    with Progress(name, total=1.0) as progress:
        summary, why = play.play(options, progress.update)
    out = Path(options.out)
    write_json(out / "summary.json", summary)
    write_json(json, summary)
    reached = ", ".join(s["name"] for s in summary["subtasks"] if s["success"]) or "nothing"
    files = ", ".join(str(p) for p in (out / "summary.json", out / "strip.png", out / "video.mp4") if p.exists())
    if not summary["success"]:
        raise UserError(f"{options.task} failed: {why}; reached: {reached}; see {files}")
    print(f"{options.task}, seed {options.seed}: success after {summary['duration_s']:.1f} s ({reached})")
    print(f"wrote {files}")
