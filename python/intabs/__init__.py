"""Interaction abstractions: demonstrations in, skills out, the arm moves. `intabs --help` says what it does."""

__version__ = "0.1.0"
