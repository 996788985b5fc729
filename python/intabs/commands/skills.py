"""`intabs skills`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json

Weights = Annotated[str, typer.Option(help="A name in models/weights, or a folder.")]
Json = Annotated[Path | None, typer.Option(help="Write the figures there.")]


def register(app: typer.Typer) -> None:
    skills = typer.Typer(no_args_is_help=True, help="The library of skills: what was learned from each demonstration.")
    app.add_typer(skills, name="skills")

    @skills.command("list")
    def list_(
        weights: Weights = "lite6",
        task: Annotated[str | None, typer.Option(help="Only those of this task.")] = None,
        json: Json = None,
    ) -> None:
        """All skills: where they come from, how long they last, what they do."""
        from intabs.skills.library import Library, weights_folder

        library = Library.load(weights_folder(weights))
        chosen = [s for chain in library.of_task(task) for s in chain] if task else library.skills
        write_json(json, {"skills": [_figures(s) for s in chosen]})
        print("skill  task          demonstration  ticks  effect")
        for s in chosen:
            print(f"{s.index:5d}  {s.task:12}  {s.source:>10} {s.number:2d}  {s.ticks:5d}  {s.effect}")

    @skills.command()
    def show(
        index: Annotated[int, typer.Argument(help="Its number in `skills list`.")],
        weights: Weights = "lite6",
        out: Annotated[Path | None, typer.Option(help="FILE.svg: start, middle and end, drawn.")] = None,
        json: Json = None,
    ) -> None:
        """One skill: z, durations, where its objects began and ended; a drawing with --out."""
        from intabs.skills.library import Library, drawing, latent_sizes, weights_folder

        library = Library.load(weights_folder(weights))
        if not 0 <= index < len(library.skills):
            raise UserError(f"skill {index}: there are 0 to {len(library.skills) - 1}; see `intabs skills list`")
        s = library.skills[index]
        write_json(json, {"skills": [_figures(s)]})
        print(f"skill {index}: {s.task}, {s.source}, the {s.number + 1}. of it; {s.effect}")
        print(f"  lasts {s.ticks} ticks of 40 ms ({s.min_ticks} to {s.max_ticks})")
        at = 0
        for name, size in latent_sizes(weights_folder(weights)).items():
            print(f"  z {name:11} " + " ".join(f"{v:6.2f}" for v in s.z[at : at + size]))
            at += size
        for slot in range(4):
            places = [f.object_pose[slot, :3] for f in (s.frames[0], s.frames[-1]) if f.known[slot]]
            if len(places) == 2:
                a, b = (" ".join(f"{100 * v:6.1f}" for v in p) for p in places)
                print(f"  object {slot}: from ({a}) to ({b}) cm")
        if out is not None:
            if out.suffix != ".svg":
                raise UserError(f"--out {out}: must end in .svg")
            out.parent.mkdir(parents=True, exist_ok=True)
            out.write_text(drawing(s))
            print(f"wrote {out}")

    @skills.command()
    def practise(
        weights: Annotated[str, typer.Argument(help="A name in models/weights, or a folder: its library changes.")],
        tries: Annotated[int, typer.Option(help="Of each demonstration, more where that tells too little.", min=1)] = 6,
        jobs: Annotated[int, typer.Option(help="Tries at a time.", min=1)] = 1,
        json: Json = None,
    ) -> None:
        """Try the skills of each demonstration in the plant: plans are made of those that do their task."""
        import numpy as np

        from intabs.skills import practice
        from intabs.skills.library import Library, weights_folder

        folder = weights_folder(weights)
        Library.load(folder)  # before any work
        with Progress("practise", total=1.0) as progress:
            practice.practise(folder, tries, jobs, progress.update)
        library = Library.load(folder)
        rates = {task: [library.rate(c) for c in library.of_task(task)] for task in library.tasks}
        figures = {task: {"best": max(r), "mean": float(np.mean(r)), "chains": len(r)} for task, r in rates.items()}
        write_json(json, figures)
        print("task          best  mean  of demonstrations")
        for task, f in figures.items():
            print(f"{task:12}  {f['best']:.2f}  {f['mean']:.2f}  {f['chains']:3d}")


def _figures(s) -> dict:
    return {
        "index": s.index, "task": s.task, "source": s.source, "number": s.number, "ticks": s.ticks,
        "min_ticks": s.min_ticks, "max_ticks": s.max_ticks, "z": s.z.tolist(), "effect": s.effect,
        "start": _frame(s.frames[0]), "end": _frame(s.frames[-1]),
    }  # fmt: skip


def _frame(f) -> dict:
    objects = {str(i): f.object_pose[i].tolist() for i in range(4) if f.known[i]}
    return {"q": f.q.tolist(), "gripper_closed": f.gripper_closed, "objects": objects}
