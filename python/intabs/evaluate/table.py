"""One table: data sets by methods, ours beside the thesis' numbers. `tools/table`.

Trains what is not there yet, each seed of each method into its folder, and goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from intabs import paths
from intabs.data import edit, importers
from intabs.data.reader import DemoFile
from intabs.errors import UserError
from intabs.evaluate.evaluate import evaluate, with_interval
from intabs.output import Progress, write_json

CONFIGS = {"intabs": "intabs-small", "tvi": "tvi", "tvi-agent": "tvi-agent"}
# State reconstruction error in the thesis, on the authors' data and on training data: H-DMP, TVI, IntAbs.
THESIS = {
    "lite6": ("its RealWorld set", 1.12, 0.09, 0.04),
    "roboturk": ("RoboTurk", 3.48, 0.72, 0.62),
    "robomimic": ("RoboMimic", 2.09, 0.84, 0.58),
    "kitchen": ("FrankaKitchen", 1.85, 0.53, 0.32),
}
FOREIGN = ("robosuite", "robomimic", "roboturk", "kitchen")  # of importers.KINDS those that hold objects and say which
HANDFUL = 20  # of fewer imported demonstrations pieces are held out, of more whole ones
PIECE, PIECES_HELD_OUT, HELD_OUT = 30, 0.25, 0.1  # frames of a piece; shares


def check_same(config: str, data: Path, run: Path, settings: list[str]) -> None:
    """Raises UserError where a run that is there came from other settings or data."""
    from intabs.train.trainer import file_hash, load_checkpoint, load_config, sizes_of

    there, want = load_checkpoint(run), load_config(config, settings)
    if want["model"]["latent"] == [0, 0]:
        want["model"]["latent"] = sizes_of(there)
    what = "data" if there["data"]["sha256"] != file_hash(data) else "settings" if there["config"] != want else ""
    if what:
        raise UserError(f"{run}: was trained with other {what}; name another --runs, or remove it")


def train(config: str, data: Path, run: Path, seed: int, settings: list[str]) -> None:
    if (run / "checkpoint.pt").exists():
        check_same(config, data, run, settings)
    if (run / "result.json").exists():
        return
    command = [sys.executable, "-m", "intabs.cli", "train", "--config", config, "--data", str(data), "--out", str(run)]
    command += ["--seed", str(seed), *(x for s in settings for x in ("--set", s))]
    if (run / "checkpoint.pt").exists():
        command.append("--resume")
    print(f"{run}: training {config}, seed {seed}", flush=True)
    if subprocess.run(command).returncode != 0 or not (run / "result.json").exists():
        raise UserError(f"{run}: training failed, see above")


def imported(kind: str, source: Path, rate: float | None, out: Path, progress) -> Path:
    """Other people's files as ours, some held out anew; a file that is there already is taken."""
    if out.exists():
        return out
    out.parent.mkdir(parents=True, exist_ok=True)
    raw, split = (out.with_name(f"{out.stem}.{what}.hdf5") for what in ("raw", "split"))
    options = importers.Options(say=lambda text: print(f"{source}: {text}", flush=True), rate_hz=rate)
    few = importers.import_demos(kind, source, raw, options, lambda k, n: progress(k, kind))["demos"] < HANDFUL
    if few:
        edit.into_pieces(raw, split, PIECE)
    edit.split(split if few else raw, split, PIECES_HELD_OUT if few else HELD_OUT, seed=0, apart=False)
    raw.unlink()
    return split.rename(out)


def about(path: Path) -> dict:
    """How much there is, in words, and of how many demonstrations."""
    with DemoFile(path) as f:
        n, held_out = len(f), len(f.masks().get("valid", []))
        of = len({f.demo_attrs(k)["piece_of"] for k in range(n)}) if n and "piece_of" in f.demo_attrs(0) else n
    what = f"{n} demonstrations" if of == n else f"{n} pieces of {of} demonstration{'s' * (of > 1)}"
    return {"about": f"{what}, {held_out} held out", "demonstrations": of}


def rows(name: str, data: Path, runs: Path, seeds: int, settings: list[str], progress) -> dict:
    sources = []
    for config in CONFIGS.values():
        for seed in range(seeds):
            run = runs / name / f"{config}-{seed}"
            train(config, data, run, seed, settings)
            sources.append(run)
    out = {unit: evaluate(sources, data, None, unit, progress=progress) for unit in ("segment", "whole")}
    return {"data": str(data), **about(data), **out}


def both(f: dict, group: str) -> str:
    """Of objects in the world, and where it is known seen from the gripper."""
    return f"{f[group]:.4f}" + (f" ({f[g]:.4f})" if (g := f"{group}_from_tip") in f else "")


def text(results: dict) -> str:
    lines = []
    for name, r in results.items():
        seeds = r["segment"]["seeds"]
        lines += [
            f"## {name}: {r['about']}, {seeds} seed{'s' * (seeds > 1)}",
            "| | segment all | balanced | joints | position (from the tip) | orientation (from the tip) | whole all |",
            "|---|---|---|---|---|---|---|",
        ]
        for method, f in r["segment"]["methods"].items():
            whole = r["whole"]["methods"][method]
            sd = f" ± {f['sd']:.4f}" if f["sd"] else ""
            lines.append(
                f"| {method} | {f['all']:.4f}{sd} | {f['balanced']:.4f} | {f['joints']:.4f} | {both(f, 'position')} | "
                f"{both(f, 'orientation')} | {whole['all']:.3f} |"
            )
        for other, k in r["segment"]["ratios"].items():
            said = ", ".join(f"{n} {with_interval(k[n])}" for n in ("all", "balanced", "position", "orientation"))
            lines.append(f"- intabs / {other}, segment: {said}")
        if name in THESIS:
            what, hdmp, tvi, ours = THESIS[name]
            lines.append(
                f"- The thesis on {what} (its own full data, training data): H-DMP {hdmp}, TVI {tvi}, IntAbs {ours}. "
                f"This table rests on {r['about']}."
            )
        if r["demonstrations"] < HANDFUL:
            lines.append("- A handful of demonstrations, not a full set.")
        if "knn" in r["segment"]:
            k = r["segment"]["knn"]
            others = f"majority {k['majority']:.3f}, untrained {k['untrained']:.3f}, PCA {k['pca']:.3f}"
            line = f"- 5-NN {k['accuracy']:.3f} ({others})"
            if b := r["segment"].get("boundaries"):
                others = f"fixed cut {b['fixed_cut_f1']:.3f}, mean times {b['mean_time_f1']:.3f}"
                line += f"; boundaries F1 {b['f1']:.3f} ({others})"
            lines.append(line)
        if "compositions" in r["segment"]:
            c = r["segment"]["compositions"]
            lines.append(
                f"- Pieces of compositions, 5-NN among single tasks: {c['accuracy']:.3f} (chance {c['chance']:.3f}, "
                f"untrained {c['untrained']:.3f}, PCA {c['pca']:.3f})"
            )
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="tools/table", description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--data", action="append", metavar="NAME=FILE",
        help="demonstrations, HDF5 of ours; or NAME=KIND:SOURCE, other people's files, imported first (KIND: "
        + ", ".join(FOREIGN) + f"; of fewer than {HANDFUL} demonstrations pieces are held out). "
        "Again for more. Names known to the thesis: " + ", ".join(THESIS) + ". Without it: the shipped sets",
    )  # fmt: skip
    parser.add_argument("--rate", type=float, help="resample what is imported to this rate [Hz]")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", type=Path, default=Path("runs/table"), help="where trainings are kept")
    parser.add_argument("--set", action="append", default=[], help="a setting of the trainings, e.g. train.steps=1000")
    parser.add_argument("--json", type=Path, help="write the figures there")
    o = parser.parse_args()
    shipped = [f"{n}={paths.MODELS / 'demos' / n}.hdf5" for n in ("lite6", "human")]
    try:
        results = {}
        for item in o.data or shipped:
            name, sep, file = item.partition("=")
            kind, colon, source = file.partition(":")
            foreign = bool(colon) and kind in FOREIGN
            if not sep or not Path(source if foreign else file).expanduser().exists():
                raise UserError(
                    f"--data {item}: write NAME=FILE.hdf5, a file that is there, or NAME=KIND:SOURCE (kinds: "
                    f"{', '.join(FOREIGN)})"
                )
            with Progress(name, total=0) as progress:
                data = Path(file)
                if foreign:
                    out = o.runs / (f"{name}.hdf5" if o.rate is None else f"{name}-{o.rate:g}Hz.hdf5")
                    data = imported(kind, Path(source).expanduser(), o.rate, out, progress.update)
                results[name] = rows(name, data, o.runs, o.seeds, o.set, progress.update)
    except UserError as e:
        raise SystemExit(f"{parser.prog}: {e}") from None
    write_json(o.json, results)
    print(text(results))


if __name__ == "__main__":
    main()
