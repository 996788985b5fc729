"""The one exception that reaches the user as a single line."""

from collections.abc import Iterator
from contextlib import contextmanager


class UserError(Exception):
    """What is wrong, which value, what to do: one line. The command line prints it and exits with 1."""


@contextmanager
def as_user_error(*kinds: type[Exception]) -> Iterator[None]:
    """Around a call whose errors of these kinds are about the user's input (loaders raise ValueError, the C++ side
    RuntimeError, with one clear line)."""
    try:
        yield
    except kinds as e:
        raise UserError(str(e)) from e
