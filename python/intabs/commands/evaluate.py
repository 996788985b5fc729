"""`intabs evaluate`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from intabs.data.demos import name_list
from intabs.errors import UserError
from intabs.output import Progress, write_json


class Unit(StrEnum):
    segment = "segment"
    whole = "whole"


def register(app: typer.Typer) -> None:
    @app.command()
    def evaluate(
        runs: Annotated[
            list[Path], typer.Argument(help="Runs of `intabs train`, several of a kind are seeds; or a weights folder.")
        ],
        data: Annotated[Path, typer.Option(help="Demonstrations, HDF5; those of mask/valid are scored.")],
        methods: Annotated[
            str, typer.Option(help="Comma-separated: intabs, tvi, tvi-agent, pca, hdmp, hdmp-faithful, still, mean.")
        ] = "",
        unit: Annotated[Unit, typer.Option(help="Single segments, or whole demonstrations in a chain.")] = Unit.segment,
        confusion: Annotated[
            Path | None, typer.Option(help="Draw there, a .png, which labels 5-NN over z takes for which.")
        ] = None,
        json: Annotated[Path | None, typer.Option(help="Write the figures there.")] = None,
    ) -> None:
        """Reconstruction error on held-out demonstrations, beside what simpler methods get."""
        try:
            import torch  # noqa: F401
        except ImportError:
            raise UserError("torch is not installed: run tools/setup (without --runtime-only)") from None
        from intabs.evaluate.evaluate import FIGURES, FROM_TIP, with_interval
        from intabs.evaluate.evaluate import evaluate as run

        if confusion and confusion.suffix != ".png":
            raise UserError(f"--confusion {confusion}: must end in .png")
        names = [m.strip() for m in methods.split(",") if m.strip()]
        with Progress("evaluate", total=0) as progress:
            figures = run(runs, data, names or None, unit.value, progress=progress.update)
        write_json(json, figures)
        print(f"{unit.value}, {figures['seeds']} seed{'s' * (figures['seeds'] > 1)}")
        print(f"{'':14}" + "".join(f"{k:>13}" for k in FIGURES))
        for name, f in figures["methods"].items():
            sd = f"   sd {f['sd']:.4f}" if f["sd"] else ""
            print(f"{name:14}" + "".join(f"{f[k]:13.4f}" for k in FIGURES) + f"   n {f['n']}{sd}")
        trained = [(name, t) for name, runs in figures["training"].items() for t in runs]
        if unequal([t for _, t in trained]):
            each = (f"{n} {t['parameters']:,}, {t['steps']:,}, {t['replays']:,}" for n, t in trained)
            print(f"not trained alike (parameters, steps, replays: {'; '.join(each)}): tools/table trains them alike")
        if foreign := list(dict.fromkeys(n for n, t in trained if t["data_sha256"] != figures["data_sha256"])):
            print(f"{', '.join(foreign)}: trained on another file than {data}: what it holds out may have been seen")
        if not names and "hdmp" not in figures["methods"]:
            print("hdmp is left out: its package comes by tools/setup --baselines")
        if all(k in f for f in figures["methods"].values() for k in FROM_TIP):
            print("objects seen from the gripper")
            for name, f in figures["methods"].items():
                shown = ("all_from_tip", None, None, "position_from_tip", "orientation_from_tip")
                print(f"{name:14}" + "".join(f"{f[k]:13.4f}" if k else " " * 13 for k in shown))
        for name, f in figures["ratios"].items():
            text = "".join(f"  {k} {with_interval(f[k])}" for k in FIGURES)
            print(f"{next(iter(figures['methods']))} / {name}:{text}")
        if u := figures.get("usage"):
            active = " and ".join(f"{a} of {n}" for a, n in zip(u["active"], u["of"], strict=True))
            print(
                f"usage: {u['skills']} skills of {u['demonstrations']} demonstrations, {u['ticks']:.0f} ticks long "
                f"(median); {active} numbers of z in use"
            )
        if "knn" in figures:
            k = figures["knn"]
            print(
                f"5-NN over z: {k['accuracy']:.3f} of {k['n']} ({k['classes']} kinds; the thesis' protocol "
                f"{k['thesis_protocol']:.3f}); majority {k['majority']:.3f}, untrained encoder {k['untrained']:.3f}, "
                f"PCA-16 {k['pca']:.3f}"
            )
        if b := figures.get("boundaries"):
            print(
                f"boundaries: precision {b['precision']:.3f}, recall {b['recall']:.3f}, F1 {b['f1']:.3f}; "
                f"best fixed cut {b['fixed_cut_f1']:.3f}, mean training times {b['mean_time_f1']:.3f}"
            )
        if "compositions" in figures:
            c = figures["compositions"]
            print(
                f"pieces of compositions, 5-NN among single tasks: {c['accuracy']:.3f} of {c['n']} vote for one of "
                f"theirs; chance {c['chance']:.3f}, untrained encoder {c['untrained']:.3f}, PCA-16 {c['pca']:.3f}"
            )
        if confusion:
            draw_confusion(figures, data, confusion)


def unequal(trained: list[dict]) -> bool:
    """More than 5 % apart in a number."""
    columns = ([t[k] for t in trained] for k in ("parameters", "steps", "replays"))
    return any(max(values) > 1.05 * min(values) for values in columns)


def draw_confusion(figures: dict, data: Path, out: Path) -> None:
    from intabs.data.reader import DemoFile
    from intabs.evaluate.knn import picture

    if "knn" not in figures:
        raise UserError(f"{data}: has no labels; --confusion needs them")
    with DemoFile(data) as f:
        names = name_list(f.attrs.get("label_names"))
    out.parent.mkdir(parents=True, exist_ok=True)
    picture(figures["knn"], names, out)
