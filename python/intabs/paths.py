"""Where things lie in the source tree."""

import os
from pathlib import Path

from intabs.errors import UserError

ROOT = Path(os.environ.get("INTABS_SOURCE_DIR") or Path(__file__).resolve().parents[2])
MODELS = ROOT / "models"
# ctest names the build it belongs to.
BIN = Path(os.environ.get("INTABS_BIN_DIR") or ROOT / "build" / "release" / "bin")


def program(name: str) -> Path:
    """A C++ program of the build."""
    path = BIN / name
    if not path.exists():
        raise UserError(f"{path} is not built: run tools/setup --runtime-only")
    return path
