"""Files made of files: merged, held out anew, demonstrations dropped or cut. Every one writes beside its target and
renames; the sources stay as they are unless they are the target."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from intabs.data.demos import PACKED_ABOVE, Demo, DemoWriter, name_list, stored
from intabs.data.reader import FILE_ONLY, DemoFile, check_size, reading
from intabs.errors import UserError

Progress = Callable[[int, int], None]
# What must agree between files to be one.
ONE_KIND = ("embodiment", "joint_units")


def _quiet(done: int, total: int) -> None:
    pass


def cut(demo: Demo, start: int, stop: int) -> Demo:
    """Frames start..stop; time begins at 0 again."""
    piece = slice(start, stop)
    time = demo.time[piece]

    def part(x):
        return None if x is None else x[piece]

    return replace(
        demo,
        time=time - time[0],
        joint_pos=part(demo.joint_pos),
        joint_vel=part(demo.joint_vel),
        gripper=part(demo.gripper),
        object_pose=demo.object_pose[piece],
        object_valid=demo.object_valid[piece],
        actions=demo.actions[piece],
        obs={n: v[piece] for n, v in demo.obs.items()},
        extra={n: v[piece] for n, v in demo.extra.items()},
    )


def _own(source: DemoFile, k: int) -> Demo:
    """Without the attributes that the file says for all."""
    demo = source.demo(k)
    demo.attrs = source.own_attrs(k)
    return demo


def _copy(source: DemoFile, k: int, writer: DemoWriter, name: str, more: dict) -> None:
    """One demonstration as it is, with `more` attributes where it has none of that name."""
    if source.packed or writer.packed:
        demo = _own(source, k)
        demo.attrs = more | demo.attrs
        writer.add(demo, name)
        return
    # Array by array: HDF5's own copying of groups crashes on some damaged files, reading does not.
    with reading(source.path):
        group = writer.file["data"].create_group(name)
        group.create_group("obs")
        for field, dataset in source.datasets(k).items():
            check_size(dataset)
            how = {"compression": "gzip", "shuffle": True} if dataset.ndim > 1 and dataset.size else {}
            group.create_dataset(field, data=dataset[...], dtype=dataset.dtype, **how)
        for key, value in (more | source.own_attrs(k)).items():
            group.attrs[key] = stored(value)
        writer.copied(name, source.length(k))


def merge(files: list[Path], out: Path, progress: Progress = _quiet) -> None:
    """Demonstrations are numbered anew; those held out stay held out."""
    if len(files) < 2:
        raise UserError("merge wants two files or more")
    sources: list[DemoFile] = []
    try:
        for path in files:
            sources.append(DemoFile(path))
        _merge(sources, out, progress)
    finally:
        for s in sources:
            s.close()


def _merge(sources: list[DemoFile], out: Path, progress: Progress) -> None:
    first = sources[0]
    attrs = [{k: v for k, v in s.attrs.items() if k not in FILE_ONLY} for s in sources]
    for s in sources[1:]:
        with reading(s.path):
            a, b = first.demo_attrs(0), s.demo_attrs(0)
            for key in ONE_KIND:
                if a.get(key) != b.get(key):
                    raise UserError(f"{s.path}: {key} is {b.get(key)}, that of {first.path} {a.get(key)}")
            if s.agent_fields != first.agent_fields:
                raise UserError(f"{s.path}: the agent is {s.agent_fields}, that of {first.path} {first.agent_fields}")
            ra, rb = (float(x.get("rate_hz", x.get("rate", 0)) or 0) for x in (a, b))
            if abs(ra - rb) > 0.03 * max(ra, rb):
                raise UserError(
                    f"{s.path}: {rb:g} Hz, {first.path} {ra:g} Hz: bring them to one rate (data import --rate)"
                )
            for name in (f"obs/{n}" for n in first.agent_fields):
                wa, wb = (x.datasets(0).get(name) for x in (first, s))
                if wa is None or wb is None or wa.shape[1:] != wb.shape[1:]:
                    raise UserError(f"{s.path}: {name} is not as in {first.path}")
    common = {k: v for k, v in attrs[0].items() if all(a.get(k) == v for a in attrs)}
    labels = [name_list(a.get("label_names")) for a in attrs]
    names = list(dict.fromkeys(n for x in labels for n in x))
    relabel = names and any(x and x != names for x in labels)
    if names:
        common["label_names"] = names
    common.setdefault("task", "all")
    total = sum(len(s) for s in sources)
    masks: dict[str, list[str]] = {}
    with DemoWriter(out, common, packed=total > PACKED_ABOVE) as writer:
        for s, own, mine in zip(sources, attrs, labels, strict=True):
            more = {k: v for k, v in own.items() if k not in common or (k == "task" and v != common["task"])}
            more.pop("label_names", None)
            masked = s.masks()
            new = {}
            for k, name in enumerate(s.names):
                new[name] = f"demo_{len(writer.names)}"
                if relabel and mine:
                    demo = _own(s, k)
                    if "labels" in demo.extra:
                        table = np.array([names.index(n) for n in mine])
                        if demo.extra["labels"].max(initial=0) >= len(table):
                            raise UserError(f"{s.path}: {name} has labels without a name")
                        demo.extra["labels"] = table[demo.extra["labels"]].astype("u1")
                    demo.attrs = more | demo.attrs
                    writer.add(demo, new[name])
                else:
                    _copy(s, k, writer, new[name], more)
                progress(len(writer.names), total)
            if not masked:
                masked = {"train": s.names}
            for mask, members in masked.items():
                masks.setdefault(mask, []).extend(new[n] for n in members if n in new)
        writer.masks = {"train": [], "valid": []} | masks


def _rewrite(source: DemoFile, out: Path, keep: Iterable[int], cuts: dict[int, tuple[int, int]],
             masks: dict[str, list[str]], progress: Progress) -> None:  # fmt: skip
    keep = list(keep)
    attrs = {k: v for k, v in source.attrs.items() if k not in FILE_ONLY}
    with DemoWriter(out, attrs, packed=len(keep) > PACKED_ABOVE) as writer:
        for i, k in enumerate(keep):
            if k in cuts:
                writer.add(cut(_own(source, k), *cuts[k]), source.names[k])
            else:
                _copy(source, k, writer, source.names[k], {})
            progress(i + 1, len(keep))
        left = set(writer.names)
        writer.masks = {m: [n for n in names if n in left] for m, names in masks.items()}


def edit(path: Path, out: Path, drop: list[str], cuts: dict[str, tuple[int, int]], progress: Progress = _quiet) -> dict:
    """Demonstrations keep their names. cuts: name -> frames to keep."""
    with DemoFile(path) as f:
        number = {n: k for k, n in enumerate(f.names)}
        for name in [*drop, *cuts]:
            if name not in number:
                raise UserError(f"{path}: has no {name}; it holds {f.names[0]} to {f.names[-1]}")
        for name, (start, stop) in cuts.items():
            length = int(f.lengths[number[name]])
            if not 0 <= start < stop <= length or stop - start < 2:
                raise UserError(f"{path}: {name} has {length} frames: cannot keep {start}:{stop}")
        if set(drop) >= set(f.names):
            raise UserError(f"{path}: nothing would be left")
        keep = [k for k, n in enumerate(f.names) if n not in set(drop)]
        _rewrite(f, out, keep, {number[n]: c for n, c in cuts.items()}, f.masks(), progress)
        return {"demos": len(keep), "dropped": len(set(drop)), "cut": len(cuts)}


def hold_out(names: list[str], tasks: list[str], share: float, seed: int) -> dict[str, list[str]]:
    """Masks train and valid: whole demonstrations, `share` of every task by chance."""
    rng = np.random.default_rng(seed)
    held: set[int] = set()
    for task in sorted(set(tasks)):
        members = np.array([k for k, t in enumerate(tasks) if t == task])
        n = int(round(share * len(members)))
        if share > 0 and len(members) > 1:
            n = min(max(n, 1), len(members) - 1)
        held.update(rng.permutation(members)[:n].tolist())
    return {
        "train": [n for k, n in enumerate(names) if k not in held],
        "valid": [n for k, n in enumerate(names) if k in held],
    }


def hold_out_groups(names: list[str], groups: list[str], share: float, seed: int) -> dict[str, list[str]]:
    """Masks train and valid: whole groups by chance, until `share` of the demonstrations are held out."""
    order = np.random.default_rng(seed).permutation(sorted(set(groups)))
    held: set[str] = set()
    for group in order[:-1]:  # one stays
        if sum(g in held for g in groups) >= round(share * len(names)):
            break
        held.add(str(group))
    return {
        "train": [n for n, g in zip(names, groups, strict=True) if g not in held],
        "valid": [n for n, g in zip(names, groups, strict=True) if g in held],
    }


def into_pieces(path: Path, out: Path, frames: int, progress: Progress = _quiet) -> int:
    """Every demonstration cut into pieces of about so many frames, each a demonstration that knows what it is a
    `piece_of`: to hold out by piece where there is but a handful. What was held out stays so. Returns their number."""
    with DemoFile(path) as f:
        counts = [max(1, round(n / frames)) for n in f.lengths]
        attrs = {k: v for k, v in f.attrs.items() if k not in FILE_ONLY}
        with DemoWriter(out, attrs, packed=sum(counts) > PACKED_ABOVE) as writer:
            for k, count in enumerate(counts):
                demo = _own(f, k)
                edges = np.linspace(0, f.lengths[k], count + 1).round().astype(int)
                for a, b in zip(edges[:-1], edges[1:], strict=True):
                    piece = cut(demo, a, b)
                    piece.attrs = demo.attrs | {"piece_of": f.names[k], "first_frame": int(a)}
                    writer.add(piece, f"demo_{len(writer.names)}")
                progress(k + 1, len(counts))
            of = np.repeat(f.names, counts)
            masks = f.masks() or {"train": f.names, "valid": []}
            writer.masks = {
                m: [n for n, x in zip(writer.names, of, strict=True) if x in set(names)] for m, names in masks.items()
            }
    return sum(counts)


def split(
    path: Path, out: Path, share: float, seed: int, apart: bool, by: str = "", progress: Progress = _quiet
) -> dict:
    """Masks anew. apart: two files, <out>_train and <out>_valid, instead. by: an attribute of the demonstrations; those
    that share its value are held out together."""
    with DemoFile(path) as f:
        if by:
            attrs = [f.demo_attrs(k) for k in range(len(f))]
            if missing := [n for n, a in zip(f.names, attrs, strict=True) if by not in a]:
                raise UserError(f"{path}: {missing[0]} has no attribute {by!r} (--by); it has {', '.join(attrs[0])}")
            masks = hold_out_groups(f.names, [str(a[by]) for a in attrs], share, seed)
        else:
            masks = hold_out(f.names, f.tasks, share, seed)
        if not apart:
            others = {m: n for m, n in f.masks().items() if m not in masks}
            _rewrite(f, out, range(len(f)), {}, others | masks, progress)
            return {m: len(n) for m, n in masks.items()}
        for mask, names in masks.items():
            chosen = set(names)
            if not chosen:
                raise UserError(f"{path}: {len(f)} demonstrations, none of them for {mask}")
            target = out.with_name(f"{out.stem}_{mask}{out.suffix}")
            keep = [k for k, n in enumerate(f.names) if n in chosen]
            _rewrite(f, target, keep, {}, {mask: names}, progress)
        return {m: len(n) for m, n in masks.items()}
