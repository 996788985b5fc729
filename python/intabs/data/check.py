"""What is wrong with a file of demonstrations. Works on runs of demonstrations at a time, so that 100,000 of them take
minutes and bounded memory; README.md lists the kinds of fault and their limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from scipy.ndimage import median_filter

from intabs.data.demos import AGENT_FIELDS, agent_fields, name_list
from intabs.data.reader import BROKEN, MOST_BYTES, DemoFile, object_slots, reading
from intabs.errors import UserError

BLOCK_FRAMES = 65536

# Of an embodiment: field -> width (0: one number a frame without a column).
REQUIRED = {"lite6": {"robot_joint_pos": 6, "time": 0}, "human": {"hand_keypoints": 63, "time": 0}}
# Also required in files that say they are in our format.
REQUIRED_OF_OURS = {"lite6": {"robot_joint_vel": 6, "robot_gripper": 1}}
ACTIONS = {"lite6": 7}

RATE_TOLERANCE = 0.03
GAP = 0.5  # s and ten steps
NORM_TOLERANCE = 1e-3
GRIPPER_FRAMES = 20  # a shorter piece may well have no use for the gripper
# A jump: a step beyond what the neighbours and the accelerations of arms and hands explain.
LITE6_STEP, LITE6_ACCELERATION, LITE6_SPEED = 0.08, 60.0, 1.5 * np.pi  # rad, rad/s^2, rad/s: its joints do pi
JOINT_STEP, JOINT_ACCELERATION, JOINT_SPEED = 0.5, 150.0, 40.0  # others: fingers are quick
OBJECT_STEP, OBJECT_ACCELERATION, OBJECT_SPEED = 0.04, 30.0, 10.0  # m, m/s^2, m/s
TURN_STEP, TURN_ACCELERATION, TURN_SPEED = 0.5, 200.0, 60.0  # rad, rad/s^2, rad/s
KEYPOINT_STEP = 0.12  # m
NEIGHBOURS = 4.0
FAR = 20.0  # m: further away an object is given in mm


@dataclass
class Block:
    """Whole demonstrations with the same fields, one after the other."""

    name: list[str]
    attrs: list[dict]
    first: np.ndarray  # row of each demonstration's first frame
    count: np.ndarray
    field: dict[str, np.ndarray]  # (N, ...)

    def __post_init__(self) -> None:
        n = int(self.count.sum())
        self.demo = np.repeat(np.arange(len(self.name)), self.count)
        self.follows = np.ones(n, bool)  # rows with a frame before them
        self.follows[self.first[self.count > 0]] = False


@dataclass
class _Rest:
    """How objects lie when a demonstration begins, over the whole file: what gives a wrong order away."""

    demo: list[str] = field(default_factory=list)
    slot: list[int] = field(default_factory=list)
    q: list[np.ndarray] = field(default_factory=list)


def find_faults(path: Path | str, progress: Callable[[int, int], None] = lambda done, total: None) -> list[dict]:
    """[{demo, kind, where}], in the order of the file."""
    faults: list[dict] = []
    with DemoFile(path) as f:
        order = {n: k for k, n in enumerate(f.names)}

        def fault(demo: str, kind: str, where: str) -> None:
            faults.append({"demo": demo, "kind": kind, "where": where})

        with reading(path):
            _attributes(f, fault)
            _masks(f, order, fault)
        rest = _Rest()
        seen = 0
        for block in _blocks(f, fault):
            _time(block, fault)
            _finite(block, fault)
            _motion(block, fault)
            _gripper(block, fault)
            _objects(block, fault, rest)
            seen += len(block.name)
            progress(seen, len(f))
        _orders(rest, fault)
        progress(len(f), len(f))
    faults.sort(key=lambda x: order.get(x["demo"], len(order)))
    return faults


# ---- structure ---------------------------------------------------------------------------------------------------


def _attributes(f: DemoFile, fault) -> None:
    if f.packed or len(f) == 0:
        return _demo_attributes(f.names[0], f.demo_attrs(0), fault) if len(f) else None
    for k, name in enumerate(f.names):
        if isinstance(f.file["data"].get(name), h5py.Group):
            _demo_attributes(name, f.demo_attrs(k), fault)
    for name in f.file["data"]:
        if name not in set(f.names) and not name.startswith("demo_"):
            fault(name, "unknown", "data holds something else than demonstrations")


def _demo_attributes(name: str, attrs: dict, fault) -> None:
    embodiment = attrs.get("embodiment")
    if not isinstance(embodiment, str) or not embodiment:
        fault(name, "attribute", "embodiment is not said" if embodiment is None else "embodiment is no text")
    rate = attrs.get("rate_hz", attrs.get("rate"))
    if rate is None:
        fault(name, "attribute", "rate_hz is not said")
    elif isinstance(rate, (str, bool)) or not np.isscalar(rate) or not 0 < float(rate) < 1e5:
        fault(name, "attribute", f"rate_hz is {rate!r}: no rate")


def _masks(f: DemoFile, order: dict, fault) -> None:
    try:
        masks = f.masks()
    except UserError as e:
        fault("mask", "mask", str(e))
        return
    for mask, names in masks.items():
        for name in names:
            if name not in order:
                fault(name, "missing", f"named by mask/{mask}")
        for name, n in Counter(names).items():
            if n > 1:
                fault(name, "mask", f"{n} times in mask/{mask}")
    for name in set(masks.get("train", [])) & set(masks.get("valid", [])):
        fault(name, "mask", "both in mask/train and in mask/valid")


def _blocks(f: DemoFile, fault) -> Iterator[Block]:
    """Sound fields only; what is missing or misshapen is reported here."""
    if f.packed:
        yield from _packed_blocks(f, fault)
        return
    usual_of = _usual_fields(f)
    held: list[tuple[str, dict, int, dict]] = []
    frames = 0
    for k, name in enumerate(f.names):
        try:
            usual = usual_of.get(str(_safe_attrs(f, k).get("task", "")), set())
            found = _fields(f, k, usual, fault)
        except (UserError, *BROKEN) as e:
            fault(name, "unreadable", str(e) or type(e).__name__)
            continue
        if found is None:
            continue
        length, arrays, attrs = found
        if held and (_kind(arrays, attrs) != _kind(held[0][3], held[0][1]) or frames + length > BLOCK_FRAMES):
            yield _joined(held)
            held, frames = [], 0
        held.append((name, attrs, length, arrays))
        frames += length
    if held:
        yield _joined(held)


def _kind(arrays: dict[str, np.ndarray], attrs: dict) -> tuple:
    return (*sorted((n, a.shape[1:], a.dtype.str) for n, a in arrays.items()), str(attrs.get("embodiment")),
            str(attrs.get("agent_fields")), str(attrs.get("joint_units")))  # fmt: skip


def _joined(held: list) -> Block:
    names, attrs, lengths, arrays = (list(x) for x in zip(*held, strict=True))
    count = np.array(lengths)
    fields = {n: np.concatenate([a[n] for a in arrays]) if len(arrays) > 1 else arrays[0][n] for n in arrays[0]}
    return Block(names, attrs, np.cumsum(count) - count, count, fields)


def _packed_blocks(f: DemoFile, fault) -> Iterator[Block]:
    k = 0
    sound = None
    while k < len(f):
        stop = k + 1
        while stop < len(f) and f.offsets[stop] + f.lengths[stop] - f.offsets[k] <= BLOCK_FRAMES:
            stop += 1
        a, b = int(f.offsets[k]), int(f.offsets[stop - 1] + f.lengths[stop - 1])
        arrays = {}
        for name, dataset in f.datasets(0).items():
            if sound is not None and name not in sound:
                continue
            try:
                arrays[name] = dataset[a:b]
            except BROKEN as e:
                fault(f.names[k], "unreadable", f"{name}: {e}")
        attrs = [_safe_attrs(f, i) for i in range(k, stop)]
        if sound is None:  # the same fields for all: said once
            arrays = _sound(f, f.names[k], b - a, arrays, attrs[0], fault)
            sound = set(arrays)
        count = f.lengths[k:stop]
        for name, n in zip(f.names[k:stop], count, strict=True):
            if n < 2:
                fault(name, "too short", f"{n} frames")
        yield Block(f.names[k:stop], attrs, f.offsets[k:stop] - a, count, arrays)
        k = stop


def _safe_attrs(f: DemoFile, k: int) -> dict:
    try:
        return f.demo_attrs(k)
    except (UserError, *BROKEN):
        return {}


def _usual_fields(f: DemoFile) -> dict[str, set[str]]:
    """What more than half of a task's first demonstrations have."""
    count: dict[str, Counter[str]] = {}
    for k in range(min(len(f), 1000)):
        fields = count.setdefault(str(_safe_attrs(f, k).get("task", "")), Counter())
        if fields[""] < 50:
            try:
                group = f.group(k)
                obs = group.get("obs")
                fields.update([f"obs/{n}" for n in obs] if isinstance(obs, h5py.Group) else [])
                fields.update(["", *(n for n in group if n != "obs")])
            except (UserError, *BROKEN):  # said where it is read
                continue
    return {task: {n for n, c in fields.items() if n and 2 * c > fields[""]} for task, fields in count.items()}


def _fields(f: DemoFile, k: int, usual: set[str], fault) -> tuple[int, dict, dict] | None:
    name = f.names[k]
    group = f.group(k)
    attrs = _safe_attrs(f, k)
    obs = group.get("obs")
    if not isinstance(obs, h5py.Group):
        fault(name, "missing", "obs" if obs is None else "obs is no group")
    if not isinstance(group.get("actions"), h5py.Dataset):
        fault(name, "missing", "actions" if "actions" not in group else "actions is no array")
    datasets = f.datasets(k)
    arrays = {}
    for where, dataset in datasets.items():
        try:
            if dataset.size * dataset.dtype.itemsize > MOST_BYTES:
                raise ValueError(f"claims {dataset.size * dataset.dtype.itemsize:.3g} bytes")
            arrays[where] = dataset[...]
        except BROKEN as e:
            fault(name, "unreadable", f"{where}: {e}")
    if isinstance(obs, h5py.Group):
        for where in sorted(usual - datasets.keys() - {"actions"}):
            fault(name, "missing", f"{where}, which the other demonstrations have")
    actions = arrays.get("actions")
    sized = [len(a) for a in arrays.values() if getattr(a, "ndim", 0)]
    length = len(actions) if actions is not None and actions.ndim else max(sized, default=0)
    if length < 2:
        fault(name, "too short", f"{length} frames")
    stated = attrs.get("num_samples")
    if stated is not None and stated != length:
        fault(name, "length", f"num_samples says {stated}, actions have {length}")
    arrays = _sound(f, name, length, arrays, attrs, fault, usual)
    return (length, arrays, attrs) if length else None


def _sound(
    f: DemoFile, name: str, length: int, arrays: dict, attrs: dict, fault, usual: set[str] | None = None
) -> dict:
    """The arrays whose type, shape and length are right."""
    embodiment = str(attrs.get("embodiment"))
    required = {f"obs/{n}": w for n, w in REQUIRED.get(embodiment, {"time": 0}).items()}
    ours = {f"obs/{n}": w for n, w in REQUIRED_OF_OURS.get(embodiment, {}).items()}
    required |= {n: w for n, w in ours.items() if "format_version" in f.attrs or n in arrays}
    if embodiment not in REQUIRED:
        required |= {f"obs/{n}": -1 for n in agent_fields(attrs, [])}
    # Said already, as what the other demonstrations have.
    for where in required.keys() - arrays.keys() - (usual or set()):
        fault(name, "missing", where)
    for i in object_slots(arrays):
        if f"obs/object_{i}_valid" not in arrays and f"obs/object_{i}_valid" not in (usual or ()):
            fault(name, "missing", f"obs/object_{i}_valid")
    slots = object_slots(arrays)
    if slots != list(range(len(slots))):
        gap = next(i for i in range(len(slots)) if i not in slots)
        fault(name, "missing", f"obs/object_{gap}_pose, below object_{slots[-1]}")
    sound = {}
    for where, array in arrays.items():
        if array.dtype.kind not in "fiub":
            fault(name, "type", f"{where} holds {array.dtype}, no numbers")
            continue
        if array.ndim == 0 or len(array) != length:
            fault(name, "length", f"{where} has {len(array) if array.ndim else 'one value'}, actions {length}")
            continue
        width = required.get(where, -1)
        if where == "obs/time":
            width = 0
        elif where.startswith("obs/object_") and where.endswith("_pose"):
            width = 7
        elif where.startswith("obs/object_") and where.endswith("_valid"):
            width = 1
        elif where == "actions":
            width = ACTIONS.get(embodiment, -1)
        if array.shape != {0: (length,), -1: array.shape}.get(width, (length, width)):
            want = "(T,)" if width == 0 else f"(T, {width})"
            fault(name, "shape", f"{where} is {array.shape}, not {want}")
            continue
        if where == "actions" and array.ndim != 2:
            fault(name, "shape", f"actions is {array.shape}, not (T, a)")
            continue
        sound[where] = array
    return sound


# ---- values ------------------------------------------------------------------------------------------------------


def _each(block: Block, wrong: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """(demonstration, its first wrong frame, number of wrong frames)."""
    rows = np.flatnonzero(wrong)
    if len(rows):
        demo, first, count = np.unique(block.demo[rows], return_index=True, return_counts=True)
        for d, i, n in zip(demo, first, count, strict=True):
            yield int(d), int(rows[i] - block.first[d]), int(n)


def _more(n: int) -> str:
    return f" and {n - 1} more" if n > 1 else ""


def _finite(block: Block, fault) -> None:
    for where, array in block.field.items():
        if array.dtype.kind == "f":
            bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
            for d, frame, n in _each(block, bad):
                fault(block.name[d], "not finite", f"{where}, frame {frame}{_more(n)}")
            if bad.any():
                block.field[where] = _bridged(array)


def _bridged(array: np.ndarray) -> np.ndarray:
    """With numbers where there were none, from the frames around: the other checks have nothing to add there."""
    flat = array.reshape(len(array), -1).copy()
    rows = np.arange(len(flat))
    for column in flat.T:
        good = np.isfinite(column)
        if not good.all():
            column[~good] = np.interp(rows[~good], rows[good], column[good]) if good.any() else 0
    return flat.reshape(array.shape)


def _time(block: Block, fault) -> None:
    time = block.field.get("obs/time")
    if time is None:
        block.period = np.full(len(block.name), 0.04)
        return
    step = np.diff(time, prepend=time[:1]).astype("f8")
    wrong = block.follows & ~(step > 0)
    for d, frame, n in _each(block, wrong):
        row = int(block.first[d]) + frame
        how = "goes back" if step[row] < 0 else "does not advance"
        fault(block.name[d], "time", f"{how} after frame {frame - 1}{_more(n)}")
    wrong_demos = set(block.demo[wrong].tolist())
    block.period = np.ones(len(block.name))
    for d, (first, count) in enumerate(zip(block.first, block.count, strict=True)):
        steps = step[first + 1 : first + count]
        steps = steps[steps > 0]
        if not len(steps):
            continue
        median = block.period[d] = float(np.median(steps))
        attrs = block.attrs[d]
        rate = attrs.get("rate_hz", attrs.get("rate"))
        stated = isinstance(rate, (int, float)) and not isinstance(rate, bool) and rate > 0
        if stated and d not in wrong_demos and abs(rate * median - 1) > RATE_TOLERANCE:
            fault(block.name[d], "rate", f"says {rate:g} Hz, its time goes at {1 / median:.4g} Hz")
        if steps.max() > max(GAP, 10 * median):
            frame = int(np.argmax(step[first : first + count]))
            fault(block.name[d], "time", f"gap of {steps.max():.3g} s before frame {frame}")


def _agent(block: Block) -> tuple[str, np.ndarray] | None:
    """The agent's configuration: what moves in every demonstration."""
    names = agent_fields(block.attrs[0], [n[4:] for n in block.field]) or AGENT_FIELDS["lite6"]
    for name in names:
        array = block.field.get(f"obs/{name}")
        if array is not None and array.dtype.kind == "f":
            return name, array.reshape(len(array), -1)
    return None


def _largest_step(block: Block, x: np.ndarray) -> np.ndarray:
    """(N,) of (N, n): the largest step of a column from the frame before, 0 where there is none."""
    step = np.zeros(len(x))
    step[1:] = np.abs(np.diff(x.astype("f8"), axis=0)).max(axis=1, initial=0)
    step[~block.follows] = 0
    return step


def _keypoint_step(block: Block, x: np.ndarray) -> np.ndarray:
    """(N,) of (N, 3 n): how far the keypoints, those seen in both frames, move at most."""
    move = np.zeros((len(x), x.shape[1] // 3))
    move[1:] = np.linalg.norm(np.diff(x.reshape(len(x), -1, 3), axis=0), axis=2)
    valid = block.field.get("obs/hand_valid")
    if valid is not None and valid.shape == move.shape:
        move[1:][(valid[1:] == 0) | (valid[:-1] == 0)] = 0
    move[~block.follows] = 0
    return move.max(axis=1, initial=0)


def _jumps(step: np.ndarray, period: np.ndarray, floor: float, acceleration: float, speed: float) -> np.ndarray:
    usual = median_filter(step, size=5, mode="nearest")
    lone = step > np.maximum(floor, acceleration * period**2) + NEIGHBOURS * usual
    return lone | (step > np.maximum(speed * period, floor))


def _motion(block: Block, fault) -> None:
    period = block.period[block.demo]
    agent = _agent(block)
    attrs = block.attrs[0]
    radians = attrs.get("joint_units", "rad") == "rad"
    # Every field that holds joints is looked at, whoever the agent is.
    joints = {n for n in ("robot_joint_pos", "object_joint_pos") if f"obs/{n}" in block.field}
    for name in sorted(joints):
        x = block.field[f"obs/{name}"].reshape(len(period), -1)
        if not radians or x.dtype.kind != "f":
            continue
        lite6 = attrs.get("embodiment") == "lite6" and name == "robot_joint_pos"
        most = 2.05 * np.pi if lite6 else 4 * np.pi
        wild = np.zeros(len(block.name), bool)
        for d, frame, _ in _each(block, (np.abs(x) > most).any(axis=1)):
            wild[d] = True
            size = np.abs(x[block.first[d] + frame]).max()
            fault(block.name[d], "unit", f"obs/{name}, frame {frame}: {size:.4g} rad")
        step = _largest_step(block, x)
        limits = (LITE6_STEP, LITE6_ACCELERATION, LITE6_SPEED)
        jump = _jumps(step, period, *(limits if lite6 else (JOINT_STEP, JOINT_ACCELERATION, JOINT_SPEED)))
        jump &= ~wild[block.demo]  # in degrees everything jumps
        for d, frame, n in _each(block, jump):
            size = step[block.first[d] + frame]
            fault(block.name[d], "jump", f"obs/{name}, frame {frame}: {size:.3g} rad in one step{_more(n)}")
    tip = block.field.get("obs/robot_eef_pos")
    if tip is not None and tip.ndim == 2:
        step = _largest_step(block, tip)
        jump = _jumps(step, period, OBJECT_STEP, OBJECT_ACCELERATION, OBJECT_SPEED)
        for d, frame, n in _each(block, jump):
            size = step[block.first[d] + frame]
            fault(block.name[d], "jump", f"obs/robot_eef_pos, frame {frame}: {size:.3g} m in one step{_more(n)}")
    if agent is None:
        return
    name, x = agent
    if name == "hand_keypoints":
        step = _keypoint_step(block, x)
        jump = step > np.maximum(KEYPOINT_STEP, 60.0 * period**2) + NEIGHBOURS * median_filter(step, size=5)
        for d, frame, n in _each(block, jump):
            fault(block.name[d], "jump", f"obs/{name}, frame {frame}: {step[block.first[d] + frame]:.3g} m{_more(n)}")
    step = _largest_step(block, x)
    _doubled(block, name, step, fault)


def _doubled(block: Block, name: str, step: np.ndarray, fault) -> None:
    """A frame that repeats the one before while agent or objects move: on both sides, or without time going on."""
    same = block.follows & (step == 0)
    moved = step.copy()
    for i in object_slots(block.field):
        valid = block.field.get(f"obs/object_{i}_valid")
        pose = block.field[f"obs/object_{i}_pose"]
        change = _largest_step(block, pose) if valid is None else _largest_step(block, pose) * (valid[:, 0] > 0)
        same &= change == 0
        moved = np.maximum(moved, change)
    if not same.any():
        return
    # A frame's typical motion, of the frames that move at all.
    least = np.ones(len(block.name)) * np.inf
    for d in np.unique(block.demo[same]):
        first, count = block.first[d], block.count[d]
        steps = moved[first : first + count]
        steps = steps[steps > 1e-5]
        if 2 * len(steps) > count:
            least[d] = 0.3 * np.median(steps)
    after = np.append(moved[1:], 0)
    after[np.append(~block.follows[1:], True)] = 0
    before = np.append(0, moved[:-1])
    moving = (before > least[block.demo]) & (after > least[block.demo])
    time = block.field.get("obs/time")
    if time is not None:
        moving |= (np.diff(time, prepend=time[:1]) <= 0) & ((before > least[block.demo]) | (after > least[block.demo]))
    for d, frame, n in _each(block, same & moving):
        fault(block.name[d], "doubled", f"frame {frame} repeats the one before, in motion{_more(n)}")


def _gripper(block: Block, fault) -> None:
    gripper = block.field.get("obs/robot_gripper")
    if gripper is None:
        return
    gripper = gripper.reshape(len(gripper), -1)
    if block.attrs[0].get("embodiment") == "lite6":
        odd = ((gripper < -1e-3) | (gripper > 1 + 1e-3)).any(axis=1)
        for d, frame, n in _each(block, odd):
            fault(block.name[d], "range", f"obs/robot_gripper, frame {frame}: not between 0 (open) and 1{_more(n)}")
    low = np.minimum.reduceat(gripper, block.first[block.count > 0]) if len(gripper) else gripper
    high = np.maximum.reduceat(gripper, block.first[block.count > 0]) if len(gripper) else gripper
    for d, still in zip(np.flatnonzero(block.count > 0), (low == high).all(axis=1), strict=True):
        if still and block.count[d] >= GRIPPER_FRAMES and "gripper" not in block.attrs[d]:
            fault(block.name[d], "gripper", f"obs/robot_gripper never moves in {block.count[d]} frames")


def _objects(block: Block, fault, rest: _Rest) -> None:
    period = block.period[block.demo]
    slots = object_slots(block.field)
    for i in slots:
        where = f"obs/object_{i}_pose"
        pose = block.field[where].astype("f8")
        valid = np.ones(len(pose), bool)
        flags = block.field.get(f"obs/object_{i}_valid")
        if flags is not None:
            valid = flags[:, 0] > 0
            for d, frame, _ in _each(block, (flags[:, 0] != 0) & (flags[:, 0] != 1)):
                fault(block.name[d], "range", f"obs/object_{i}_valid, frame {frame}: neither 0 nor 1")
        ever = np.zeros(len(block.name), bool)
        ever[np.unique(block.demo[valid])] = True
        placed = np.abs(pose[:, :3]).max(axis=1) > 0
        for d in np.flatnonzero(~ever & (block.count > 0)):
            # An unused slot has a null pose and no name.
            if placed[block.first[d] : block.first[d] + block.count[d]].any() or _named(block.attrs[d], i):
                fault(block.name[d], "never valid", f"obs/object_{i}_valid: 0 in every frame")
        norm = np.linalg.norm(pose[:, 3:], axis=1)
        off = valid & ~(np.abs(norm - 1) < NORM_TOLERANCE)
        for d, frame, n in _each(block, off):
            size = norm[block.first[d] + frame]
            fault(block.name[d], "quaternion", f"{where}, frame {frame}: norm is {size:.4g}, not 1{_more(n)}")
        far = valid & (np.abs(pose[:, :3]).max(axis=1) > FAR)
        wild = np.zeros(len(block.name), bool)
        for d, frame, n in _each(block, far):
            wild[d] = True
            fault(block.name[d], "unit", f"{where}, frame {frame}: more than {FAR:g} m away{_more(n)}")
        both = valid & block.follows
        both[1:] &= valid[:-1]
        step = np.zeros(len(pose))
        step[1:] = np.linalg.norm(np.diff(pose[:, :3], axis=0), axis=1)
        step[~both] = 0
        jump = both & _jumps(step, period, OBJECT_STEP, OBJECT_ACCELERATION, OBJECT_SPEED)
        for d, frame, n in _each(block, jump & ~wild[block.demo]):
            size = step[block.first[d] + frame]
            fault(block.name[d], "jump", f"{where}, frame {frame}: {size:.3g} m in one step{_more(n)}")
        unit = both & ~off
        unit[1:] &= ~off[:-1]
        turn = np.zeros(len(pose))
        dot = np.abs(np.einsum("ij,ij->i", pose[1:, 3:], pose[:-1, 3:]))
        turn[1:] = 2 * np.arccos(np.clip(dot, 0, 1))
        turn[~unit] = 0
        for d, frame, n in _each(block, unit & _jumps(turn, period, TURN_STEP, TURN_ACCELERATION, TURN_SPEED)):
            size = np.degrees(turn[block.first[d] + frame])
            fault(block.name[d], "jump", f"{where}, frame {frame}: turns {size:.0f} deg in one step{_more(n)}")
        good = valid & ~off
        for d, frame, _ in _each(block, good):
            row = int(block.first[d]) + frame
            q = pose[row : row + 10, 3:][good[row : row + 10] & (block.demo[row : row + 10] == d)]
            q = (q * np.where(q @ q[0] < 0, -1, 1)[:, None]).mean(axis=0)
            rest.demo.append(block.name[d])
            rest.slot.append(i)
            rest.q.append((q / np.linalg.norm(q)).astype("f4"))


def _named(attrs: dict, slot: int) -> bool:
    names = name_list(attrs.get("object_names"))
    return slot < len(names) and bool(names[slot])


def _orders(rest: _Rest, fault) -> None:
    """Things stand upright when a demonstration begins. Numbers that only do so when they are read as x, y, z, w are in
    that order; of one that stands upright either way (no yaw) the other demonstrations tell."""
    if not rest.q:
        return
    q, slots = np.array(rest.q, "f8"), np.array(rest.slot)
    tilt = 2 * np.degrees(np.arcsin(np.clip(np.hypot(q[:, 1], q[:, 2]), 0, 1)))
    swapped = 2 * np.degrees(np.arcsin(np.clip(np.hypot(q[:, 0], q[:, 1]), 0, 1)))
    upside_down = np.abs(q[:, 2]) > 0.985
    wrong = (swapped < 4) & (tilt > 5) & (tilt > 3 * swapped) & ~upside_down
    for slot in np.unique(slots):
        mine = slots == slot
        upright = mine & (tilt < 5) & (swapped > 15)
        if upright.sum() >= 3:
            # Upright, with a yaw beyond 150 deg where the others keep below 45: as x, y, z, w it would be like them.
            calm = (2 * np.degrees(np.arccos(np.clip(np.abs(q[upright, 0]), 0, 1))) < 45).all()
            wrong |= mine & calm & (swapped < 4) & (tilt < 5) & (np.abs(q[:, 3]) > 0.966)
            wrong |= mine & (swapped < 4) & upside_down
        # Things that lie about in any way say nothing.
        if ((tilt < 5) | wrong)[mine].mean() < 0.8:
            wrong &= ~mine
    for k in np.flatnonzero(wrong):
        fault(
            rest.demo[k], "quaternion order",
            f"obs/object_{slots[k]}_pose: stands upright only if read as x, y, z, w",
        )  # fmt: skip
