"""LeRobot v2.0, v2.1 (a parquet an episode) and v3.0 (episodes one after the other in larger parquets). A folder with
meta/info.json. Videos are named, not read."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from intabs.data.demos import Demo
from intabs.data.importers import Options, Recording, finite_matrix, joints_in_radians, velocities
from intabs.data.resample import steps_of
from intabs.errors import UserError

STATE, ACTION, ENVIRONMENT = "observation.state", "action", "observation.environment_state"


def _parquet():
    try:
        import pyarrow.parquet
    except ImportError:
        raise UserError("LeRobot's files are parquet: pip install pyarrow (part of the extra 'train')") from None
    return pyarrow.parquet


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except UserError:
        raise
    except Exception as e:  # pyarrow's own, and Python's for columns of another type
        raise UserError(f"{path}: missing, damaged or of another layout ({type(e).__name__}: {e})") from None


def read(source: Path, options: Options) -> Recording:
    _parquet()
    info = _json(source / "meta/info.json", source)
    version = str(info.get("codebase_version", ""))
    if not version.startswith(("v2.", "v3.")):
        raise UserError(f"{source}: LeRobot {version or 'of no version'}: v2.0, v2.1 and v3.0 are read")
    features = info.get("features")
    if not isinstance(features, dict) or STATE not in features:
        raise UserError(f"{source}: meta/info.json names no feature {STATE}")
    with _reading(source / "meta"):
        rate = float(options.source_rate_hz or info["fps"])
        width = int(np.prod(features[STATE]["shape"], dtype=int))
        names = _flat(features[STATE].get("names"))
        videos = [n for n, f in features.items() if f.get("dtype") in ("video", "image")]
        v3 = version.startswith("v3.")
        tasks = _tasks(source, v3)
        episodes = _episodes_v3(source, info) if v3 else _episodes_v2(source, info)
    options.say(f"format: LeRobot {version}; rate of the meta: {rate:g} Hz")
    what = {"rad": "rad (not stated in the meta; plausible)", "deg": "degrees, turned to rad", "none": "as is"}
    options.say(f"units of the joints: {what[options.units]}; no object poses in this format")
    if videos:
        options.say(f"videos left out: {', '.join(videos)}")
    stated = info.get("total_episodes")
    if stated is not None and stated != len(episodes):
        options.say(f"the meta says {stated} episodes, the files hold {len(episodes)}")
    attrs = {
        "embodiment": str(info.get("robot_type") or "unknown").lower(),
        "agent_fields": ["robot_joint_pos"],
        "joint_names": names,
        "joint_units": options.units if options.units == "none" else "rad",
    }
    return Recording(_demos(episodes, rate, width, tasks, options), len(episodes), attrs, width)


def _json(path: Path, source: Path) -> dict:
    if not path.is_file():
        raise UserError(f"{source}: no {path.relative_to(source)}: not a folder of LeRobot")
    with _reading(path):
        value = json.loads(path.read_text())
    if not isinstance(value, dict):
        raise UserError(f"{path}: not an object of JSON")
    return value


def _flat(names) -> list[str]:
    if isinstance(names, dict):
        names = list(names.values())
    out = []
    for n in names or []:
        out += _flat(n) if isinstance(n, (list, dict)) else [str(n)]
    return out


def _tasks(source: Path, v3: bool) -> dict[int, str]:
    if v3:
        path = source / "meta/tasks.parquet"
        if not path.is_file():
            return {}
        table = _parquet().read_table(path).to_pydict()
        text = next((v for k, v in table.items() if k != "task_index"), [])
        return dict(zip(table["task_index"], map(str, text), strict=True))
    path = source / "meta/tasks.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines() if line.strip()] if path.is_file() else []
    return {int(r["task_index"]): str(r["task"]) for r in rows}


# An episode: its parquet, the first row and the number of rows (None: to the end), its task's text if the meta says it.
Episode = tuple[Path, int, int | None, str | None]


def _episodes_v2(source: Path, info: dict) -> list[Episode]:
    path = source / "meta/episodes.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
    beside = {p.name: p for p in sorted((source / "data").rglob("episode_*.parquet"))}
    out = []
    for r in sorted(rows, key=lambda r: r["episode_index"]):
        k = int(r["episode_index"])
        at = source / str(info["data_path"]).format(episode_chunk=k // int(info["chunks_size"]), episode_index=k)
        # Some copies leave the chunk's folder out.
        at = at if at.is_file() else beside.get(f"episode_{k:06d}.parquet", at)
        text = r.get("tasks") or [None]
        out.append((at, 0, int(r["length"]), text[0]))
    return out


def _episodes_v3(source: Path, info: dict) -> list[Episode]:
    rows = []
    for path in sorted((source / "meta/episodes").rglob("*.parquet")):
        columns = [c for c in _parquet().read_schema(path).names if not c.startswith(("stats/", "videos/"))]
        rows += _parquet().read_table(path, columns=columns).to_pylist()
    if not rows:
        raise UserError(f"{source}: meta/episodes holds no episode")
    out, first = [], {}
    for r in sorted(rows, key=lambda r: r["episode_index"]):
        at = source / str(info["data_path"]).format(
            chunk_index=int(r["data/chunk_index"]), file_index=int(r["data/file_index"])
        )
        # dataset_from_index counts from the beginning of the set; rows of a file from its own.
        begin = first.setdefault(at, int(r["dataset_from_index"]))
        text = r.get("tasks") or [None]
        out.append((at, int(r["dataset_from_index"]) - begin, int(r["length"]), text[0]))
    return out


def _demos(episodes: list[Episode], rate: float, width: int, tasks: dict, options: Options) -> Iterator[Demo]:
    held: tuple[Path, object] | None = None
    for k, (path, first, length, text) in enumerate(episodes):
        with _reading(path):
            if held is None or held[0] != path:
                held = (path, _parquet().read_table(path))
            table = held[1].slice(first, length)
            if length is not None and table.num_rows != length:
                raise UserError(f"{path}: episode {k} has {table.num_rows} frames, the meta says {length}")
            if "episode_index" in table.column_names and len(set(table["episode_index"].to_pylist())) > 1:
                raise UserError(f"{path}: the rows of episode {k} belong to several episodes")
            state = _matrix(table, STATE, path, k, width)
            task = table["task_index"][0].as_py() if "task_index" in table.column_names else None
            stamp = table["timestamp"].to_numpy() if "timestamp" in table.column_names else None
        # Stamps are single precision; the rate says the same without the rounding. Where they disagree they count.
        time = np.arange(len(state)) / rate
        if stamp is not None:
            stamp = np.asarray(stamp, float) - float(stamp[0])
            time = time if np.abs(stamp - time).max() < 0.25 / rate else stamp
        joint = joints_in_radians(state, options, f"{path}: {STATE}")
        obs, extra = {}, {}
        if ENVIRONMENT in table.column_names:
            obs["environment_state"] = _matrix(table, ENVIRONMENT, path, k)
        if ACTION in table.column_names:
            extra["source_actions"] = _matrix(table, ACTION, path, k)
        yield Demo(
            time=time,
            joint_pos=joint,
            joint_vel=velocities(joint, time),
            gripper=None,
            object_pose=np.zeros((len(joint), 0, 7)),
            object_valid=np.zeros((len(joint), 0), bool),
            actions=steps_of(joint, None),
            attrs={"task": text or tasks.get(task, "unknown"), "source": path.name, "rate_hz": rate},
            obs=obs,
            extra=extra,
        )


def _matrix(table, column: str, path: Path, k: int, width: int | None = None) -> np.ndarray:
    with _reading(path):
        import pyarrow
        import pyarrow.compute

        rows = table[column].combine_chunks()
        if pyarrow.types.is_list(rows.type) or pyarrow.types.is_fixed_size_list(rows.type):
            if len(pyarrow.compute.unique(pyarrow.compute.list_value_length(rows))) != 1:
                raise UserError(f"{path}: {column} of episode {k} is not of one width")
            rows = rows.flatten()
        value = rows.to_numpy(zero_copy_only=False).reshape(table.num_rows, -1)
    return finite_matrix(value, f"{path}: {column} of episode {k}", width)
