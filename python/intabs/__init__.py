"""Interaction abstractions: demonstrations in, skills out, the arm moves. `intabs --help` says what it does."""
