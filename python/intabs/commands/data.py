"""`intabs data`: what a file of demonstrations holds, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from intabs.errors import UserError
from intabs.output import write_json

JsonOption = Annotated[Path | None, typer.Option("--json", help="Write the figures there.")]
FileArgument = Annotated[Path, typer.Argument(help="Demonstrations, HDF5.", show_default=False)]


def register(app: typer.Typer) -> None:
    data = typer.Typer(help="Look into files of demonstrations.")
    app.add_typer(data, name="data")

    @data.command()
    def info(file: FileArgument, json: JsonOption = None) -> None:
        """What a file holds."""
        figures = inspect(file)
        write_json(json, figures)
        for key in ("demos", "frames", "rate_hz", "embodiment"):
            print(f"{key:<12}{figures[key]}")
        for task, n in figures["tasks"].items():
            print(f"{'task':<12}{task}: {n}")
        for name, shape in figures["state"].items():
            print(f"{'state':<12}{name} {shape}")

    @data.command()
    def check(file: FileArgument, json: JsonOption = None) -> None:
        """Look for faults: fields that are missing or of the wrong length, numbers that are not finite, time that does
        not advance, quaternions that are none. Exit 0 only if there are none."""
        faults = find_faults(file)
        write_json(json, {"faults": faults})
        for fault in faults:
            print(f"{fault['demo']}: {fault['kind']} ({fault['where']})")
        if faults:
            raise UserError(f"{file} has {len(faults)} fault{'s' if len(faults) > 1 else ''}")
        print(f"{file}: no faults")


def _open(file: Path):
    import h5py

    if not file.is_file():
        raise UserError(f"{file}: no such file")
    try:
        f = h5py.File(file, "r")
    except OSError as e:
        raise UserError(f"{file}: not an HDF5 file, or cut off ({e})") from None
    if not _demos(f):
        f.close()
        raise UserError(f"{file}: holds no demonstration (no group data/demo_*)")
    return f


def _demos(f) -> dict:
    """Name -> group, in the order of their numbers."""
    import h5py

    data = f.get("data")
    if not isinstance(data, h5py.Group):
        return {}
    names = [n for n in data if n.startswith("demo_") and n[5:].isdigit() and isinstance(data[n], h5py.Group)]
    return {n: data[n] for n in sorted(names, key=lambda n: int(n[5:]))}


def inspect(file: Path) -> dict:
    with _open(file) as f:
        demos = _demos(f)
        attrs = f["data"].attrs
        first = next(iter(demos.values()))
        tasks = Counter(str(g.attrs.get("task", attrs.get("task", "unknown"))) for g in demos.values())
        rate = attrs.get("rate_hz", attrs.get("rate"))
        return {
            "demos": len(demos),
            "frames": sum(_length(g) for g in demos.values()),
            "rate_hz": None if rate is None else float(rate),
            "embodiment": str(attrs.get("embodiment", "unknown")),
            "state": {n: list(d.shape[1:]) for n, d in first.get("obs", {}).items() if hasattr(d, "shape")},
            "tasks": dict(tasks),
        }


def _length(demo) -> int:
    if "actions" in demo:
        return len(demo["actions"])
    return max((len(d) for d in demo.get("obs", {}).values() if getattr(d, "shape", ())), default=0)


def find_faults(file: Path) -> list[dict]:
    """[{demo, kind, where}], in the order of the file."""
    import numpy as np

    faults = []
    with _open(file) as f:
        demos = _demos(f)
        for name, group in demos.items():

            def fault(kind: str, where: str, name: str = name) -> None:
                faults.append({"demo": name, "kind": kind, "where": where})

            for part in ("obs", "actions"):
                if part not in group:
                    fault("missing", part)
            length = _length(group)
            if length < 2:
                fault("too short", f"{length} frames")
            fields = {f"obs/{n}": d for n, d in group.get("obs", {}).items() if hasattr(d, "shape")}
            if "actions" in group:
                fields["actions"] = group["actions"]
            arrays = {}
            for where, dataset in fields.items():
                try:
                    arrays[where] = dataset[...]
                except OSError as e:
                    fault("unreadable", f"{where}: {e}")
            for where, array in arrays.items():
                if array.ndim == 0 or len(array) != length:
                    fault("length", f"{where} has {len(array) if array.ndim else 'one value'}, actions {length}")
                if array.dtype.kind == "f" and not np.isfinite(array).all():
                    row = int(np.argwhere(~np.isfinite(array))[0][0]) if array.ndim else 0
                    fault("not finite", f"{where}, frame {row}")
            clock = arrays.get("obs/time")
            if clock is not None and clock.ndim == 1 and (step := np.diff(clock)).size and not (step > 0).all():
                fault("time", f"does not advance after frame {int(np.argmax(~(step > 0)))}")
            for where, pose in arrays.items():
                if not (where.startswith("obs/object_") and where.endswith("_pose")):
                    continue
                if pose.ndim != 2 or pose.shape[1] != 7:
                    fault("shape", f"{where} is {pose.shape}, not (T, 7)")
                    continue
                valid = arrays.get(where.removesuffix("_pose") + "_valid")
                used = np.ones(len(pose), bool)
                if valid is not None and len(valid) == len(pose):
                    used = valid.reshape(len(valid), -1)[:, 0] > 0
                off = used & (np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1) > 1e-3)
                if off.any():
                    fault("quaternion", f"{where}, frame {int(np.argmax(off))}: norm is not 1")
        for mask in ("train", "valid"):
            for name in f[f"mask/{mask}"][...].tolist() if f"mask/{mask}" in f else []:
                name = name.decode() if isinstance(name, bytes) else str(name)
                if name not in demos:
                    faults.append({"demo": name, "kind": "missing", "where": f"named by mask/{mask}"})
    return faults
