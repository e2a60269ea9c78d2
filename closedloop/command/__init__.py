"""What the commands share: the border to the shell, output, the current folder, a user's module, results."""
