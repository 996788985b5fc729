"""Trains InteractionAbstractions by segment pretraining. Deterministic for a seed; resumes to the same weights."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from pathlib import Path

import numpy as np
import torch
import yaml

from intabs import __version__, _core
from intabs.data.demos import load_demos
from intabs.data.features import Normalizer, trajectory
from intabs.errors import UserError
from intabs.model.networks import InteractionAbstractions
from intabs.train.objective import action_error, kl_to_standard_normal
from intabs.train.segments import Segments, SegmentSampler

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CHECKPOINT_EVERY = 500
VALIDATE_EVERY = 250


def load_config(name_or_file: str, overrides: list[str]) -> dict:
    path = Path(name_or_file)
    if path.suffix not in (".yaml", ".yml"):
        path = CONFIGS / f"{name_or_file}.yaml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in CONFIGS.glob("*.yaml")))
        raise UserError(f"no config {name_or_file!r}; known: {known}, or the path of a .yaml file")
    config = yaml.safe_load(path.read_text())
    for item in overrides:
        key, sep, value = item.partition("=")
        node = config
        *groups, last = key.split(".")
        for group in groups:
            node = node.get(group) if isinstance(node, dict) else None
        if not sep or not isinstance(node, dict) or last not in node:
            raise UserError(f"--set {item}: no such setting; write group.name=value, e.g. train.steps=1000")
        new = yaml.safe_load(value)
        if isinstance(node[last], float) and isinstance(new, int) and not isinstance(new, bool):
            new = float(new)
        if type(new) is not type(node[last]):
            raise UserError(f"--set {item}: wants a value like {node[last]}")
        node[last] = new
    for key in ("steps", "batch"):
        if config["train"][key] < 1:
            raise UserError(f"train.{key} is {config['train'][key]}: must be 1 or more")
    return config


def file_hash(path: Path | str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def default_arm():
    return _core.ArmModel.lite6()


class Trainer:
    def __init__(self, config: dict, data: Path | str, run: Path | str, seed: int, device: str):
        self.config, self.data, self.run, self.seed, self.device = config, Path(data), Path(run), seed, device
        torch.manual_seed(seed)
        torch.use_deterministic_algorithms(True, warn_only=device != "cpu")
        arm = default_arm()
        train_demos, self.data_attrs = load_demos(data, "train")
        valid_demos, _ = load_demos(data, "valid")
        train = [trajectory(d, arm) for d in train_demos]
        valid = [trajectory(d, arm) for d in valid_demos]
        self.normalizer = Normalizer.fit(train)
        length = tuple(config["objective"]["segment"])

        def sampler(trajectories):
            normalized = [self.normalizer.normalize(t) for t in trajectories]
            return SegmentSampler(normalized, self.normalizer, arm, length, config["noise"], device)

        self.sampler = sampler(train)
        self.valid = sampler(valid) if valid else None
        self.model = InteractionAbstractions(config["model"]).to(device)
        t = config["train"]
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=t["lr"], weight_decay=t["weight_decay"])
        self.scheduler = torch.optim.lr_scheduler.LambdaLR(self.optimizer, self._rate)
        self.rng = np.random.default_rng(seed)
        self.step = 0
        self.seconds = 0.0

    def _rate(self, step: int) -> float:
        """Linear warm-up, then half a cosine to 5 %."""
        t = self.config["train"]
        if step < t["warmup"]:
            return (step + 1) / t["warmup"]
        x = (step - t["warmup"]) / max(1, t["steps"] - t["warmup"])
        return 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * min(x, 1.0)))

    def _loss(self, batch: Segments, rng: np.random.Generator | None) -> tuple[torch.Tensor, dict]:
        """rng: of z's noise; None takes the mean."""
        mean, log_std = self.model.encode(batch.state, batch.agent_action, batch.environment_action)
        z = mean
        if rng is not None:
            noise = rng.standard_normal(tuple(mean.shape), dtype="f4")
            z = mean + torch.exp(log_std) * torch.from_numpy(noise).to(mean.device)
        agent, environment = self.model.act(batch.seen, z)
        terms = {
            "agent": action_error(agent, batch.agent_action),
            "environment": action_error(environment, batch.environment_action),
            "kl": kl_to_standard_normal(mean, log_std),
        }
        o = self.config["objective"]
        loss = terms["agent"] + o["environment"] * terms["environment"] + o["beta"] * terms["kl"]
        return loss, {k: v.detach() for k, v in terms.items()}

    def validate(self) -> dict:
        """Held-out demonstrations, always the same segments, z at its mean, no noise."""
        if self.valid is None:
            return {}
        rng = np.random.default_rng(0)
        self.model.eval()
        sums: dict[str, float] = {}
        with torch.no_grad():
            for _ in range(4):
                _, terms = self._loss(self.valid.sample(256, rng, noisy=False), None)
                for k, v in terms.items():
                    sums[k] = sums.get(k, 0.0) + float(v) / 4
        self.model.train()
        return sums

    def one_step(self) -> tuple[torch.Tensor, dict]:
        """One batch, one update."""
        batch = self.sampler.sample(self.config["train"]["batch"], self.rng)
        loss, terms = self._loss(batch, self.rng)
        if not torch.isfinite(loss):
            raise UserError(f"loss is not finite at step {self.step}; lower train.lr or look at the data")
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config["train"]["clip"])
        self.optimizer.step()
        self.scheduler.step()
        self.step += 1
        return loss.detach(), terms

    def train(self, progress=lambda step, text: None) -> dict:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(str(self.run), purge_step=self.step)
        total = self.config["train"]["steps"]
        if self.step >= total:
            raise UserError(f"{self.run} has {self.step} steps, train.steps is {total}: nothing to do")
        valid: dict = {}
        loss_value = float("nan")
        began = time.monotonic() - self.seconds
        while self.step < total:
            loss, terms = self.one_step()
            self.seconds = time.monotonic() - began
            if self.step % 50 == 0 or self.step == total:
                loss_value = loss.item()
                writer.add_scalar("train/loss", loss_value, self.step)
                for k, v in terms.items():
                    writer.add_scalar(f"train/{k}", float(v), self.step)
                progress(self.step, f"loss {loss_value:.4f}")
            if self.step % VALIDATE_EVERY == 0 or self.step == total:
                valid = self.validate()
                for k, v in valid.items():
                    writer.add_scalar(f"valid/{k}", v, self.step)
                text = ", ".join(f"{k} {v:.4f}" for k, v in valid.items())
                progress(self.step, f"loss {loss_value:.4f}; held out: {text}")
            if self.step % CHECKPOINT_EVERY == 0 or self.step == total:
                self.save()
        writer.close()
        result = {"steps": self.step, "seconds": round(self.seconds, 1), "loss": loss_value, "valid": valid}
        (self.run / "result.json").write_text(json.dumps(result, indent=1))
        return result

    # --- checkpoints ---------------------------------------------------------------------------------------------
    @property
    def path(self) -> Path:
        return self.run / "checkpoint.pt"

    def save(self) -> None:
        self.run.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_suffix(".partial")
        torch.save(
            {
                "config": self.config,
                "normalizer": self.normalizer.to_dict(),
                "data": {"path": str(self.data), "sha256": file_hash(self.data)},
                "code_version": __version__,
                "seed": self.seed,
                "step": self.step,
                "seconds": self.seconds,
                "model": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "scheduler": self.scheduler.state_dict(),
                "rng": json.dumps(self.rng.bit_generator.state),
            },
            partial,
        )
        os.replace(partial, self.path)

    def resume(self) -> None:
        if not self.path.exists():
            raise UserError(f"{self.path}: nothing to resume; train without --resume first")
        c = load_checkpoint(self.run)
        if c["config"]["model"] != self.config["model"]:
            raise UserError(f"{self.path}: was trained with another model configuration")
        if c["data"]["sha256"] != file_hash(self.data):
            raise UserError(f"{self.path}: was trained on other data ({c['data']['path']})")
        self.model.load_state_dict(c["model"])
        self.optimizer.load_state_dict(c["optimizer"])
        self.scheduler.load_state_dict(c["scheduler"])
        self.rng.bit_generator.state = json.loads(c["rng"])
        self.step, self.seconds = c["step"], c["seconds"]


def load_checkpoint(run: Path | str) -> dict:
    path = Path(run) / "checkpoint.pt"
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint; `intabs train --out {run}` makes one")
    return torch.load(path, map_location="cpu", weights_only=True)


def load_model(run: Path | str) -> tuple[InteractionAbstractions, Normalizer, dict]:
    c = load_checkpoint(run)
    model = InteractionAbstractions(c["config"]["model"])
    model.load_state_dict(c["model"])
    model.eval()
    return model, Normalizer.from_dict(c["normalizer"]), c
