"""Shared by the commands: arguments and exit status, output, the current folder, a user's module, results."""
