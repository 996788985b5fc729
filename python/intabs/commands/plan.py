"""`intabs plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.commands.demo import Out, Perception, PerceptionOption, Seed, play_and_tell
from intabs.errors import UserError
from intabs.output import write_json


def register(app: typer.Typer) -> None:
    @app.command()
    def plan(
        goal: Annotated[str, typer.Option(help="A task, tasks joined by +, or a JSON file of wanted object poses.")],
        task: Annotated[str | None, typer.Option(help="The world to plan in; for a task as goal: that task's.")] = None,
        weights: Annotated[str, typer.Option(help="A name in models/weights, or a folder.")] = "lite6",
        seed: Seed = 0,
        spread: Annotated[
            float, typer.Option(help="How far objects lie from their nominal place, cm.", min=0, max=15)
        ] = 2.0,
        run: Annotated[bool, typer.Option("--run", help="Play it then, as `demo` does, and report in --out.")] = False,
        perception: PerceptionOption = Perception.tags,
        out: Out = Path("out/plan"),
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Find skills that bring the objects to wanted poses, and say where they should end, before anything moves.

        A goal file: {"goals": [{"object": 0, "p_WO": [.28, .07, .02], "q_WO": [1, 0, 0, 0]}]}, in their order;
        either of the two may be left out."""
        from intabs import _core, paths, play
        from intabs.errors import as_user_error
        from intabs.skills.library import weights_folder
        from intabs.skills.planner import Planner, goals_of, load_goals, seen_from

        folder = weights_folder(weights)
        planner = Planner(folder)
        known = goal if all(t in planner.library.tasks for t in goal.split("+")) else None
        world = task or known
        if world is None:
            raise UserError("--goal is a file: say with --task in which world")

        def find(of_planner, seen):
            goals = goals_of(of_planner.library, known, seen) if known else load_goals(Path(goal))
            return of_planner.find(goals, seen)

        if run:
            options = play.Options(
                world, perception.value, "lockstep", "plant", seed, spread, out, plan=find, weights=weights
            )
            play_and_tell(options, "plan", json)
            return
        with as_user_error(RuntimeError):
            session = _core.Session(str(paths.MODELS), world, "")
            session.reset(seed, spread)
        seen = seen_from(session.observe())
        found = find(planner, seen)
        write_json(
            json,
            {
                "skills": [{"index": s.index, "task": s.task, "source": s.source} for s in found.skills],
                "predicted": {str(i): found.predicted[i].tolist() for i in range(4) if seen.known[i]},
                "missing_m": found.missing, "search_s": found.search_s, "verify_s": found.verify_s,
            },
        )  # fmt: skip
        print(f"{found.about}: {len(found.skills)} skills, {0.04 * sum(s.ticks for s in found.skills):.0f} s")
        for i in range(4):
            if seen.known[i]:
                p = ", ".join(f"{100 * v:.1f}" for v in found.predicted[i, :3])
                print(f"  object {i} should end at ({p}) cm")
        times = f"searched {found.search_s:.2f} s, verified {found.verify_s:.2f} s"
        print(f"  {1000 * found.missing:.0f} mm from the goal; {times}")
