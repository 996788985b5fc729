"""What a command tells the user while it runs, and the figures it leaves."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path


def write_json(path: Path | str | None, figures: dict) -> None:
    """Writes `figures`; does nothing without a path."""
    if path is None:
        return
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(figures, indent=2) + "\n")


class Progress:
    """A bar on a terminal, otherwise a plain line now and then.

    with Progress("train", total=steps) as progress:
        progress.update(step, f"loss {loss:.3f}")
    """

    LINE_EVERY_S = 5.0

    def __init__(self, name: str, total: float):
        self.name, self.total = name, total
        self._bar = None
        self._last_line = 0.0

    def __enter__(self) -> Progress:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[text]}"),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(self.name, total=self.total, text="")
        return self

    def __exit__(self, *_exc) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: float, text: str = "") -> None:
        """`done` of `total`; `text` says what is going on."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, text=text)
            return
        now = time.monotonic()
        if now - self._last_line >= self.LINE_EVERY_S:
            self._last_line = now
            share = 100 * done / self.total if self.total else 0
            print(f"{self.name}: {share:3.0f} % {text}".rstrip(), file=sys.stderr, flush=True)
