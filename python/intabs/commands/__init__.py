"""One module a verb. Each has `register(app)`, which adds its command to the typer app, and imports what is heavy
(torch above all) inside the command. A module dropped in here is on the command line; nothing else lists the verbs.
"""

from __future__ import annotations

import importlib
import pkgutil

import typer


def register_all(app: typer.Typer) -> None:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}").register(app)
