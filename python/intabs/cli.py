"""The console script `intabs`. Bad input ends in one line, `intabs <verb>: what, which value, what to do`, and a
non-zero exit; a traceback is a bug of ours.
"""

from __future__ import annotations

import sys

import typer

from intabs import commands
from intabs.errors import UserError

# Found through typer's own class: newer versions carry a click of their own.
_UsageError = typer.BadParameter.__mro__[1]


def _verb(argv: list[str]) -> str:
    words = []
    for word in argv[:2]:
        if word.startswith("-"):
            break
        words.append(word)
    return " ".join(["intabs", *(words if words[:1] == ["data"] else words[:1])])


def run(argv: list[str]) -> int:
    """Exit code of `intabs ARGV...`."""
    app = typer.Typer(
        help="Interaction abstractions: learn skills from demonstrations, play them on an arm.",
        add_completion=False,
        pretty_exceptions_enable=False,
        no_args_is_help=False,
    )

    @app.callback()
    def _root() -> None:
        pass

    commands.register_all(app)
    try:
        result = typer.main.get_command(app).main(args=argv or ["--help"], prog_name="intabs", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except _UsageError as e:
        where = e.ctx.command_path if e.ctx is not None else "intabs"
        message, code = f"{where}: {_one_line(e.format_message())} (see {where} --help)", 2
    except UserError as e:
        message, code = f"{_verb(argv)}: {_one_line(str(e))}", 1
    except OSError as e:
        message, code = f"{_verb(argv)}: {_one_line(str(e))}", 1
    except (KeyboardInterrupt, typer.Abort):
        message, code = f"{_verb(argv)}: interrupted", 130
    print(message, file=sys.stderr)
    return code


def _one_line(text: str) -> str:
    return " ".join(text.split())


def main() -> None:
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
