"""`intabs plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from intabs.commands.demo import Out, Perception, PerceptionOption, Seed, play_and_tell
from intabs.errors import UserError
from intabs.output import write_json

FAR = 0.2  # m: what no demonstration does is not tried


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
        Success of --run is the task's, or that the poses of a goal file are reached to 3 cm (10 cm a radian).

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
            found = of_planner.find(goals, seen)
            if found.missing > FAR:
                raise UserError(
                    f"--goal {goal}: the nearest that demonstrations lead to is {found.missing:.2f} m from it; want "
                    "the objects where a demonstration of this world brings them"
                )
            return found

        if run:
            options = play.Options(
                world, perception.value, "lockstep", "plant", seed, spread, out, plan=find,
                by_goals=known is None, weights=weights,
            )  # fmt: skip
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
        print(found.expected(seen))
