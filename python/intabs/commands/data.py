"""`intabs data`: what files of demonstrations hold, what is wrong with them, others' made ours, many made one."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import Progress, write_json

JsonOption = Annotated[Path | None, typer.Option("--json", help="Write the figures there.")]
FileArgument = Annotated[Path, typer.Argument(help="Demonstrations, HDF5.", show_default=False)]
OutOption = Annotated[Path | None, typer.Option("--out", "-o", help="File to write; without it the file itself.")]
SHOWN = 20  # faults of a kind on the terminal


def find_faults(file: Path) -> list[dict]:
    """[{demo, kind, where}], in the order of the file."""
    from intabs.data import check

    with Progress("check", total=1) as bar:
        return check.find_faults(file, _counting(bar))


def inspect(file: Path) -> dict:
    from intabs.data import reader

    return reader.inspect(file)


def register(app: typer.Typer) -> None:
    data = typer.Typer(help="Look into, check, import and edit files of demonstrations.")
    app.add_typer(data, name="data")

    @data.callback()
    def _output() -> None:
        # Names in a damaged file may be no text.
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")

    @data.command()
    def info(file: FileArgument, json: JsonOption = None) -> None:
        """What a file holds."""
        figures = inspect(file)
        write_json(json, figures)
        _tell(figures)

    @data.command()
    def check(file: FileArgument, json: JsonOption = None) -> None:
        """Look for faults: fields that are missing or of the wrong shape or length, numbers that are not finite, time
        that goes back, frames twice, jumps, quaternions that are none or in the wrong order, a rate that is not what
        it says, a gripper that never moves, objects never seen, units. Exit 0 only if there are none."""
        faults = find_faults(file)
        write_json(json, {"faults": faults})
        shown: dict[str, int] = {}
        for fault in faults:
            shown[fault["kind"]] = shown.get(fault["kind"], 0) + 1
            if shown[fault["kind"]] <= SHOWN:
                print(f"{fault['demo']}: {fault['kind']} ({fault['where']})")
        for kind, n in shown.items():
            if n > SHOWN:
                print(f"... and {n - SHOWN} more of kind {kind} (all of them: --json FILE)")
        if faults:
            raise UserError(f"{file} has {len(faults)} fault{'s' if len(faults) > 1 else ''}")
        print(f"{file}: no faults")

    @data.command()
    def view(
        file: FileArgument,
        out: Annotated[
            Path | None, typer.Option("--out", "-o", help="Page (.html) or picture strip (.png); default FILE.html.")
        ] = None,
        demo: Annotated[list[int] | None, typer.Option(help="Number of a demonstration; may be repeated.")] = None,
        most: Annotated[int, typer.Option(min=1, help="At most so many demonstrations.")] = 10,
        rerun: Annotated[bool, typer.Option("--rerun", help="Open in rerun instead (-o FILE.rrd: for later).")] = False,
        viser: Annotated[bool, typer.Option("--viser", help="Serve one demonstration to a browser instead.")] = False,
    ) -> None:
        """Demonstrations to look at: trajectories, labels, pictures where there are any."""
        from intabs.data import view as views

        chosen = _chosen(file, demo, most)
        if viser:
            views.to_viser(file, chosen[0], _until_interrupted)
            return
        if rerun:
            views.to_rerun(file, chosen, out)
            return
        target = out or file.with_suffix(".html")
        if target.suffix == ".png":
            image = views.strip(file, chosen[0])
            _written(target, lambda p: image.save(p, "PNG"))
        elif target.suffix in (".html", ".htm"):
            text = views.page(file, chosen)
            _written(target, lambda p: p.write_text(text, encoding="utf-8", errors="replace"))
        else:
            raise UserError(f"{target}: a page ends in .html, a strip in .png")
        print(f"{target}: {len(chosen) if target.suffix != '.png' else 1} demonstrations")

    @data.command(name="import")
    def import_(
        kind: Annotated[str, typer.Argument(help="robosuite, robomimic, roboturk, kitchen, lerobot, lite6-csv, npz.")],
        source: Annotated[Path, typer.Argument(help="File or folder.", show_default=False)],
        out: Annotated[Path, typer.Argument(help="File to write.", show_default=False)],
        agent: Annotated[str | None, typer.Option(help="npz: name of the agent's array.")] = None,
        object: Annotated[str | None, typer.Option(help="npz: name of the objects' array.")] = None,
        time_key: Annotated[str, typer.Option("--time", help="npz: name of the array of times.")] = "time",
        rate: Annotated[float | None, typer.Option(min=0.1, max=10000, help="Resample to this rate [Hz].")] = None,
        source_rate: Annotated[
            float | None, typer.Option(min=0.1, max=10000, help="Rate of the files, where they do not say it [Hz].")
        ] = None,
        units: Annotated[str, typer.Option(help="Of the joints, where files do not say it: rad, deg, none.")] = "rad",
        quat: Annotated[str, typer.Option(help="npz: order of quaternions, wxyz or xyzw.")] = "wxyz",
        json: JsonOption = None,
    ) -> None:
        """Other people's demonstrations in our format. Says units, frames, quaternions and rate, and checks them."""
        from intabs.data import importers

        for name, value, known in (("--units", units, ("rad", "deg", "none")), ("--quat", quat, ("wxyz", "xyzw"))):
            if value not in known:
                raise UserError(f"{name} {value}: known are {', '.join(known)}")
        options = importers.Options(
            rate_hz=rate, source_rate_hz=source_rate, units=units, quaternion=quat,
            agent=agent, object=object, time=time_key,
        )  # fmt: skip
        with Progress("import", total=1) as bar:
            figures = importers.import_demos(kind, source, out, options, _counting(bar))
        write_json(json, figures)
        _tell(figures)

    @data.command()
    def merge(
        files: Annotated[list[Path], typer.Argument(help="Two files or more.", show_default=False)],
        out: Annotated[Path, typer.Option("--out", "-o", help="File to write.", show_default=False)],
        json: JsonOption = None,
    ) -> None:
        """Several files in one. Demonstrations are numbered anew; those held out stay held out."""
        from intabs.data import edit as edits

        with Progress("merge", total=1) as bar:
            edits.merge(files, out, _counting(bar))
        figures = inspect(out)
        write_json(json, figures)
        print(f"{out}: {figures['demos']} demonstrations, {figures['frames']} frames")

    @data.command()
    def split(
        file: FileArgument,
        out: OutOption = None,
        valid: Annotated[float, typer.Option(min=0, max=1, help="Share to hold out, of every task.")] = 0.1,
        seed: Annotated[int, typer.Option(min=0)] = 0,
        apart: Annotated[bool, typer.Option("--apart", help="Two files, OUT_train and OUT_valid, instead.")] = False,
        by: Annotated[str, typer.Option(help="Attribute whose values are held out whole, e.g. object_names.")] = "",
        json: JsonOption = None,
    ) -> None:
        """Hold out demonstrations anew (masks train and valid)."""
        from intabs.data import edit as edits

        with Progress("split", total=1) as bar:
            figures = edits.split(file, out or file, valid, seed, apart, by, _counting(bar))
        write_json(json, figures)
        print(", ".join(f"{mask}: {n}" for mask, n in figures.items()))

    @data.command()
    def pieces(
        file: FileArgument,
        out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
        frames: Annotated[int, typer.Option(min=4, help="About how long a piece is.")],
        json: JsonOption = None,
    ) -> None:
        """Cut demonstrations into pieces, each a demonstration: to hold out (split) by piece of a handful."""
        from intabs.data import edit as edits

        if out.resolve() == file.resolve():
            raise UserError(f"--out {out}: write another file; the whole demonstrations would be lost")
        with Progress("pieces", total=1) as bar:
            count = edits.into_pieces(file, out, frames, _counting(bar))
        write_json(json, {"pieces": count})
        print(f"{out}: {count} pieces")

    @data.command()
    def edit(
        file: FileArgument,
        out: OutOption = None,
        drop: Annotated[
            list[str] | None, typer.Option(help="Demonstrations to leave out: numbers or names, 3,7-9 or demo_3.")
        ] = None,
        cut: Annotated[
            list[str] | None, typer.Option(help="Frames to keep of one: 4:10:200, 4::200 or 4:10: (may be repeated).")
        ] = None,
        json: JsonOption = None,
    ) -> None:
        """Drop or cut demonstrations. The rest keep their names."""
        from intabs.data import edit as edits
        from intabs.data.reader import DemoFile

        if not drop and not cut:
            raise UserError("nothing to do: give --drop or --cut")
        with DemoFile(file) as f:
            cuts = dict(_cut(text, f) for text in cut or [])
        with Progress("edit", total=1) as bar:
            figures = edits.edit(file, out or file, _names(drop or []), cuts, _counting(bar))
        write_json(json, figures)
        print(f"{out or file}: {figures['demos']} left, {figures['dropped']} dropped, {figures['cut']} cut")


def _tell(figures: dict) -> None:
    for key in ("demos", "frames", "rate_hz", "embodiment", "layout"):
        print(f"{key:<12}{figures[key]}")
    agent = figures["agent"]
    print(f"{'agent':<12}{' + '.join(agent['fields'])}: {agent['width']} numbers")
    print(f"{'objects':<12}{figures['object_slots']}")
    tasks = sorted(figures["tasks"].items(), key=lambda x: -x[1])
    for task, n in tasks[:SHOWN]:
        print(f"{'task':<12}{task}: {n}")
    if len(tasks) > SHOWN:
        print(f"{'':<12}... and {len(tasks) - SHOWN} more tasks")
    for name, shape in figures["state"].items():
        print(f"{'state':<12}{name} {shape}")


def _counting(bar: Progress):
    """Moves the bar; says nothing about what is done in two seconds."""
    start = time.monotonic()

    def update(done: int, total: int) -> None:
        if time.monotonic() - start > 2:
            bar.update(done / max(total, 1), f"{done} of {total}")

    return update


def _chosen(file: Path, demo: list[int] | None, most: int) -> list[int]:
    """Indices into the file of the demonstrations of these numbers, or of some over the whole file."""
    from intabs.data.reader import DemoFile

    with DemoFile(file) as f:
        number = {n: k for k, n in enumerate(f.names)}
        for n in demo or []:
            if f"demo_{n}" not in number:
                raise UserError(f"{file}: has no demo_{n}; it holds {f.names[0]} to {f.names[-1]}")
        if demo:
            return [number[f"demo_{n}"] for n in demo]
        step = max(1, -(-len(f) // most))
        return list(range(0, len(f), step))


def _names(texts: list[str]) -> list[str]:
    """3,7-9 and demo_3 -> names."""
    out = []
    for part in (p.strip() for text in texts for p in text.split(",")):
        first, _, last = part.removeprefix("demo_").partition("-")
        last = last.removeprefix("demo_") or first
        if not (first.isascii() and first.isdecimal() and last.isascii() and last.isdecimal()):
            raise UserError(f"--drop {part}: not a number, a range or a name (3,7-9, demo_3)")
        if int(last) - int(first) > 10_000_000:
            raise UserError(f"--drop {part}: too many")
        out += [f"demo_{n}" for n in range(int(first), int(last) + 1)]
    return out


def _cut(text: str, f) -> tuple[str, tuple[int, int]]:
    parts = text.split(":")
    if len(parts) != 3 or not all(p == "" or (p.isascii() and p.isdecimal()) for p in parts[1:]):
        raise UserError(f"--cut {text}: not DEMO:FROM:TO (4:10:200 keeps frames 10 to 199 of demo_4)")
    name = _names([parts[0]])[0]
    if name not in f.names:
        raise UserError(f"--cut {text}: the file has no {name}")
    stop = int(f.lengths[f.names.index(name)])
    return name, (int(parts[1] or 0), int(parts[2] or stop))


def _written(path: Path, write) -> None:
    """Beside the target, then renamed."""
    partial = path.with_name(path.name + ".partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        write(partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _until_interrupted() -> None:
    print("Ctrl-C ends it")
    try:
        while True:
            time.sleep(1)
    except KeyboardInterrupt:
        return
