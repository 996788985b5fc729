"""Trains InteractionAbstractions. Deterministic for a seed; resumes to the same weights."""

from __future__ import annotations

import atexit
import contextlib
import copy
import hashlib
import json
import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import distributed

from intabs import __version__, _core, paths
from intabs.data.demos import Demo
from intabs.data.reader import DemoFile
from intabs.errors import UserError
from intabs.evaluate.metrics import Scaling, motion_of
from intabs.model.networks import LATENT, InteractionAbstractions, encoder_inputs, phase, phase_basis
from intabs.model.space import Space, State, state_of
from intabs.replay.replay import RETURN
from intabs.train import cutting
from intabs.train.linear import measure, start_linear
from intabs.train.objective import (
    RolloutError,
    action_error,
    held_error,
    kl_between,
    kl_to_standard_normal,
    mean_over,
    near_error,
    pushed,
    termination_error,
)
from intabs.train.windows import Windows, WindowSampler, disturbed, prepare

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CHECKPOINT_EVERY = 500
VALIDATE_EVERY = 250
LOG = "log.jsonl"
RESULT = "result.json"
LOST, LOST_M = 1.0, 0.03  # a rollout so far from the demonstration [deviations of the training split; m] is given up
PUSH_TICKS = 20  # by then a push has faded to a twelfth
CUTS = 0.1  # weight of what `objective.cuts` adds [nat a tick]
CHOICE = 0.02  # of eta's loss for the next skill [nat] beside that for the end of the running one [nat a tick]


def load_config(name_or_file: str, overrides: list[str]) -> dict:
    path = Path(name_or_file)
    if path.suffix not in (".yaml", ".yml"):
        path = CONFIGS / f"{name_or_file}.yaml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in CONFIGS.glob("*.yaml")))
        raise UserError(f"no config {name_or_file!r}; known: {known}, or the path of a .yaml file")
    try:
        config = yaml.safe_load(path.read_text())
    except yaml.YAMLError as e:
        raise UserError(f"{path}: not YAML: {' '.join(str(e).split())}") from None
    if not isinstance(config, dict):
        raise UserError(f"{path}: no settings in it; start from one of {CONFIGS.name}/*.yaml")
    if "base" in config:  # another one with changes
        config = _merged(load_config(config.pop("base"), []), config, path)
    elif missing := missing_settings(config):
        raise UserError(f"{path}: has no {missing}; start from one of {CONFIGS.name}/*.yaml")
    for item in overrides:
        key, sep, value = item.partition("=")
        node = config
        *groups, last = key.split(".")
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if not sep or not isinstance(node, dict) or last not in node:
            raise UserError(f"--set {item}: no such setting; write group.name=value, e.g. train.steps=1000")
        new = yaml.safe_load(value)
        if isinstance(node[last], float) and not isinstance(new, bool):
            with contextlib.suppress(TypeError, ValueError):
                new = float(new)  # an integer, or 3e-3, which YAML takes for text
        if type(new) is not type(node[last]) or (isinstance(new, float) and not math.isfinite(new)):
            raise UserError(f"--set {item}: wants a value like {node[last]}")
        node[last] = new
    least = {("train", "steps"): 1, ("train", "batch"): 1, ("train", "patience"): 0, ("objective", "lead"): 0}
    for (group, key), value in least.items():
        if config[group][key] < value:
            raise UserError(f"{group}.{key} is {config[group][key]}: must be {value} or more")
    return config


def missing_settings(config: dict) -> str:
    """The first of intabs-small's that is not there."""
    for group, settings in yaml.safe_load((CONFIGS / "intabs-small.yaml").read_text()).items():
        if not isinstance(config.get(group), dict):
            return group
        for key in settings:
            if key not in config[group]:
                return f"{group}.{key}"
    return ""


def _merged(base: dict, changes: dict, path: Path) -> dict:
    for key, value in changes.items():
        if key not in base:
            raise UserError(f"{path}: no such setting: {key}")
        base[key] = _merged(base[key], value, path) if isinstance(base[key], dict) else value
    return base


def file_hash(path: Path | str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def code_version() -> str:
    """The package's, and where git knows it the commit, "-dirty" if files differ from it."""
    try:
        command = ["git", "-C", str(paths.ROOT), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return __version__
    if not (paths.ROOT / ".git").exists():  # that of a repository around ours
        return __version__
    return f"{__version__} {done.stdout.strip()}".strip()


def load_space(demos: list[Demo], objects: str = "gripper", rotation: str = "columns") -> Space:
    """Sizes as in these demonstrations; scales not yet fitted."""
    state, command = state_of(demos[0])
    arm = _core.ArmModel.lite6() if command is not None else None
    return Space(state.agent.shape[-1], state.p.shape[-2], state.environment.shape[-1], arm, objects, rotation)


def load_named(path: Path | str, mask: str | None = None) -> tuple[list[Demo], list[str]]:
    with DemoFile(path, mask) as f:
        return [f.demo(k) for k in range(len(f))], list(f.names)


def join_others(device: str) -> tuple[int, int, str]:
    """Rank, number of processes, device: as torchrun says in the environment."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        return 0, 1, device
    if not distributed.is_initialized():
        distributed.init_process_group("nccl" if device == "cuda" else "gloo")
        # gloo's threads may still hold tensors; freeing them while the interpreter ends aborts the process.
        atexit.register(distributed.destroy_process_group)
    return distributed.get_rank(), world, f"cuda:{os.environ['LOCAL_RANK']}" if device == "cuda" else device


def end_together() -> None:
    """Ends the processes that joined, when each has done its work; returns if there is only one. Not by way of the
    interpreter's end: there one of two was aborted after hours of training although it had left the group."""
    if distributed.is_initialized():
        distributed.barrier()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


class _Curves:
    """TensorBoard; and LOG, one line of JSON an entry, which goes with exported weights."""

    def __init__(self, run: Path, step: int):
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(str(run), purge_step=step)
        self.path = run / LOG
        # What an interrupted run wrote after its last checkpoint comes again.
        lines = self.path.read_text().splitlines(keepends=True) if step and self.path.exists() else []
        self.path.write_text(
            "".join(line for line in lines if line.endswith("\n") and json.loads(line)["step"] <= step)
        )

    def add(self, group: str, values: dict, step: int) -> None:
        values = {k: float(v) for k, v in values.items()}
        for k, v in values.items():
            self.writer.add_scalar(f"{group}/{k}", v, step)
        entry = {"step": step, "of": group} | {k: float(f"{v:.5g}") for k, v in values.items()}
        with self.path.open("a") as f:
            print(json.dumps(entry), file=f)

    def close(self) -> None:
        self.writer.close()


class Trainer:
    """Under torchrun several processes share each batch, and train as one does.

    replays: a file of `intabs replay`; those of held-out demonstrations are left out."""

    def __init__(
        self, config: dict, data: Path | str, run: Path | str, seed: int, device: str, replays: Path | str | None = None
    ):
        self.rank, self.world, device = join_others(device)
        config = copy.deepcopy(config)
        if config["train"]["batch"] < self.world:
            raise UserError(f"train.batch is {config['train']['batch']}: fewer windows than processes ({self.world})")
        self.config, self.data, self.run, self.seed, self.device = config, Path(data), Path(run), seed, device
        self.replays = Path(replays) if replays else None
        torch.manual_seed(seed)
        torch.use_deterministic_algorithms(True, warn_only=device != "cpu")
        torch.utils.deterministic.fill_uninitialized_memory = False  # a seventh of the time, and we read none
        train_demos, train_names = load_named(data, "train")
        valid_demos, _ = load_named(data, "valid")
        replayed = load_named(self.replays)[0] if self.replays else []
        replayed = [d for d in replayed if d.attrs.get("source") in train_names]
        if self.replays and not replayed:
            raise UserError(f"{replays}: holds no replays of the demonstrations that {data} trains on")
        if not any(d.object_valid.any() or d.arrays().environment.size for d in train_demos):
            raise UserError(f"{data}: no demonstration shows an object; there is no interaction to learn")
        space = load_space(train_demos, config["model"]["objects"], config["model"]["rotation"])
        space.fit([state_of(d) for d in train_demos + replayed])
        recorded = prepare(train_demos, space, train_names)
        self.scaling = Scaling.fit([motion_of(d.state) for d in recorded])
        o = config["objective"]
        augment = o["augment"]["lite6" if space.arm is not None else "other"]
        train = recorded + prepare(replayed, space, [str(d.attrs["source"]) for d in replayed])
        window, segment = o["window"], tuple(o["segment"])
        shown = {"strangers": o["strangers"], "siblings": o["siblings"]}
        self.sampler = WindowSampler(train, space, window, segment, augment, **shown)
        self.joint_sampler = WindowSampler(train, space, window, segment, augment, **shown)
        valid = prepare(valid_demos, space)
        self.valid = WindowSampler(valid, space, window, segment) if valid else None
        self.rollout_error = RolloutError(self.scaling)
        motion = measure(space, self.sampler, self.rollout_error)
        if config["model"]["latent"] == [0, 0]:
            config["model"]["latent"] = motion.sizes()
        self.model = InteractionAbstractions(config["model"], space)
        start_linear(self.model, motion, o["rollout"])
        self.cutter = cutting.Cutter(self.model) if o["cuts"] in cutting.DRAWN else None
        self.cuts = cutting.Cuts(self.model, [d.state for d in recorded], o, self.cutter)
        self.recorded = recorded
        self.found: dict[str, list[int]] = {}  # where the recordings' skills begin
        if self.cuts.kind == "motion":  # from recordings alone, which stay on the CPU
            self._recut()
        for module in (self.model, self.rollout_error, self.cutter):
            if module is not None:
                module.to(device)
        t = config["train"]
        self.optimizer = torch.optim.AdamW(self._parameters(), lr=t["lr"], weight_decay=t["weight_decay"])
        self.scheduler = torch.optim.lr_scheduler.LambdaLR(self.optimizer, self._rate)
        self.rng = np.random.default_rng(seed)
        self.step = 0
        self.seconds = 0.0
        self.code_version = code_version()
        self.best = (math.inf, 0)  # loss on what is held out, and the step

    def _rate(self, step: int) -> float:
        """Linear warm-up, then half a cosine to 5 %."""
        t = self.config["train"]
        if step < t["warmup"]:
            return (step + 1) / t["warmup"]
        x = (step - t["warmup"]) / max(1, t["steps"] - t["warmup"])
        return 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * min(x, 1.0)))

    def _parameters(self) -> list[torch.nn.Parameter]:
        return [*self.model.parameters(), *(self.cutter.parameters() if self.cutter else [])]

    def _recut(self) -> None:
        """What is found for a recording holds for its replays."""
        self.found = {d.source: self.cuts.of(d.state, d.command).tolist() for d in self.recorded}
        self._use_cuts()

    def _use_cuts(self) -> None:
        if self.found:
            self.joint_sampler.cuts = [d.at(self.found[d.source]) for d in self.joint_sampler.demonstrations]

    def _encode(self, batch: Windows) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log of the standard deviation of z (M, 16) of what the batch shows."""
        space = self.model.space
        shown = (space.features(batch.shown[:, :-1])[0], *space.between(batch.shown[:, :-1], batch.shown[:, 1:]))
        inputs = encoder_inputs(space, shown[0], batch.shown_command, *shown[1:])
        return self.model.encode(*(batch.pieces(x) for x in inputs), batch.within)

    @torch.no_grad()
    def _led_to(self, before: Windows, recorded: State) -> State:
        """Where pi's own rollout through `before` ends, (B, ...); `recorded` where it has lost the thread."""
        z = self._encode(before)[0]
        end = self.model.rollout(before.state[:, 0], z[before.skill], before.age, before.ticks)[0][:, -1]
        joints = self.model.space.joints
        strayed = ((end.agent - recorded.agent) / self.model.space.scale[: end.agent.shape[-1]]).abs()[:, :joints]
        lost = strayed.amax(1) > LOST
        if recorded.p.shape[1]:
            lost |= ((end.p - recorded.p).norm(dim=-1) * recorded.known).amax(1) > LOST_M
            lost |= ((before.state.known[:, 0] != recorded.known) | (before.state.valid[:, 0] != recorded.valid)).any(1)
        return end.either(recorded, ~lost)

    def _loss(
        self, batch: Windows, rng: np.random.Generator | None, joint: bool = False, before: Windows | None = None
    ) -> tuple[torch.Tensor, dict]:
        """rng: of z's noise and of the disturbances pi sees; None: z at its mean, no disturbance. joint: with eta.
        before: rollouts begin where pi has come through these."""
        o, model = self.config["objective"], self.model
        space = model.space
        now, after = batch.state[:, :-1], batch.state[:, 1:]
        state, tip = space.features(now)
        change = space.between(now, after)
        mean, log_std = self._encode(batch)
        z = mean
        if rng is not None:
            of_windows, of_skills = batch.chance(rng)
            noise = of_skills.standard_normal(tuple(mean.shape))
            z = mean + torch.exp(log_std) * torch.from_numpy(noise).to(mean.device)
        terms = {"kl": kl_to_standard_normal(mean, log_std, o["free_bits"])}
        if space.arm is not None:
            if rng is not None:  # what a servo with errors and cameras with errors would say
                state, _ = space.features(disturbed(now, self.config["noise"], of_windows))
            carried = space.carried(now, tip, after.agent[..., : space.joints])
            terms.update(self._on_recorded_states(batch, state, z, *change, carried))

        # pi on its own predictions, which may begin beside the demonstration and are to come back to it.
        start, want = now[:, 0], after
        if before is not None:
            start = self._led_to(before, start)
        elif space.arm is not None and rng is not None:
            push, flip = pushed(batch.state, o["push"], PUSH_TICKS, of_windows)
            agent = torch.cat([start.agent[:, :-1] + push, start.agent[:, -1:] * flip[:, None]], 1)
            start = replace(start, agent=agent)
        push = (start.agent - now.agent[:, 0])[:, None, : space.joints]
        fades = (1 - RETURN) ** torch.arange(1, now.agent.shape[1] + 1, device=push.device)[:, None]
        want = replace(
            after,
            agent=torch.cat([after.agent[..., : space.joints] + push * fades, after.agent[..., space.joints :]], -1),
        )
        rolled, commands = model.rollout(start, z[batch.skill], batch.age, batch.ticks, hard=rng is None)
        groups = self.rollout_error(rolled, want, batch.mask)
        terms.update(zip(("joints", "position", "orientation"), groups, strict=True))
        if space.arm is not None:
            at = torch.cat([start.agent[:, None], rolled.agent[:, :-1]], 1).detach()
            back = RETURN * (now.agent - at)[..., :-1] / space.command_scale[:-1]
            recalled = batch.command + torch.nn.functional.pad(back, (0, 1))
            terms["recall"] = action_error(commands, recalled, batch.mask)
            terms["near"] = near_error(rolled, want, space.arm, batch.mask)
        if joint:
            terms.update(self._eta_terms(batch, state, z, mean, log_std))
            terms.update(self._cut_terms(batch, mean, of_windows))
        loss = (
            terms.get("agent", 0.0)
            + o["recall"] * terms.get("recall", 0.0)
            + o["near"] * terms.get("near", 0.0)
            + o["motion"] * sum(terms.get(k, 0.0) for k in ("environment", "response", "held"))
            + sum(w * g for w, g in zip(o["rollout"], groups, strict=True))
            + o["beta"] * (terms["kl"] + terms.get("kl_eta", 0.0))
            + CUTS * (terms.get("cuts", 0.0) + terms.get("prior", 0.0))
            + o["eta"] * (terms.get("termination", 0.0) + CHOICE * terms.get("choice", 0.0))
        )
        return loss, {k: v.detach() for k, v in terms.items()}

    def _on_recorded_states(self, batch: Windows, state: torch.Tensor, z, response, change, carried) -> dict:
        """pi on the Lite 6's recorded states: its commands, which no kinematic rollout can tell, and all else."""
        seen, carried, change = batch.pieces(state), batch.pieces(carried), batch.pieces(change)
        age = torch.arange(seen.shape[1], device=seen.device, dtype=seen.dtype)[None]
        basis = phase_basis(phase(age, batch.within.sum(1, keepdim=True)))
        y = self.model.pi(self.model.policy_input(seen, z[:, None].expand(-1, seen.shape[1], -1), basis))
        return {
            "agent": action_error(y["agent"], batch.pieces(batch.command), batch.within),
            "response": action_error(y["response"], batch.pieces(response), batch.within),
            "environment": action_error(self.model.change(y, carried), change, batch.within),
            "held": held_error(y["carried"], change, carried, batch.within),
        }

    def _eta_terms(self, batch: Windows, state: torch.Tensor, z, mean, log_std) -> dict:
        """eta runs beside each skill from zero memory, up to the tick in which the next begins."""
        steps = state.shape[1]
        length = batch.within.sum(1).long()
        offset = torch.arange(batch.gather.shape[1] + 1, device=state.device)[None]
        at = batch.gather[:, :1] + torch.minimum(offset, length[:, None])
        row_end = (batch.gather[:, :1] // steps + 1) * steps - 1
        seen = state.flatten(0, 1)[torch.minimum(at, row_end)]
        mask = ((offset < length[:, None]) | ((offset == length[:, None]) & (batch.whole[:, None] > 0))).float()
        mask[:, 0] = 0  # a skill lasts one tick at least
        y = self.model.terminate(seen, z.detach(), offset.expand(len(z), -1).to(seen.dtype))
        begins = (offset == length[:, None]).float()
        terms = {"termination": termination_error(y["b"][..., 0], begins, mask)}
        # What eta would have chosen next, at the tick where it does; skills of a window are neighbours in order.
        first = torch.nonzero(batch.whole)[:, 0]
        chosen = {k: y[k][first, length[first]] for k in ("mean", "log_std")}
        prior = (chosen["mean"], chosen["log_std"].clamp(-4, 2))
        q = (mean[first + 1], log_std[first + 1])
        one = torch.ones_like(first, dtype=mean.dtype)
        terms["choice"] = mean_over(kl_between(*(x.detach() for x in q), *prior), one)  # trains eta
        terms["kl_eta"] = mean_over(kl_between(*q, *(x.detach() for x in prior)), one)  # trains the encoders
        return terms

    def _cut_terms(self, batch: Windows, z: torch.Tensor, chance) -> dict:
        """What the kind of cuts adds to a joint batch [nat a tick]."""
        segment = self.cuts.segment
        if self.cuts.kind == "exact":
            return {"cuts": cutting.exact_error(self.model, batch, segment)}
        if self.cutter is None:
            return {}
        told, z = cutting.Told(self.model, batch), z.detach()
        logit = self.cutter(torch.cat(told.inputs, -1))
        if self.cuts.kind == "gumbel":
            uniform = torch.special.ndtr(torch.from_numpy(chance.standard_normal(tuple(logit.shape)))).to(logit)
            error = cutting.gumbel_error(told, z, logit, uniform, segment)
        else:
            error = cutting.reinforce_error(told, z, logit, segment)
        free = cutting.choices(cutting.begins_of(batch), batch.mask, segment)
        return {"cuts": error, "prior": cutting.prior_error(logit, free)}

    def _drawn(self, batch: Windows) -> Windows:
        """The same windows, cut by the network's draws."""
        with torch.no_grad():
            whole = batch.to(self.device)
            logit = self.cutter.look(self.model, whole).cpu()
        uniform = torch.from_numpy(self.rng.random(tuple(logit.shape), dtype="f4"))
        return batch.recut(cutting.draw(logit, batch.mask, self.cuts.segment, uniform))

    def validate(self) -> dict:
        """Held-out demonstrations, always the same segments, z at its mean, no noise."""
        if self.valid is None:
            return {}
        rng = np.random.default_rng(0)
        self.model.eval()
        sums: dict[str, float] = {}
        with torch.no_grad():
            for _ in range(4):
                loss, terms = self._loss(self.valid.sample(64, rng).to(self.device), None)
                for k, v in {"loss": loss, **terms}.items():
                    sums[k] = sums.get(k, 0.0) + float(v) / 4
        self.model.train()
        return sums

    def one_step(self) -> tuple[torch.Tensor, dict]:
        """One batch, one update."""
        # First skills of all lengths from anywhere; then half of the time those of the learned boundaries, with eta,
        # the other half from where pi has come by itself.
        t = self.config["train"]
        o = self.config["objective"]
        late = self.step >= o["joint_from"] * t["steps"]
        joint = late and self.step % 2 == 0
        sampler = self.joint_sampler if joint else self.sampler
        if joint and self.cuts.kind in ("viterbi", "exact") and (not self.found or self.step % cutting.RECUT == 0):
            self._recut()
        lead = min(o["lead"], sampler.longest_lead) if late and not joint else 0
        lead = int(self.rng.integers(lead + 1)) if lead else 0
        batch = sampler.sample(t["batch"], self.rng, lead)
        if joint and self.cutter:
            batch = self._drawn(batch)
        parts = batch.split(lead) if lead else (None, batch)
        before, ours = (x.share(self.rank, self.world).to(self.device) if x else None for x in parts)
        loss, terms = self._loss(ours, self.rng, joint, before)
        self.optimizer.zero_grad()
        loss.backward()
        if self.world > 1:
            loss = self._average(loss, terms)
        if not torch.isfinite(loss):
            names = ", ".join(dict.fromkeys(batch.names))
            raise UserError(
                f"loss is not finite at step {self.step}, batch of {names}; lower train.lr or look at the data"
            )
        torch.nn.utils.clip_grad_norm_(self._parameters(), self.config["train"]["clip"])
        self.optimizer.step()
        self.scheduler.step()
        self.step += 1
        return loss.detach(), terms

    def _average(self, loss: torch.Tensor, terms: dict) -> torch.Tensor:
        """Gradients, loss and terms over all processes, in place but for the loss, which is returned."""
        grads = [p.grad for p in self._parameters() if p.grad is not None]
        numbers = torch.stack([loss.detach(), *terms.values()])
        flat = torch.cat([g.flatten() for g in grads] + [numbers])
        distributed.all_reduce(flat)
        *parts, numbers = (flat / self.world).split([g.numel() for g in grads] + [len(numbers)])
        for g, part in zip(grads, parts, strict=True):
            g.copy_(part.view_as(g))
        terms.update(zip(terms, numbers[1:], strict=True))
        return numbers[0]

    def train(self, progress=lambda step, text: None) -> dict:
        total, patience = self.config["train"]["steps"], self.config["train"]["patience"]
        if self.step >= total:
            raise UserError(f"{self.run} has {self.step} steps, train.steps is {total}: nothing to do")
        log = _Curves(self.run, self.step) if self.rank == 0 else None
        valid: dict = {}
        loss_value = float("nan")
        began = time.monotonic() - self.seconds
        over = False
        while not over:
            loss, terms = self.one_step()
            self.seconds = time.monotonic() - began
            over = self.step == total
            if self.step % 50 == 0 or over:
                loss_value = loss.item()
                if log:
                    log.add("train", {"loss": loss_value, **terms}, self.step)
                progress(self.step, f"loss {loss_value:.4f}")
            if self.step % VALIDATE_EVERY == 0 or over:
                valid = self.validate()
                if log:
                    log.add("valid", valid, self.step)
                text = ", ".join(f"{k} {v:.4f}" for k, v in valid.items())
                progress(self.step, f"loss {loss_value:.4f}; held out: {text}")
                if patience and valid:
                    over = self._no_better(valid["loss"], patience) or over
            if self.step % CHECKPOINT_EVERY == 0 or over:
                self.save()
        result = {"steps": self.step, "seconds": round(self.seconds, 1), "loss": loss_value, "valid": valid}
        if log:
            log.close()
            if patience and valid:
                result["best_step"], result["best_loss"] = self.best[1], self.best[0]
                if (self.run / "best.pt").exists():  # not where a run that had ended went on and became no better
                    os.replace(self.run / "best.pt", self.path)
            (self.run / RESULT).write_text(json.dumps(result, indent=1))
        return result

    def _no_better(self, loss: float, patience: int) -> bool:
        """Keeps the best so far; whether it has been so for too long."""
        if loss < self.best[0]:
            self.best = (loss, self.step)
            self.save("best.pt")
        return self.step - self.best[1] >= patience * VALIDATE_EVERY

    # --- checkpoints ---------------------------------------------------------------------------------------------
    @property
    def path(self) -> Path:
        return self.run / "checkpoint.pt"

    def save(self, name: str = "checkpoint.pt") -> None:
        if self.rank > 0:
            return
        self.run.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_suffix(".partial")
        torch.save(
            {
                "config": self.config,
                "space": self.model.space.config,
                "data": {
                    "path": str(self.data),
                    "sha256": file_hash(self.data),
                    "replays_path": str(self.replays or ""),
                    "replays_sha256": file_hash(self.replays) if self.replays else "",
                    "replays": len(self.sampler.demonstrations) - len(self.recorded),
                },
                "code_version": self.code_version,
                "seed": self.seed,
                "step": self.step,
                "seconds": self.seconds,
                "best": self.best,
                "model": self.model.state_dict(),
                "cutter": self.cutter.state_dict() if self.cutter else None,
                "cuts": self.found,
                "optimizer": self.optimizer.state_dict(),
                "scheduler": self.scheduler.state_dict(),
                "rng": json.dumps(self.rng.bit_generator.state),
            },
            partial,
        )
        os.replace(partial, self.run / name)

    def resume(self) -> None:
        if not self.path.exists():
            raise UserError(f"{self.path}: nothing to resume; train without --resume first")
        c = load_checkpoint(self.run)
        if c["config"]["model"] | {"latent": sizes_of(c)} != self.config["model"]:
            raise UserError(f"{self.path}: was trained with another model configuration")
        if c["config"]["objective"].get("cuts", "motion") != self.cuts.kind:
            raise UserError(f"{self.path}: was trained with other objective.cuts")
        if c["data"]["sha256"] != file_hash(self.data):
            raise UserError(f"{self.path}: was trained on other data ({c['data']['path']})")
        if c["data"]["replays_sha256"] != (file_hash(self.replays) if self.replays else ""):
            raise UserError(f"{self.path}: was trained with other --replays")
        self.model.load_state_dict(c["model"])
        if self.cutter:
            self.cutter.load_state_dict(c["cutter"])
        self.found = c["cuts"]
        self._use_cuts()
        self.optimizer.load_state_dict(c["optimizer"])
        self.scheduler.load_state_dict(c["scheduler"])
        self.rng.bit_generator.state = json.loads(c["rng"])
        self.step, self.seconds, self.best = c["step"], c["seconds"], c["best"]
        if not c["code_version"].endswith(self.code_version):
            self.code_version = f"{c['code_version']}, then {self.code_version}"


def load_checkpoint(run: Path | str) -> dict:
    path = Path(run) / "checkpoint.pt"
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint; `intabs train --out {run}` makes one")
    return torch.load(path, map_location="cpu", weights_only=True)


def sizes_of(checkpoint: dict) -> list[int]:
    """Numbers of z^r and z^e; checkpoints of before there was a choice do not say them."""
    return checkpoint["config"]["model"].get("latent", [LATENT, LATENT])


def load_model(run: Path | str) -> tuple[InteractionAbstractions, dict]:
    c = load_checkpoint(run)
    model = InteractionAbstractions(c["config"]["model"], Space.from_config(c["space"], _core.ArmModel.lite6()))
    model.load_state_dict(c["model"])
    model.eval()
    return model, c
