"""2-D key points of a hand, by MediaPipe in a process and an environment of its own."""

from __future__ import annotations

import contextlib
import struct
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intabs import paths
from intabs.errors import UserError

POINTS = 21
PYTHON = paths.ROOT / ".venv" / "hands" / "bin" / "python"
CURE = "run tools/setup --hands"


@dataclass
class Found:
    uv: np.ndarray  # (21, 2) px, integer = pixel centre
    score: float
    ms: float  # the estimator alone


class MediaPipeHands:
    """with MediaPipeHands() as hands: hands.find(rgb)

    independent: the frames have nothing to do with each other; otherwise a hand found is followed.
    """

    def __init__(self, independent: bool = False):
        if not PYTHON.exists():
            raise UserError(f"MediaPipe's environment is missing: {CURE}")
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        self._worker = subprocess.Popen(
            # -I: nothing of our own environment reaches it.
            [
                PYTHON,
                "-I",
                Path(__file__).with_name("mediapipe_worker.py"),
                "independent" if independent else "sequence",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
        )
        if self._worker.stdout.readline() != b"ready\n":
            self._died("does not start")

    def __enter__(self) -> MediaPipeHands:
        return self

    def __exit__(self, *_exc) -> None:
        with contextlib.suppress(OSError):
            self._worker.stdin.close()
        try:
            self._worker.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._worker.kill()
            self._worker.wait()
        self._worker.stdout.close()
        self._log.close()

    def find(self, rgb: np.ndarray) -> Found | None:
        """The most certain hand of an (H, W, 3) uint8 picture, None: there is none."""
        height, width, _ = rgb.shape
        size = POINTS * 8 + 8
        try:
            self._worker.stdin.write(struct.pack("<ii", width, height) + np.ascontiguousarray(rgb).tobytes())
            self._worker.stdin.flush()
            answer = self._worker.stdout.read(size)
        except OSError:
            answer = b""
        if len(answer) != size:
            self._died("ended")
        uv = np.frombuffer(answer, "<f4", POINTS * 2).reshape(POINTS, 2).astype("f8")
        score, ms = struct.unpack("<ff", answer[-8:])
        return Found(uv, score, ms) if np.isfinite(uv).all() else None

    def _died(self, what: str) -> None:
        self._worker.kill()
        self._worker.wait()
        self._log.seek(0)
        lines = [s for s in self._log.read().decode(errors="replace").splitlines() if s.strip()]
        last = lines[-1] if lines else "it said nothing"
        raise UserError(f"MediaPipe's process {what}: {last}; if it is broken, remove {PYTHON.parents[1]} and {CURE}")
