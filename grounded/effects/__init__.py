"""Unmodelled effects, one family a file."""
