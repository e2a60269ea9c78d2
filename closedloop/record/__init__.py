"""The run and its file."""
