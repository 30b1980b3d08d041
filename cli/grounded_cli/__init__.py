"""The words: one command a file. A command loads, calls one function, shows, saves."""
