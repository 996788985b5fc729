"""Packages of other people's methods: tools/setup --baselines puts them into .venv/baselines."""

from __future__ import annotations

import importlib.util
import sys
import types

from intabs import paths

FOLDER = paths.ROOT / ".venv" / "baselines"
CURE = "run tools/setup --baselines"


def find(name: str) -> bool:
    """Whether a package can be imported, now that the folder is looked at, too."""
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))
    return importlib.util.find_spec(name) is not None


class _Absent(types.ModuleType):
    __path__: list = []

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


def without_pictures() -> None:
    """robomimic imports torchvision for pictures, of which there are none here; PyPI's torchvision does not load beside
    every build of torch."""
    for name in ("torchvision", "torchvision.transforms", "torchvision.transforms.functional", "torchvision.models"):
        parent, _, child = name.rpartition(".")
        module = sys.modules.setdefault(name, _Absent(name))
        if parent:
            setattr(sys.modules[parent], child, module)
