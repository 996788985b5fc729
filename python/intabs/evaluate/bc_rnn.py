"""Beside robomimic's BC-RNN: `tools/bc_rnn`. One policy a task by its own code and its own settings for
low-dimensional observations (Mandlekar et al. 2021: LSTM 2 x 400, GMM head), on the same demonstrations and replays,
the same features of the state and the same 25 Hz; then both in the plant, trial by trial with the same seeds.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import time
from pathlib import Path

import h5py
import numpy as np

from intabs import _core, paths
from intabs.errors import UserError, as_user_error
from intabs.evaluate import packages
from intabs.output import Progress, write_json
from intabs.rollout import UNSEEN, rollout, wilson
from intabs.train.trainer import load_named

TASKS = ("pick_place", "drawer_open", "box_open", "pour", "stir")
LONGER = 1.5  # than the longest demonstration a trial may last
HELD = 50  # ticks for which success must last


def load_robomimic():
    """Its modules (algo, config, dataset, observations). Raises UserError where it is not installed."""
    if not packages.find("robomimic"):
        raise UserError(f"robomimic is not installed: {packages.CURE}")
    packages.without_pictures()
    with contextlib.redirect_stdout(io.StringIO()):  # it misses a file of private settings
        import robomimic.algo
        import robomimic.config
        import robomimic.utils.dataset
        import robomimic.utils.obs_utils

    return robomimic.algo, robomimic.config, robomimic.utils.dataset, robomimic.utils.obs_utils


def states(demo) -> np.ndarray:
    """(T, 59), as pi sees them, not normalised."""
    slots = 4 - demo.object_pose.shape[1]
    pose = np.pad(demo.object_pose, ((0, 0), (0, slots), (0, 0)))
    valid = np.pad(demo.object_valid > 0, ((0, 0), (0, slots)))
    pose[~valid] = (0, 0, 0, 1, 0, 0, 0)
    known = np.maximum.accumulate(valid, axis=0)
    arm = _core.ArmModel.lite6()
    return _core.assemble_states(arm, demo.joint_pos, demo.gripper > 0.5, pose, known, valid)


def write_task(path: Path, data: Path, replays: Path | None, task: str) -> dict:
    """A file for robomimic: training demonstrations of the task and their replays. What a rollout must know."""
    demos, names = load_named(data, "train")
    more = [d for d in load_named(replays)[0] if d.attrs.get("source") in names] if replays else []
    demos = [d for d in [*demos, *more] if d.attrs.get("task") == task]
    if not demos:
        raise UserError(f"{data}: holds no training demonstration of {task}")
    seen = [states(d) for d in demos]
    mean, deviation = np.concatenate(seen).mean(0), np.concatenate(seen).std(0)
    deviation = np.where(deviation > 1e-4, deviation, 1.0)
    actions = [d.actions[:, :7].astype("f4") for d in demos]
    scale = np.abs(np.concatenate(actions)).max(0).clip(1e-4)
    with h5py.File(path, "w") as f:
        for i, (s, a) in enumerate(zip(seen, actions, strict=True)):
            group = f.create_group(f"data/demo_{i}")
            group.attrs["num_samples"] = len(s)
            group["obs/state"] = ((s - mean) / deviation).clip(-5, 5).astype("f4")
            group["actions"] = (a / scale).astype("f4")
    longest = max(len(s) for s in seen)
    numbers = {"mean": mean, "deviation": deviation, "scale": scale}
    return {"longest": longest, "demos": len(demos), **{k: v.astype(float).tolist() for k, v in numbers.items()}}


def make_policy(learning_rate: float):
    """robomimic's BC_RNN_GMM on observations `state`."""
    algo, config, _, obs = load_robomimic()
    c = config.config_factory("bc")
    with c.values_unlocked():
        c.observation.modalities.obs.low_dim = ["state"]
        c.algo.gmm.enabled = c.algo.rnn.enabled = True
        c.algo.actor_layer_dims = ()
        c.algo.optim_params.policy.learning_rate.initial = learning_rate
        c.train.seq_length = c.algo.rnn.horizon
    with contextlib.redirect_stdout(io.StringIO()):  # it tells what it has none of
        obs.initialize_obs_utils_with_config(c)
    return c, algo.algo_factory("bc", c, obs_key_shapes={"state": [_core.STATE_DIM]}, ac_dim=7, device="cpu")


def train_task(out: Path, data: Path, replays: Path | None, task: str, minutes: float, learning_rate: float) -> None:
    import torch

    if (out / "policy.pt").exists():
        return
    out.mkdir(parents=True, exist_ok=True)
    about = write_task(out / "data.hdf5", data, replays, task)
    torch.manual_seed(0)
    c, policy = make_policy(learning_rate)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        dataset = load_robomimic()[2].SequenceDataset(
            str(out / "data.hdf5"), obs_keys=("state",), dataset_keys=("actions",), seq_length=c.train.seq_length,
            hdf5_cache_mode="all", load_next_obs=False,
        )  # fmt: skip
    loader = torch.utils.data.DataLoader(dataset, batch_size=100, shuffle=True, drop_last=True)
    policy.set_train()
    began, steps, losses = time.monotonic(), 0, []
    with Progress(f"robomimic BC-RNN, {task}", total=int(60 * minutes)) as progress:
        while (spent := time.monotonic() - began) < 60 * minutes:
            for batch in loader:
                info = policy.train_on_batch(policy.process_batch_for_training(batch), epoch=0)
                losses.append(float(info["losses"]["action_loss"]))
                steps += 1
                if steps % 50 == 0:
                    progress.update(int(spent), f"{steps} steps, loss {np.mean(losses[-200:]):.2f}")
                if (spent := time.monotonic() - began) >= 60 * minutes:
                    break
    about |= {"task": task, "steps": steps, "minutes": minutes, "loss": float(np.mean(losses[-200:])),
              "learning_rate": learning_rate}  # fmt: skip
    (out / "about.json").write_text(json.dumps(about))
    torch.save(policy.serialize(), out / "policy.pt")


def run_policy(out: Path, task: str, trials: int, spread: float) -> list[bool]:
    """Closed loop in the plant, truth, seeds as `intabs rollout` has them. Success is what lasts for HELD ticks. What
    was run before is kept."""
    import torch

    kept = out / f"{spread:g}cm.json"
    if kept.exists() and len(json.loads(kept.read_text())) >= trials:
        return json.loads(kept.read_text())[:trials]

    about = json.loads((out / "about.json").read_text())
    _, policy = make_policy(about["learning_rate"])
    policy.deserialize(torch.load(out / "policy.pt", weights_only=True))
    policy.set_eval()
    mean, deviation, scale = (np.array(about[k]) for k in ("mean", "deviation", "scale"))
    arm, session, done = _core.ArmModel.lite6(), _core.Session(str(paths.MODELS), task, ""), []
    with Progress(f"rollout of BC-RNN, {task}", total=trials) as progress:
        for trial in range(trials):
            session.reset(UNSEEN + trial, spread)
            policy.reset()
            o = session.observe()
            target, known, lasted = np.array(o["q_commanded"]), np.zeros(4, bool), 0
            for _ in range(int(LONGER * about["longest"])):
                o = session.observe()
                valid = np.asarray(o["object_valid"], bool)
                known |= valid
                pose = np.where(known[:, None], np.asarray(o["object_pose"]), [0, 0, 0, 1, 0, 0, 0])
                closed = np.array([bool(o["gripper_closed"])])
                s = _core.assemble_states(arm, np.asarray(o["q"])[None], closed, pose[None], known[None], valid[None])
                x = torch.from_numpy(((s - mean) / deviation).clip(-5, 5).astype("f4"))
                with torch.no_grad():
                    action = policy.get_action({"state": x})[0].numpy() * scale
                target = target + action[:6]
                session.command(target, bool(action[6] > 0))
                lasted = lasted + 1 if session.success else 0
                if lasted == HELD:
                    break
            done.append(lasted == HELD or bool(session.success))
            progress.update(trial + 1, f"{sum(done)} of {len(done)} succeeded")
    kept.write_text(json.dumps(done))
    return done


def mcnemar(ours: list[bool], theirs: list[bool]) -> tuple[int, int, float]:
    """Trials that only we, only they did, and the exact two-sided p of so uneven a split."""
    from scipy.stats import binomtest

    a = sum(x and not y for x, y in zip(ours, theirs, strict=True))
    b = sum(y and not x for x, y in zip(ours, theirs, strict=True))
    return a, b, float(binomtest(a, a + b).pvalue) if a + b else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(prog="tools/bc_rnn", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="demonstrations, as `intabs collect` writes them")
    parser.add_argument("--replays", type=Path, help="as for `intabs train`")
    parser.add_argument("--out", type=Path, default=Path("runs/bc_rnn"), help="policies are kept and taken up there")
    parser.add_argument("--weights", default="lite6", help="ours: a name in models/weights, or a folder")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--minutes", type=float, default=10, help="of training a task")
    parser.add_argument("--learning-rate", type=float, default=1e-3, help="robomimic's own 1e-4 is for longer training")
    parser.add_argument("--trials", type=int, default=40, help="a task")
    parser.add_argument("--spread", type=float, default=5.0, help="cm")
    parser.add_argument("--json", type=Path, help="write the figures there")
    a = parser.parse_args()
    try:
        load_robomimic()
        figures, ours, theirs = {}, [], []
        with as_user_error(RuntimeError, ValueError):
            for task in a.tasks:
                train_task(a.out / task, a.data, a.replays, task, a.minutes, a.learning_rate)
            for task in a.tasks:
                report = a.out / task / f"{Path(a.weights).name}_{a.spread:g}cm"
                with Progress(f"rollout of ours, {task}", total=a.trials) as progress:
                    rollout(
                        task, a.trials, a.spread, a.weights, "truth", report=report, resume=True,
                        progress=progress.update,
                    )  # fmt: skip
                lines = [json.loads(x) for x in (report / "trials.jsonl").read_text().splitlines()[1:]]
                good = {x["trial"]: bool(x["success"]) for x in lines}
                ours.append([good[i] for i in range(a.trials)])
                theirs.append(run_policy(a.out / task, task, a.trials, a.spread))
                figures[task] = [sum(ours[-1]), sum(theirs[-1])]
        pooled = [[x for row in rows for x in row] for rows in (ours, theirs)]
        only_ours, only_theirs, p = mcnemar(*pooled)
        n = len(pooled[0])
        print(f"success at {a.spread:g} cm, {a.trials} trials a task: ours, BC-RNN")
        for task, (x, y) in figures.items():
            print(f"  {task}: {x}, {y}")
        for name, row in zip(("ours", "BC-RNN"), pooled, strict=True):
            low, high = wilson(sum(row), n)
            print(f"  pooled, {name}: {sum(row)} of {n} ({low:.2f} to {high:.2f})")
        print(f"  only ours {only_ours}, only BC-RNN {only_theirs}: McNemar's exact p = {p:.2g}")
        write_json(a.json, {"tasks": figures, "n": n, "pooled": [sum(x) for x in pooled], "p": p})
    except UserError as e:
        print(f"tools/bc_rnn: {e}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
